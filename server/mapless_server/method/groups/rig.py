"""The pose of a rig: several cameras that are fixed to each other, each with a photograph of the same moment.

A pose is estimated from the matches of all photographs (generalized PnP), also if none of them could be localized
alone; then matches are searched near the projected points, and everything is adjusted together.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from mapless.geometry import Array, RigidTransform, cross_matrix

from ..bundle.priors import PriorCheck
from ..bundle.shutter import MotionPrior, row_times
from ..features.limits import MIN_INLIERS
from ..optim.optimize import covariance_in_world, perturbed, pose_jacobian
from ..options import LocalizeOptions
from ..pose.generalized import inlier_count, rig_ransac
from ..pose.pnp import PnpOptions
from ..rejection import Rejection, RejectionReason
from .images import (
    GroupImage,
    MatchedImage,
    PosedImage,
    group_gate_failure,
    matched_images_of,
    priors_of,
    rejection_without_matches,
    too_few_matches,
)
from .joint import adjust_in_rounds
from .problem import GroupState
from .trust import trust_of_group

PNP = PnpOptions()
"""Options of the pose solver; `MIN_MATCHES` holds for all cameras together."""


@dataclass(frozen=True, eq=False)
class RigEstimate:
    """The estimated pose of a rig.

    Attributes:
        world_from_rig: the metric pose.
        covariance: (6, 6) of the pose, order x y z rx ry rz, fixed world axes, metres and radians.
        matched: the images that have matches, in order, in the world of the group.
        trust: 0 to 1, see `judge`.
        prior_checks: comparisons with the photographs' priors, by the photographs' index.
    """

    world_from_rig: RigidTransform
    covariance: Array
    matched: tuple[PosedImage, ...]
    trust: float = 1.0
    prior_checks: Mapping[int, tuple[PriorCheck, ...]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class RigState(GroupState):
    """The pose of a rig, which has no cost. Its parameters are a left perturbation (v, w) of rig_from_world."""

    rig_from_world: RigidTransform
    rig_from_camera: tuple[RigidTransform, ...]

    @property
    def size(self) -> int:
        """See GroupState."""
        return 6

    def camera_from_world(self, image: int) -> RigidTransform:
        """See GroupState."""
        return self.rig_from_camera[image].inverse().compose(self.rig_from_world)

    def jacobian(self, image: int) -> Array:
        """The adjoint of the camera's `camera_from_rig`."""
        camera_from_rig = self.rig_from_camera[image].inverse()
        rotation = camera_from_rig.rotation
        lever = cross_matrix(camera_from_rig.translation) @ rotation
        return np.block([[rotation, lever], [np.zeros((3, 3)), rotation]])

    def moved(self, step: Array) -> "RigState":
        """See GroupState."""
        return RigState(perturbed(self.rig_from_world, step), self.rig_from_camera)


def solve_rig(
    images: Sequence[GroupImage], rig_from_camera: Sequence[RigidTransform], coverage: float = LocalizeOptions.coverage
) -> RigEstimate | Rejection:
    """Estimates the pose of a rig from the photograph of each camera, with its own answer and metric pose in the rig.

    The coverage is the share of right answers that are accepted.

    A rejection is that of the image that reached the latest stage, if none has matches; TOO_FEW_MATCHES; PNP_FAILED if
    no pose has four inliers; or GATE.
    """
    matched_images = matched_images_of(images)
    if not matched_images:
        return rejection_without_matches(images)
    if few := too_few_matches(matched_images, "images"):
        return few
    origin = matched_images[0].origin
    start = _start(matched_images, rig_from_camera)
    if isinstance(start, Rejection):
        return start
    state = RigState(start.inverse(), tuple(rig_from_camera))
    estimate = adjust_in_rounds(matched_images, state, priors_of(images, origin))
    if estimate.inlier_count < MIN_INLIERS:
        return Rejection(RejectionReason.PNP_FAILED, "no pose of the rig explains four matches")
    if failure := group_gate_failure(estimate.matched):
        return Rejection(RejectionReason.GATE, failure)
    trust, doubt = trust_of_group(estimate.matched, coverage)
    if doubt:
        return doubt
    world_from_rig = estimate.state.rig_from_world.inverse()
    covariance = covariance_in_world(estimate.covariance, world_from_rig) + _by_motion(estimate.matched, estimate.state)
    return RigEstimate(world_from_rig.shifted(origin), covariance, estimate.matched, trust, estimate.prior_checks)


def _by_motion(matched: Sequence[PosedImage], state: RigState) -> Array:
    """The part (6, 6) of a rig's covariance by its motion while rolling shutters read, which is one for all cameras."""
    world_from_rig, by_motion = state.rig_from_world.inverse(), list[Array]()
    for it in matched:
        if it.source.motion_covariance is not None:
            to_rig = np.eye(6)
            to_rig[:3, 3:] = -cross_matrix(world_from_rig.translation - it.world_from_camera.translation)
            by_motion.append(to_rig @ it.source.motion_covariance @ to_rig.T)
    return np.asarray(np.mean(by_motion, axis=0)) if by_motion else _by_unseen_motion(matched, state)


def _by_unseen_motion(matched: Sequence[PosedImage], state: RigState) -> Array:
    """The same where no photograph is localized alone, so that none shows the motion: by all of its prior.

    To first order keypoints are moved by the share of the read-out at which their row was read; see `bundle.shutter`.
    """
    information, cross, spread = (np.zeros((6, 6)) for _ in range(3))
    for it in matched:
        x_in_world = it.source.structure.x_in_world[it.matches.point[it.inliers]]
        if not len(x_in_world):
            continue
        x_in_camera, camera_from_rig = it.world_from_camera.inverse().apply(x_in_world), state.jacobian(it.source.image)
        by_rig = np.einsum("aim,ij->ajm", pose_jacobian(it.source.query.camera, x_in_camera), camera_from_rig)
        information += np.einsum("aim,ajm->ij", by_rig, by_rig)
        if it.source.shutter is not None:
            time = row_times(it.source.query, it.source.shutter)[it.matches.keypoint[it.inliers]]
            cross += np.einsum("aim,ajm->ij", by_rig, by_rig * time)
            prior = MotionPrior.of(it.source.shutter, float(np.median(x_in_camera[:, 2])))
            spread = np.maximum(spread, prior.spread)
    by_motion = np.linalg.pinv(information, hermitian=True) @ cross
    return covariance_in_world(by_motion @ spread @ by_motion.T, state.rig_from_world.inverse())


def _start(
    matched_images: Sequence[MatchedImage], rig_from_camera: Sequence[RigidTransform]
) -> RigidTransform | Rejection:
    """Returns the pose with most inliers, from generalized PnP or from the own pose of an image."""
    cameras = [it.camera_matches(rig_from_camera[it.image]) for it in matched_images]
    found = rig_ransac(cameras, PNP)
    candidates = [] if found is None else [found]
    candidates += [
        it.own_pose.compose(rig_from_camera[it.image].inverse()) for it in matched_images if it.own_pose is not None
    ]
    counts = [inlier_count(cameras, pose, PNP.inlier_px) for pose in candidates]
    if max(counts, default=0) < MIN_INLIERS:
        message = f"no pose of the rig explains more than {max(counts, default=0)} of {sum(map(len, cameras))} matches"
        return Rejection(RejectionReason.PNP_FAILED, message)
    return candidates[int(np.argmax(counts))]
