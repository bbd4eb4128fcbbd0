"""Places of a tag: the squares in space that its corners in several photographs agree on.

A detector's identifiers may be false, a tag may be in a scene twice, or have been moved between photographs. What is
one tag at one place is therefore found by its geometry: two photographs give four corners in space, by the intersection
of rays, and the place is that on which most photographs agree; the others are searched for a further place.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Similarity, normalize
from mapless_tools.ingest.metres import umeyama

from ..pictures import PosedPicture
from .fitting import least
from .sightings import Sighting

MIN_PHOTOGRAPHS = 3
"""Any two photographs intersect somewhere; the third confirms it."""
CORNER_PX, CORNER_SHARE = 3.0, 0.05
"""A corner may be off by 3 pixels, or by 5 % of the tag's edge if that is more: errors of poses and of blurred
corners. Another tag is off by about an edge."""
MIN_ANGLE_DEG = 1.0
"""Smallest angle between the rays of two photographs that give corners in space."""
MAX_PAIRS = 400
GROUPS = 8
"""Groups of neighbouring photographs that are left out by turns; errors of neighbours are alike."""
ROBUST_PX = 1.0
UNIT_SQUARE = np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])
"""Corners of a tag of edge 1 in its own axes: x along its top, y down its side, z into the wall."""


@dataclass(frozen=True, eq=False)
class Square:
    """A place of a tag, in the reconstruction's frame and unit.

    `corners` is (4, 3), `part_from_tag` has the length of an edge as its scale, `edge_sigma` is the relative standard
    deviation of that, `deformation` the root mean square of the corners' distances to a square, as a share of its edge.
    """

    corners: Array
    part_from_tag: Similarity
    edge_sigma: float
    deformation: float
    edge_px: float
    photographs: frozenset[int]


@dataclass(frozen=True, eq=False)
class _Observed:
    """Sightings as arrays: camera centres (N, 3), rotations to the camera (N, 3, 3), rays at depth 1 (N, 4, 3) there.

    `focal_px` (N,) turns slopes into pixels, `bound_px` (N,) is the largest error of a corner.
    """

    photographs: NDArray[np.integer]
    centres: Array
    camera_from_part: Array
    rays: Array
    focal_px: Array
    bound_px: Array
    edge_px: Array

    def __len__(self) -> int:
        return len(self.centres)

    def __getitem__(self, chosen: NDArray[np.integer]) -> "_Observed":
        return _Observed(**{it.name: getattr(self, it.name)[chosen] for it in fields(self)})

    def residuals_px(self, corners: Array) -> Array:
        """Errors (..., N, 4, 2) of corners (..., 4, 3); infinite behind a camera."""
        offsets = corners[..., None, :, :] - self.centres[:, None]
        seen = normalize(np.einsum("nij,...nkj->...nki", self.camera_from_part, offsets))
        errors = (seen - self.rays[..., :2]) * self.focal_px[:, None, None]
        return np.asarray(np.nan_to_num(errors, nan=1e6))


def squares(posed: Sequence[PosedPicture], seen: Sequence[Sighting]) -> tuple[list[Square], list[Sighting]]:
    """The places that at least MIN_PHOTOGRAPHS photographs agree on, most seen first, and the sightings of none."""
    rest, found = list(seen), list[Square]()
    while len({it.photograph for it in rest}) >= MIN_PHOTOGRAPHS:
        agreeing = _largest_agreement(_observed(posed, rest))
        if agreeing is None:
            break
        chosen = [rest[i] for i in agreeing]
        found.append(_square(_observed(posed, chosen), chosen))
        rest = [it for i, it in enumerate(rest) if i not in set(agreeing)]
    return found, rest


def _observed(posed: Sequence[PosedPicture], seen: Sequence[Sighting]) -> _Observed:
    cameras = [posed[it.photograph] for it in seen]
    edge_px = np.array([it.edge_px for it in seen])
    return _Observed(
        photographs=np.array([it.photograph for it in seen]),
        centres=np.array([it.world_from_camera.translation for it in cameras]),
        camera_from_part=np.array([it.world_from_camera.rotation.T for it in cameras]),
        rays=np.array([it.camera.rays(sighting.corners_px) for it, sighting in zip(cameras, seen, strict=True)]),
        focal_px=np.array([(it.camera.focal_x_px + it.camera.focal_y_px) / 2 for it in cameras]),
        bound_px=np.maximum(CORNER_PX, CORNER_SHARE * edge_px),
        edge_px=edge_px,
    )


def _largest_agreement(seen: _Observed) -> list[int] | None:
    """Indices of the sightings, one of each photograph, that agree on one place; None if they are too few.

    Their rays intersect.
    """
    pairs = [(i, j) for i, j in combinations(range(len(seen)), 2) if seen.photographs[i] != seen.photographs[j]]
    if len(pairs) > MAX_PAIRS:
        chosen = np.random.default_rng(0).choice(len(pairs), MAX_PAIRS, replace=False)
        pairs = [pairs[i] for i in sorted(chosen)]
    best, least = list[int](), (0, 0.0)
    for pair in pairs:
        corners = _intersections(seen[np.array(pair)])
        if corners is None:
            continue
        agreeing, cost = _agreeing(seen, corners)
        if (len(agreeing), -cost) > least:
            best, least = agreeing, (len(agreeing), -cost)
    start = _intersections(seen[np.array(best)]) if len(best) >= MIN_PHOTOGRAPHS else None
    if start is None:
        return None
    refined, _ = _agreeing(seen, _refined(seen[np.array(best)], start))
    return refined if len(refined) > len(best) and _intersections(seen[np.array(refined)]) is not None else best


def _agreeing(seen: _Observed, corners: Array) -> tuple[list[int], float]:
    """The best sighting of each photograph within the bounds, and their summed errors as shares of these."""
    worst = np.linalg.norm(seen.residuals_px(corners), axis=-1).max(axis=-1) / seen.bound_px
    best: dict[int, int] = {}
    for i in np.argsort(worst, kind="stable").tolist():
        if worst[i] <= 1:
            best.setdefault(int(seen.photographs[i]), i)
    return sorted(best.values()), float(worst[list(best.values())].sum())


def _intersections(seen: _Observed) -> Array | None:
    """Points (4, 3) nearest to the rays of each corner; None if the rays are too parallel."""
    rays = np.einsum("nji,nkj->nki", seen.camera_from_part, seen.rays)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    across = np.eye(3) - rays[..., :, None] * rays[..., None, :]
    normal = across.sum(axis=0)
    # Of n rays the smallest eigenvalue is the sum of the squared sines to their mean direction.
    if np.linalg.eigvalsh(normal)[:, 0].min() < np.sin(np.radians(MIN_ANGLE_DEG)) ** 2 / 2:
        return None
    moments = np.einsum("nkij,nj->ki", across, seen.centres)
    return np.asarray(np.linalg.solve(normal, moments[..., None])[..., 0])


def _start(seen: _Observed) -> Array:
    found = _intersections(seen)
    assert found is not None, "sightings that agree have rays that intersect"
    return found


def _refined(seen: _Observed, corners: Array) -> Array:
    """The corners (4, 3) of least robust squared errors in pixels (soft L1 beyond ROBUST_PX)."""
    scale = float(np.linalg.norm(corners[0] - corners[2]))

    def residuals(shift: Array) -> Array:
        return np.asarray(seen.residuals_px(corners + scale * shift.reshape(4, 3)).ravel())

    shift, _ = least(residuals, np.zeros(12), ROBUST_PX)
    return np.asarray(corners + scale * shift.reshape(4, 3))


def _square(seen: _Observed, sightings: Sequence[Sighting]) -> Square:
    corners = _refined(seen, _start(seen))
    part_from_tag = umeyama(UNIT_SQUARE, corners)
    off = np.linalg.norm(part_from_tag.apply(UNIT_SQUARE) - corners, axis=1)
    return Square(
        corners,
        part_from_tag,
        _jackknife(seen, corners, part_from_tag.scale),
        float(np.sqrt((off**2).mean())) / part_from_tag.scale,
        float(np.median(seen.edge_px)),
        frozenset(it.photograph for it in sightings),
    )


def _jackknife(seen: _Observed, corners: Array, edge: float) -> float:
    """The relative standard deviation of the edge by leaving out groups of photographs (delete-group jackknife)."""
    groups = np.array_split(np.arange(len(seen)), min(GROUPS, len(seen)))
    edges = []
    for group in groups:
        left = np.setdiff1d(np.arange(len(seen)), group)
        without = umeyama(UNIT_SQUARE, _refined(seen[left], corners)).scale
        edges.append(np.log(without / edge))
    count = len(groups)
    return float(np.sqrt((count - 1) / count * ((np.array(edges) - np.mean(edges)) ** 2).sum()))
