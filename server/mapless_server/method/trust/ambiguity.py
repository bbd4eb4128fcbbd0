"""Two places that look the same: a second pose, elsewhere, that other references support about as well.

Repeated corridors and floors, the same furniture twice, references of which some are posed wrongly: then references
vote in two clusters, and whichever pose has a few votes more wins. So the matches with which the winner disagrees are
asked again for a pose. It is a rival if

    its own matches are no chance (the a-contrario test of `gate`, over the matches asked),
    it explains at least a stated share of as many keypoints as the winner does, counted alike,
    it stands apart from the winner, further than both poses' 95 % radii, and
    most of its matches come from references that agree with it more than with the winner.

Keypoints are counted over the matches with each reference, before the vote in which a keypoint's point is chosen, since
the vote is what the stronger place wins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, RigidTransform, rotation_angle_deg

from ..options import check_bounds
from ..perturbation import pose_hessian, reprojection_errors_px, world_covariance
from ..pnp import PnpOptions, ransac
from ..rejection import Hypothesis
from ..results import Support
from ..uncertainty.covariance import Accuracy, accuracy_from_covariance
from ..views import Matches
from .gate import false_alarms


@dataclass(frozen=True)
class AmbiguityOptions:
    """Options of the search for a rival.

    Attributes:
        min_share: a rival explains at least this share of as many keypoints as the winner. A place that has half the
            votes of another is distinguished from it by that alone.
        min_keypoints: and no fewer keypoints than this.
        max_log10_false_alarms: as of the gate, with a reserve: every answer is asked for a rival.
        min_own_share: least share of its matches from references that agree with it more than with the winner. A few
            references that see both places support both.
        min_apart_m, min_apart_deg: poses nearer than this are one place, whatever their radii say.
        agreeing_px: matches within this distance are the winner's; beyond the inliers' bound, since a point that is
            off is no second place.
        pnp: of the rival. The few iterations find a pose that explains a third of the matches asked.
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


@dataclass(frozen=True, eq=False)
class _Votes:
    """Matches with each reference, carried to points: row v is one vote.

    Attributes:
        reference: (V,) which reference's match it was.
        keypoint: (V,) of the query.
        x_in_world: (V, 3) the point.
        pixels: (V, 2) the keypoint.
    """

    reference: NDArray[np.intp]
    keypoint: NDArray[np.intp]
    x_in_world: Array
    pixels: Array

    def __getitem__(self, rows: NDArray[np.bool_]) -> _Votes:
        return _Votes(self.reference[rows], self.keypoint[rows], self.x_in_world[rows], self.pixels[rows])

    def errors_px(self, camera: Camera, world_from_camera: RigidTransform) -> Array:
        """Distances (V,) of the points' projections from the keypoints; NaN behind the camera."""
        return reprojection_errors_px(camera, world_from_camera, self.x_in_world, self.pixels)

    def keypoint_count(self, rows: NDArray[np.bool_]) -> int:
        """Different keypoints among some of the votes (V,)."""
        return len(np.unique(self.keypoint[rows]))


def find_rival(
    support: Support, query_matches: Sequence[Matches], options: AmbiguityOptions
) -> tuple[Hypothesis, Hypothesis] | None:
    """The winner and its rival, as hypotheses in the support's world; None if nothing rivals it.

    Costs a projection of all matches, and a search only where enough of them disagree.

    Args:
        support: of the winner, with its estimate.
        query_matches: with each reference, (query keypoint, reference keypoint).
        options: see there.
    """
    estimate, camera = support.estimate, support.query.camera
    if estimate is None:
        return None
    votes = _votes(support, query_matches)
    errors_px = votes.errors_px(camera, estimate.world_from_camera)
    own = errors_px < options.pnp.inlier_px
    wanted = max(options.min_keypoints, int(np.ceil(options.min_share * votes.keypoint_count(own))))
    asked = _dissenting(votes, own, ~(errors_px < options.agreeing_px), len(support.references))
    if votes.keypoint_count(asked) < wanted:
        return None
    rival = _second_pose(camera, votes[asked], wanted, options)
    if rival is None:
        return None
    pose, radii = rival
    claim = accuracy_from_covariance(estimate.covariance)
    if not _stand_apart(estimate.world_from_camera, claim, pose, radii, options):
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
    camera: Camera, votes: _Votes, wanted: int, options: AmbiguityOptions
) -> tuple[RigidTransform, Accuracy] | None:
    """What some votes agree on, if enough keypoints do and chance would not; with its radii."""
    pose = ransac(camera, votes.x_in_world, votes.pixels, None, options.pnp)
    if pose is None:
        return None
    inliers = votes.errors_px(camera, pose) < options.pnp.inlier_px
    asked, count = len(np.unique(votes.keypoint)), votes.keypoint_count(inliers)
    # A keypoint hits by chance as often as it has votes.
    disc_share = np.pi * options.pnp.inlier_px**2 / (camera.width_px * camera.height_px)
    chance = float(disc_share * len(votes.keypoint) / asked)
    if count < wanted or false_alarms(asked, count, chance) > options.max_log10_false_alarms:
        return None
    # By a keypoint noise of a pixel.
    covariance = world_covariance(pose_hessian(camera, pose, votes.x_in_world[inliers]), pose)
    return pose, accuracy_from_covariance(covariance)


def _supporters(names: Sequence[str], own: NDArray[np.intp], other: NDArray[np.intp]) -> tuple[str, ...]:
    """Names of the references with more votes for one place than for the other, the most first."""
    return tuple(names[i] for i in np.argsort(-own, kind="stable") if own[i] > other[i])


def _votes(support: Support, query_matches: Sequence[Matches]) -> _Votes:
    """The matches that end at a point."""
    tracks = support.structure.tracks
    offsets = np.concatenate([[0], np.cumsum([len(r.view.features) for r in support.references])])
    point_of = np.full(offsets[-1], -1)
    point_of[offsets[tracks.view] + tracks.keypoint] = tracks.point
    reference = np.repeat(np.arange(len(query_matches)), [len(m) for m in query_matches])
    pairs = np.concatenate([np.asarray(m, np.intp).reshape(-1, 2) for m in query_matches])
    point = point_of[offsets[reference] + pairs[:, 1]]
    known = point >= 0
    keypoint = pairs[known, 0]
    pixels = support.query.features.keypoints[keypoint].astype(np.float64)
    return _Votes(reference[known], keypoint, support.structure.x_in_world[point[known]], pixels)


def _dissenting(
    votes: _Votes, own: NDArray[np.bool_], apart: NDArray[np.bool_], reference_count: int
) -> NDArray[np.bool_]:
    """The votes (V,) against the winner, of references that have more of these than for it."""
    against, favour = (np.bincount(votes.reference[rows], minlength=reference_count) for rows in (apart, own))
    return np.asarray(apart & (against > favour)[votes.reference])


def _stand_apart(
    first: RigidTransform, claim: Accuracy, second: RigidTransform, other: Accuracy, options: AmbiguityOptions
) -> bool:
    apart_m = float(np.linalg.norm(second.translation - first.translation))
    apart_deg = rotation_angle_deg(first.rotation.T @ second.rotation)
    reach_m = max(options.min_apart_m, claim.position_95_m + other.position_95_m)
    reach_deg = max(options.min_apart_deg, claim.rotation_95_deg + other.rotation_95_deg)
    return apart_m > reach_m or apart_deg > reach_deg
