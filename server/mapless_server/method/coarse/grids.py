"""The input of a network: a picture of one of few sizes, without lens distortion, and its pinhole camera.

The official loader fits one size to the first photograph of a set. Here the sizes are fixed, one for each usual aspect
ratio, so that a reference nearly always has the same one, and its tokens can be cached.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mapless.geometry import Array, Camera
from mapless_server.networks.encoder import PATCH_PX

from ..features.views import ALONG_SIDE, Ignored, undistort_pixels

PIXEL_LIMIT = 37 * 28 * PATCH_PX**2
"""Largest number of pixels of a picture: 518x392 for 4:3, a fifth fewer patches than the official loader's 574x434, and
in the range that the networks were trained on, 100,000 to 255,000; attention over all views is quadratic in it."""

ASPECTS = ((2, 1), (16, 9), (3, 2), (4, 3), (1, 1), (3, 4), (2, 3), (9, 16), (1, 2))
"""Width to height, over the range that the networks were trained on; within it a photograph's aspect differs from its
nearest grid's by at most 15 %."""

MAX_STRETCH = 1.16
"""A photograph whose aspect is the grid's within this factor is resized along each axis separately, as by the official
loader; another one is fitted inside, its aspect kept, and the rest is filled."""

MAX_DISTORTION_PX = 0.5
"""A lens that moves no pixel of the picture by more than this is treated as a pinhole: depth is read at the nearest
pixel, and each resampling costs sharpness."""

MAX_HALF_FIELD_DEG = 50.0
"""Largest angle between the optical axis and a side of an undistorted picture: the networks were hardly trained beyond
it, and a pinhole wastes pixels there."""


@dataclass(frozen=True)
class Grid:
    """The size of a network's picture, in patches of `PATCH_PX` pixels."""

    columns: int
    rows: int

    @property
    def width_px(self) -> int:
        """Width of the picture, pixels."""
        return self.columns * PATCH_PX

    @property
    def height_px(self) -> int:
        """Height of the picture, pixels."""
        return self.rows * PATCH_PX

    @property
    def aspect(self) -> float:
        """Width over height."""
        return self.columns / self.rows


@cache
def _grids(pixel_limit: int) -> tuple[Grid, ...]:
    """One grid for each aspect."""
    return tuple(fitted_grid(width, height, pixel_limit) for width, height in ASPECTS)


def fitted_grid(width_px: float, height_px: float, pixel_limit: int) -> Grid:
    """Size that the official loader gives an image: its aspect as nearly as patches allow, within `pixel_limit`."""
    scale = math.sqrt(pixel_limit / (width_px * height_px))
    columns, rows = round(width_px * scale / PATCH_PX), round(height_px * scale / PATCH_PX)
    while columns * rows * PATCH_PX**2 > pixel_limit:
        if columns / rows > width_px / height_px:
            columns -= 1
        else:
            rows -= 1
    return Grid(max(1, columns), max(1, rows))


def natural_grid(camera: Camera, pixel_limit: int) -> Grid:
    """Returns the grid whose aspect is nearest to a photograph's, by ratio; the first of equally near ones."""
    ideal = ideal_camera(camera, pixel_limit)
    aspect = ideal.width_px / ideal.height_px
    return min(_grids(pixel_limit), key=lambda grid: abs(math.log(grid.aspect / aspect)))


def common_grid(cameras: Sequence[Camera], pixel_limit: int) -> Grid:
    """Returns the natural grid of most photographs; of equally frequent ones that of the first photograph."""
    return Counter(natural_grid(camera, pixel_limit) for camera in cameras).most_common(1)[0][0]


@lru_cache(maxsize=1024)
def ideal_camera(camera: Camera, pixel_limit: int) -> Camera:
    """The pinhole that a photograph is undistorted to: the same focal lengths, and the largest field without a gap.

    Where distortion does not matter, it is the camera itself as a pinhole. A lens that shows nothing within
    `MAX_HALF_FIELD_DEG` gets an empty field of that size.
    """
    if not _distortion_matters(camera, pixel_limit):
        return camera.pinhole()
    left, top, right, bottom = _field(camera)
    return replace(
        camera.pinhole(),
        width_px=max(1, round((right - left) * camera.focal_x_px)),
        height_px=max(1, round((bottom - top) * camera.focal_y_px)),
        principal_x_px=-left * camera.focal_x_px - 0.5,
        principal_y_px=-top * camera.focal_y_px - 0.5,
    )


def _distortion_matters(camera: Camera, pixel_limit: int) -> bool:
    if camera.distortion is None:
        return False
    columns, rows = (np.linspace(-0.5, side - 0.5, ALONG_SIDE) for side in (camera.width_px, camera.height_px))
    rays = camera.rays(np.stack(np.meshgrid(columns, rows), axis=-1))
    moved_px = np.linalg.norm(camera.project(rays) - camera.pinhole().project(rays), axis=-1)
    scale = math.sqrt(pixel_limit / (camera.width_px * camera.height_px))
    return not moved_px.max() * scale <= MAX_DISTORTION_PX


def _field(camera: Camera) -> tuple[float, float, float, float]:
    """Left, top, right and bottom, at depth 1, of the largest upright rectangle within the field of view."""
    size = np.array([camera.width_px, camera.height_px])
    limit = math.tan(math.radians(MAX_HALF_FIELD_DEG))
    along = np.linspace(0, 1, 33)
    sides = []
    for axis in (0, 1):
        ends = []
        for end in (0.0, 1.0):
            edge = np.empty((len(along), 2))
            edge[:, axis], edge[:, 1 - axis] = end, along
            # Where the lens model has no inverse, the lens has a wider field than any pinhole.
            ideal = camera.rays(undistort_pixels(edge * size - 0.5, camera))[:, axis]
            finite = ideal[np.isfinite(ideal)]
            innermost = (finite.max() if end == 0 else finite.min()) if len(finite) else (-limit if end == 0 else limit)
            ends.append(float(np.clip(innermost, -limit, limit)))
        sides.append(ends if ends[0] < ends[1] else [-limit, limit])
    (left, right), (top, bottom) = sides
    return left, top, right, bottom


@dataclass(frozen=True, eq=False)
class Layout:
    """The place of a photograph in a picture of a grid's size.

    Attributes:
        grid: the picture's size.
        source: the photograph's camera.
        ideal: the pinhole that the photograph is undistorted to.
        box: left, top, width and height, pixels, of the part of the picture that shows the photograph.
        undistorts: whether the lens has distortion that has to be removed.
    """

    grid: Grid
    source: Camera
    ideal: Camera
    box: tuple[int, int, int, int]
    undistorts: bool

    @cached_property
    def camera(self) -> Camera:
        """The picture's pinhole."""
        left, top, width, height = self.box
        inside = self.ideal.resized(width, height)
        return replace(
            inside,
            width_px=self.grid.width_px,
            height_px=self.grid.height_px,
            principal_x_px=inside.principal_x_px + left,
            principal_y_px=inside.principal_y_px + top,
        )

    @cached_property
    def intrinsics(self) -> Array:
        """K (3, 3) of the picture in the networks' convention: (0.5, 0.5) is the centre of the top-left pixel."""
        k = self.camera.matrix()
        k[:2, 2] += 0.5
        return k

    @cached_property
    def shown(self) -> NDArray[np.bool_] | None:
        """Mask (H, W) of the picture's pixels that show the photograph; None if all do."""
        left, top, width, height = self.box
        shown = np.zeros((self.grid.height_px, self.grid.width_px), bool)
        box = shown[top : top + height, left : left + width]
        box[:] = _covered(self.source, self.ideal.resized(width, height))[1] if self.undistorts else True
        return None if shown.all() else shown

    def shown_without(self, ignored: Ignored | None) -> NDArray[np.bool_] | None:
        """Returns whether each pixel (H, W) of the picture shows the photograph and is not ignored; None if all do."""
        if ignored is None:
            return self.shown
        painted = self.picture(np.repeat(ignored[:, :, None] * np.uint8(255), 3, axis=2))
        clear = np.asarray(painted[:, :, 0] == 0, bool)
        return clear if self.shown is None else clear & self.shown

    def picture(self, photograph: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Makes the picture (3, H, W), 0 to 1, of a photograph (H, W, 3) RGB, filled with the mean of the shown pixels.

        ValueError if the photograph is not of its camera's size.
        """
        if photograph.shape != (self.source.height_px, self.source.width_px, 3):
            raise ValueError(f"a photograph of shape {photograph.shape} does not belong to {self.source}")
        left, top, width, height = self.box
        ideal = self._undistorted(photograph) if self.undistorts else photograph
        inside = _resized(ideal, width, height)
        shown = self.shown
        if shown is None:
            picture = inside
        else:
            box = shown[top : top + height, left : left + width]
            mean = inside[box].mean(axis=0) if box.any() else np.full(3, 127.5)
            picture = np.empty((*shown.shape, 3), np.uint8)
            picture[:] = np.rint(mean)
            picture[top : top + height, left : left + width][box] = inside[box]
        return np.ascontiguousarray(picture.transpose(2, 0, 1), np.float32) / np.float32(255)

    def _undistorted(self, photograph: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Undistorts the photograph, at up to twice the picture's size, where resampling costs little sharpness."""
        _, _, width, height = self.box
        scale = min(1.0, max(2 * width / self.ideal.width_px, 2 * height / self.ideal.height_px))
        source, ideal = (
            camera.resized(max(1, round(camera.width_px * scale)), max(1, round(camera.height_px * scale)))
            for camera in (self.source, self.ideal)
        )
        reduced = _resized(photograph, source.width_px, source.height_px)
        # Outside the photograph its edge is repeated, so that no other colour bleeds into the inside.
        columns, rows = _lens_map(source, ideal)
        return np.asarray(cv2.remap(reduced, columns, rows, cv2.INTER_CUBIC, None, cv2.BORDER_REPLICATE), np.uint8)


@lru_cache(maxsize=256)  # with the mask of what is shown, 200 kB each
def lay_out(camera: Camera, grid: Grid, pixel_limit: int) -> Layout:
    """The layout of a camera's photographs on a grid of those with this limit."""
    ideal = ideal_camera(camera, pixel_limit)
    stretch = math.log(ideal.width_px / ideal.height_px / grid.aspect)
    width, height = grid.width_px, grid.height_px
    if abs(stretch) > math.log(MAX_STRETCH):
        scale = min(width / ideal.width_px, height / ideal.height_px)
        width, height = max(1, round(ideal.width_px * scale)), max(1, round(ideal.height_px * scale))
    box = ((grid.width_px - width) // 2, (grid.height_px - height) // 2, width, height)
    return Layout(grid, camera, ideal, box, _distortion_matters(camera, pixel_limit))


def _resized(image: NDArray[np.uint8], width_px: int, height_px: int) -> NDArray[np.uint8]:
    """Resizes an image (H, W, 3) with the filter of the official loader; OpenCV's filters do not antialias.

    Images of more than four times the size are first reduced by averaging to at least twice the size, which is faster.
    """
    resized = Image.fromarray(image).resize((width_px, height_px), Image.Resampling.LANCZOS, reducing_gap=2.0)
    return np.asarray(resized, np.uint8)


@lru_cache(maxsize=8)  # 7 MB each; a robot's camera seldom changes, references are prepared once
def _lens_map(source: Camera, ideal: Camera) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """For each pixel of the ideal image, column and row in the distorted one, at most two pixels outside of it."""
    pixels, _ = _covered(source, ideal)
    pixels = np.clip(pixels, -2, (source.width_px + 1, source.height_px + 1)).astype(np.float32)
    return np.ascontiguousarray(pixels[..., 0]), np.ascontiguousarray(pixels[..., 1])


def _covered(source: Camera, ideal: Camera) -> tuple[Array, NDArray[np.bool_]]:
    """For each pixel of the ideal image, its pixel (H, W, 2) in the distorted one, and whether (H, W) it is inside."""
    rows, columns = np.indices((ideal.height_px, ideal.width_px))
    pixels = source.project(ideal.rays(np.stack([columns, rows], axis=-1)))
    inside = ((pixels >= -0.5) & (pixels <= (source.width_px - 0.5, source.height_px - 0.5))).all(axis=-1)
    return pixels, inside & _unfolded(pixels)


def _unfolded(pixels: Array) -> NDArray[np.bool_]:
    """Where a lens map (H, W, 2) keeps orientation; beyond, a polynomial shows the image again, mirrored."""
    if min(pixels.shape[:2]) < 2:
        return np.ones(pixels.shape[:2], bool)
    (x_down, x_right), (y_down, y_right) = (np.gradient(pixels[..., i]) for i in (0, 1))
    # A mirroring through a point keeps the sign of the determinant, but not that of the trace.
    return np.asarray((x_right * y_down - y_right * x_down > 0) & (x_right + y_down > 0))
