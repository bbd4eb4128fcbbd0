"""How far an answer is from its references, by the depth of what it sees, and how its error grows with that."""

from __future__ import annotations

import numpy as np

from ..results import Support

POSITION_GROWTH, ROTATION_GROWTH = 0.3, 0.3
"""Exponents of the gap in the ratio of errors to radii, from `research.self_calibration`."""

USUAL_GAP = 0.1
"""The gap at which factors are stated."""

LEAST_GAP, LARGEST_GAP = 0.03, 0.5
"""Beyond these, ratios do not change with the gap."""

SUPPORTING_SHARE = 0.1
"""References with fewer inliers, by those of the one with the most, do not hold the pose."""


def viewpoint_gap(support: Support) -> tuple[float, float]:
    """The distance to the nearest reference that holds the pose, by the median depth of the inliers; and that depth.

    Raises:
        ValueError: there is no estimate.
    """
    if support.estimate is None:
        raise ValueError("support.estimate must not be None")
    pose, counts = support.estimate.world_from_camera, np.array(support.inliers_by_reference())
    points = [support.structure.x_in_world[support.matches.point[support.estimate.inliers]]]
    if support.two_view is not None:
        points.append(support.two_view.x_in_world[support.two_view.inliers])
    depth = pose.inverse().apply(np.concatenate(points))[:, 2]
    depth_m = max(float(np.nanmedian(depth)) if len(depth) else 0.0, np.finfo(float).tiny)
    holding = np.flatnonzero(counts >= SUPPORTING_SHARE * counts.max())
    centres = np.array([support.references[i].world_from_camera.translation for i in holding])
    return float(np.linalg.norm(centres - pose.translation, axis=1).min()) / depth_m, depth_m


def growth(gap: float) -> tuple[float, float]:
    """Ratios of position's and rotation's errors to their radii at a gap, by those at the usual one."""
    ratio = float(np.clip(gap, LEAST_GAP, LARGEST_GAP)) / USUAL_GAP
    return ratio**POSITION_GROWTH, ratio**ROTATION_GROWTH
