"""Tags in photographs, by OpenCV's detector, with corners to a tenth of a pixel, undistorted."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array
from mapless_server.errors import InvalidArgument
from mapless_server.images import ANY_SIZE, decode_image
from mapless_tools.progress import Progress, tracked

from ..pictures import PosedPicture
from .corners import ideal_corners
from .options import FAMILIES, TagId

STEP = "tags"


@dataclass(frozen=True, eq=False)
class Sighting:
    """A tag in a photograph, by its index: corners (4, 2) in pixels of the ideal pinhole camera of the same K.

    Clockwise from the tag's top left, as OpenCV draws it; the longest edge, pixels.
    """

    photograph: int
    corners_px: Array
    edge_px: float


def sightings(
    posed: Sequence[PosedPicture], families: Iterable[str], progress: Progress
) -> dict[TagId, tuple[Sighting, ...]]:
    """Everything in the photographs that these families' detectors take for a tag, one photograph in memory at a time.

    ValueError if a photograph cannot be read.
    """
    detectors = {family: _detector(family) for family in sorted(set(families))}
    modules = {family: _dictionary(family).markerSize + 2 for family in detectors}
    found: dict[TagId, list[Sighting]] = {}
    for index, it in enumerate(tracked(STEP, posed, len(posed), progress)):
        grey = _grey(it)
        for family, detector in detectors.items():
            corners, numbers, _ = detector.detectMarkers(grey)
            for shown_px, number in zip(corners, () if numbers is None else numbers.ravel(), strict=True):
                ideal_px = ideal_corners(grey, shown_px.reshape(4, 2).astype(float), modules[family], it.camera)
                if ideal_px is not None:
                    edges_px = np.linalg.norm(ideal_px - np.roll(ideal_px, 1, axis=0), axis=1)
                    sighting = Sighting(index, ideal_px, float(edges_px.max()))
                    found.setdefault(TagId(family, int(number)), []).append(sighting)
    return {tag: tuple(all_of) for tag, all_of in found.items()}


def _grey(posed: PosedPicture) -> NDArray[np.uint8]:
    picture = posed.picture
    try:
        pixels = decode_image(picture.path.read_bytes(), ANY_SIZE)
    except (OSError, InvalidArgument) as error:
        raise ValueError(f"{picture.path} cannot be read: {error}") from error
    if pixels.shape[:2] != (posed.camera.height_px, posed.camera.width_px):
        size = f"{pixels.shape[1]}x{pixels.shape[0]}"
        raise ValueError(
            f"{picture.path} has {size} pixels, its camera {posed.camera.width_px}x{posed.camera.height_px}"
        )
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), np.uint8)


def _detector(family: str) -> cv2.aruco.ArucoDetector:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    return cv2.aruco.ArucoDetector(_dictionary(family), parameters)


def _dictionary(family: str) -> cv2.aruco.Dictionary:
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, FAMILIES[family][0]))
