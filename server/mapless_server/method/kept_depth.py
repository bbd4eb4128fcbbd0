"""Depths stored with the references: points where nothing can be triangulated, and better ones where little can.

A network has predicted the depth of each reference once, when it was added (see `scenes.depth`). A keypoint with depth
d and relative standard deviation s, of a camera at C with the viewing direction z, then has its point near the plane

    z . (x - C) = d,    with the standard deviation    s d.

Where the photograph matches many triangulated points, depths are not used: a network's errors are shared by all points
of a surface, so that they do not average out, and the references' own poses follow them. Otherwise a point that its
plane determines better than its rays is moved by what both say, each weighted by its information, unless they
contradict each other. A reference's keypoint that only the query matches becomes a point at its depth, which one
reference observes. Its error is along the ray, so it moves the photograph's keypoint along the epipolar line; the final
adjustment knows that, since it keeps the planes (see `bundle`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array

from .correspond import Correspondences
from .match import vote
from .observations import Tracks, keypoint_offsets, keypoint_rays
from .results import DepthPlanes, Structure
from .structure import observe
from .views import PosedView

MAX_CONTRADICTION = 3.0
"""A depth that is farther from its triangulated point, in standard deviations of both, is wrong: it is at an edge, or
the keypoint shows a reflection."""

ENOUGH_MATCHES = 200
"""With so many matches with triangulated points depths are not used. In `euroc-v101-drone`, with five references and
over a thousand, depths with shared errors of some per cent cost 5 cm; in the kitchen, where most photographs have less,
100 instead of 200 costs a tenth of the gain."""


def with_kept_depths(
    structure: Structure,
    references: Sequence[PosedView],
    correspondences: Correspondences,
    enough_matches: int = ENOUGH_MATCHES,
) -> Structure:
    """Adds the points that stored depths give to a structure, after the triangulated ones, with its `planes`.

    The references are in the order of the structure's tracks; the correspondences are those of the query with each. The
    structure, possibly without points, is unchanged if depths are not needed. A reference at least has some.
    """
    counts = [len(reference.view.features) for reference in references]
    if len(vote(structure, counts, correspondences)) >= enough_matches:
        return structure
    known = _KnownDepths.of(references)
    triangulated = _combined(structure, references, known)
    return _with_single(triangulated, references, correspondences, known)


@dataclass(frozen=True, eq=False)
class _KnownDepths:
    """Known depths of the N keypoints of all references.

    Attributes:
        offsets: (K + 1,) of each reference's keypoints.
        centre, ray, axis: (N, 3) camera centre, viewing ray of depth 1 and viewing direction, world.
        depth, sigma: (N,) depth and standard deviation in the unit of the poses; NaN where unknown.
    """

    offsets: NDArray[np.intp]
    centre: Array
    ray: Array
    axis: Array
    depth: Array
    sigma: Array

    @staticmethod
    def of(references: Sequence[PosedView]) -> "_KnownDepths":
        offsets = keypoint_offsets(references)
        counts = np.diff(offsets)
        depth, sigma = np.full(offsets[-1], np.nan), np.full(offsets[-1], np.nan)
        for reference, start, end in zip(references, offsets[:-1], offsets[1:], strict=True):
            if reference.depths is not None:
                depth[start:end] = reference.depths.depth
                sigma[start:end] = reference.depths.depth * reference.depths.relative_sigma
        axis = np.repeat([it.world_from_camera.rotation[:, 2] for it in references], counts, axis=0)
        return _KnownDepths(offsets, *keypoint_rays(references), axis, depth, sigma)

    def planes(self, rows: NDArray[np.intp]) -> DepthPlanes:
        """Planes of the points that these keypoints show; all must have a depth."""
        normal = self.axis[rows]
        offset = (normal * self.centre[rows]).sum(axis=1) + self.depth[rows]
        return DepthPlanes(normal, offset, self.sigma[rows] ** -2.0)


def _combined(structure: Structure, references: Sequence[PosedView], known: _KnownDepths) -> Structure:
    """Moves each triangulated point that a depth determines better, and does not contradict, by that depth."""
    tracks, count = structure.tracks, len(structure.x_in_world)
    none = DepthPlanes(np.zeros((count, 3)), np.zeros(count), np.zeros(count))
    row = known.offsets[tracks.view] + tracks.keypoint
    order = np.lexsort((known.sigma[row], tracks.point))  # NaN is last
    best = row[order[np.unique(tracks.point[order], return_index=True)[1]]] if count else row
    has_depth = np.isfinite(known.depth[best])
    if not has_depth.any():
        return replace(structure, planes=none)
    chosen, planes = np.flatnonzero(has_depth), known.planes(best[has_depth])
    kept = tracks.select(has_depth)
    x = structure.x_in_world[chosen]
    covariance = observe(kept, references, structure.noise).point_covariances(x)
    across = np.einsum("pij,pj->pi", covariance, planes.normal)
    variance = (across * planes.normal).sum(axis=1) + 1 / planes.information
    off = planes.offset - (planes.normal * x).sum(axis=1)
    is_better = variance > 2 / planes.information
    agrees = is_better & (off**2 <= MAX_CONTRADICTION**2 * variance)
    moved = structure.x_in_world.copy()
    moved[chosen[agrees]] += (across * (off / variance)[:, None])[agrees]
    for name in ("normal", "offset", "information"):
        getattr(none, name)[chosen[agrees]] = getattr(planes, name)[agrees]
    return replace(structure, x_in_world=moved, planes=none)


def _with_single(
    structure: Structure, references: Sequence[PosedView], correspondences: Correspondences, known: _KnownDepths
) -> Structure:
    """Adds a point for each matched keypoint that has a depth and observes no point."""
    tracks = structure.tracks
    matched = zip(correspondences.query_matches, known.offsets[:-1], strict=True)
    rows = np.unique(np.concatenate([pairs[:, 1] + start for pairs, start in matched]))
    rows = np.setdiff1d(rows[np.isfinite(known.depth[rows])], known.offsets[tracks.view] + tracks.keypoint)
    if not len(rows):
        return structure
    view = np.searchsorted(known.offsets, rows, side="right") - 1
    points = known.centre[rows] + known.ray[rows] * known.depth[rows, None]
    single = Tracks(np.arange(len(rows)), view, rows - known.offsets[view])
    return structure.and_last(points, single, known.planes(rows))
