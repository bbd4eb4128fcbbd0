"""Whether photographs are explained by a camera that only turned: then nothing shows how far anything is.

A turn moves the rays of a photograph by one rotation, whatever they see. Mappers find poses all the same, since a wrong
focal length and a wrong lens bend a turn so that it looks like a little movement. So rotations are fitted to the
matches of all pairs, with one factor of the focal lengths and one radial coefficient, which are free.
"""

from collections.abc import Collection
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.optimize import minimize

from mapless.geometry import Array

TURN_SHARE = 0.002
"""Largest distance of matches from where a turn moves them, over the longer side: 2 px of 1024, twice their noise."""
PARALLAX_SHARE = 0.25
"""Least share of pairs whose matches are farther off. Evidence: parallax."""
_MATCHES, _PAIRS = 100, 150
_MIN_MATCHES, _ROUNDS = 15, 10
_FACTORS, _RADIAL = (0.4, 0.55, 0.75, 1.0, 1.35, 1.8, 2.5), 0.5
"""Focal lengths at which the search begins, and the largest radial coefficient."""


def only_turned(database: Path, image_ids: Collection[int]) -> bool:
    """Whether turns alone explain the matches of pairs of some images of a database."""
    return share_with_parallax(database, image_ids) < PARALLAX_SHARE


def share_with_parallax(database: Path, image_ids: Collection[int]) -> float:
    """The share of pairs of some images of a database whose matches no turn explains; 1 without pairs."""
    pairs = _pairs(database, frozenset(image_ids))
    if not len(pairs):
        return 1.0

    def off(unknowns: NDArray[np.float64]) -> Array:
        return _off_turn(pairs, float(np.exp(unknowns[0])), float(unknowns[1]))

    def cost(unknowns: NDArray[np.float64]) -> float:
        return float(np.minimum(off(unknowns), 10 * TURN_SHARE).mean())

    start = min(np.log(_FACTORS), key=lambda it: cost(np.array([it, 0.0])))
    bounds = [(start - 0.4, start + 0.4), (-_RADIAL, _RADIAL)]
    simplex = [[start, 0.0], [start + 0.2, 0.0], [start, 0.1]]
    found = minimize(
        cost, [start, 0.0], method="Nelder-Mead", bounds=bounds, options={"maxiter": 80, "initial_simplex": simplex}
    )
    return float((off(found.x) > TURN_SHARE).mean())


def _pairs(database: Path, image_ids: Collection[int]) -> Array:
    """Matches (P, 2, M, 3) of verified pairs: x and y from the centre over the focal length, and that over the side."""
    chosen = []
    with pycolmap.Database.open(database) as content:
        cameras = {it.camera_id: it for it in content.read_all_cameras()}
        of_image = {it.image_id: cameras[it.camera_id] for it in content.read_all_images()}
        pair_ids, counts = content.read_two_view_geometry_num_inliers()
        ends = [pycolmap.pair_id_to_image_pair(it) for it in pair_ids]
        found = [
            it
            for it, count in zip(ends, counts, strict=True)
            if count >= _MIN_MATCHES and it[0] in image_ids and it[1] in image_ids
        ]
        for first, second in found[:: 1 + len(found) // _PAIRS]:
            matches = content.read_two_view_geometry(first, second).inlier_matches
            rows = np.linspace(0, len(matches) - 1, _MATCHES).round().astype(int)
            sides = []
            for side, image_id in enumerate((first, second)):
                camera = of_image[image_id]
                pixels = content.read_keypoints(image_id)[matches[rows, side], :2].astype(float)
                centre, focal_px = (camera.principal_point_x, camera.principal_point_y), camera.mean_focal_length()
                share = np.full((_MATCHES, 1), focal_px / max(camera.width, camera.height))
                sides.append(np.hstack([(pixels - centre) / focal_px, share]))
            chosen.append(sides)
    return np.array(chosen)


def _off_turn(pairs: Array, factor: float, radial: float) -> Array:
    """Median distance (P,) of each pair's matches from where the best turn moves them, over the longer side.

    The turn minimizes the sum of the distances' logarithms, not of their squares: it is that of most matches, also
    where others are of an object that moves before a camera that stands still.
    """
    plane = pairs[..., :2] / factor
    plane = plane * (1 + radial * (plane**2).sum(axis=-1, keepdims=True))
    rays = np.concatenate([plane, np.ones((*plane.shape[:-1], 1))], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    weights = np.ones(rays.shape[::2][:1] + rays.shape[2:3])
    for _ in range(_ROUNDS):
        u, _, vt = np.linalg.svd(np.einsum("pm,pmi,pmj->pij", weights, rays[:, 1], rays[:, 0]))
        u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
        turned = rays[:, 0] @ np.swapaxes(u @ vt, 1, 2)
        off = np.linalg.norm(turned - rays[:, 1], axis=-1) * factor * pairs[:, 1, :, 2]
        weights = 1 / np.maximum(off, TURN_SHARE) ** 2
    return np.asarray(np.median(off, axis=1))
