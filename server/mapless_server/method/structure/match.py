"""Matching: 2D-3D matches of the query's keypoints with the points of the structure.

The paper projects every point with the query's initial pose, u_k = pi(P_q^init, X_k), and takes the nearest descriptor
within a radius. Our form first carries the query's matches with each reference to points through the tracks; the guided
search only adds to them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mapless.geometry import RigidTransform
from mapless_server.bounds import check_bounds

from ..features.matching import CorrespondOptions
from ..features.views import PosedView, View
from ..pairs.correspond import Correspondences
from .model import PointMatches, Structure


@dataclass(frozen=True)
class MatchOptions:
    """Options of matching.

    Attributes:
        through_tracks: begin with the matches between the query and the references, carried to points by their tracks.
        radius_px: search radius around a point's projection; 20 in the paper. Ours searches only for points without a
            match, and nearby, because the initial pose is good.
        min_similarity: smallest cosine of descriptors found by the guided search; -1 accepts any, as the paper does.
    """

    through_tracks: bool = True
    radius_px: float = 6.0
    min_similarity: float = CorrespondOptions.guided_similarity

    def __post_init__(self) -> None:
        check_bounds(self, "radius_px", at_least=0)
        check_bounds(self, "min_similarity", at_least=-1, at_most=1)


PAPER_MATCH = MatchOptions(through_tracks=False, radius_px=20.0, min_similarity=-1.0)
"""The paper's form."""


def match_points(
    query: View,
    references: Sequence[PosedView],
    structure: Structure,
    correspondences: Correspondences,
    world_from_query: RigidTransform,
    options: MatchOptions,
    prior_pose: RigidTransform | None = None,
) -> PointMatches:
    """Matches the query with the metric points of a structure, whose tracks number the references in their order.

    The correspondences are between query and references. `world_from_query` is the initial pose; the search starts from
    the prior's pose, if it is given and more of the matches through tracks are inliers of it. `PAPER_MATCH` is the
    paper's form.
    """
    nothing = np.empty(0, np.intp)
    known = PointMatches(nothing, nothing, np.empty(0, bool), options.radius_px)
    if options.through_tracks:
        known = vote(structure, [len(r.view.features) for r in references], correspondences)
    if prior_pose is not None:
        seen = known.seen(query, structure.x_in_world)
        poses = (world_from_query, prior_pose)
        world_from_query = max(poses, key=lambda pose: seen.inlier_count(pose, options.radius_px))
    found = search(query, references, structure, world_from_query, known, options)
    return replace(known.and_last(found.point, found.keypoint, found.guided), radius_px=options.radius_px)


def vote(structure: Structure, keypoint_counts: Sequence[int], correspondences: Correspondences) -> PointMatches:
    """Carries matches between query and references to points; if references disagree, the majority decides."""
    tracks = structure.tracks
    offsets = np.concatenate([[0], np.cumsum(keypoint_counts)])
    point_of = np.full(offsets[-1], -1)
    point_of[offsets[tracks.view] + tracks.keypoint] = tracks.point
    matches = correspondences.query_matches
    keypoint = np.concatenate([m[:, 0] for m in matches]).astype(np.intp)
    point = np.concatenate([point_of[offsets[view] + m[:, 1]] for view, m in enumerate(matches)])
    keypoint, point = keypoint[point >= 0], point[point >= 0]
    pairs, votes = np.unique(keypoint * (tracks.point_count + 1) + point, return_counts=True)
    keypoint, point = one_to_one(*np.divmod(pairs, tracks.point_count + 1), votes.astype(float))
    return PointMatches(point, keypoint, np.zeros(len(point), bool), 0.0)


def search(
    query: View,
    references: Sequence[PosedView],
    structure: Structure,
    world_from_query: RigidTransform,
    known: PointMatches,
    options: MatchOptions,
) -> PointMatches:
    """Matches each free point with the most similar free keypoint within the radius of its projection.

    The similarity of a point and a keypoint is the largest over the descriptors of the point's observations.
    """
    keypoints = query.features.pixels()
    projected = query.camera.project(world_from_query.inverse().apply(structure.x_in_world))
    size = np.array([query.camera.width_px, query.camera.height_px])
    within = (projected > -options.radius_px) & (projected < size + options.radius_px)
    inside = within[:, 0] & within[:, 1]
    is_free = np.ones(len(keypoints), bool)
    inside[known.point] = is_free[known.keypoint] = False
    free_points, free_keypoints = np.flatnonzero(inside), np.flatnonzero(is_free)
    near = KDTree(projected[free_points]).sparse_distance_matrix(
        KDTree(keypoints[free_keypoints]), options.radius_px, output_type="ndarray"
    )
    point, keypoint = free_points[near["i"]], free_keypoints[near["j"]]

    tracks = structure.tracks
    length = np.diff(np.append(tracks.starts, len(tracks.point)))[point]
    first = np.cumsum(length) - length  # first row below of each pair
    observation = np.arange(length.sum()) - np.repeat(first - tracks.starts[point], length)
    ours = query.features.unit_descriptors()[np.repeat(keypoint, length)]
    theirs = np.empty_like(ours)
    for view, reference in enumerate(references):
        seen = np.flatnonzero(tracks.view[observation] == view)
        theirs[seen] = reference.view.features.unit_descriptors(tracks.keypoint[observation[seen]])
    similarity = np.einsum("od,od->o", theirs, ours)
    best = np.maximum.reduceat(similarity, first) if len(first) else similarity
    good = best > options.min_similarity
    keypoint, point = one_to_one(keypoint[good], point[good], best[good].astype(np.float64))
    return PointMatches(point, keypoint, np.ones(len(point), bool), options.radius_px)


def one_to_one(
    first: NDArray[np.intp], second: NDArray[np.intp], score: NDArray[np.float64]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Keeps the best pair of each first element, then of each second element."""
    for key in (0, 1):
        order = np.lexsort((-score, (first, second)[key]))
        first, second, score = first[order], second[order], score[order]
        leading = np.diff((first, second)[key], prepend=-1) != 0
        first, second, score = first[leading], second[leading], score[leading]
    return first, second
