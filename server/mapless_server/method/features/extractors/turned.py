"""Features of a photograph whose raster is turned: learned features describe what is upright, and match no others."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera

from ..limits import MAX_SIDE_PX
from ..views import Features, Ignored, View, reduce_image, view_of
from . import FeatureExtractor


def extract_upright(
    extractor: FeatureExtractor,
    image: NDArray[np.uint8],
    camera: Camera,
    upright_deg: float,
    clockwise_deg: Sequence[float] = (),
    ignored: Ignored | None = None,
) -> View:
    """Finds the features of a photograph, see `extract_turned`, in its upright raster, or in that turned by angles.

    Turned clockwise by `upright_deg`, the raster is upright by the photograph's EXIF.
    """
    angles_deg = [(upright_deg + it) % 360 for it in clockwise_deg or (0.0,)]
    if angles_deg == [0.0]:
        return extractor.extract(image, camera, ignored)
    return replace(extract_turned(extractor, image, camera, angles_deg, ignored), upright_deg=upright_deg)


def extract_turned(
    extractor: FeatureExtractor,
    image: NDArray[np.uint8],
    camera: Camera,
    clockwise_deg: Sequence[float],
    ignored: Ignored | None = None,
) -> View:
    """Finds the features of a photograph, see FeatureExtractor.extract, in each of its rasters turned by these angles.

    Returns one view of all of them, in pixels of the raster that is not turned; only the descriptors are those of the
    turned ones. Angles should be further apart than those at which the features still match: what is described twice
    alike matches nothing, since the best match of a feature has to be clearly better than the second.
    """
    if any(angle_deg % 90 for angle_deg in clockwise_deg):  # a canvas of the whole image could be very large
        image, camera = reduce_image(image, camera, 2 * MAX_SIDE_PX)
    found = [_in_raster(extractor, image, camera, angle_deg, ignored) for angle_deg in clockwise_deg]
    processed = found[0].camera
    share = np.divide((processed.width_px, processed.height_px), (camera.width_px, camera.height_px))
    pixels = np.concatenate([it.in_image_px for it in found])
    descriptors = np.concatenate([it.features.descriptors for it in found])
    sizes_px = np.concatenate([it.features.sizes_px * (processed.width_px / it.camera.width_px) for it in found])
    # The strongest features of each raster come first, as those of one raster do.
    order = np.argsort(np.concatenate([np.arange(len(it.in_image_px)) for it in found]), kind="stable")
    pixels = (pixels + 0.5) * share - 0.5
    return view_of(processed, pixels[order], descriptors[order], sizes_px[order].astype(np.float32))


class _InRaster(NamedTuple):
    """The camera at the size in which features were found, their pixels (N, 2) in the whole image, and the features."""

    camera: Camera
    in_image_px: Array
    features: Features


def _in_raster(
    extractor: FeatureExtractor,
    image: NDArray[np.uint8],
    camera: Camera,
    angle_deg: float,
    ignored: Ignored | None,
) -> _InRaster:
    turned, turned_from_image = _turned(image, angle_deg)
    height, width = turned.shape[:2]
    # Distortion is not the extractor's to remove: it belongs to the raster that is not turned.
    plain = Camera(width, height, float(max(turned.shape)), float(max(turned.shape)), (width - 1) / 2, (height - 1) / 2)
    found = extractor.extract(turned, plain, _ignored(image, angle_deg, ignored))
    size = found.camera.width_px, found.camera.height_px
    in_turned = (found.features.pixels() + 0.5) * np.divide((width, height), size) - 0.5
    in_image = (in_turned - turned_from_image[:, 2]) @ turned_from_image[:, :2]  # the inverse of a rotation
    scale = max(size) / max(width, height)
    columns, rows = (max(1, round(scale * side)) for side in (camera.width_px, camera.height_px))
    return _InRaster(camera.resized(columns, rows), in_image, found.features)


def _turned(
    image: NDArray[np.uint8] | NDArray[np.bool_], angle_deg: float
) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """The image turned clockwise in a canvas that holds all of it, and its pixels (2, 3) from those of the image."""
    height, width = image.shape[:2]
    quarters, rest_deg = divmod(angle_deg, 90)
    cos, sin = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    if not rest_deg:
        cos, sin = np.rint(cos), np.rint(sin)
    turned_from_image = np.array([[cos, -sin, 0.0], [sin, cos, 0.0]])
    sides = np.abs(turned_from_image[:, :2]) @ (width, height)
    columns, rows = (int(side) for side in np.ceil(sides - 1e-6))
    centre = np.array([(width - 1) / 2, (height - 1) / 2])
    turned_from_image[:, 2] = ((columns - 1) / 2, (rows - 1) / 2) - turned_from_image[:, :2] @ centre
    if not rest_deg:  # exactly, without interpolation
        return np.ascontiguousarray(np.rot90(image, -int(quarters))).astype(np.uint8, copy=False), turned_from_image
    pixels = image.astype(np.uint8, copy=False)
    return np.asarray(cv2.warpAffine(pixels, turned_from_image, (columns, rows)), np.uint8), turned_from_image


def _ignored(image: NDArray[np.uint8], angle_deg: float, ignored: Ignored | None) -> Ignored | None:
    """The ignored pixels of the turned raster, also those of its corners, which show nothing."""
    if not angle_deg % 90:
        return None if ignored is None else _turned(ignored, angle_deg)[0].astype(bool)
    used: NDArray[np.uint8] = np.ones(image.shape[:2], np.uint8)
    if ignored is not None:
        resized = cv2.resize((~ignored).astype(np.uint8), image.shape[1::-1], interpolation=cv2.INTER_NEAREST)
        used = np.asarray(resized, np.uint8)
    return _turned(255 * used, angle_deg)[0] < 255
