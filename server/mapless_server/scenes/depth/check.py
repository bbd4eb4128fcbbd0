"""Checks the depths that a network predicts for references, and keeps those that agree with the poses.

The network sees references whose poses are known, and one more photograph, whose pose is known too but not given. Its
depths are compared with three independent results:

    the pose of that photograph    the network's depths are plausible if it finds this pose approximately;
    triangulated points            of each reference, matched with others: their median gives the reference's scale,
                                   and their spread the standard deviation of its depths;
    the other references           a pixel that lies in front of what others see there, more often than on it, is wrong:
                                   they look through it. One behind is hidden from them, which says nothing.

A reference is dropped whole that has too few triangulated points, whose depths disagree with them, or most of whose
pixels are wrong. Pixels at edges of depth are dropped, because a keypoint there may belong to either side.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform
from mapless_server.method.features.views import KeptDepth, PosedView, ReconstructedView, Reconstruction, map_cells
from mapless_server.method.optim.optimize import normal_sigma
from mapless_server.method.pairs.correspond import Correspondences
from mapless_server.method.pairs.readings.repeats import pose_difference
from mapless_server.method.structure.model import MetricScale, Structure
from mapless_server.method.structure.structure import StructureOptions, triangulated_structure

MAX_OFF, MAX_OFF_DEG = 0.1, 5.0
"""Largest error of the predicted pose that was not given: of its position as a share of the median depth, and of its
rotation. Networks are better by far where they understand a place."""
MIN_PARALLAX_DEG = 2.0
"""Least parallax of triangulated points: at 2 degrees a keypoint's error of half a pixel, at a focal length of 500 px,
is 3 % of the depth."""
MIN_POINTS = 20
"""Triangulated points of a reference."""
MAX_SCALE = 1.25
"""Largest factor between a reference's scale and that of all together."""
MIN_SIGMA, MAX_SIGMA = 0.01, 0.1
"""Relative standard deviation of depths: the least that is assumed, and the largest; less accurate ones are no better
than matches."""
AGREEING_SIGMA = 3.0
"""Depths of two references that differ by less, in their standard deviations, are of one surface."""
MAX_WRONG = 0.3
"""Largest share of wrong pixels, of those that another reference sees."""
MAX_STEP = 1.1
"""Largest factor between the depths of neighbouring pixels that are of one surface."""
MIN_CONFIDENCE = 0.1
"""Least confidence of the network for which a depth is kept."""


def checked_depths(
    reconstruction: Reconstruction,
    scale: MetricScale,
    references: Sequence[PosedView],
    world_from_query: RigidTransform,
    correspondences: Correspondences,
) -> list[KeptDepth | None]:
    """Returns the part of each reference's predicted depths that is kept; None if nothing is.

    The reconstruction is of the references and of the photograph whose pose, `world_from_query`, was not given; the
    correspondences are those of the references with one another.
    """
    options = StructureOptions(min_parallax_deg=MIN_PARALLAX_DEG)
    structure = triangulated_structure(references, correspondences, options)
    off, off_deg = pose_difference(scale.world_from_query, world_from_query)
    depths = [
        _scaled(view, scale.metres_per_unit, reference, _seen(structure, index), structure)
        for index, (view, reference) in enumerate(zip(reconstruction.references, references, strict=True))
    ]
    known = [float(np.nanmedian(it.depth)) for it in depths if it is not None]
    if not known:
        return [None] * len(references)
    is_found = off <= MAX_OFF * np.median(known) and off_deg <= MAX_OFF_DEG
    if not is_found:  # also if it is NaN
        return [None] * len(references)
    return [_confirmed(index, depths, references) for index in range(len(references))]


def _seen(structure: Structure, index: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The points that a reference observes, and its keypoints."""
    rows = structure.tracks.view == index
    return structure.tracks.point[rows], structure.tracks.keypoint[rows]


def _scaled(
    view: ReconstructedView,
    metres_per_unit: float,
    reference: PosedView,
    seen: tuple[NDArray[np.intp], NDArray[np.intp]],
    structure: Structure,
) -> KeptDepth | None:
    """A reference's depth at the scale of its triangulated points; None if it disagrees with them."""
    point, keypoint = seen
    predicted = metres_per_unit * view.point_map[..., 2].astype(np.float64)
    usable = np.isfinite(predicted) & (predicted > 0) & (view.confidence >= MIN_CONFIDENCE)
    depth = np.where(usable, predicted, np.nan)
    depth[~_is_smooth(depth)] = np.nan
    at_points = KeptDepth(view.camera, depth.astype(np.float32), 1.0).at_keypoints(reference.view).depth[keypoint]
    triangulated = reference.world_from_camera.inverse().apply(structure.x_in_world[point])[:, 2]
    ratio = np.log(triangulated / at_points)
    ratio = ratio[np.isfinite(ratio)]
    if len(ratio) < MIN_POINTS:
        return None
    middle = float(np.median(ratio))
    sigma = max(MIN_SIGMA, float(normal_sigma(ratio - middle)))
    if abs(middle) > np.log(MAX_SCALE) or sigma > MAX_SIGMA:
        return None
    return KeptDepth(view.camera, (depth * np.exp(middle)).astype(np.float32), sigma)


def _is_smooth(depth: Array) -> NDArray[np.bool_]:
    """Mask (H, W) of the pixels that are of one surface with their neighbours."""
    known = np.isfinite(depth)
    around = np.ones((3, 3), np.uint8)
    nearest = cv2.erode(np.where(known, depth, np.inf), around)
    farthest = cv2.dilate(np.where(known, depth, 0.0), around)
    return np.asarray(known & (farthest / MAX_STEP**2 <= nearest))


def _confirmed(index: int, depths: Sequence[KeptDepth | None], references: Sequence[PosedView]) -> KeptDepth | None:
    """Removes pixels in front of what others see there from a reference's depth; None if these are too many."""
    kept = depths[index]
    if kept is None:
        return None
    known = np.isfinite(kept.depth)
    rows, columns = np.nonzero(known)
    rays = kept.camera.rays(np.stack([columns, rows], axis=1).astype(np.float64))
    x_in_world = references[index].world_from_camera.apply(rays / rays[:, 2:] * kept.depth[known, None])
    votes, is_seen = np.zeros(len(rows), int), np.zeros(len(rows), bool)
    for other, reference in zip(depths, references, strict=True):
        if other is None or other is kept:
            continue
        x_in_camera = reference.world_from_camera.inverse().apply(x_in_world)
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = np.where(x_in_camera[:, 2:] > 0, other.camera.project(x_in_camera), -2.0)
        row, column, inside = map_cells(other.camera, pixels, other.camera)
        there = np.where(inside, other.depth[row, column], np.nan)
        off = np.log(np.where(inside, x_in_camera[:, 2], np.nan) / there)
        limit = AGREEING_SIGMA * np.hypot(kept.relative_sigma, other.relative_sigma)
        votes += (np.abs(off) <= limit).astype(int) - (off < -limit)
        is_seen |= np.abs(off) <= limit
        is_seen |= off < -limit
    is_wrong = votes < 0
    if not is_seen.any() or is_wrong.sum() > MAX_WRONG * is_seen.sum():
        return None
    depth = kept.depth.copy()
    depth[rows[is_wrong], columns[is_wrong]] = np.nan
    return KeptDepth(kept.camera, depth, kept.relative_sigma)
