"""The matching stage on a device: the same votes and the same search as in `match`, in arrays of fixed size.

The match of a point is stored at the point: the index of the keypoint, or the number of keypoints for none.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mapless.geometry import Camera

from ..arrays import AnyArray, normalize
from ..correspond import Correspondences
from ..match import MatchOptions
from ..tracks import keypoint_offsets
from ..views import PosedView, View

CHUNK_ELEMENTS = 2**25
"""Number of similarities (of an observation and a keypoint) computed together: 128 MiB."""


@dataclass(frozen=True, eq=False)
class MatchInputs:
    """The input of matching without the structure: N keypoints of the references and Q of the query.

    Attributes:
        descriptors: (N, D) float32.
        query_descriptors: (Q, D) float32.
        query_pixels: (Q, 2).
        vote_row: (V,) for each match of the query with a reference, the row among the (P, L) observations.
        vote_keypoint: (V,) for the same match, the keypoint of the query.
    """

    descriptors: AnyArray
    query_descriptors: AnyArray
    query_pixels: AnyArray
    vote_row: AnyArray
    vote_keypoint: AnyArray


def prepare_match(
    query: View,
    references: Sequence[PosedView],
    correspondences: Correspondences,
    keypoint: NDArray[np.intp],
    options: MatchOptions,
) -> MatchInputs:
    """Makes the inputs; `keypoint` (P, L) are the structure's observations."""
    offsets, rows = keypoint_offsets(references), np.flatnonzero(keypoint >= 0)
    row_of = np.full(offsets[-1], -1)
    row_of[keypoint.reshape(-1)[rows]] = rows
    matches = zip(correspondences.query_matches, offsets[:-1], strict=True) if options.through_tracks else ()
    votes = np.concatenate([np.empty((0, 2), np.intp), *(m + [0, offset] for m, offset in matches)])
    row = row_of[votes[:, 1]]
    return MatchInputs(
        np.concatenate([r.view.features.unit_descriptors() for r in references]),
        query.features.unit_descriptors(),
        query.features.keypoints.astype(np.float64),
        row[row >= 0],
        votes[row >= 0, 0],
    )


@dataclass(frozen=True, eq=False)
class DevicePoints:
    """The structure on the device, as input of matching.

    Attributes:
        x_in_world: (P, 3) metres.
        keypoint: (P, L) observations, as keypoints counted through all references; arbitrary where blank.
        seen: (P, L) which rows are observations of points that exist.
    """

    x_in_world: Tensor
    keypoint: Tensor
    seen: Tensor


def match_on_device(
    inputs: MatchInputs, points: DevicePoints, rotation: Tensor, centre: Tensor, camera: Camera, options: MatchOptions
) -> tuple[Tensor, Tensor]:
    """Matches the query, whose initial world_from_camera is `rotation` (3, 3) and `centre` (3,), with the points.

    Returns:
        keypoint: (P,) keypoint of the query; Q for a point without a match.
        guided: (P,) whether the match was found near the point's projection.
    """
    none = len(inputs.query_pixels)
    known = torch.full_like(points.keypoint[:, 0], none)
    if options.through_tracks:
        known = _vote(inputs, points.seen)
    found = _search(inputs, points, (points.x_in_world - centre) @ rotation, known, camera, options)
    return torch.where(known < none, known, found), (known == none) & (found < none)


def _vote(inputs: MatchInputs, seen: Tensor) -> Tensor:
    """Votes as `match.vote` does."""
    (points, width), keypoints = seen.shape, len(inputs.query_pixels)
    counts = seen.reshape(-1)[inputs.vote_row]
    point = torch.where(counts, inputs.vote_row // width, points)
    keypoint = torch.where(counts, inputs.vote_keypoint, keypoints)
    pair = keypoint * (points + 1) + point
    ordered = pair.sort().values
    votes = torch.searchsorted(ordered, pair, right=True) - torch.searchsorted(ordered, pair)
    return one_to_one(*best_by_group(keypoint, point, votes.double(), keypoints, points), points)


def _search(
    inputs: MatchInputs, points: DevicePoints, x_in_query: Tensor, known: Tensor, camera: Camera, options: MatchOptions
) -> Tensor:
    """Searches as `match.search` does, with points in the query's frame."""
    (count, width), keypoints = points.seen.shape, len(inputs.query_pixels)
    x, y = normalize(x_in_query).unbind(1)
    x, y = x * camera.focal_x_px + camera.principal_x_px, y * camera.focal_y_px + camera.principal_y_px
    radius = options.radius_px
    inside = (x > -radius) & (x < camera.width_px + radius) & (y > -radius) & (y < camera.height_px + radius)
    free_points = inside & points.seen.any(1) & (known == keypoints)
    taken = free_points.new_zeros(keypoints + 1).index_fill(0, known, True)[:keypoints]
    keypoint_x, keypoint_y = inputs.query_pixels.unbind(1)

    best = torch.full_like(inputs.query_descriptors[:, 0], -torch.inf)
    point = torch.full_like(best, count, dtype=torch.int64)
    step = max(1, CHUNK_ELEMENTS // max(1, width * keypoints))
    for begin in range(0, count, step):
        chunk = slice(begin, begin + step)
        seen = points.seen[chunk]
        descriptors = inputs.descriptors[points.keypoint[chunk].clip(0).reshape(-1)]
        similarity = (descriptors @ inputs.query_descriptors.T).reshape(*seen.shape, keypoints)
        similarity = similarity.masked_fill_(~seen[:, :, None], -torch.inf).amax(1)  # (p, Q)
        near = (x[chunk, None] - keypoint_x) ** 2 + (y[chunk, None] - keypoint_y) ** 2 <= radius**2
        good = near & free_points[chunk, None] & ~taken & (similarity > options.min_similarity)
        nearest = similarity.masked_fill_(~good, -torch.inf).max(0)
        better = nearest.values > best
        best = torch.where(better, nearest.values, best)
        point = torch.where(better, nearest.indices + begin, point)
    return one_to_one(point, best, count)


def one_to_one(point: Tensor, score: Tensor, point_count: int) -> Tensor:
    """Returns the best keypoint (P,) of each point, from each keypoint's best point (Q,) and its score (Q,)."""
    keypoint = torch.arange(len(point), device=point.device)
    return best_by_group(point, keypoint, score, point_count, len(point))[0]


def best_by_group(
    group: Tensor, candidate: Tensor, score: Tensor, group_count: int, candidate_count: int
) -> tuple[Tensor, Tensor]:
    """Finds the candidate with the highest score in each group; of equal ones that with the smallest index.

    Of M candidates: group (`group_count` G for none), index and score (M,). `candidate_count` stands for no candidate.
    Returns candidate and score of each group, (G,).
    """
    best = score.new_full((group_count + 1,), -torch.inf).scatter_reduce(0, group, score, "amax")
    chosen = torch.where(score == best[group], candidate, candidate_count)
    none = candidate.new_full((group_count + 1,), candidate_count)
    return none.scatter_reduce(0, group, chosen, "amin")[:-1], best[:-1]
