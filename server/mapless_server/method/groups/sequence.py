"""The poses of a short sequence: photographs of one camera with the poses that the device tracked.

Four steps: jumps of the tracking are found where photographs are localized alone (see `jumps`), and cut the sequence
into parts; every frame gets an initial pose (see `start`); a joint adjustment with a switch on each tracked step (see
`drift`); and the last frames are checked against the result.

So drift does not affect frames with good matches, and accurate tracking poses those without. A frame is never posed
across a step that the photographs contradict: the last frame's part is answered, if its own photographs localize it.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from mapless.geometry import Array, RigidTransform, Similarity

from ..bundle.priors import PriorCheck, Priors
from ..features.limits import INEXACT_INLIER_PX, MIN_INLIERS
from ..optim.optimize import covariance_in_world
from ..options import LocalizeOptions
from ..rejection import Rejection, RejectionReason
from .drift import SequenceState, world_from_session_at
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
from .joint import JointEstimate, adjust_in_rounds
from .jumps import Jump
from .start import Session, Start
from .trust import trust_of_group

SHOULD_SHOW, LEAST_NEAR = 15, 3
"""The last photograph, not localized alone, contradicts the pose that it is tracked to if so many points should be
visible, or are matched, and fewer of its matches are near them, within `INEXACT_INLIER_PX` and three standard
deviations of the pose. Evidence: group-sequences."""

INDEPENDENT = 2.0
"""Photographs of a sequence count as at most so many independent ones in the covariance of a pose: they share
references, and with them points and their errors. Evidence: group-sequences."""

MAX_SCALE_SIGMA = 0.15
"""Largest relative standard deviation of an accepted scale."""


@dataclass(frozen=True, eq=False)
class SequenceEstimate:
    """The estimated poses of a sequence.

    Attributes:
        world_from_session: transform at the last frame, from the session's unit to metres.
        scale_sigma: relative standard deviation of its scale; 0 where the session is metric.
        world_from_camera: metric pose of every frame, corrected for drift and jumps.
        covariances: (F, 6, 6) of these poses, order x y z rx ry rz, fixed world axes, metres and radians.
        matched: the frames that have matches, in order, in the world of the group.
        jumps: jumps of the tracking, in order.
        trust: 0 to 1, see `judge`; of the frames since the last jump.
        prior_checks: comparisons with the frames' priors, by the frames' index.
    """

    world_from_session: Similarity
    scale_sigma: float
    world_from_camera: tuple[RigidTransform, ...]
    covariances: Array
    matched: tuple[PosedImage, ...]
    jumps: tuple[Jump, ...] = ()
    trust: float = 1.0
    prior_checks: Mapping[int, tuple[PriorCheck, ...]] = field(default_factory=dict)


def solve_sequence(
    images: Sequence[GroupImage],
    session_from_camera: Sequence[RigidTransform],
    estimate_scale: bool,
    coverage: float = LocalizeOptions.coverage,
    unit: str = "m",
) -> SequenceEstimate | Rejection:
    """Estimates the poses of a sequence: frames in the order they were taken, with their own answers and tracked poses.

    If the scale is not to be estimated, the session's unit is the scene's. The coverage is the share of right answers
    that are accepted; `unit` is the scene's unit of length, in messages. A rejection is that of the frame that reached
    the latest stage, if none has matches; TOO_FEW_MATCHES; PNP_FAILED if no poses have four inliers; SCALE_UNRELIABLE
    if the scale is unknown and the session moves too little to determine it, or jumps; or GATE, also if the tracking
    jumps and the frames after it are not localized.
    """
    matched_images = matched_images_of(images)
    if not matched_images:
        return rejection_without_matches(images)
    origin = matched_images[0].origin
    session = Session(tuple(session_from_camera), estimate_scale, priors_of(images, origin), unit)
    if estimate_scale and not session.moves:
        return Rejection(RejectionReason.SCALE_UNRELIABLE, "the session does not move: its unit cannot be determined")
    if few := too_few_matches(matched_images, "frames"):
        return few
    found = _estimated(matched_images, session)
    if isinstance(found, Rejection):
        return found
    start, estimate = found
    if last := _last_contradicted(estimate, len(images)):
        posed = _posed_by_themselves(images, matched_images, session, last, coverage)
        if isinstance(posed, Rejection):
            return posed
        found = _estimated(posed, session)
        if isinstance(found, Rejection):
            return found
        start, estimate = found
    since_jump = max(start.cut, default=-1) + 1
    last_part = [it for it in estimate.matched if it.source.image >= since_jump]
    trust, rejection = _judged(estimate, last_part, coverage)
    if rejection is not None:
        cut = [it.described(unit) for it in start.jumps]
        return replace(rejection, message="; ".join([*cut, rejection.message]))
    return _result(estimate, start, session, origin, trust)


def _estimated(
    matched_images: Sequence[MatchedImage], session: Session
) -> tuple[Start, JointEstimate[SequenceState]] | Rejection:
    """Finds initial poses and adjusts them jointly."""
    start = session.start(matched_images)
    if isinstance(start, Rejection):
        return start
    state = SequenceState.of(start.poses, session.frames, start.scale, session.scale_is_free, start.cut)
    return start, adjust_in_rounds(matched_images, state, session.priors)


def _judged(
    estimate: JointEstimate[SequenceState], last_part: Sequence[PosedImage], coverage: float
) -> tuple[float, Rejection | None]:
    """The trust in the photographs since the last jump; a rejection if they, or the scale, do not support the poses."""
    if sum(int(it.inliers.sum()) for it in last_part) < MIN_INLIERS:
        return 0.0, Rejection(RejectionReason.PNP_FAILED, "no poses of the sequence explain four matches")
    if failure := group_gate_failure(last_part):
        return 0.0, Rejection(RejectionReason.GATE, failure)
    sigma = _scale_sigma(estimate)
    if not sigma <= MAX_SCALE_SIGMA:
        message = f"the session moves too little for its unit: the scale is known to {100 * sigma:.0f} % only"
        return 0.0, Rejection(RejectionReason.SCALE_UNRELIABLE, message)
    return trust_of_group(last_part, coverage)


def _last_contradicted(estimate: JointEstimate[SequenceState], frame_count: int) -> PosedImage | None:
    """Returns the last frame if its matches, though enough, do not support the pose that it is tracked to."""
    last = estimate.matched[-1]
    if last.source.image != frame_count - 1 or last.source.own_pose is not None:
        return None
    if max(last.findable_count(), len(last.source.matches)) < SHOULD_SHOW:
        return None
    sigma = np.sqrt(np.diag(estimate.covariance)[6 * (frame_count - 1) :][:6])
    source, focal_px = last.source, last.source.query.camera.focal_x_px
    # Not the depth: after a jump by a rotation, the points are behind the camera.
    rays_m = source.structure.x_in_world[last.matches.point] - last.world_from_camera.translation
    distance_m = np.median(np.linalg.norm(rays_m, axis=1))
    bound_px = INEXACT_INLIER_PX + 3 * focal_px * (max(sigma[:3]) / max(distance_m, 1e-9) + max(sigma[3:]))
    near = int((last.errors_px[~last.matches.guided] < bound_px).sum())
    return last if near < LEAST_NEAR else None


def _posed_by_themselves(
    images: Sequence[GroupImage],
    matched_images: Sequence[MatchedImage],
    session: Session,
    last: PosedImage,
    coverage: float,
) -> list[MatchedImage] | Rejection:
    """Poses the last images by their own matches, together; a rejection if no pose is found."""
    posed = [it.image for it in matched_images if it.own_pose is not None]
    # Of frames in an unknown unit only the last is posed.
    first = len(images) - 1 if session.scale_is_free else max(posed, default=-1) + 1
    if first == 0 or isinstance(
        alone := solve_sequence(images[first:], session.frames[first:], False, coverage), Rejection
    ):
        message = (
            f"the last photograph contradicts its tracked pose: {int(last.inliers.sum())} of its {len(last.matches)} "
            f"matches agree, and {last.findable_count()} points should be visible; the tracking may have jumped, and "
            "the photograph is not localized without it"
        )
        return Rejection(RejectionReason.GATE, message)

    def posed_as_found(it: MatchedImage) -> MatchedImage:
        own_pose = alone.world_from_camera[it.image - first].shifted(-it.origin)
        return replace(it, own_pose=own_pose, own_covariance=alone.covariances[it.image - first])

    return [posed_as_found(it) if it.image >= first else it for it in matched_images]


def _scale_sigma(estimate: JointEstimate[SequenceState]) -> float:
    return math.sqrt(estimate.covariance[-1, -1]) if estimate.state.scale_is_free else 0.0


def _covariances(estimate: JointEstimate[SequenceState], priors: Mapping[int, Priors]) -> Array:
    """Covariances (F, 6, 6) of the poses in the world: of at most `INDEPENDENT` photographs like each, and its priors.

    What this adds to the nearest photograph is added to one that is not localized alone: such errors are common.
    """
    poses = [frame.inverse() for frame in estimate.state.frames]
    blocks = (estimate.covariance[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i in range(len(poses)))
    joint = np.array([covariance_in_world(block, pose) for block, pose in zip(blocks, poses, strict=True)])
    added = {}
    for it in estimate.matched:
        i = it.source.image
        if it.source.own_covariance is None or not np.isfinite(joint[i]).all():
            continue
        information = INDEPENDENT * np.linalg.inv(it.source.own_covariance)
        if i in priors:
            used = priors[i].consistent(estimate.prior_checks[i])
            information += used.gradient_and_information(poses[i])[1] if used else 0.0
        added[i] = _at_least(joint[i], np.linalg.inv(information)) - joint[i]
    if not added:
        return joint
    nearest = [min(added, key=lambda k: abs(k - i)) for i in range(len(poses))]
    return np.asarray(joint + np.array([added[i] for i in nearest]))


def _at_least(covariance: Array, least: Array) -> Array:
    """The covariance (N, N) with at least the variance of another one in every direction."""
    root = np.linalg.cholesky(least)
    whitened = np.linalg.solve(root, np.linalg.solve(root, covariance).T)
    values, vectors = np.linalg.eigh(whitened)
    axes = root @ vectors
    return np.asarray((axes * np.maximum(values, 1.0)) @ axes.T)


def _result(
    estimate: JointEstimate[SequenceState], start: Start, session: Session, origin: Array, trust: float
) -> SequenceEstimate:
    state = estimate.state
    poses = [frame.inverse() for frame in state.frames]
    last = world_from_session_at(poses[-1], session.frames[-1], state.scale)
    return SequenceEstimate(
        replace(last, translation=last.translation + origin),
        _scale_sigma(estimate),
        tuple(pose.shifted(origin) for pose in poses),
        _covariances(estimate, session.priors),
        estimate.matched,
        start.jumps,
        trust,
        estimate.prior_checks,
    )
