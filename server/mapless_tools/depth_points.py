"""The depth of references as coloured points, for pictures of scenes: few enough to be sent, and without edges."""

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapless import Reference
from mapless.depth import implausible_median
from mapless.geometry import Array
from mapless_server.errors import InvalidArgument
from mapless_server.images import ANY_SIZE, decode_depth
from mapless_server.method.structure.measured_depth import MeasuredDepth, median_depth
from mapless_tools.matches import Picture, colours_at

log = logging.getLogger(__name__)

DEPTH_POINTS, MAX_OF_REFERENCE = 200_000, 20_000
"""Points by depth in a picture of a scene, at most, and of one reference: some megabytes, which a browser draws."""
EDGE_SHARE = 0.05
"""A pixel whose depth differs by a larger share from that of a neighbour is left out: at edges sensors see points that
are not there."""


@dataclass(frozen=True, eq=False)
class ColouredPoints:
    """Points (N, 3) in the world, in the unit of poses, and their colours (N, 3), RGB."""

    points: Array
    colours: NDArray[np.uint8]


def share_of(reference_count: int) -> int:
    """Points that each of so many references may have."""
    return min(MAX_OF_REFERENCE, DEPTH_POINTS // max(reference_count, 1))


def depth_points(
    reference: Reference, picture: Picture, max_count: int, is_metric: bool = True
) -> ColouredPoints | None:
    """The depth of a reference, evenly thinned to so many points, in the colours of its photograph, possibly reduced.

    None without depth, or if it cannot be used; one that a server does not use, because it cannot be metres where the
    scene's unit is the metre, is named in the log.
    """
    depth, photo = reference.depth, reference.camera
    if depth is None or max_count < 1:
        return None
    try:
        values = decode_depth(depth, (photo.width_px, photo.height_px), ANY_SIZE)
    except InvalidArgument:
        return None
    if is_metric and (text := implausible_median(median_depth(values))):
        log.warning("the depth of reference %r is left out: its median is %s", reference.reference_id, text)
        return None
    camera = depth.camera or photo.resized(values.shape[1], values.shape[0])
    points = MeasuredDepth(camera, thinned(without_edges(values), max_count), depth.known_noise).points()
    if depth.camera_from_depth_camera is not None:
        points = depth.camera_from_depth_camera.apply(points)
    colours = np.full((len(points), 3), 128, np.uint8)
    seen = photo.project(np.where(points[:, 2:] > 0, points, [0.0, 0.0, 1.0]))
    inside = (points[:, 2] > 0) & ((seen >= -0.5) & (seen < (photo.width_px - 0.5, photo.height_px - 0.5))).all(axis=1)
    colours[inside] = colours_at(picture, photo, seen[inside])
    return ColouredPoints(reference.world_from_camera.apply(points), colours)


def without_edges(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Depths (H, W) with NaN at pixels beside a discontinuity."""
    found = depth.copy()
    rows, columns = (np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])
    for one, other in (rows, columns):
        jumps = np.abs(depth[one] - depth[other]) > EDGE_SHARE * np.minimum(depth[one], depth[other])
        found[one][jumps] = found[other][jumps] = np.nan
    return found


def thinned(depth: NDArray[np.float32], max_count: int) -> NDArray[np.float32]:
    """Depths (H, W) with at most so many values, those of each so-many-th row and column."""
    step = max(1, int(np.sqrt(np.isfinite(depth).sum() / max_count)))
    while True:
        found = np.full_like(depth, np.nan)
        found[step // 2 :: step, step // 2 :: step] = depth[step // 2 :: step, step // 2 :: step]
        if np.isfinite(found).sum() <= max_count:
            return found
        step += 1
