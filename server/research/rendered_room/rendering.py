"""The room seen by a pinhole camera, exactly: light once, then one ray a sample, of which the nearest rectangle wins.

Light is a window and a lamp with soft shadows and dark corners, baked into the textures. For a rectangle in the camera
frame, x(u, v) = corner + u across + v down, and a pixel p = (x, y, 1),

    (u, v, 1) / depth = [across | down | corner]^-1 K^-1 p,

so u / depth, v / depth and 1 / depth are linear in the pixel, and nothing is approximate but the filtering of textures.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, RigidTransform

from .furniture import ROOM_M, Box, Quad, Room

Floats = NDArray[np.float32]
NEAR_M = 0.02
"""Surfaces closer than this are not drawn."""


class Surface(NamedTuple):
    """A rectangle and the light that leaves it: linear, uint16 with 65535 for 1, each level half of the last."""

    quad: Quad
    pyramid: list[NDArray[np.uint16]]


def light_room(room: Room) -> list[Surface]:
    """Textures turned from reflectance on a screen into light that leaves the surface."""
    grids = [_grid(quad) for quad in room.quads]
    points = np.concatenate([p.reshape(-1, 3) for p in grids]).astype(np.float32)
    counts = [p.shape[0] * p.shape[1] for p in grids]
    normals = np.repeat([quad.normal() for quad in room.quads], counts, axis=0).astype(np.float32)
    owners = np.repeat([quad.owner for quad in room.quads], counts)

    openness = _openness(points, normals, owners, room.boxes)
    light = np.array([0.30, 0.31, 0.33]) * (0.8 + 0.2 * normals[:, 2:]) * openness[:, None]
    casters = [box for box in room.boxes if np.sort(box.size)[1] >= 0.18]
    daylight = np.array([1.00, 1.04, 1.12]) * 0.72
    for y, z in [(y, z) for y in (1.3, 2.6) for z in (1.1, 2.0)] + [(1.95, 1.6)]:
        position = np.array([-0.05, y, z])
        light += _direct(points + 0.01 * normals, normals, position, daylight, np.array([1.0, 0.0, 0.0]), casters)
    lamp = np.array([1.0, 0.86, 0.66]) * 0.55
    light += _direct(points + 0.01 * normals, normals, np.array([2.45, 2.0, 1.62]), lamp, None, casters)

    surfaces = []
    for quad, grid, irradiance in zip(room.quads, grids, np.split(light, np.cumsum(counts)[:-1]), strict=True):
        radiance = np.asarray(cv2.pow(quad.texture, 2.2), np.float32)
        if not quad.glows:
            lightmap = irradiance.reshape(grid.shape).astype(np.float32)
            lightmap = np.asarray(cv2.resize(lightmap, radiance.shape[1::-1], interpolation=cv2.INTER_LINEAR))
            radiance = np.asarray(radiance * lightmap, np.float32)
        levels = [(np.clip(radiance, 0, 1) * 65535 + 0.5).astype(np.uint16)]
        while max(levels[-1].shape[:2]) > 4:
            h, w = levels[-1].shape[:2]
            half = cv2.resize(levels[-1], ((w + 1) // 2, (h + 1) // 2), interpolation=cv2.INTER_AREA)
            levels.append(half.astype(np.uint16, copy=False))
        surfaces.append(Surface(quad, levels))
    return surfaces


def _grid(quad: Quad) -> Array:
    """Points (rows, columns, 3) on the rectangle where light is computed, cell centres, 11 cm apart."""
    columns, rows = (int(np.clip(np.linalg.norm(edge) / 0.11, 2, 48).round()) for edge in (quad.across, quad.down))
    u, v = (np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows
    return np.asarray(quad.corner + v[:, None, None] * quad.down + u[None, :, None] * quad.across)


def _openness(points: Floats, normals: Floats, owners: NDArray[np.int_], boxes: Sequence[Box]) -> Floats:
    """How much of the sky a point sees, (N,), 0 to 1: by how near other solids and walls come to a probe before it."""
    probe = points + np.float32(0.08) * normals
    openness = np.ones(len(points), np.float32)
    for axis, wall in itertools.product(range(3), (0, 1)):
        distance = np.abs(points[:, axis] - wall * ROOM_M[axis])
        beside = np.abs(normals[:, axis]) < 0.5
        openness *= np.where(beside, 1 - 0.30 * np.exp(-distance / 0.25), 1).astype(np.float32)
    for index, box in enumerate(boxes):
        local = np.abs((probe - box.centre.astype(np.float32)) @ box.world_from_box().astype(np.float32))
        distance = np.linalg.norm(np.maximum(local - (box.size / 2).astype(np.float32), 0), axis=-1)
        openness *= np.where(owners == index, 1, 1 - 0.45 * np.exp(-distance / 0.07)).astype(np.float32)
    return openness


def _direct(
    points: Floats, normals: Floats, lamp: Array, power: Array, facing: Array | None, casters: Sequence[Box]
) -> Floats:
    """Irradiance (N, 3) that a lamp (RGB power at 1 m) gives to points that no caster hides from it (slab test)."""
    way = lamp.astype(np.float32) - points
    distance = np.linalg.norm(way, axis=-1)
    cosine = np.maximum(np.einsum("ij,ij->i", way, normals) / distance, 0)
    if facing is not None:
        cosine *= np.maximum(-(way @ facing.astype(np.float32)) / distance, 0)
    for box in casters:
        lit = np.flatnonzero(cosine > 0)
        axes, half = box.world_from_box().astype(np.float32), (box.size / 2).astype(np.float32)
        start, step = (points[lit] - box.centre.astype(np.float32)) @ axes, way[lit] @ axes
        step = np.where(np.abs(step) < 1e-6, np.float32(1e-6), step)
        a, b = (-half - start) / step, (half - start) / step
        enter, leave = np.minimum(a, b).max(axis=-1), np.maximum(a, b).min(axis=-1)
        cosine[lit[(enter < leave) & (leave > 1e-3) & (enter < 0.98)]] = 0
    return np.asarray((cosine / (distance**2 + 0.3))[:, None] * power, np.float32)


def cast(quads: Sequence[Quad], camera: Camera, world_from_camera: RigidTransform) -> tuple[Floats, NDArray[np.int16]]:
    """For every pixel centre, (H, W): 1 / depth in metres (0: nothing), and the index of the nearest rectangle (-1)."""
    inverse_depth = np.zeros((camera.height_px, camera.width_px), np.float32)
    nearest = np.full(inverse_depth.shape, -1, np.int16)
    uvw_from_pixel = _uvw_from_pixel(quads, camera, world_from_camera)
    for index, window in _windows(quads, camera, world_from_camera):
        m = uvw_from_pixel[index].astype(np.float32)
        x = np.arange(window[1].start, window[1].stop, dtype=np.float32)[None, :]
        y = np.arange(window[0].start, window[0].stop, dtype=np.float32)[:, None]
        w = m[2, 0] * x + (m[2, 1] * y + m[2, 2])
        nearer = (w > inverse_depth[window]) & (w < 1 / NEAR_M)
        if not nearer.any():
            continue
        u, v = (row[0] * x + (row[1] * y + row[2]) for row in m[:2])
        if quads[index].is_round:
            nearer &= (u - w / 2) ** 2 + (v - w / 2) ** 2 <= w * w / 4
        else:
            nearer &= (u >= 0) & (u <= w) & (v >= 0) & (v <= w)
        np.copyto(inverse_depth[window], w, where=nearer)
        np.copyto(nearest[window], np.int16(index), where=nearer)
    return inverse_depth, nearest


def shade(surfaces: Sequence[Surface], camera: Camera, world_from_camera: RigidTransform) -> Floats:
    """Radiance (H, W, 3) at every pixel centre, linear, 0 to 1, filtered between two levels of each texture."""
    quads = [surface.quad for surface in surfaces]
    _, nearest = cast(quads, camera, world_from_camera)
    image = np.zeros((nearest.size, 3), np.float32)
    order = np.argsort(nearest, axis=None, kind="stable")  # a radix sort: pixels of one rectangle together
    found, starts = np.unique(nearest.ravel()[order], return_index=True)
    uvw_from_pixel = _uvw_from_pixel(quads, camera, world_from_camera)
    for index, pixels in zip(found.tolist(), np.split(order, starts[1:]), strict=True):
        if index < 0:
            continue
        pyramid, m = surfaces[index].pyramid, uvw_from_pixel[index]
        y, x = (a.astype(np.float32) for a in np.divmod(pixels, camera.width_px))
        u, v, w = (row[0] * x + row[1] * y + row[2] for row in m.astype(np.float32))
        # The Jacobian of a homography has determinant det(M) / w^3: texels per pixel, as an area.
        area = abs(float(np.linalg.det(m))) * pyramid[0].shape[0] * pyramid[0].shape[1]
        image[pixels] = _sample(pyramid, u / w, v / w, 0.5 * np.log2(area / w**3))
    return image.reshape(*nearest.shape, 3)


def _sample(pyramid: Sequence[NDArray[np.uint16]], u: Floats, v: Floats, level: Floats) -> Floats:
    """Colours (N, 3) at (u, v) in 0..1, linear within and between levels."""
    level = np.clip(level, 0, len(pyramid) - 1)
    colours = np.zeros((len(u), 3), np.float32)
    for k in range(int(level.min()), int(np.ceil(level.max())) + 1):
        weight = 1 - np.abs(level - k)
        near = np.flatnonzero(weight > 0)
        if len(near) == 0:
            continue
        # (0, 0) is the edge corner of the texture, and a texel's centre lies half a texel inside.
        h, w = pyramid[k].shape[:2]
        shape = (-(-len(near) // 1024), 1024)  # remap wants images, not lists
        x, y = np.resize(u[near] * w - 0.5, shape), np.resize(v[near] * h - 0.5, shape)
        found = cv2.remap(pyramid[k], x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        colours[near] += found.reshape(-1, 3)[: len(near)] * (weight[near] / 65535)[:, None]
    return colours


def _in_camera(quads: Sequence[Quad], world_from_camera: RigidTransform) -> tuple[Array, Array, Array]:
    """Corner, across and down of every rectangle, (N, 3) each, camera frame."""
    corner, across, down = (np.array([quad[part] for quad in quads]) for part in range(3))
    axes = world_from_camera.rotation
    return (corner - world_from_camera.translation) @ axes, across @ axes, down @ axes


def _uvw_from_pixel(quads: Sequence[Quad], camera: Camera, world_from_camera: RigidTransform) -> Array:
    """Matrices (N, 3, 3) from pixels (x, y, 1) to (u, v, 1) / depth; zero for a rectangle seen edge-on."""
    corner, across, down = _in_camera(quads, world_from_camera)
    frames = np.stack([across, down, corner], axis=-1)
    flat = np.abs(np.linalg.det(frames)) < 1e-12
    frames[flat] = np.eye(3)
    matrices = np.linalg.inv(camera.matrix() @ frames)
    matrices[flat] = 0
    return np.asarray(matrices, float)


def _windows(
    quads: Sequence[Quad], camera: Camera, world_from_camera: RigidTransform
) -> list[tuple[int, tuple[slice, slice]]]:
    """Index, rows and columns of every rectangle that may be seen: in view, and neither from behind nor edge-on."""
    corner, across, down = _in_camera(quads, world_from_camera)
    size = np.array([camera.width_px, camera.height_px])
    area = np.linalg.norm(across, axis=-1) * np.linalg.norm(down, axis=-1)
    facing = np.einsum("ij,ij->i", corner, np.cross(across, down)) > 1e-4 * area
    polygons = np.stack([corner, corner + across, corner + across + down, corner + down], axis=1)
    windows = []
    for index in np.flatnonzero(facing & (polygons[..., 2].max(axis=-1) > NEAR_M)).tolist():
        low, high = np.zeros(2, int), size
        if polygons[index, :, 2].min() >= NEAR_M:  # else it may be anywhere
            pixels = camera.project(polygons[index])
            low = np.maximum(np.floor(pixels.min(axis=0)), 0).astype(int)
            high = np.minimum(np.ceil(pixels.max(axis=0)) + 1, size).astype(int)
        if (low < high).all():
            windows.append((index, (slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0])))))
    return windows
