"""Depths of the references: points where nothing can be triangulated.

A sensor has measured the depth of a reference (see `measured_depth`), or a network has predicted it once, when it was
added (see `scenes.depth`). A keypoint with depth d and relative standard deviation s, of a camera at C with the viewing
direction z, then has its point near the plane

    z . (x - C) = d,    with the standard deviation    s d.

A reference's keypoint that only the query matches becomes a point at its depth, which one reference observes. Its error
is along the ray; the final adjustment keeps the planes (see `bundle`). Where the photograph matches mostly triangulated
points, these alone are used instead of a network's depths.

A factor is common to all depths of a photograph: the error of a sensor's scale, or of a network. It is seen at the
keypoints of triangulated points: the most probable one is removed, by the variances of depths and points, with Cauchy's
loss and a prior of its standard deviation. What is left of it moves all planes of a reference together, which the
pose's covariance contains (see `bundle.dispersion`). Points that are triangulated stay where they are.
"""

import math
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
from .structure import StructureOptions, observe

ITERATIONS = 6
"""Steps to a common factor, by reweighted least squares."""


def with_kept_depths(
    structure: Structure,
    references: Sequence[PosedView],
    correspondences: Correspondences,
    min_added_share: float = MIN_ADDED_SHARE,
) -> Structure:
    """Adds the points that depths give to a structure, after the triangulated ones, with its `planes`.

    Each is of a reference's keypoint that the query matches and that observes no triangulated point. The references
    are in the order of the structure's tracks; the correspondences are those of the query with each. The structure,
    possibly without points, is unchanged if depths are not needed. A reference at least has some.
    """
    known = _KnownDepths.of(references)
    rows = _single_rows(structure, correspondences, known)
    counts = [len(reference.view.features) for reference in references]
    if any(it.depths is not None and it.depths.source is DepthSource.MEASURED for it in references):
        min_added_share = 0.0
    if not len(rows) or len(rows) < min_added_share * len(vote(structure, counts, correspondences)):
        return structure
    return _with_single(structure, _without_common_factors(structure, references, known), rows)


@dataclass(frozen=True, eq=False)
class _KnownDepths:
    """Known depths of the N keypoints of all references.

    Attributes:
        offsets: (K + 1,) of each reference's keypoints.
        centre, ray, axis: (N, 3) camera centre, viewing ray of depth 1 and viewing direction, world.
        depth, sigma: (N,) depth and standard deviation in the unit of the poses; NaN where unknown.
        factor_sigma: (K,) standard deviation of the factor that the depths of each reference share.
    """

    offsets: NDArray[np.intp]
    centre: Array
    ray: Array
    axis: Array
    depth: Array
    sigma: Array
    factor_sigma: Array

    @staticmethod
    def of(references: Sequence[PosedView]) -> "_KnownDepths":
        offsets = keypoint_offsets(references)
        counts = np.diff(offsets)
        depth, sigma, factor_sigma = np.full(offsets[-1], np.nan), np.full(offsets[-1], np.nan), np.zeros(len(counts))
        for index, (reference, start, end) in enumerate(zip(references, offsets[:-1], offsets[1:], strict=True)):
            if reference.depths is not None:
                factor_sigma[index] = reference.depths.common_sigma
                depth[start:end] = reference.depths.depth
                sigma[start:end] = reference.depths.depth * reference.depths.relative_sigma
        axis = np.repeat([it.world_from_camera.rotation[:, 2] for it in references], counts, axis=0)
        return _KnownDepths(offsets, *keypoint_rays(references), axis, depth, sigma, factor_sigma)

    def planes(self, rows: NDArray[np.intp]) -> DepthPlanes:
        """Planes of the points that these keypoints show; all must have a depth."""
        normal = self.axis[rows]
        offset = (normal * self.centre[rows]).sum(axis=1) + self.depth[rows]
        view = np.searchsorted(self.offsets, rows, side="right") - 1
        common = self.factor_sigma[view] * self.depth[rows]
        return DepthPlanes(normal, offset, self.sigma[rows] ** -2.0, view, common)


def _without_common_factors(structure: Structure, references: Sequence[PosedView], known: _KnownDepths) -> _KnownDepths:
    """Divides the depths of each reference by the factor that triangulated points say they share."""
    tracks, depth, sigma = structure.tracks, known.depth.copy(), known.sigma.copy()
    factor_sigma = known.factor_sigma.copy()
    row = known.offsets[tracks.view] + tracks.keypoint
    has_depth = np.isfinite(known.depth[row])
    if not has_depth.any():
        return known
    observations = observe(tracks, references, structure.noise)
    covariance = observations.point_covariances(structure.x_in_world)[tracks.point]
    axis = known.axis[row]
    triangulated = (axis * (structure.x_in_world[tracks.point] - known.centre[row])).sum(axis=1)
    log_factor = np.log(known.depth[row] / triangulated)
    relative_variance = np.einsum("oi,oij,oj->o", axis, covariance, axis) / triangulated**2
    for view, reference in enumerate(references):
        seen = has_depth & (tracks.view == view)
        if reference.depths is None or not seen.any():
            continue
        common_sigma = reference.depths.common_sigma
        prior_information = common_sigma**-2 if common_sigma else math.inf
        own_variance = reference.depths.relative_sigma[tracks.keypoint[seen]].astype(np.float64) ** 2
        values, variance, common = log_factor[seen], own_variance + relative_variance[seen], 0.0
        for _ in range(ITERATIONS):
            # Depths are wrong at edges, and of what is reflected.
            squared = (values - common) ** 2 / variance
            weight = cauchy_weight(squared, StructureOptions.loss_scale_sigma) / variance
            information = float(weight.sum()) + prior_information
            common = float(weight @ values) / information
        its_rows = slice(known.offsets[view], known.offsets[view + 1])
        depth[its_rows] /= np.exp(common)
        sigma[its_rows] /= np.exp(common)
        factor_sigma[view] = information**-0.5
    return replace(known, depth=depth, sigma=sigma, factor_sigma=factor_sigma)


def _single_rows(structure: Structure, correspondences: Correspondences, known: _KnownDepths) -> NDArray[np.intp]:
    """Rows of the references' keypoints that the query matches, and that have a depth and observe no point."""
    tracks = structure.tracks
    matched = zip(correspondences.query_matches, known.offsets[:-1], strict=True)
    rows = np.unique(np.concatenate([pairs[:, 1] + start for pairs, start in matched]))
    return np.setdiff1d(rows[np.isfinite(known.depth[rows])], known.offsets[tracks.view] + tracks.keypoint)


def _with_single(structure: Structure, known: _KnownDepths, rows: NDArray[np.intp]) -> Structure:
    """Adds a point at its depth for each of these keypoints."""
    view = np.searchsorted(known.offsets, rows, side="right") - 1
    points = known.centre[rows] + known.ray[rows] * known.depth[rows, None]
    single = Tracks(np.arange(len(rows)), view, rows - known.offsets[view])
    unknown = DepthPlanes.unknown(len(structure.x_in_world))
    return replace(structure, planes=unknown).and_last(points, single, known.planes(rows))
