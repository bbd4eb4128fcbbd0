"""Light in the rendered room: a window, a lamp, soft shadows and dark corners, baked into the textures once."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array

from .raycast import Quad, Surface

GRID_M = 0.11
"""Spacing of the points at which light is computed; between them it is interpolated."""

SHADOW_SIZE_M = 0.18
"""Boxes whose second longest side is shorter cast no shadow of their own, only contact darkening."""


@dataclass(frozen=True, eq=False)
class Box:
    """A solid that stands upright.

    Attributes:
        centre: (3,) world, metres.
        size: (3,) metres along its own axes.
        yaw: rotation about the world's z axis, radians.
    """

    centre: Array
    size: Array
    yaw: float = 0.0

    def world_from_box(self) -> Array:
        """Its axes as columns, (3, 3)."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def corners(self) -> Array:
        """(8, 3) world, ordered by the signs of x, y, z."""
        signs = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
        return self.centre + (signs * self.size) @ self.world_from_box().T

    def edges(self) -> Array:
        """(12, 2, 3) world: corners whose signs differ once."""
        corners = self.corners()
        pairs = [(i, i | bit) for i in range(8) for bit in (1, 2, 4) if not i & bit]
        return np.array([[corners[a], corners[b]] for a, b in pairs])


@dataclass(frozen=True, eq=False)
class Lamp:
    """A small light that shines in all directions, or only to the front of `facing`.

    Attributes:
        position: (3,) world, metres.
        power: (3,) RGB, irradiance at 1 m.
        facing: (3,) unit length, or None.
    """

    position: Array
    power: Array
    facing: Array | None = None


def light_room(
    quads: Sequence[Quad], boxes: Sequence[Box], room_m: Array, lamps: Sequence[Lamp], ambient: Array
) -> list[Surface]:
    """Textures turned from reflectance on a screen into light that leaves the surface."""
    grids = [_grid(quad) for quad in quads]
    points = np.concatenate([p.reshape(-1, 3) for p in grids]).astype(np.float32)
    counts = [p.shape[0] * p.shape[1] for p in grids]
    normals = np.repeat([quad.normal() for quad in quads], counts, axis=0).astype(np.float32)
    owners = np.repeat([quad.owner for quad in quads], counts)

    light = ambient * (0.8 + 0.2 * normals[:, 2:]) * _openness(points, normals, owners, boxes, room_m)[:, None]
    casters = [box for box in boxes if np.sort(box.size)[1] >= SHADOW_SIZE_M]
    for lamp in lamps:
        light += _direct(points + 0.01 * normals, normals, lamp, casters)

    surfaces = []
    for quad, grid, irradiance in zip(quads, grids, np.split(light, np.cumsum(counts)[:-1]), strict=True):
        radiance = np.asarray(cv2.pow(quad.texture, 2.2), np.float32)
        if not quad.glows:
            lightmap = irradiance.reshape(grid.shape).astype(np.float32)
            lightmap = np.asarray(cv2.resize(lightmap, radiance.shape[1::-1], interpolation=cv2.INTER_LINEAR))
            radiance = np.asarray(radiance * lightmap, np.float32)
        surfaces.append(Surface.of(quad, radiance))
    return surfaces


def _grid(quad: Quad) -> Array:
    """Points (rows, columns, 3) on the rectangle, cell centres."""
    columns, rows = (int(np.clip(np.linalg.norm(edge) / GRID_M, 2, 48).round()) for edge in (quad.across, quad.down))
    u, v = (np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows
    return np.asarray(quad.corner + v[:, None, None] * quad.down + u[None, :, None] * quad.across)


def _openness(
    points: NDArray[np.float32],
    normals: NDArray[np.float32],
    owners: NDArray[np.int_],
    boxes: Sequence[Box],
    room_m: Array,
) -> NDArray[np.float32]:
    """How much of the sky a point sees, (N,), 0 to 1: by how near other solids and walls come to a probe before it."""
    probe = points + np.float32(0.08) * normals
    openness = np.ones(len(points), np.float32)
    for axis, wall in itertools.product(range(3), (0, 1)):
        distance = np.abs(points[:, axis] - wall * room_m[axis])
        beside = np.abs(normals[:, axis]) < 0.5
        openness *= np.where(beside, 1 - 0.30 * np.exp(-distance / 0.25), 1).astype(np.float32)
    for index, box in enumerate(boxes):
        local = np.abs((probe - box.centre.astype(np.float32)) @ box.world_from_box().astype(np.float32))
        distance = np.linalg.norm(np.maximum(local - (box.size / 2).astype(np.float32), 0), axis=-1)
        openness *= np.where(owners == index, 1, 1 - 0.45 * np.exp(-distance / 0.07)).astype(np.float32)
    return openness


def _direct(
    points: NDArray[np.float32], normals: NDArray[np.float32], lamp: Lamp, casters: Sequence[Box]
) -> NDArray[np.float32]:
    """Irradiance (N, 3) that a lamp gives to points that no caster hides from it."""
    way = lamp.position.astype(np.float32) - points
    distance = np.linalg.norm(way, axis=-1)
    cosine = np.maximum(np.einsum("ij,ij->i", way, normals) / distance, 0)
    if lamp.facing is not None:
        cosine *= np.maximum(-(way @ lamp.facing.astype(np.float32)) / distance, 0)
    for box in casters:
        lit = np.flatnonzero(cosine > 0)
        cosine[lit[_hidden(points[lit], way[lit], box)]] = 0
    return np.asarray((cosine / (distance**2 + 0.3))[:, None] * lamp.power, np.float32)


def _hidden(points: NDArray[np.float32], way: NDArray[np.float32], box: Box) -> NDArray[np.bool_]:
    """Whether the box stands between a point and point + way (slab test), (N,)."""
    axes = box.world_from_box().astype(np.float32)
    start, step = (points - box.centre.astype(np.float32)) @ axes, way @ axes
    step = np.where(np.abs(step) < 1e-6, np.float32(1e-6), step)
    half = (box.size / 2).astype(np.float32)
    a, b = (-half - start) / step, (half - start) / step
    enter, leave = np.minimum(a, b).max(axis=-1), np.maximum(a, b).min(axis=-1)
    return np.asarray((enter < leave) & (leave > 1e-3) & (enter < 0.98))
