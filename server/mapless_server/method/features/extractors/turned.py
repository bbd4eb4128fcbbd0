"""Features of a photograph whose raster is turned: learned features describe what is upright, and match no others."""

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Camera

from ..views import Ignored, View, view_of
from . import FeatureExtractor


def extract_turned(
    extractor: FeatureExtractor,
    image: NDArray[np.uint8],
    camera: Camera,
    clockwise_quarter_turns: int,
    ignored: Ignored | None = None,
) -> View:
    """Finds the features of a photograph, see FeatureExtractor.extract, in its raster turned by 0 to 3 quarters.

    Returns the view in pixels of the raster that is not turned; only its descriptors are those of the turned one.
    """
    sides = camera.width_px, camera.height_px
    width, height = sides[::-1] if clockwise_quarter_turns % 2 else sides
    # Distortion is not the extractor's to remove: it belongs to the raster that is not turned.
    plain = Camera(width, height, float(max(sides)), float(max(sides)), (width - 1) / 2, (height - 1) / 2)
    turned = None if ignored is None else np.rot90(ignored, -clockwise_quarter_turns)
    found = extractor.extract(np.ascontiguousarray(np.rot90(image, -clockwise_quarter_turns)), plain, turned)
    size = found.camera.width_px, found.camera.height_px
    pixels = found.features.keypoints
    for _ in range(clockwise_quarter_turns):  # back: what is right was up, and what is down was right
        pixels, size = np.stack([pixels[:, 1], size[0] - 1 - pixels[:, 0]], axis=1), size[::-1]
    features = found.features
    return view_of(camera.resized(*size), pixels.astype(np.float64), features.descriptors, features.sizes_px)
