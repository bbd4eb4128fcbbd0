"""Depths of the references: points where nothing can be triangulated, and observations of those that are.

A sensor has measured the depth of a reference (see `measured_depth`), or a network has predicted it once, when it was
added (see `scenes.depth`). A keypoint with depth d and relative standard deviation s, of a camera at C with the viewing
direction z, then has its point near the plane

    z . (x - C) = d,    with the standard deviation    s d.

A reference's keypoint that only the query matches becomes a point at its depth, which one reference observes. A point
that is triangulated keeps its place, and lies near the plane of its most certain depth, unless that is off by more than
both errors allow, as at an edge or in a mirror. The final adjustment weighs planes and observations (see `bundle`): the
smaller the baseline, the more the depth counts. Where the photograph matches mostly triangulated points, these alone
are used instead of a network's depths.

Triangulated points with too little parallax are dropped (see `structure`). Of those near this bound the ones are left
that errors of their keypoints made nearer, so they are biased. The depths say how much parallax a point has: where such
errors may bring it below the bound, the point says nothing of common errors, and lies at its depth if that is more
certain than the triangulation.

All depths of a photograph share errors of the sensor, or of the network: a factor, and an offset, here in terms of
the median depth m,

    ln d = ln z + a + b (m / z - 1),

both with the standard deviation of the factor. They are seen at the keypoints of triangulated points: the most probable
ones are removed, by the variances of depths and points, with Cauchy's loss and their prior, so an offset remains 0
where depths do not differ. What is left of them moves the planes of all references together, as they have one sensor,
which the pose's covariance contains (see `bundle.dispersion`). Evidence: depth-errors.

Neighbouring depths share errors, too, so n of them do not average out: they count as of `REGIONS` regions, each with an
error of its own as large as the common one. Those of a reference share the error of its pose as well, so they count as
fewer, `PLACED_REGIONS`: the variance of each is larger by n / `PLACED_REGIONS` of its square. So hundreds of depths do
not outweigh what is triangulated.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array

from ..features.tracks import Tracks, keypoint_offsets
from ..features.views import DepthSource, PosedView
from ..optim.optimize import cauchy_weight
from ..pairs.correspond import Correspondences
from .match import vote
from .model import MIN_ADDED_SHARE, DepthPlanes, Structure
from .observations import keypoint_rays
from .structure import StructureOptions, observe, parallaxes_deg

ITERATIONS = 6
"""Steps to the common errors, by reweighted least squares."""

REGIONS = 20
"""Regions of an image whose depths have independent errors. Evidence: depth-errors."""

PLACED_REGIONS = 5
"""The same for points at the depths of a reference, whose errors of the pose they share. Evidence: depth-errors."""

AGREEING_SIGMA = 3.0
"""Largest residual of a right match, and difference of a depth from a triangulated point that it is of, in standard
deviations."""


def with_kept_depths(
    structure: Structure,
    references: Sequence[PosedView],
    correspondences: Correspondences,
    min_added_share: float = MIN_ADDED_SHARE,
) -> Structure:
    """Adds the points that depths give to a structure, after the triangulated ones, and the `planes` of both.

    Those are of the references' keypoints that the query matches and that observe no triangulated point. The references
    are in the order of the structure's tracks; the correspondences are those of the query with each. The structure,
    possibly without points, is unchanged if depths are not needed. A reference at least has some.
    """
    known = _KnownDepths.of(references)
    single = _single_rows(structure, correspondences, known)
    counts = [len(reference.view.features) for reference in references]
    matched = vote(structure, counts, correspondences).point
    if any(it.depths is not None and it.depths.source is DepthSource.MEASURED for it in references):
        min_added_share = 0.0
    if len(single) < min_added_share * len(matched):
        return structure
    observed = _Observed.of(structure, references, known)
    known = _without_common_errors(observed, references, known)
    poor = observed.poor(known)
    if len(poor):
        kept = ~np.isin(np.arange(len(structure.x_in_world)), poor)
        structure = replace(structure, x_in_world=structure.x_in_world[kept], tracks=structure.tracks.select(kept))
        observed, single = _Observed.of(structure, references, known), _single_rows(structure, correspondences, known)
        matched = vote(structure, counts, correspondences).point
    triangulated = observed.agreeing(known, matched)
    if not len(single) + len(triangulated[0]):
        return structure
    return _with_planes(structure, known, triangulated, single)


@dataclass(frozen=True, eq=False)
class _KnownDepths:
    """Known depths of the N keypoints of all references.

    Attributes:
        offsets: (K + 1,) of each reference's keypoints.
        centre, ray, axis: (N, 3) camera centre, viewing ray of depth 1 and viewing direction, world.
        depth, sigma: (N,) depth and standard deviation in the unit of the poses; NaN where unknown.
        shared_sigma: (N,) standard deviation of the errors that neighbours share, as a share of the depth.
        common: (N, 2) change of a depth, as a share of it, by one standard deviation of each of the two independent
            common errors of its reference's depths.
    """

    offsets: NDArray[np.intp]
    centre: Array
    ray: Array
    axis: Array
    depth: Array
    sigma: Array
    shared_sigma: Array
    common: Array

    @staticmethod
    def of(references: Sequence[PosedView]) -> "_KnownDepths":
        offsets = keypoint_offsets(references)
        counts = np.diff(offsets)
        depth, sigma, shared = (np.full(offsets[-1], np.nan) for _ in range(3))
        common = np.zeros((offsets[-1], 2))
        for reference, start, end in zip(references, offsets[:-1], offsets[1:], strict=True):
            if reference.depths is not None:
                its = slice(start, end)
                depth[its] = reference.depths.depth
                sigma[its] = reference.depths.depth * reference.depths.relative_sigma
                shared[its] = reference.depths.common_sigma
                common[its] = reference.depths.common_sigma * _common_slopes(depth[its])
        axis = np.repeat([it.world_from_camera.rotation[:, 2] for it in references], counts, axis=0)
        return _KnownDepths(offsets, *keypoint_rays(references), axis, depth, sigma, shared, common)

    def views(self, rows: NDArray[np.intp]) -> NDArray[np.intp]:
        """The reference of each of these keypoints."""
        return np.searchsorted(self.offsets, rows, side="right") - 1

    def own_variance(self, rows: NDArray[np.intp]) -> Array:
        """Variances of these depths without what they share, as shares of them."""
        return np.asarray((self.sigma[rows] / self.depth[rows]) ** 2)

    def planes(self, rows: NDArray[np.intp]) -> DepthPlanes:
        """Planes of the points that these keypoints show; all must have a depth."""
        normal, view = self.axis[rows], self.views(rows)
        offset = (normal * self.centre[rows]).sum(axis=1) + self.depth[rows]
        count = np.bincount(view, minlength=len(self.offsets))[view]
        variance = self.sigma[rows] ** 2 + (self.shared_sigma[rows] * self.depth[rows]) ** 2 * count / PLACED_REGIONS
        return DepthPlanes(normal, offset, 1 / variance, view, self.common[rows] * self.depth[rows, None])


def _common_slopes(depth: Array) -> Array:
    """Derivatives (N, 2) of the logarithms of depths by a common factor, and by an offset in median depths.

    The offset's is 0 at the median depth, so that the factor is that of the median.
    """
    if not np.isfinite(depth).any():
        return np.zeros((len(depth), 2))
    return np.stack([np.ones(len(depth)), np.nanmedian(depth) / depth - 1], axis=1)


@dataclass(frozen=True, eq=False)
class _Observed:
    """Observations of triangulated points by keypoints with a depth.

    Attributes:
        point, row, view, keypoint: (O,) of each observation; the row is of `_KnownDepths`.
        inverse_depth: (O,) of the triangulated point in the reference. Its errors are symmetric, and as large wherever
            along the ray the point came to lie.
        inverse_variance: (O,) its variance.
        depth_parallax: (O,) depth times parallax, degrees: the same wherever along the ray the point lies.
    """

    point: NDArray[np.intp]
    row: NDArray[np.intp]
    view: NDArray[np.intp]
    keypoint: NDArray[np.intp]
    inverse_depth: Array
    inverse_variance: Array
    depth_parallax: Array

    @staticmethod
    def of(structure: Structure, references: Sequence[PosedView], known: _KnownDepths) -> "_Observed":
        tracks = structure.tracks
        row = known.offsets[tracks.view] + tracks.keypoint
        seen = np.flatnonzero(np.isfinite(known.depth[row]))
        point, row = tracks.point[seen], row[seen]
        observations, x_in_world = observe(tracks, references, structure.noise), structure.x_in_world
        covariance, parallax_deg = observations.point_covariances(x_in_world), parallaxes_deg(observations, x_in_world)
        axis = known.axis[row]
        depth = (axis * (x_in_world[point] - known.centre[row])).sum(axis=1)
        variance = np.einsum("oi,oij,oj->o", axis, covariance[point], axis)
        seen_by = tracks.view[seen], tracks.keypoint[seen]
        return _Observed(point, row, *seen_by, 1 / depth, variance / depth**4, parallax_deg[point] * depth)

    def is_sure(self, known: _KnownDepths) -> NDArray[np.bool_]:
        """Whether points at the depths (O,) have so much parallax that no error of their keypoints drops them."""
        _, variance = self.compared(known)
        least = self.depth_parallax / known.depth[self.row] * (1 - AGREEING_SIGMA * np.sqrt(variance))
        return np.asarray(least > StructureOptions.min_parallax_deg)

    def compared(self, known: _KnownDepths) -> tuple[Array, Array]:
        """By which shares (O,) the depths are too long, and the variances (O,) of these by the triangulation."""
        depth = known.depth[self.row]
        return depth * self.inverse_depth - 1, depth**2 * self.inverse_variance

    def agrees(self, known: _KnownDepths) -> NDArray[np.bool_]:
        """Whether the depths (O,) are those of the points."""
        excess, variance = self.compared(known)
        return np.asarray(np.abs(excess) < AGREEING_SIGMA * np.sqrt(known.own_variance(self.row) + variance))

    def poor(self, known: _KnownDepths) -> NDArray[np.intp]:
        """Points that would be dropped if they seemed to be farther, and have an agreeing depth that is more exact."""
        _, variance = self.compared(known)
        is_better = known.own_variance(self.row) + known.shared_sigma[self.row] ** 2 < variance
        return np.unique(self.point[self.agrees(known) & is_better & ~self.is_sure(known)])

    def agreeing(self, known: _KnownDepths, among: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """The points (Q,) among some that a depth agrees with, and the row of the most certain one."""
        order = np.lexsort((known.own_variance(self.row), self.point))
        order = order[(self.agrees(known) & np.isin(self.point, among))[order]]
        point, first = np.unique(self.point[order], return_index=True)
        return point, self.row[order[first]]


def _without_common_errors(observed: _Observed, references: Sequence[PosedView], known: _KnownDepths) -> _KnownDepths:
    """Corrects the depths of each reference by the factor and the offset that triangulated points say they share."""
    depth, sigma, common = known.depth.copy(), known.sigma.copy(), known.common.copy()
    (excess, triangulation), is_sure = observed.compared(known), observed.is_sure(known)
    for view, reference in enumerate(references):
        seen = (observed.view == view) & is_sure
        if reference.depths is None or not reference.depths.common_sigma or not seen.any():
            continue
        its = slice(known.offsets[view], known.offsets[view + 1])
        slopes, common_sigma = _common_slopes(known.depth[its]), reference.depths.common_sigma
        keypoints = observed.keypoint[seen]
        own_variance = reference.depths.relative_sigma[keypoints].astype(np.float64) ** 2
        variance = own_variance + triangulation[seen] + common_sigma**2 * seen.sum() / REGIONS
        errors, covariance = _common_errors(excess[seen], slopes[keypoints], variance, common_sigma)
        factor = np.exp(-slopes @ errors)
        depth[its] *= factor
        sigma[its] *= factor
        common[its] = slopes @ np.linalg.cholesky(covariance)
    return replace(known, depth=depth, sigma=sigma, common=common)


def _common_errors(excess: Array, slopes: Array, variance: Array, prior_sigma: float) -> tuple[Array, Array]:
    """The most probable factor and offset (2,) of depths that are too long by shares, and their covariance (2, 2)."""
    errors: Array = np.zeros(2)
    prior = np.diag(np.full(2, prior_sigma**-2))
    for _ in range(ITERATIONS):
        # Depths are wrong at edges, and of what is reflected.
        squared = (excess - slopes @ errors) ** 2 / variance
        weighted = slopes * (cauchy_weight(squared, StructureOptions.loss_scale_sigma) / variance)[:, None]
        information = weighted.T @ slopes + prior
        errors = np.asarray(np.linalg.solve(information, weighted.T @ excess))
    return errors, np.asarray(np.linalg.inv(information))


def _single_rows(structure: Structure, correspondences: Correspondences, known: _KnownDepths) -> NDArray[np.intp]:
    """Rows of the references' keypoints that the query matches, and that have a depth and observe no point."""
    tracks = structure.tracks
    matched = zip(correspondences.query_matches, known.offsets[:-1], strict=True)
    rows = np.unique(np.concatenate([pairs[:, 1] + start for pairs, start in matched]))
    return np.setdiff1d(rows[np.isfinite(known.depth[rows])], known.offsets[tracks.view] + tracks.keypoint)


def _with_planes(
    structure: Structure,
    known: _KnownDepths,
    triangulated: tuple[NDArray[np.intp], NDArray[np.intp]],
    single: NDArray[np.intp],
) -> Structure:
    """Adds planes to triangulated points, by point and row, and a point at its depth for each of the single rows."""
    (point, row), view = triangulated, known.views(single)
    planes = known.planes(np.concatenate([row, single]))
    which = np.full(len(structure.x_in_world), len(point))
    which[point] = np.arange(len(point))
    of_points = planes[: len(point)].and_last(DepthPlanes.unknown(1))[which]
    x_in_world = known.centre[single] + known.ray[single] * known.depth[single, None]
    tracks = Tracks(np.arange(len(single)), view, single - known.offsets[view])
    return replace(structure, planes=of_points).and_last(x_in_world, tracks, planes[len(point) :])
