"""Features of a photograph whose raster is turned lie where its own do."""

import numpy as np
import pytest
from support.images import textured

from mapless.geometry import Camera
from mapless.lenses import RadialTangential
from mapless_server.method.features.extractors.sift import SiftExtractor
from mapless_server.method.features.extractors.turned import extract_turned
from mapless_server.method.features.matching import mutual_matches

LENS = RadialTangential(k1=0.05, k2=-0.02, p1=0.004, p2=-0.003)
CAMERA = Camera(1280, 301, 1000.0, 1010.0, 650.0, 140.0, LENS)
"""Longer than features are found in: the image is reduced, to 1024 x 241 pixels."""


@pytest.mark.parametrize("angles_deg", [[90.0], [180.0], [270.0], [0.0, 180.0]])
def test_turned_features_lie_where_the_others_do(angles_deg: list[float]) -> None:
    image, extractor = textured(CAMERA.width_px, CAMERA.height_px), SiftExtractor()
    upright, turned = extractor.extract(image, CAMERA), extract_turned(extractor, image, CAMERA, angles_deg)
    assert turned.camera == upright.camera
    assert turned.distortion == upright.distortion
    second, first = mutual_matches(turned.features, upright.features, 0.8).T
    apart_px = np.linalg.norm(upright.features.keypoints[first] - turned.features.keypoints[second], axis=1)
    assert len(first) > 200
    assert np.median(apart_px) < 0.05
