"""Initial pose of a query from two-view matches and 2D-3D matches together.

Candidates, of which the one with the highest score is taken:

    - PnP on the 2D-3D matches, if there are any;
    - the generalized relative pose: five matches with one reference and one with another (PoseLib);
    - for each of the references with the most matches, the relative pose up to its unknown distance (five points), and
      the distance from every single match with another reference and with a point. PoseLib chooses the distance
      among random samples of all matches, most of which are of the strongest reference and do not depend on it.

The score is sum (1 - r^2 / r_max^2) log10(1 / p) over the inliers, with residual r and the chance p that a wrong match
is an inlier: an epipolar line excludes less of the image than a point, so such a match counts less.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import poselib
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, RigidTransform
from mapless_server.bounds import check_bounds

from ..features.limits import EPIPOLAR_PX
from ..features.views import PosedView, View
from ..structure.model import PixelPoints
from .pnp import (
    MIN_MATCHES,
    REFINEMENT,
    PnpOptions,
    disc_chance,
    inverse_of,
    iterations_between,
    poselib_camera,
    poselib_pose,
    ransac,
)
from .two_view_matches import MIN_TWO_VIEW, TwoViewMatches

PNP = PnpOptions()
"""Options of poses from 2D-3D matches, and the bound of their inliers."""

MAX_DISTANCES = 200
"""Largest number of distances that are scored for each reference, evenly thinned."""


@dataclass(frozen=True)
class RelativePoseOptions:
    """Options of the search.

    Attributes:
        min_iterations, max_iterations: bounds of iterations for the generalized relative pose; 20,000 take 0.1 s.
        pair_iterations: largest number of iterations for one reference, reached with 15 % inliers.
        strongest: number of references whose relative pose is computed.
    """

    min_iterations: int = 1000
    max_iterations: int = PnpOptions.max_iterations
    pair_iterations: int = 5000
    strongest: int = 2

    def __post_init__(self) -> None:
        check_bounds(self, "min_iterations", above=0, at_most=self.max_iterations)
        check_bounds(self, "pair_iterations strongest", above=0)


@dataclass(frozen=True, eq=False)
class Evidence:
    """All matches of a query.

    Attributes:
        query: the photograph.
        references: the posed references.
        two_view: matches with the references.
        x_in_world: (N, 3) points of the 2D-3D matches.
        keypoint: (N,) their keypoints in the query.
    """

    query: View
    references: Sequence[PosedView]
    two_view: TwoViewMatches
    x_in_world: Array
    keypoint: NDArray[np.intp]

    @property
    def points(self) -> PixelPoints:
        """The points of the 2D-3D matches, and their keypoints."""
        return PixelPoints(self.query.camera, self.x_in_world, self.query.features.pixels(self.keypoint))


def band_chance(camera: Camera) -> float:
    """Chance that a wrong match is within `EPIPOLAR_PX` of its epipolar line: a band's share of the image.

    Both keypoints share the distance, so the band is sqrt(2) times as wide; it is at most as long as the diagonal.
    """
    length_px = np.hypot(camera.width_px, camera.height_px)
    return float(min(1.0, 2 * np.sqrt(2) * EPIPOLAR_PX * length_px / (camera.width_px * camera.height_px)))


def find_pose(evidence: Evidence, options: RelativePoseOptions) -> RigidTransform | None:
    """Returns the world_from_query with the highest score, not refined; None without a candidate."""
    by_points = ransac(evidence.points, None, PNP) if len(evidence.x_in_world) >= MIN_MATCHES else None
    found = [by_points, _generalized(evidence, options)]
    found += [_by_distance(evidence, it, options) for it in _strongest(evidence.two_view, options)]
    candidates = [pose for pose in found if pose is not None]
    return max(candidates, key=lambda pose: score(evidence, pose), default=None)


def score(evidence: Evidence, world_from_query: RigidTransform) -> float:
    """The score of a pose; the docstring of this module defines it."""
    rotation, centre = world_from_query.rotation, world_from_query.translation
    return float(_scores_along(evidence, rotation, centre, np.zeros(3), np.zeros(1))[0])


def scores_by_keypoint(evidence: Evidence, world_from_query: RigidTransform) -> Array:
    """The parts (F,) of the score of a pose by the query's keypoints."""
    camera, points = evidence.query.camera, evidence.points
    lines = np.nan_to_num(evidence.two_view.sampson_px(world_from_query) / EPIPOLAR_PX, nan=np.inf)
    errors = np.nan_to_num(points.errors_px(world_from_query) / PNP.inlier_px, nan=np.inf)
    parts = (
        (evidence.two_view.keypoint, lines, band_chance(camera)),
        (evidence.keypoint, errors, disc_chance(camera, PNP.inlier_px)),
    )
    total = np.zeros(len(evidence.query.features))
    for keypoint, residual, chance in parts:
        np.add.at(total, keypoint, -np.log10(chance) * np.clip(1 - residual**2, 0, None))
    return total


def _scores_along(evidence: Evidence, rotation: Array, centre: Array, direction: Array, distance: Array) -> Array:
    """Scores (S,) at centre + distance * direction, for S distances."""
    camera = evidence.query.camera
    lines = evidence.two_view.sampson_along_px(rotation, centre, direction, distance) / EPIPOLAR_PX
    total = -np.log10(band_chance(camera)) * _truncated(lines)
    if len(evidence.x_in_world):
        weight, points = -np.log10(disc_chance(camera, PNP.inlier_px)), evidence.points
        errors = [points.errors_px(RigidTransform(rotation, centre + it * direction)) for it in distance]
        total = total + weight * _truncated(np.array(errors) / PNP.inlier_px)
    return np.asarray(total)


def _truncated(residuals: Array) -> Array:
    """Sums (S,) of 1 - r^2 over residuals r (S, N) below one."""
    return np.asarray(np.clip(1 - np.nan_to_num(residuals, nan=np.inf) ** 2, 0, None).sum(axis=1))


def _generalized(evidence: Evidence, options: RelativePoseOptions) -> RigidTransform | None:
    """The generalized relative pose."""
    two_view, references = evidence.two_view, evidence.references
    counts = np.bincount(two_view.reference, minlength=len(references))
    used = np.flatnonzero(counts)
    if len(used) < 2 or counts.max() < 5:  # PoseLib's sampling would not end
        return None
    pairs = []
    for reference in used:
        rows, pair = two_view.reference == reference, poselib.PairwiseMatches()
        pair.cam_id1, pair.cam_id2 = int(reference), 0
        pair.x1, pair.x2 = _pixels(evidence, rows, int(reference))
        pairs.append(pair)
    pose, _ = poselib.estimate_generalized_relative_pose(
        pairs,
        [poselib_pose(it.world_from_camera.inverse()) for it in references],
        [poselib_camera(it.view.camera) for it in references],
        [poselib_pose(RigidTransform(np.eye(3), np.zeros(3)))],
        [poselib_camera(evidence.query.camera)],
        {"max_epipolar_error": EPIPOLAR_PX, **iterations_between(options.min_iterations, options.max_iterations)},
        REFINEMENT,
    )
    return inverse_of(pose)


def _strongest(two_view: TwoViewMatches, options: RelativePoseOptions) -> list[int]:
    """Indices of the references with the most matches."""
    counts = np.bincount(two_view.reference)
    order = np.argsort(-counts, kind="stable")[: options.strongest]
    return [int(it) for it in order if counts[it] >= MIN_TWO_VIEW]


def _by_distance(evidence: Evidence, reference: int, options: RelativePoseOptions) -> RigidTransform | None:
    """The pose relative to a reference, at the distance that the other matches support most."""
    view, two_view = evidence.references[reference], evidence.two_view
    theirs, ours = _pixels(evidence, two_view.reference == reference, reference)
    relative, _ = poselib.estimate_relative_pose(
        theirs,
        ours,
        poselib_camera(view.view.camera),
        poselib_camera(evidence.query.camera),
        {"max_epipolar_error": EPIPOLAR_PX, **iterations_between(PNP.min_iterations, options.pair_iterations)},
        REFINEMENT,
    )
    turned = inverse_of(relative)  # reference_from_query, at a distance of one
    if turned is None:
        return None
    rotation = view.world_from_camera.rotation @ turned.rotation
    direction = view.world_from_camera.rotation @ turned.translation
    centre = view.world_from_camera.translation
    distances = _distances(evidence, reference, rotation, centre, direction)
    distances = distances[np.isfinite(distances) & (distances > 0)]
    if not len(distances):
        return None
    distances = np.sort(distances)[:: -(-len(distances) // MAX_DISTANCES)]
    scores = _scores_along(evidence, rotation, centre, direction, distances)
    return RigidTransform(rotation, centre + float(distances[np.argmax(scores)]) * direction)


def _distances(evidence: Evidence, reference: int, rotation: Array, centre: Array, direction: Array) -> Array:
    """Distances from the reference that each match with another reference, and each 2D-3D match, gives."""
    others = evidence.two_view[evidence.two_view.reference != reference]
    normal = np.cross(others.ray @ rotation.T, others.reference_ray)
    rays = evidence.query.camera.rays(evidence.points.pixels) @ rotation.T
    across, offset = np.cross(direction, rays), np.cross(evidence.x_in_world - centre, rays)
    with np.errstate(invalid="ignore", divide="ignore"):
        by_lines = (normal * (others.reference_centre - centre)).sum(axis=1) / (normal @ direction)
        by_points = (across * offset).sum(axis=1) / (across**2).sum(axis=1)
    return np.concatenate([by_lines, by_points])


def _pixels(evidence: Evidence, rows: NDArray[np.bool_], reference: int) -> tuple[Array, Array]:
    """Pixels (M, 2) of the given matches in their reference, and in the query."""
    two_view, view = evidence.two_view, evidence.references[reference].view
    ours = evidence.query.features.pixels(two_view.keypoint[rows])
    return view.features.pixels(two_view.reference_keypoint[rows]), ours
