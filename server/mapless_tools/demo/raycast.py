"""Textured rectangles seen by a pinhole camera, exactly: one ray per sample, the nearest rectangle wins.

For a rectangle x(u, v) = corner + u across + v down in the camera frame and a pixel p = (x, y, 1),

    (u, v, 1) / depth = [across | down | corner]^-1 K^-1 p,

so u / depth, v / depth and 1 / depth are linear in the pixel, and nothing is approximate but the filtering of textures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, RigidTransform

from .textures import Image

NEAR_M = 0.02
"""Surfaces closer than this are not drawn."""


@dataclass(frozen=True, eq=False)
class Quad:
    """A rectangle with a texture, visible from its front only.

    Attributes:
        corner: (3,) world, metres; where the texture's top-left edge corner lies.
        across: (3,) from there along the texture's rows, seen from the front to the right.
        down: (3,) along its columns.
        texture: (h, w, 3) float32 RGB.
        is_round: only the inscribed ellipse exists.
        glows: shines by itself; takes no light and no shadow.
        owner: index of the box it belongs to, -1 for none.
    """

    corner: Array
    across: Array
    down: Array
    texture: Image
    is_round: bool = False
    glows: bool = False
    owner: int = -1

    def normal(self) -> Array:
        """(3,) unit length, towards who sees the front."""
        n = np.cross(self.down, self.across)
        return np.asarray(n / np.linalg.norm(n), float)

    def corners(self) -> Array:
        """(4, 3) world, around the rectangle."""
        offsets = np.array([0 * self.across, self.across, self.across + self.down, self.down])
        return np.asarray(self.corner + offsets, float)


@dataclass(frozen=True, eq=False)
class Surface:
    """A rectangle ready to be seen.

    Attributes:
        quad: where it lies; its own texture is not used any more.
        pyramid: light leaving it, linear, uint16 with 65535 for 1; each level half the size of the one before.
    """

    quad: Quad
    pyramid: tuple[NDArray[np.uint16], ...]

    @staticmethod
    def of(quad: Quad, radiance: Image) -> Surface:
        """From linear radiance (h, w, 3) float32, 0 to 1."""
        levels = [(np.clip(radiance, 0, 1) * 65535 + 0.5).astype(np.uint16)]
        while max(levels[-1].shape[:2]) > 4:
            h, w = levels[-1].shape[:2]
            half = cv2.resize(levels[-1], ((w + 1) // 2, (h + 1) // 2), interpolation=cv2.INTER_AREA)
            levels.append(half.astype(np.uint16, copy=False))
        return Surface(quad, tuple(levels))


@dataclass(frozen=True, eq=False)
class Visible:
    """What each pixel's centre sees.

    Attributes:
        inverse_depth: (H, W) float32, 1 / metres along the optical axis; 0 where nothing is.
        index: (H, W) int16, position in the list of rectangles; -1 where nothing is.
    """

    inverse_depth: NDArray[np.float32]
    index: NDArray[np.int16]


def cast(quads: Sequence[Quad], camera: Camera, world_from_camera: RigidTransform) -> Visible:
    """Find the nearest rectangle for every pixel centre of a pinhole camera."""
    shape = (camera.height_px, camera.width_px)
    visible = Visible(np.zeros(shape, np.float32), np.full(shape, -1, np.int16))
    uvw_from_pixel = _uvw_from_pixel(quads, camera, world_from_camera)
    for index, (rows, columns) in _windows(quads, camera, world_from_camera):
        m = uvw_from_pixel[index].astype(np.float32)
        x = np.arange(columns.start, columns.stop, dtype=np.float32)[None, :]
        y = np.arange(rows.start, rows.stop, dtype=np.float32)[:, None]
        w = m[2, 0] * x + (m[2, 1] * y + m[2, 2])
        nearer = (w > visible.inverse_depth[rows, columns]) & (w < 1 / NEAR_M)
        if not nearer.any():
            continue
        u, v = (row[0] * x + (row[1] * y + row[2]) for row in m[:2])
        if quads[index].is_round:
            nearer &= (u - w / 2) ** 2 + (v - w / 2) ** 2 <= w * w / 4
        else:
            nearer &= (u >= 0) & (u <= w) & (v >= 0) & (v <= w)
        np.copyto(visible.inverse_depth[rows, columns], w, where=nearer)
        np.copyto(visible.index[rows, columns], np.int16(index), where=nearer)
    return visible


def shade(
    surfaces: Sequence[Surface], visible: Visible, camera: Camera, world_from_camera: RigidTransform
) -> NDArray[np.float32]:
    """Radiance (H, W, 3), linear, 0 to 1, of what `cast` found, filtered between two levels of each texture."""
    image = np.zeros((camera.height_px * camera.width_px, 3), np.float32)
    order = np.argsort(visible.index, axis=None, kind="stable")  # a radix sort: pixels of one rectangle together
    found, starts = np.unique(visible.index.ravel()[order], return_index=True)
    uvw_from_pixel = _uvw_from_pixel([surface.quad for surface in surfaces], camera, world_from_camera)
    for index, pixels in zip(found.tolist(), np.split(order, starts[1:]), strict=True):
        if index < 0:
            continue
        pyramid, m = surfaces[index].pyramid, uvw_from_pixel[index]
        y, x = (a.astype(np.float32) for a in np.divmod(pixels, camera.width_px))
        u, v, w = (row[0] * x + row[1] * y + row[2] for row in m.astype(np.float32))
        # The Jacobian of a homography has determinant det(M) / w^3: texels per pixel, as an area.
        texels = abs(float(np.linalg.det(m))) * pyramid[0].shape[0] * pyramid[0].shape[1]
        image[pixels] = _sample(pyramid, u / w, v / w, 0.5 * np.log2(texels / w**3))
    return image.reshape(camera.height_px, camera.width_px, 3)


def _sample(
    pyramid: Sequence[NDArray[np.uint16]], u: NDArray[np.float32], v: NDArray[np.float32], level: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Colours (N, 3) at (u, v) in 0..1, linear within and between levels."""
    level = np.clip(level, 0, len(pyramid) - 1)
    colours = np.zeros((len(u), 3), np.float32)
    for k in range(int(level.min()), int(np.ceil(level.max())) + 1):
        weight = 1 - np.abs(level - k)
        near = np.flatnonzero(weight > 0)
        if len(near) == 0:
            continue
        texture = pyramid[k]
        # (0, 0) is the edge corner of the texture, and a texel's centre lies half a texel inside.
        x, y = u[near] * texture.shape[1] - 0.5, v[near] * texture.shape[0] - 0.5
        rows = -(-len(near) // 1024)  # remap wants images, not lists
        found = cv2.remap(
            texture,
            np.resize(x, (rows, 1024)),
            np.resize(y, (rows, 1024)),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        ).reshape(-1, 3)[: len(near)]
        colours[near] += found * (weight[near] / 65535)[:, None]
    return colours


def _in_camera(quads: Sequence[Quad], world_from_camera: RigidTransform) -> tuple[Array, Array, Array]:
    """Corner, across and down of every rectangle, (N, 3) each, camera frame."""
    corner, across, down = (np.array([getattr(quad, part) for quad in quads]) for part in ("corner", "across", "down"))
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
    area = np.linalg.norm(across, axis=-1) * np.linalg.norm(down, axis=-1)
    facing = np.einsum("ij,ij->i", corner, np.cross(across, down)) > 1e-4 * area
    polygons = np.stack([corner, corner + across, corner + across + down, corner + down], axis=1)
    windows = []
    for index in np.flatnonzero(facing & (polygons[..., 2].max(axis=-1) > NEAR_M)).tolist():
        polygon = polygons[index]
        if polygon[:, 2].min() < NEAR_M:
            polygon = _clip_near(polygon)
        pixels = camera.project(polygon)
        left, top = np.maximum(np.floor(pixels.min(axis=0)), 0).astype(int).tolist()
        right, bottom = (
            np.minimum(np.ceil(pixels.max(axis=0)) + 1, [camera.width_px, camera.height_px]).astype(int).tolist()
        )
        if left < right and top < bottom:
            windows.append((index, (slice(top, bottom), slice(left, right))))
    return windows


def _clip_near(polygon: Array) -> Array:
    """The part (M, 3) of a polygon (N, 3) in the camera frame that lies beyond NEAR_M (Sutherland and Hodgman)."""
    kept = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if a[2] >= NEAR_M:
            kept.append(a)
        if (a[2] >= NEAR_M) != (b[2] >= NEAR_M):
            kept.append(a + (NEAR_M - a[2]) / (b[2] - a[2]) * (b - a))
    return np.array(kept).reshape(-1, 3)
