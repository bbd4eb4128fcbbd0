"""The depth of what photographs show, and whether it is plausible in metres: a wrong unit changes no angle."""

from collections.abc import Sequence

import numpy as np

from ..epipolar import MIN_PARALLAX_DEG, triangulate_depths
from .errors import MatchedPair, Views

MIN_POINTS = 100
"""Fewer points give no typical depth."""
MIN_DEPTH_M, MAX_DEPTH_M = 0.05, 500.0
"""Plausible median depths of photographs, metres; other units differ by a thousand. Evidence: scene-agreement."""


def median_depth(views: Views, matched: Sequence[MatchedPair]) -> float | None:
    """Median depth of points that pairs of photographs show, in the unit of the poses; None if there are too few."""
    depths = []
    for item in matched:
        centre, ray = [], []
        for side, index in enumerate(item.pair):
            posed = views[index]
            rays = posed.view.camera.rays(posed.view.features.keypoints[item.matches[:, side]])
            centre.append(np.broadcast_to(posed.world_from_camera.translation, rays.shape))
            ray.append(rays @ posed.world_from_camera.rotation.T)
        depth, parallax_deg = triangulate_depths(np.stack(centre, axis=1), np.stack(ray, axis=1))
        depths.append(depth[(depth > 0).all(axis=1) & (parallax_deg >= MIN_PARALLAX_DEG)].ravel())
    found = np.concatenate(depths) if depths else np.zeros(0)
    return float(np.median(found)) if len(found) >= 2 * MIN_POINTS else None


def implausible_depth(depth: float | None) -> str:
    """One sentence about a median depth that is not plausible in metres; empty if it is plausible."""
    if depth is None or MIN_DEPTH_M <= depth <= MAX_DEPTH_M:
        return ""
    likely = "millimetres" if depth > MAX_DEPTH_M else "kilometres"
    return (
        f"what the photographs show is {depth:.3g} m away, in the median ({MIN_DEPTH_M:g} to {MAX_DEPTH_M:g} m are "
        f"plausible): are the poses in {likely}?"
    )
