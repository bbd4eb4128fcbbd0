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

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.depth import DepthNoise
from mapless.geometry import Array, Camera, RigidTransform

from ..features.views import DepthSource, KeypointDepths, View, undistort_pixels


@dataclass(frozen=True, eq=False)
class MeasuredDepth:
    """The depths of a sensor.

    Attributes:
        camera: camera of the depth image, in its pixels, with its lens distortion.
        depth: (H, W) float32, in the unit of poses, along its viewing direction; NaN where there is none.
        noise: standard deviations of its depths.
        camera_from_depth_camera: pose of its camera in the photograph's camera; None if it is the same.
    """

    camera: Camera
    depth: NDArray[np.float32]
    noise: DepthNoise
    camera_from_depth_camera: RigidTransform | None = None

    def at_keypoints(self, view: View) -> KeypointDepths:
        """The depths at the keypoints of the photograph, with their standard deviations."""
        seen = self if self.camera_from_depth_camera is None else self.seen_by(view.camera)
        pixels = seen.camera.project(view.camera.rays(view.features.pixels()))
        depth = _interpolated(_without_edges(seen.depth, self.noise), pixels)
        sigma = np.hypot(self.noise.sigma_m(depth) / depth, self.noise.common)
        return KeypointDepths(
            depth.astype(np.float32), sigma.astype(np.float32), self.noise.common, DepthSource.MEASURED
        )

    def seen_by(self, camera: Camera) -> "MeasuredDepth":
        """The depths as a camera (a pinhole) sees them that is at the photograph's place."""
        assert self.camera_from_depth_camera is not None
        density = np.hypot(self.camera.focal_x_px, self.camera.focal_y_px) / np.hypot(
            camera.focal_x_px, camera.focal_y_px
        )
        width, height = (max(1, round(side * min(density, 1.0))) for side in (camera.width_px, camera.height_px))
        target = camera.resized(width, height)
        points = self.camera_from_depth_camera.apply(self.points())
        points = points[points[:, 2] > 0]
        columns, rows = np.rint(target.project(points)).astype(np.intp).T
        inside = (columns >= 0) & (rows >= 0) & (columns < width) & (rows < height)
        nearest = np.full(width * height, np.inf)
        np.minimum.at(nearest, rows[inside] * width + columns[inside], points[inside, 2])
        depth = np.where(np.isfinite(nearest), nearest, np.nan).reshape(height, width)
        return MeasuredDepth(target, _filled(depth), self.noise)

    def points(self) -> Array:
        """The points (P, 3) of the pixels with a depth, in the frame of the depth camera."""
        rows, columns = np.nonzero(np.isfinite(self.depth))
        pixels = np.stack([columns, rows], axis=1).astype(np.float64)
        if self.camera.distortion is not None:
            pixels = undistort_pixels(pixels, self.camera)
        return np.asarray(self.camera.rays(pixels) * self.depth[rows, columns, None].astype(np.float64))


def _without_edges(depth: NDArray[np.float32], noise: DepthNoise) -> Array:
    """Inverse depths (H, W); NaN without a value, at edges and beside them.

    The second difference of neighbours is 0 on a plane, but for noise: with the weights 1, -2 and 1 it has six
    times the variance of one of them. An edge is beyond three standard deviations.
    """
    inverse = 1 / depth.astype(np.float64)
    limit = 3 * np.sqrt(6) * noise.sigma_m(depth.astype(np.float64)) / depth
    bend = np.zeros(inverse.shape, np.uint8)
    across, down = inverse[:, 2:] + inverse[:, :-2], inverse[2:] + inverse[:-2]
    bend[:, 1:-1] |= np.abs(across / inverse[:, 1:-1] - 2) > limit[:, 1:-1]
    bend[1:-1] |= np.abs(down / inverse[1:-1] - 2) > limit[1:-1]
    inverse[cv2.dilate(bend, np.ones((3, 3), np.uint8)) > 0] = np.nan
    return inverse


def _interpolated(inverse: Array, pixels: Array) -> Array:
    """Depths (N,) at pixels (N, 2) of a map of inverse depths; NaN where one of the four pixels around has none."""
    height, width = inverse.shape
    first = np.floor(np.where(np.isfinite(pixels), pixels, -1)).astype(np.intp)
    inside = np.asarray(((first >= 0) & (first < (width - 1, height - 1))).all(axis=1))
    column, row = np.where(inside[:, None], first, 0).T
    if not inside.any():
        return np.full(len(pixels), np.nan)
    right, low = (pixels - first).T
    upper = inverse[row, column] * (1 - right) + inverse[row, column + 1] * right
    lower = inverse[row + 1, column] * (1 - right) + inverse[row + 1, column + 1] * right
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(inside, 1 / (upper * (1 - low) + lower * low), np.nan))


def _filled(depth: Array) -> NDArray[np.float32]:
    """Fills single holes, between pixels that rounding moved apart, with the nearest depth around."""
    inverse = np.nan_to_num(1 / depth)
    closed = cv2.morphologyEx(inverse, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    with np.errstate(divide="ignore"):
        filled = np.where(closed > 0, 1 / closed, np.nan)
    return np.where(np.isnan(depth), filled, depth).astype(np.float32)
