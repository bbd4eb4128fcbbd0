"""The neighbourhood of a reference: points that its neighbours triangulate among themselves.

The audited reference is not used, so its errors cannot affect the points by which it is judged. A neighbour that is
wrong itself loses its matches in the epipolar check or its points by their residuals, as long as most are right.

Which points a camera should show: a local feature is matched when it is seen from about the same direction and
distance: SIFT tolerates a turn of the surface of some tens of degrees and, in a photograph of limited size, a factor of
about two in scale. A point counts as visible if this holds for one of the references that observe it. Occlusion is not
known, so the count is an upper bound.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, RigidTransform
from mapless_server.method.features.matching import mutual_matches
from mapless_server.method.features.tracks import Tracks, build_tracks
from mapless_server.method.features.views import Matches, PosedView
from mapless_server.method.pairs.correspond import Correspondences
from mapless_server.method.pairs.epipolar import epipolar_distance_px
from mapless_server.method.pairs.stationary import IgnoredKeypoints, fixed_in, without_ignored
from mapless_server.method.structure.match import vote
from mapless_server.method.structure.model import PointMatches, Structure
from mapless_server.method.structure.observations import triangulate
from mapless_server.method.structure.structure import StructureOptions, observe, refine_points
from mapless_server.store import LruCache

from .resection import ObservedPoints


class PairMatches:
    """Matches of pairs of photographs by descriptors alone, cached; thread-safe.

    `method.pairs.correspond.Matcher` caches matches that agree with the given poses, which are what is audited here.
    """

    def __init__(self, ratio: float = 0.9, cached_pairs: int = 20_000) -> None:
        """Uses the `ratio` of the features, see `CorrespondOptions`."""
        self._ratio = ratio
        self._cache: LruCache[Matches] = LruCache(cached_pairs)

    def match(self, first: PosedView, second: PosedView) -> Matches:
        """Matches (M, 2): keypoints of the first and of the second photograph."""
        if first.key > second.key:
            return np.ascontiguousarray(self.match(second, first)[:, ::-1])
        key = first.key, second.key
        matches = self._cache.get(key)
        if matches is None:
            features = first.view.features
            matches = mutual_matches(features, second.view.features, self._ratio)
            self._cache.put(key, matches)
        return matches


@dataclass(frozen=True, eq=False)
class Neighbourhood:
    """Metric points that neighbours triangulate, and their tracks over the neighbours.

    The covariances of the points (P, 3, 3) are in square metres, world axes. `fixed` is what is fixed to the
    neighbours' cameras, such as a bonnet, and no part of the points.
    """

    references: tuple[PosedView, ...]
    structure: Structure
    point_covariance: Array
    fixed: IgnoredKeypoints


_EPIPOLAR_PX = 2.0
"""As for matching references."""


def build_neighbourhood(references: Sequence[PosedView], pairs: PairMatches) -> Neighbourhood:
    """Triangulates the matches among the references; the result may have no points."""
    options = StructureOptions()
    if len(references) < 2:
        nothing = np.empty(0, np.intp)
        structure = Structure(np.empty((0, 3)), Tracks(nothing, nothing, nothing), options.first_noise)
        return Neighbourhood(tuple(references), structure, np.empty((0, 3, 3)), fixed_in(references, {}))
    every = {(i, j): pairs.match(references[i], references[j]) for i, j in combinations(range(len(references)), 2)}
    fixed = fixed_in(references, every)
    ignored = [fixed.of(reference.view) for reference in references]
    matches = {}
    for (i, j), found in every.items():
        kept = without_ignored(found, ignored[i], ignored[j])
        matches[i, j] = kept[epipolar_distance_px(references[i], references[j], kept) < _EPIPOLAR_PX]
    tracks = build_tracks(matches, [len(r.view.features) for r in references])
    observations = observe(tracks, references, options.first_noise)
    refined = refine_points(observations, triangulate(observations), options)
    covariance = refined.observations.point_covariances(refined.x_in_world)
    trusted = refined.trusted & np.isfinite(covariance).all(axis=(1, 2))
    structure = Structure(refined.x_in_world[trusted], refined.observations.tracks.select(trusted), refined.noise)
    return Neighbourhood(tuple(references), structure, covariance[trusted], fixed)


def match_points(
    subject: PosedView, neighbourhood: Neighbourhood, pairs: PairMatches
) -> tuple[PointMatches, tuple[Matches, ...]]:
    """Matches the neighbourhood's points with the subject's photograph, by descriptors alone.

    The second result has the matches with each reference.
    """
    fixed = neighbourhood.fixed
    own = fixed.of(subject.view)
    found = tuple(
        without_ignored(pairs.match(subject, reference), own, fixed.of(reference.view))
        for reference in neighbourhood.references
    )
    if not len(neighbourhood.structure.x_in_world):
        nothing = np.empty(0, np.intp)
        return PointMatches(nothing, nothing, np.empty(0, bool), 0.0), found
    counts = [len(r.view.features) for r in neighbourhood.references]
    return vote(neighbourhood.structure, counts, Correspondences({}, found)), found


def observed_points(subject: PosedView, neighbourhood: Neighbourhood, found: PointMatches) -> ObservedPoints:
    """The points of the matches, where they are seen, and how accurately."""
    features = subject.view.features
    return ObservedPoints(
        features.pixels(found.keypoint),
        neighbourhood.structure.x_in_world[found.point],
        neighbourhood.point_covariance[found.point],
        np.asarray(neighbourhood.structure.noise.sigma_px(features.sizes_px[found.keypoint].astype(np.float64))),
    )


@dataclass(frozen=True)
class Visibility:
    """Limits within which a point counts as seen from about the same direction and distance.

    Attributes:
        max_turn_deg: largest angle between the viewing rays of the camera and of a reference that observes the point.
        max_scale: largest ratio of the point's sizes in pixels in both.
    """

    max_turn_deg: float
    max_scale: float


@dataclass(frozen=True, eq=False)
class Visible:
    """Points that a camera should show.

    Attributes:
        point: (V,) indices into the structure.
        pixel: (V, 2) their projections.
        turn_deg: (V,) angle to the viewing ray of the most similar observation.
        scale: (V,) ratio of the point's sizes in that reference's image and here, 1 or more.
        reference: (V,) index of that reference.
    """

    point: NDArray[np.intp]
    pixel: Array
    turn_deg: Array
    scale: Array
    reference: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.point)


def visible_points(
    camera: Camera, world_from_camera: RigidTransform, neighbourhood: Neighbourhood, limits: Visibility
) -> Visible:
    """The neighbourhood's points that a pinhole camera at this pose should show."""
    structure = neighbourhood.structure
    x_in_camera = world_from_camera.inverse().apply(structure.x_in_world)
    pixel = camera.project(x_in_camera)
    size = np.array([camera.width_px, camera.height_px])
    inside = np.all((pixel >= -0.5) & (pixel < size - 0.5), axis=1)

    centres = np.stack([r.world_from_camera.translation for r in neighbourhood.references])
    focals = np.array([r.view.camera.focal_x_px for r in neighbourhood.references])
    point, view = structure.tracks.point, structure.tracks.view
    theirs = structure.x_in_world[point] - centres[view]
    ours = structure.x_in_world[point] - world_from_camera.translation
    their_distance, our_distance = np.linalg.norm(theirs, axis=1), np.linalg.norm(ours, axis=1)
    cosine = (theirs * ours).sum(axis=1) / np.maximum(their_distance * our_distance, 1e-12)
    turn_deg = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    ratio = (camera.focal_x_px / np.maximum(our_distance, 1e-12)) / (focals[view] / their_distance)
    scale = np.maximum(ratio, 1 / np.maximum(ratio, 1e-12))

    alike: NDArray[np.bool_] = inside[point] & (turn_deg < limits.max_turn_deg) & (scale < limits.max_scale)
    rows = np.flatnonzero(alike)
    # Of a point's observations the most similar one, weighing angle and scale by their bounds.
    unlikeness = turn_deg[rows] / limits.max_turn_deg + np.log(scale[rows]) / np.log(limits.max_scale)
    rows = rows[np.lexsort((unlikeness, point[rows]))]
    rows = rows[np.diff(point[rows], prepend=-1) != 0]
    return Visible(point[rows], pixel[point[rows]], turn_deg[rows], scale[rows], view[rows])
