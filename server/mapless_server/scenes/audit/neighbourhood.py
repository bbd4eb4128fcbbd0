"""What a reference's neighbours know of the place: points, from their own poses alone.

The reference that is examined takes no part, so whatever is wrong with it cannot bend the points that it is judged by.
A neighbour that is wrong itself loses its matches to the epipolar check or its points to the residuals, as long as the
others are more.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from threading import Lock

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

from .resection import ObservedPoints


class PairMatches:
    """Matches of pairs of photographs by descriptors alone, whatever their poses; remembers. Safe from many threads.

    `method.correspond.Matcher` remembers matches that satisfy the given poses, which are what is in question here.
    """

    def __init__(self, ratio: float = 0.9, remembered_pairs: int = 20_000) -> None:
        self._ratio, self._remembered_pairs = ratio, remembered_pairs
        self._remembered: OrderedDict[tuple[str, str], Matches] = OrderedDict()
        self._lock = Lock()

    def match(self, first: PosedView, second: PosedView) -> Matches:
        """Matches (M, 2): keypoints of the first and of the second."""
        if first.key > second.key:
            return np.ascontiguousarray(self.match(second, first)[:, ::-1])
        key = first.key, second.key
        with self._lock:
            if key in self._remembered:
                self._remembered.move_to_end(key)
                return self._remembered[key]
        matches = mutual_matches(first.view.features, second.view.features, self._ratio)
        with self._lock:
            self._remembered[key] = matches
            while len(self._remembered) > self._remembered_pairs:
                self._remembered.popitem(last=False)
        return matches


@dataclass(frozen=True, eq=False)
class Neighbourhood:
    """Points that neighbours see.

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
    """Triangulates what the references match among themselves; possibly nothing."""
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


def sight(subject: PosedView, neighbourhood: Neighbourhood, pairs: PairMatches) -> ObservedPoints:
    """The neighbourhood's points that the subject's photograph shows, by descriptors alone."""
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
