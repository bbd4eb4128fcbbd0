"""Depth images that sensors measured, at the keypoints of their photographs.

A depth image has a camera of its own: the photograph's, scaled, or another one beside it. The depths of another one are
points, which are seen from the photograph's camera in a map of about as many pixels; of two in a pixel the nearer one
hides the other.

Between pixels the inverse depth is interpolated, which on a plane is linear in the image. Where it bends by more than
the sensor's noise, or a pixel beside has no value, there is an edge, at which a keypoint may belong to either side: it
has no depth.

A sensor's calibration bends its space: depths that are near one another are wrong by a part of the common error that
the common factor does not remove. So this error counts in each depth, too; else hundreds would weigh as independent
ones, more than triangulated points.
"""

import math
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from mapless.depth import DepthImage, DepthNoise
from mapless.geometry import Array, Camera, RigidTransform

from ..features.views import ALONG_SIDE, DepthSource, KeypointDepths, View, undistort_pixels


@dataclass(frozen=True, eq=False)
class MeasuredDepth:
    """The depths of a sensor.

    Attributes:
        camera: camera of the depth image, in its pixels, with its lens distortion.
        depth: (H, W) float32, in the unit of poses, along its viewing direction; NaN where there is none.
        noise: standard deviations of its depths.
        camera_from_depth_camera: pose of its camera in the photograph's camera; None if it is the same.
        median: the median of the image as its sensor gave it, by which its unit is judged; NaN if it is not known.
    """

    camera: Camera
    depth: NDArray[np.float32]
    noise: DepthNoise
    camera_from_depth_camera: RigidTransform | None = None
    median: float = math.nan
    _seen: dict[Camera, "MeasuredDepth"] = field(default_factory=dict, init=False, repr=False)

    @staticmethod
    def of(image: DepthImage, depth: NDArray[np.float32], photo: Camera) -> "MeasuredDepth":
        """The decoded depths (H, W) of an image, measured with a photograph of this camera."""
        height, width = depth.shape
        camera = image.camera or photo.resized(width, height)
        noise, pose = image.known_noise.bounded(), image.camera_from_depth_camera
        return MeasuredDepth(camera, depth, noise, pose, median_depth(depth))

    def at_keypoints(self, view: View) -> KeypointDepths:
        """The depths at the keypoints of the photograph, with their standard deviations."""
        depth = self.at_pixels(view.camera, view.features.pixels())
        sigma = np.hypot(self.noise.relative_sigma(depth), self.noise.common)
        known, common = (depth.astype(np.float32), sigma.astype(np.float32)), self.noise.common
        return KeypointDepths(*known, common, DepthSource.MEASURED, self.median)

    def on_grid(self, camera: Camera, count: int) -> tuple[Array, Array]:
        """Pixels (N, 2) of the photograph's camera (a pinhole), on a grid of about so many, and their depths (N,)."""
        step = math.sqrt(camera.width_px * camera.height_px / count)
        across, down = (np.arange(step / 2, side - 1, step) for side in (camera.width_px, camera.height_px))
        pixels = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
        depth = self.at_pixels(camera, pixels)
        known = np.isfinite(depth)
        return pixels[known], depth[known]

    def inverse_in(self, camera: Camera) -> tuple[Camera, NDArray[np.float32]]:
        """Inverse depths (H, W) as the photograph's camera sees them, without edges, NaN where there is none.

        Their camera comes first. `at_keypoints` interpolates between the same values.
        """
        seen = self.in_photograph(camera)
        return seen.camera, _inverse_without_edges(seen.depth, self.noise)

    def at_pixels(self, camera: Camera, pixels: Array) -> Array:
        """Depths (N,) at pixels (N, 2) of the photograph's camera, a pinhole; NaN where there is none."""
        seen = self.in_photograph(camera)
        return _depth_at(seen.depth, seen.camera.project(camera.rays(pixels)), self.noise)

    def in_photograph(self, camera: Camera) -> "MeasuredDepth":
        """The depths in a depth image of the photograph's own place: these, if they are, or as `seen_by` its camera.

        Each camera's are computed once.
        """
        if self.camera_from_depth_camera is None:
            return self
        if camera not in self._seen:
            self._seen[camera] = self.seen_by(camera)
        return self._seen[camera]

    def seen_by(self, camera: Camera) -> "MeasuredDepth":
        """The depths as a camera (a pinhole) sees them that is at the photograph's place."""
        assert self.camera_from_depth_camera is not None
        density = np.hypot(self.camera.focal_x_px, self.camera.focal_y_px) / np.hypot(
            camera.focal_x_px, camera.focal_y_px
        )
        width, height = (max(1, round(side * min(density, 1.0))) for side in (camera.width_px, camera.height_px))
        target = camera.resized(width, height)
        column, row, depth = self._seen_pixels(target, max(1, min(int(density), min(self.depth.shape) // 2)))
        with np.errstate(invalid="ignore"):
            inside = (depth > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        nearest = np.full(width * height, np.inf, np.float32)
        np.minimum.at(nearest, (row[inside] * width + column[inside]).astype(np.intp), depth[inside])
        return MeasuredDepth(target, _filled(nearest.reshape(height, width)), self.noise, median=self.median)

    def _seen_pixels(
        self, target: Camera, step: int
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Columns and rows (H, W) of a pinhole at the photograph's place that show each step's depth, and depths there.

        A depth d at the homogeneous pixel p has its place in the other image at d M p + b. In single precision, whose
        pixels are exact to a thousandth, all takes a third of the time.
        """
        assert self.camera_from_depth_camera is not None
        pose, k = self.camera_from_depth_camera, target.matrix()
        m = (k @ pose.rotation @ np.linalg.inv(self.camera.matrix())).astype(np.float32)
        b = (k @ pose.translation).astype(np.float32)
        (height, width), depth = self.depth.shape, self.depth[::step, ::step]
        columns, rows = np.arange(0, width, step, dtype=np.float32), np.arange(0, height, step, dtype=np.float32)
        column, row = columns, rows[:, None]
        if self.camera.distortion is not None:
            column, row = _undistorted(columns, rows, self.camera)
        x, y, z = (depth * (m[i, 0] * column + (m[i, 1] * row + m[i, 2])) + b[i] for i in range(3))
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.rint(x / z), np.rint(y / z), z

    def points(self) -> Array:
        """The points (P, 3) of the pixels with a depth, in the frame of the depth camera."""
        rows, columns = np.nonzero(np.isfinite(self.depth))
        pixels = np.stack([columns, rows], axis=1).astype(np.float64)
        if self.camera.distortion is not None:
            pixels = undistort_pixels(pixels, self.camera)
        return np.asarray(self.camera.rays(pixels) * self.depth[rows, columns, None].astype(np.float64))


def _undistorted(
    columns: NDArray[np.float32], rows: NDArray[np.float32], camera: Camera
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Undistorted columns and rows (H, W) of the pixels at columns (W,) and rows (H,).

    They are exact on a lattice of `ALONG_SIDE` squared positions along a side, between which lenses are linear to
    hundredths of a pixel.
    """
    knots, lower, share = zip(*(_lattice(it) for it in (columns, rows)), strict=True)
    pixels = np.stack(np.meshgrid(*knots), axis=-1).reshape(-1, 2).astype(np.float64)
    exact = undistort_pixels(pixels, camera).astype(np.float32).T.reshape(2, len(knots[1]), len(knots[0]))
    across = exact[:, :, lower[0]] * (1 - share[0]) + exact[:, :, lower[0] + 1] * share[0]
    column, row = across[:, lower[1]] * (1 - share[1][:, None]) + across[:, lower[1] + 1] * share[1][:, None]
    return column, row


def _lattice(positions: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.intp], NDArray[np.float32]]:
    """At most `ALONG_SIDE` squared of sorted positions; for each position the one before and the share of the way."""
    chosen = np.unique(np.linspace(0, len(positions) - 1, min(ALONG_SIDE**2, len(positions))).round().astype(np.intp))
    knots = positions[chosen]
    lower = np.clip(np.searchsorted(knots, positions, side="right") - 1, 0, max(0, len(knots) - 2))
    return knots, lower, (positions - knots[lower]) / np.diff(knots)[lower]


def median_depth(depth: NDArray[np.float32]) -> float:
    """Median of the depths (H, W) of an image that has some; NaN is none."""
    return float(np.median(depth[np.isfinite(depth)]))


def _depth_at(depth: NDArray[np.float32], pixels: Array, noise: DepthNoise) -> Array:
    """Depths (N,) at pixels (N, 2) of a depth image; NaN where one of the four around has none or is at an edge."""
    first = np.floor(np.where(np.isfinite(pixels), pixels, -6)).astype(np.intp)
    right, low = (pixels - first).T
    inverse = _without_edges(_patches(depth, first), noise)
    upper = inverse[:, 0, 0] * (1 - right) + inverse[:, 0, 1] * right
    lower = inverse[:, 1, 0] * (1 - right) + inverse[:, 1, 1] * right
    return np.asarray(1 / (upper * (1 - low) + lower * low))


def _patches(depth: NDArray[np.float32], first: NDArray[np.intp]) -> Array:
    """Depths (N, 6, 6) around the upper left (column, row) of four pixels, which is at [2, 2]; NaN beyond the image.

    The four depend on all of them: an edge beside a pixel is seen from its neighbours.
    """
    height, width = depth.shape
    column, row = (first[:, axis, None] + np.arange(-2, 4) for axis in (0, 1))
    inside = ((row >= 0) & (row < height))[:, :, None] & ((column >= 0) & (column < width))[:, None, :]
    values = depth[np.clip(row, 0, height - 1)[:, :, None], np.clip(column, 0, width - 1)[:, None, :]]
    return np.where(inside, values.astype(np.float64), np.nan)


def _without_edges(patches: Array, noise: DepthNoise) -> Array:
    """Inverse depths (N, 2, 2) of the four pixels amid patches; NaN without a value, at edges and beside them.

    The second difference of neighbours is 0 on a plane, but for noise: with the weights 1, -2 and 1 it has six
    times the variance of one of them. An edge is beyond three standard deviations.
    """
    inverse, inner = 1 / patches, patches[:, 1:-1, 1:-1]
    limit = 3 * np.sqrt(6) * noise.relative_sigma(inner)
    across, down = inverse[:, 1:-1, 2:] + inverse[:, 1:-1, :-2], inverse[:, 2:, 1:-1] + inverse[:, :-2, 1:-1]
    bends = [np.abs(sums / inverse[:, 1:-1, 1:-1] - 2) > limit for sums in (across, down)]
    near_edge = sliding_window_view(bends[0] | bends[1], (3, 3), axis=(1, 2)).any(axis=(-2, -1))
    return np.where(near_edge, np.nan, inverse[:, 2:-2, 2:-2])


def _inverse_without_edges(depth: NDArray[np.float32], noise: DepthNoise) -> NDArray[np.float32]:
    """Inverse depths (H, W) of a whole image; NaN where `_without_edges` has none."""
    with np.errstate(invalid="ignore"):
        inverse = 1 / depth
        limit = 3 * np.sqrt(6) * (noise.constant_m * inverse + (noise.linear + noise.quadratic_per_m * depth))
        is_edge = np.zeros(depth.shape, np.uint8)
        inner = inverse[1:-1, 1:-1]
        for sums in (inverse[1:-1, 2:] + inverse[1:-1, :-2], inverse[2:, 1:-1] + inverse[:-2, 1:-1]):
            is_edge[1:-1, 1:-1] |= np.abs(sums / inner - 2) > limit[1:-1, 1:-1]
    return np.where(cv2.dilate(is_edge, np.ones((3, 3), np.uint8)) > 0, np.float32(np.nan), inverse)


def _filled(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Fills single holes, between pixels that rounding moved apart, with the nearest depth around.

    Holes are infinite, and NaN in the result.
    """
    inverse = 1 / depth
    closed = cv2.morphologyEx(inverse, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    with np.errstate(divide="ignore"):
        return np.where(np.isfinite(depth), depth, np.where(closed > 0, 1 / closed, np.float32(np.nan)))
