"""Structure: 3D points from tracks over the references, whose poses are known and fixed.

The paper's structure-only bundle adjustment: with fixed poses every point is its own problem of three unknowns,

    X_k = argmin sum_i rho(|| pi(P_i, X_k) - u_ki ||^2),     rho(s) = 2 c^2 (sqrt(1 + s / c^2) - 1)   (soft L1),

so all points take Levenberg-Marquardt steps at once, each with its own damping. Residuals are divided by the standard
deviation of their keypoint; in the paper's form this is one pixel for all. The equations are in `observations`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array
from mapless_server.bounds import check_bounds

from ..features.tracks import Tracks, build_tracks, keypoint_offsets
from ..features.views import Matches, PosedView, Reconstruction
from ..optim.optimize import columns, length, take
from ..pairs.correspond import Correspondences
from .model import MetricScale, PointMatches, Structure
from .observations import (
    FIRST_GUESS,
    ONE_PIXEL,
    KeypointNoise,
    Observations,
    adjust_points,
    better_start,
    estimate_noise,
    keypoint_depths,
    keypoint_rays,
    triangulate,
)

ENTRY_BYTES = 2048
"""Memory of a cached structure besides its arrays: objects, and the keys of ten references."""


@dataclass(frozen=True)
class StructureOptions:
    """Options of the structure.

    Attributes:
        all_references: merge tracks over all pairs of references (better poses) or, as the paper does, take the first
            reference's pairs alone.
        optimize: adjust the points; otherwise they stay as the reconstruction predicts them (the paper's ablation).
        model_noise: weight observations by the noise of their keypoint; the paper gives all the same weight.
        iterations: number of Levenberg-Marquardt steps, made twice; four converge from a good start.
        loss_scale_sigma: residual, in standard deviations, at which the loss turns from square to linear.
        max_residual_sigma: points with a larger residual in any view are dropped; None keeps all.
        min_parallax_deg: points with a smaller parallax are dropped, because their depth is not determined.
    """

    all_references: bool = True
    optimize: bool = True
    model_noise: bool = True
    iterations: int = 4
    loss_scale_sigma: float = 2.0
    max_residual_sigma: float | None = 4.0
    min_parallax_deg: float = 0.5

    def __post_init__(self) -> None:
        check_bounds(self, "iterations loss_scale_sigma", above=0)
        if self.max_residual_sigma is not None:
            check_bounds(self, "max_residual_sigma", above=0)
        check_bounds(self, "min_parallax_deg", at_least=0, below=90)

    @property
    def first_noise(self) -> KeypointNoise:
        """Noise of the keypoints before it is estimated from the residuals."""
        return FIRST_GUESS if self.model_noise else ONE_PIXEL


PAPER_STRUCTURE = StructureOptions(
    all_references=False,
    model_noise=False,
    iterations=12,
    loss_scale_sigma=1.0,
    max_residual_sigma=None,
    min_parallax_deg=0.0,
)
"""The paper's form."""


def build_structure(
    reconstruction: Reconstruction,
    scale: MetricScale,
    references: Sequence[PosedView],
    correspondences: Correspondences,
    options: StructureOptions,
) -> Structure:
    """Triangulates metric points from the references' tracks, starting at the reconstruction's depths; possibly none.

    The reconstruction's references are in the order of `references`; the correspondences are those between them. Every
    point is finite and in front of the references that observe it. `PAPER_STRUCTURE` is the paper's form.
    """
    counts = [len(reference.view.features) for reference in references]
    tracks = build_tracks(correspondences.reference_pairs, counts, None if options.all_references else 0)
    observations = observe(tracks, references, options.first_noise)
    start = predicted_points(reconstruction, scale, references, tracks)
    if options.optimize and options.all_references:
        start = better_start(observations, start, triangulate(observations), options.loss_scale_sigma)
    return _refined(observations, start, options)


def triangulated_structure(
    references: Sequence[PosedView], correspondences: Correspondences, options: StructureOptions
) -> Structure:
    """Triangulates the structure of one reference or more from their poses alone, over all their pairs.

    It depends neither on the query nor on the references' order, so it is computed once for a set of references: in
    the order of their names, in the caller's world around the first of these.
    """
    source = correspondences.source
    given = references if source is None else source.references
    order = sorted(range(len(given)), key=lambda i: (given[i].name, given[i].key))
    structure = None if source is None else source.cache.get(source.key(options))
    if not isinstance(structure, Structure):
        structure = _triangulated(given, order, correspondences.reference_pairs, options)
        if source is not None:
            source.cache.put(source.key(options), structure, structure.size_bytes + ENTRY_BYTES)
    return structure.moved(order, references[order[0]].world_from_camera.translation)


def _triangulated(
    references: Sequence[PosedView],
    order: Sequence[int],
    pairs: Mapping[tuple[int, int], Matches],
    options: StructureOptions,
) -> Structure:
    """Triangulates references in an order, relative to the camera centre of the first of these."""
    origin = references[order[0]].world_from_camera.translation
    ordered = [
        replace(references[i], world_from_camera=references[i].world_from_camera.shifted(-origin)) for i in order
    ]
    matches = {
        (a, b): pairs[i, j] if i < j else pairs[j, i][:, ::-1]
        for (a, i), (b, j) in combinations(enumerate(order), 2)
        if (min(i, j), max(i, j)) in pairs
    }
    tracks = build_tracks(matches, [len(reference.view.features) for reference in ordered])
    observations = observe(tracks, ordered, options.first_noise)
    return _refined(observations, triangulate(observations), options)


def _refined(observations: Observations, start: Array, options: StructureOptions) -> Structure:
    refined = refine_points(observations, start, options)
    tracks = refined.observations.tracks.select(refined.trusted)
    return Structure(refined.x_in_world[refined.trusted], tracks, refined.noise)


@dataclass(frozen=True, eq=False)
class RefinedPoints:
    """Adjusted points.

    Attributes:
        x_in_world: (P, 3) metres.
        observations: observations of these points, without outliers.
        trusted: (P,) which points to keep.
        noise: noise of the keypoints.
    """

    x_in_world: Array
    observations: Observations
    trusted: NDArray[np.bool_]
    noise: KeypointNoise


def refine_points(observations: Observations, x_in_world: Array, options: StructureOptions) -> RefinedPoints:
    """Adjusts points from their initial values (P, 3); `observations` must have the noise `options.first_noise`."""
    points, noise = x_in_world, options.first_noise
    if options.optimize:
        points = adjust_points(observations, points, options.loss_scale_sigma, options.iterations)
        if options.model_noise:
            noise = estimate_noise(observations, points, noise)
            observations = replace(observations, sigma_px=noise.sigma_px(observations.size_px))
        if options.max_residual_sigma is not None:
            # A track with one wrong match has right observations too.
            explained = length(observations.residuals(points).T) < options.max_residual_sigma
            observations, points = observations.prune(explained, points)
        points = adjust_points(observations, points, options.loss_scale_sigma, options.iterations)
    return RefinedPoints(points, observations, trustworthy(observations, points, options), noise)


def trustworthy(observations: Observations, x_in_world: Array, options: StructureOptions) -> NDArray[np.bool_]:
    """Mask (P,) of the points that are finite, fit all their observations and have enough parallax."""
    limit = options.max_residual_sigma
    explained = observations.max_by_point(length(observations.residuals(x_in_world).T)) < (limit or np.inf)
    return np.asarray(explained & (parallaxes_deg(observations, x_in_world) >= options.min_parallax_deg))


def parallaxes_deg(observations: Observations, x_in_world: Array) -> Array:
    """Largest angle (P,) at each point between its first observation and another one, degrees."""
    direction = take(columns(x_in_world), observations.tracks.point) - observations.rays()[0]
    direction = direction / (direction**2).sum(0) ** 0.5
    cosine = (direction * take(direction, observations.tracks.starts[observations.tracks.point])).sum(0)
    return observations.max_by_point(np.rad2deg(np.arccos(np.clip(cosine, -1, 1))))


def observe(tracks: Tracks, references: Sequence[PosedView], noise: KeypointNoise) -> Observations:
    """Makes the observations of tracks over these references."""
    poses, cameras = [r.world_from_camera.inverse() for r in references], [r.view.camera for r in references]
    pixels = np.concatenate([r.view.features.pixels() for r in references])
    rows = keypoint_offsets(references)[tracks.view] + tracks.keypoint
    sizes_px = np.concatenate([r.view.features.sizes_px for r in references]).astype(np.float64)[rows]

    def of_view(values: Sequence[object]) -> Array:
        return take(columns(np.array(values)), tracks.view)

    return Observations(
        tracks,
        columns(pixels[rows]),
        sizes_px,
        noise.sigma_px(sizes_px),
        of_view([it.rotation for it in poses]),
        of_view([it.translation for it in poses]),
        of_view([(it.focal_x_px, it.focal_y_px) for it in cameras]),
        of_view([(it.principal_x_px, it.principal_y_px) for it in cameras]),
    )


def predicted_points(
    reconstruction: Reconstruction, scale: MetricScale, references: Sequence[PosedView], tracks: Tracks
) -> Array:
    """Back-projects the first keypoint of each track with its predicted depth at metric scale, (P, 3) in the world.

    Points are NaN where the reconstruction has no depth.
    """
    first = keypoint_offsets(references)[tracks.view[tracks.starts]] + tracks.keypoint[tracks.starts]
    centre, ray = keypoint_rays(references)
    depth = keypoint_depths(reconstruction, references)
    return np.asarray(centre[first] + ray[first] * (scale.metres_per_unit * depth[first])[:, None])


def query_tracks(
    references: Sequence[PosedView],
    structure: Structure,
    query_matches: Sequence[Matches],
    free: NDArray[np.bool_],
) -> Tracks:
    """Builds tracks of the query's free keypoints and the references' keypoints that they match and no point has.

    The query is the last view; `free` is (N,) over its keypoints. Each of these is a point, for no keypoint of a
    reference matches two.
    """
    offsets, tracks = keypoint_offsets(references), structure.tracks
    is_observed = np.zeros(offsets[-1], bool)
    is_observed[offsets[tracks.view] + tracks.keypoint] = True
    view = np.repeat(np.arange(len(query_matches)), [len(it) for it in query_matches])
    own, theirs = np.concatenate([np.empty((0, 2), np.intp), *query_matches]).T
    unused = free[own] & ~is_observed[offsets[view] + theirs]
    own, theirs, view = own[unused], theirs[unused], view[unused]
    seen, first, point = np.unique(own, return_index=True, return_inverse=True)
    by_first = np.argsort(offsets[view[first]] + theirs[first])  # the order of `build_tracks`
    points = np.concatenate([np.argsort(by_first)[point], np.arange(len(seen))])
    views = np.concatenate([view, np.full(len(seen), len(references))])
    return Tracks.in_order(points, views, np.concatenate([theirs, seen[by_first]]))


def with_query_points(
    query: PosedView,
    references: Sequence[PosedView],
    structure: Structure,
    matches: PointMatches,
    tracks: Tracks,
    options: StructureOptions,
) -> tuple[Structure, PointMatches]:
    """Adds the points of `query_tracks`, triangulated with the query at a pose, and the query's matches with them.

    Most are observed by a single reference; those that do not fit the pose, or have too little parallax, are left out.
    """
    observations = observe(tracks, [*references, query], structure.noise)
    refined = refine_points(observations, triangulate(observations), replace(options, model_noise=False))
    found = refined.observations.tracks
    chosen = np.zeros(found.point_count, bool)
    chosen[found.point[found.view == len(references)]] = True
    chosen &= refined.trusted
    found, count = found.select(chosen), len(structure.x_in_world)
    is_query = found.view == len(references)
    seen = Tracks(found.point[~is_query], found.view[~is_query], found.keypoint[~is_query])
    added = count + found.point[is_query]
    return structure.and_last(refined.x_in_world[chosen], seen), matches.and_last(added, found.keypoint[is_query])


def tracks_with_query(
    structure: Structure, point: NDArray[np.intp], keypoint: NDArray[np.intp], view: int
) -> tuple[Tracks, NDArray[np.bool_]]:
    """Builds tracks over references and query, of the points that the query, view number `view`, is matched with.

    Each match has a point (M,) of the structure's P, none twice, and a keypoint (M,) of the query. Also returns a mask
    (P,) of the points that the tracks belong to.
    """
    chosen = np.zeros(len(structure.x_in_world), bool)
    chosen[point] = True
    seen = structure.tracks.select(chosen)
    points = np.concatenate([seen.point, np.cumsum(chosen)[point] - 1])
    views = np.concatenate([seen.view, np.full(len(point), view)])
    return Tracks.in_order(points, views, np.concatenate([seen.keypoint, keypoint])), chosen
