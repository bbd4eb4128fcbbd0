"""Local features: a photograph becomes a view, a pinhole camera with keypoints and descriptors.

A seam: an extractor is a name and one method. What it finds is stored with the reference under that name, so a change
of anything that changes the features must change the name.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, Fisheye, RadialTangential

from .views import Features, View


class FeatureExtractor(Protocol):
    """Finds local features.

    Attributes:
        name: identifies the extractor and everything that changes its output; the key of stored features.
    """

    @property
    def name(self) -> str:
        """See the class."""
        ...

    def extract(self, image: NDArray[np.uint8], camera: Camera) -> View:
        """The view of a photograph.

        Args:
            image: (H, W, 3) uint8, RGB, as stored in the file.
            camera: its camera, of the same size.

        Returns:
            The view, possibly with no keypoints at all (a blank wall); that is for the caller to judge.
        """
        ...


@dataclass(frozen=True)
class SiftOptions:
    """Options of SIFT.

    Attributes:
        max_keypoints: the strongest are kept; matching is quadratic in it.
        max_side_px: longer images are reduced to it; beyond it SIFT gains little and costs much.
        contrast_threshold: half of OpenCV's default, for weakly textured walls; `max_keypoints` bounds the rest.
    """

    max_keypoints: int = 2048
    max_side_px: int = 1024
    contrast_threshold: float = 0.02

    def __post_init__(self) -> None:
        if self.max_keypoints < 1 or self.max_side_px < 32 or not self.contrast_threshold >= 0:
            raise ValueError(f"senseless options: {self}")


@dataclass(frozen=True)
class SiftExtractor:
    """SIFT (Lowe 2004) by OpenCV with square-root normalized descriptors (Arandjelovic and Zisserman 2012)."""

    options: SiftOptions = field(default_factory=SiftOptions)

    @property
    def name(self) -> str:
        """E.g. "sift-2048-1024px-0.02"."""
        options = self.options
        return f"sift-{options.max_keypoints}-{options.max_side_px}px-{options.contrast_threshold:g}"

    def extract(self, image: NDArray[np.uint8], camera: Camera) -> View:
        """See FeatureExtractor.extract."""
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
        reduced, reduced_camera = reduce_image(grey, camera, self.options.max_side_px)
        # OpenCV's plain upscaling of the first octave shifts every keypoint by a quarter pixel.
        sift = cv2.SIFT.create(
            nfeatures=self.options.max_keypoints,
            contrastThreshold=self.options.contrast_threshold,
            enable_precise_upscale=True,
        )
        found, raw = sift.detectAndCompute(reduced, None)
        if not found:
            nothing = Features(np.empty((0, 2), np.float32), np.empty((0, 128), np.float32), np.empty(0, np.float32))
            return View(reduced_camera.pinhole(), nothing)
        # OpenCV keeps ties of the weakest keypoint, so it may return more than asked for.
        found, raw = found[: self.options.max_keypoints], raw[: self.options.max_keypoints]
        keypoints = np.array([k.pt for k in found])
        ideal = undistort_pixels(keypoints, reduced_camera)
        usable = np.isfinite(ideal).all(axis=1)
        features = Features(
            ideal[usable].astype(np.float32),
            np.sqrt(raw[usable] / raw[usable].sum(axis=1, keepdims=True)).astype(np.float32),
            np.array([k.size for k in found], np.float32)[usable],
        )
        return View(reduced_camera.pinhole(), features)


def make_extractor(name: str) -> FeatureExtractor:
    """The extractor that a setting names.

    Raises:
        ValueError: unknown name.
    """
    if name == "sift":
        return SiftExtractor()
    raise ValueError(f"unknown features {name!r}; known: sift")


def reduce_image(image: NDArray[np.uint8], camera: Camera, max_side_px: int) -> tuple[NDArray[np.uint8], Camera]:
    """The image, its longer side at most `max_side_px`, and its camera."""
    height, width = image.shape[:2]
    scale = max_side_px / max(height, width)
    if scale >= 1:
        return image, camera
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8), camera.resized(*size)


MAX_INCIDENCE_DEG = 80.0
"""Rays further from the optical axis are dropped: a pinhole's pixels run to infinity towards 90 degrees."""


def undistort_pixels(pixels: Array, camera: Camera) -> Array:
    """Pixels (N, 2) of the ideal pinhole camera with the same K; NaN where the lens model has no inverse."""
    if camera.distortion is None:
        return pixels
    d, k = camera.distortion, camera.matrix()
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-9)
    points = np.ascontiguousarray(pixels, np.float64)[:, None]
    if isinstance(d, RadialTangential):
        coefficients = np.array([d.k1, d.k2, d.p1, d.p2, d.k3], float)
        ideal = cv2.undistortPoints(points, k, coefficients, R=None, P=k, criteria=criteria).reshape(-1, 2)
    else:
        assert isinstance(d, Fisheye)
        ideal = cv2.fisheye.undistortPoints(
            points, k, np.array([d.k1, d.k2, d.k3, d.k4], float), P=k, criteria=criteria
        )[:, 0]
    # The iteration may run off where the model folds over; what does not come back to where it started is no solution.
    rays = camera.rays(ideal)
    returned = camera.project(rays)
    good = np.linalg.norm(returned - pixels, axis=1) < 0.05
    good &= np.linalg.norm(rays[:, :2], axis=1) < np.tan(np.radians(MAX_INCIDENCE_DEG))
    return np.where(good[:, None], ideal, np.nan)
