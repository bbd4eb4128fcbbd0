"""The neighbourhood of a reference: points that its neighbours triangulate among themselves.

The audited reference takes no part, so its errors cannot affect the points by which it is judged. A neighbour that is
wrong itself loses its matches in the epipolar check or its points by their residuals, as long as most are right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from mapless.geometry import Array
from mapless_server.method.arrays import invert_symmetric
from mapless_server.method.correspond import Correspondences, epipolar_distance_px, mutual_matches
from mapless_server.method.match import vote
from mapless_server.method.observations import Observations, triangulate
from mapless_server.method.results import Structure
from mapless_server.method.structure import StructureOptions, observe, refine_points
from mapless_server.method.tracks import Tracks, build_tracks
from mapless_server.method.views import Matches, PosedView
from mapless_server.store import LruCache

from .resection import ObservedPoints


class PairMatches:
    """Matches of pairs of photographs by descriptors alone, cached; thread-safe.

    `method.correspond.Matcher` caches matches that agree with the given poses, which are what is audited here.
    """

    def __init__(self, ratio: float = 0.9, cached_pairs: int = 20_000) -> None:
        """`ratio` is that of the features, see `CorrespondOptions`."""
        self._ratio = ratio
        self._cache: LruCache[Matches] = LruCache(cached_pairs)

    def match(self, first: PosedView, second: PosedView) -> Matches:
        """Matches (M, 2): keypoints of the first and of the second."""
        if first.key > second.key:
            return np.ascontiguousarray(self.match(second, first)[:, ::-1])
        key = first.key, second.key
        matches = self._cache.get(key)
        if matches is None:
            matches = mutual_matches(first.view.features, second.view.features, self._ratio)
            self._cache.put(key, matches)
        return matches


@dataclass(frozen=True, eq=False)
class Neighbourhood:
    """Points that neighbours triangulate.

    Attributes:
        references: the neighbours.
        structure: metric points and their tracks over the neighbours.
        point_covariance: (P, 3, 3) square metres, world axes.
    """

    references: tuple[PosedView, ...]
    structure: Structure
    point_covariance: Array


def build_neighbourhood(
    references: Sequence[PosedView], pairs: PairMatches, epipolar_px: float, options: StructureOptions
) -> Neighbourhood:
    """Triangulates the matches among the references; there may be none."""
    if len(references) < 2:
        nothing = np.empty(0, np.intp)
        structure = Structure(np.empty((0, 3)), Tracks(nothing, nothing, nothing), options.first_noise)
        return Neighbourhood(tuple(references), structure, np.empty((0, 3, 3)))
    matches = {}
    for i, j in combinations(range(len(references)), 2):
        first, second = references[i], references[j]
        found = pairs.match(first, second)
        matches[i, j] = found[epipolar_distance_px(first, second, found) < epipolar_px]
    tracks = build_tracks(matches, [len(r.view.features) for r in references])
    observations = observe(tracks, references, options.first_noise)
    refined = refine_points(observations, triangulate(observations), options)
    left = refined.observations.tracks
    assert isinstance(left, Tracks)
    covariance = _point_covariance(refined.observations, refined.x_in_world)
    trusted = refined.trusted & np.isfinite(covariance).all(axis=(1, 2))
    structure = Structure(refined.x_in_world[trusted], left.select(trusted), refined.noise)
    return Neighbourhood(tuple(references), structure, covariance[trusted])


def match_points(subject: PosedView, neighbourhood: Neighbourhood, pairs: PairMatches) -> ObservedPoints:
    """The neighbourhood's points that are matched in the subject's photograph, by descriptors alone."""
    if not len(neighbourhood.structure.x_in_world):
        return ObservedPoints(np.empty((0, 2)), np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0))
    matches = tuple(pairs.match(subject, reference) for reference in neighbourhood.references)
    counts = [len(r.view.features) for r in neighbourhood.references]
    found = vote(neighbourhood.structure, counts, Correspondences({}, matches))
    features = subject.view.features
    return ObservedPoints(
        features.keypoints[found.keypoint].astype(np.float64),
        neighbourhood.structure.x_in_world[found.point],
        neighbourhood.point_covariance[found.point],
        np.asarray(neighbourhood.structure.noise.sigma_px(features.sizes_px[found.keypoint].astype(np.float64))),
    )


def _point_covariance(observations: Observations, x_in_world: Array) -> Array:
    _, jacobians = observations.linearized(x_in_world)
    return np.asarray(invert_symmetric(observations.sum_by_point(np.swapaxes(jacobians, 1, 2) @ jacobians)))
