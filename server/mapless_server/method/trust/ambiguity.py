"""Ambiguity: a second pose, at another place, that other references support about as well.

With repeated corridors and floors, identical furniture, or some references with wrong poses, the matches of the
references form two clusters, and the pose with a few more inliers is found. So a second pose is searched among the
matches that are outliers of the first. It is a rival if

    its inliers are not chance (the a-contrario test of `gate`, over these matches),
    it explains at least a given share of the number of keypoints that the first pose explains,
    it is further from the first pose than the 95 % radii of both, and
    most of its inliers come from references that support it more than the first pose.

Keypoints are counted over the matches with each reference, before the majority vote for a keypoint's point, which
removes the matches of the weaker place.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Camera, RigidTransform, rotation_angle_deg

from ..options import check_bounds
from ..perturbation import pose_hessian, world_covariance
from ..pnp import PnpOptions, ransac
from ..rejection import Hypothesis
from ..results import Support
from ..uncertainty.radii import Accuracy, accuracy_from_covariance
from .evidence import Votes
from .gate import false_alarms


@dataclass(frozen=True)
class AmbiguityOptions:
    """Options of the search for a rival.

    Attributes:
        min_share: least number of keypoints of a rival, as a share of those of the first pose. A place with less than
            half the keypoints of another is distinguished from it.
        min_keypoints: least number of keypoints of a rival.
        max_log10_false_alarms: as in `GateOptions`, but stricter, because a rival is searched for every answer.
        min_own_share: least share of a rival's inliers from references that support it more than the first pose. A few
            references that show both places support both.
        min_apart_m, min_apart_deg: poses nearer than this are one place, independent of their radii.
        agreeing_px: matches within this distance belong to the first pose; larger than the inlier bound, since a point
            with an error is not a second place.
        pnp: options of the rival's pose. The few iterations find a pose with a third of the matches as inliers.
    """

    min_share: float = 0.5
    min_keypoints: int = 10
    max_log10_false_alarms: float = -6.0
    min_own_share: float = 0.5
    min_apart_m: float = 0.1
    min_apart_deg: float = 5.0
    agreeing_px: float = 12.0
    pnp: PnpOptions = field(default_factory=lambda: PnpOptions(min_iterations=50, max_iterations=200, max_matches=300))

    def __post_init__(self) -> None:
        check_bounds(self, "min_share min_own_share", above=0, at_most=1)
        check_bounds(self, "min_keypoints", at_least=4)
        check_bounds(self, "min_apart_m min_apart_deg", at_least=0)
        check_bounds(self, "agreeing_px", at_least=self.pnp.inlier_px)


def find_rival(support: Support, votes: Votes, options: AmbiguityOptions) -> tuple[Hypothesis, Hypothesis] | None:
    """Finds the first pose and its rival, as hypotheses in the support's world; None without a rival.

    Projects all matches, and searches only if enough of them are outliers.

    Args:
        support: the first pose's support, with its estimate.
        votes: the query's matches with each reference.
        options: options of the search.
    """
    estimate, camera = support.estimate, support.query.camera
    if estimate is None:
        return None
    errors_px = votes.errors_px(camera, estimate.world_from_camera)
    own = errors_px < options.pnp.inlier_px
    wanted = max(options.min_keypoints, int(np.ceil(options.min_share * votes.keypoint_count(own))))
    candidates = _outliers(votes, own, ~(errors_px < options.agreeing_px), len(support.references))
    if votes.keypoint_count(candidates) < wanted:
        return None
    rival = _second_pose(camera, votes[candidates], wanted, options)
    if rival is None:
        return None
    pose, radii = rival
    own_radii = accuracy_from_covariance(estimate.covariance)
    if not _are_apart(estimate.world_from_camera, own_radii, pose, radii, options):
        return None
    theirs = votes.errors_px(camera, pose) < options.pnp.inlier_px
    counts = [np.bincount(votes.reference[rows], minlength=len(support.references)) for rows in (own, theirs)]
    if counts[1][counts[1] > counts[0]].sum() < options.min_own_share * counts[1].sum():
        return None
    names = [reference.name for reference in support.references]
    return (
        Hypothesis(estimate.world_from_camera, votes.keypoint_count(own), _supporters(names, counts[0], counts[1])),
        Hypothesis(pose, votes.keypoint_count(theirs), _supporters(names, counts[1], counts[0])),
    )


def _second_pose(
    camera: Camera, votes: Votes, wanted: int, options: AmbiguityOptions
) -> tuple[RigidTransform, Accuracy] | None:
    """Finds a pose with enough inliers that are not chance, and its radii."""
    pose = ransac(camera, votes.x_in_world, votes.pixels, None, options.pnp)
    if pose is None:
        return None
    inliers = votes.errors_px(camera, pose) < options.pnp.inlier_px
    keypoint_count, count = len(np.unique(votes.keypoint)), votes.keypoint_count(inliers)
    # The chance of an inlier is proportional to the number of matches of a keypoint.
    disc_share = np.pi * options.pnp.inlier_px**2 / (camera.width_px * camera.height_px)
    chance = float(disc_share * len(votes.keypoint) / keypoint_count)
    if count < wanted or false_alarms(keypoint_count, count, chance) > options.max_log10_false_alarms:
        return None
    # With a keypoint noise of one pixel.
    covariance = world_covariance(pose_hessian(camera, pose, votes.x_in_world[inliers]), pose)
    return pose, accuracy_from_covariance(covariance)


def _supporters(names: Sequence[str], own: NDArray[np.intp], other: NDArray[np.intp]) -> tuple[str, ...]:
    """Names of the references with more inliers of one pose than of the other, those with the most first."""
    return tuple(names[i] for i in np.argsort(-own, kind="stable") if own[i] > other[i])


def _outliers(
    votes: Votes, own: NDArray[np.bool_], apart: NDArray[np.bool_], reference_count: int
) -> NDArray[np.bool_]:
    """Mask (V,) of the matches far from the first pose, of references with more such matches than inliers."""
    against, favour = (np.bincount(votes.reference[rows], minlength=reference_count) for rows in (apart, own))
    return np.asarray(apart & (against > favour)[votes.reference])


def _are_apart(
    first: RigidTransform, radii: Accuracy, second: RigidTransform, other: Accuracy, options: AmbiguityOptions
) -> bool:
    apart_m = float(np.linalg.norm(second.translation - first.translation))
    apart_deg = rotation_angle_deg(first.rotation.T @ second.rotation)
    reach_m = max(options.min_apart_m, radii.position_95_m + other.position_95_m)
    reach_deg = max(options.min_apart_deg, radii.rotation_95_deg + other.rotation_95_deg)
    return apart_m > reach_m or apart_deg > reach_deg
