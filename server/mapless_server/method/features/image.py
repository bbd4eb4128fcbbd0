"""What all extractors share: reducing the image, and undistorting keypoints to an ideal pinhole camera."""

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, Fisheye, RadialTangential, unknown_lens

from ..views import Features, View, rounded_descriptors


def reduce_image(
    image: NDArray[np.uint8], camera: Camera, max_side_px: int, multiple_px: int = 1
) -> tuple[NDArray[np.uint8], Camera]:
    """Reduces an image so that its longer side is at most `max_side_px`; returns it and its camera.

    Args:
        image: (H, W) or (H, W, 3).
        camera: the image's camera, of the same size.
        max_side_px: longest side of the result, a multiple of `multiple_px`.
        multiple_px: both sides of the result are multiples of it, the nearest ones that keep the aspect; the image may
            grow for that by less than one multiple.
    """
    height, width = image.shape[:2]
    scale = min(1.0, max_side_px / max(height, width))
    columns, rows = (max(1, round(side * scale / multiple_px)) * multiple_px for side in (width, height))
    if (columns, rows) == (width, height):
        return image, camera
    reduced = cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA)
    return np.asarray(reduced, np.uint8), camera.resized(columns, rows)


MAX_INCIDENCE_DEG = 80.0
"""Rays further from the optical axis are dropped: a pinhole's pixels run to infinity towards 90 degrees."""


def undistort_pixels(pixels: Array, camera: Camera) -> Array:
    """Undistorts pixels (N, 2) to the ideal pinhole camera with the same K; NaN where the lens model has no inverse."""
    if camera.distortion is None:
        return pixels
    d, k = camera.distortion, camera.matrix()
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-9)
    points = np.ascontiguousarray(pixels, np.float64)[:, None]
    if isinstance(d, RadialTangential):
        coefficients = np.array([d.k1, d.k2, d.p1, d.p2, d.k3], float)
        ideal = cv2.undistortPoints(points, k, coefficients, R=None, P=k, criteria=criteria).reshape(-1, 2)
    elif isinstance(d, Fisheye):
        ideal = cv2.fisheye.undistortPoints(
            points, k, np.array([d.k1, d.k2, d.k3, d.k4], float), P=k, criteria=criteria
        )[:, 0]
    else:
        raise unknown_lens(d)
    # The iteration may diverge where the model folds over; only pixels that project back to themselves are solutions.
    rays = camera.rays(ideal)
    returned = camera.project(rays)
    good = np.linalg.norm(returned - pixels, axis=1) < 0.05
    good &= np.linalg.norm(rays[:, :2], axis=1) < np.tan(np.radians(MAX_INCIDENCE_DEG))
    return np.where(good[:, None], ideal, np.nan)


def seen_share(camera: Camera) -> float:
    """Share of the image, 0 to 1, whose pixels have a ray through the lens; small for wrong coefficients."""
    if camera.distortion is None:
        return 1.0
    across, down = (np.linspace(-0.5, side - 0.5, 17)[1::2] for side in (camera.width_px, camera.height_px))
    pixels = np.stack(np.meshgrid(across, down), -1).reshape(-1, 2)
    return float(np.isfinite(undistort_pixels(pixels, camera)).all(axis=1).mean())


def view_of(
    camera: Camera,
    pixels: Array,
    descriptors: NDArray[np.float32] | NDArray[np.uint8],
    sizes_px: NDArray[np.float32],
) -> View:
    """Makes the view of keypoints found in an image: undistorted, without those that have no undistorted pixel.

    Descriptors are rounded to 8 bits, for queries as for stored references.

    Args:
        camera: of the image, with its lens distortion.
        pixels: (N, 2) keypoints in the image.
        descriptors: (N, D): float32, or uint8 as in Features.
        sizes_px: (N,), see Features.
    """
    is_exact = descriptors.dtype == np.uint8
    rounded = descriptors if is_exact else rounded_descriptors(np.asarray(descriptors, np.float32))
    if not len(pixels):
        nothing = Features(np.empty((0, 2), np.float32), rounded, sizes_px)
        return View(camera.pinhole(), nothing, distortion=camera.distortion)
    ideal = undistort_pixels(pixels, camera)
    usable = np.isfinite(ideal).all(axis=1)
    features = Features(ideal[usable].astype(np.float32), rounded[usable], sizes_px[usable])
    return View(camera.pinhole(), features, distortion=camera.distortion)
