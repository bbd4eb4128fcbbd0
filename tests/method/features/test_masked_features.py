"""Features of photographs with masks: none near an ignored pixel, the others as without a mask, the limit filled."""

import numpy as np
import pytest
from support import corner
from support.scenes import random_for
from support.stores import assert_same_view

from mapless_server.images import ImageLimits, decode_image
from mapless_server.method.features.extractors import SiftExtractor, SiftOptions
from mapless_server.method.features.extractors.turned import extract_turned
from mapless_server.method.features.masks import MARGIN_PX, are_usable, usable_pixels
from mapless_server.method.features.views import Ignored

CAMERA = corner.CAMERA
IMAGE = decode_image(corner.photograph(corner.pose(0.0)), ImageLimits())


def left_half() -> Ignored:
    ignored = np.zeros((CAMERA.height_px, CAMERA.width_px), bool)
    ignored[:, : CAMERA.width_px // 2] = True
    return ignored


def test_usable_pixels_are_further_than_the_margin_by_brute_force() -> None:
    random = random_for("margin")
    ignored = random.random((60, 80)) < 0.002
    rows, columns = np.nonzero(ignored)
    y, x = np.mgrid[:60, :80]
    distance_px = np.hypot(x[..., None] - columns, y[..., None] - rows).min(axis=-1)
    np.testing.assert_array_equal(usable_pixels(ignored, 80, 60), distance_px > MARGIN_PX)


def test_a_single_ignored_pixel_survives_reduction() -> None:
    ignored = np.zeros((600, 800), bool)
    ignored[300, 401] = True
    usable = usable_pixels(ignored, 100, 75)
    assert not are_usable(usable, np.array([[50.0, 37.4]]))[0]
    assert are_usable(usable, np.array([[60.0, 37.4], [-0.5, 74.5]])).all()


def test_features_away_from_the_mask_are_those_of_the_whole_image() -> None:
    everything = SiftOptions(max_keypoints=100_000)
    whole = SiftExtractor(everything).extract(IMAGE, CAMERA).features
    masked = SiftExtractor(everything).extract(IMAGE, CAMERA, left_half()).features
    beyond = np.rint(whole.keypoints[:, 0]) > CAMERA.width_px // 2 - 1 + MARGIN_PX
    assert 0.2 < beyond.mean() < 0.8
    np.testing.assert_array_equal(masked.keypoints, whole.keypoints[beyond])
    np.testing.assert_array_equal(masked.descriptors, whole.descriptors[beyond])


def test_the_limit_is_filled_with_the_strongest_that_are_left() -> None:
    few = SiftOptions(max_keypoints=150)
    whole = SiftExtractor(few).extract(IMAGE, CAMERA).features
    masked = SiftExtractor(few).extract(IMAGE, CAMERA, left_half()).features
    assert len(whole) == len(masked) == 150
    assert masked.keypoints[:, 0].min() > CAMERA.width_px // 2 - 1 + MARGIN_PX - 0.5
    kept = {tuple(it) for it in masked.keypoints}
    right = [tuple(it) for it in whole.keypoints if it[0] > CAMERA.width_px // 2 + MARGIN_PX + 1]
    assert right
    assert kept.issuperset(right)


def test_a_mask_of_everything_leaves_nothing() -> None:
    everything = np.ones((CAMERA.height_px, CAMERA.width_px), bool)
    assert len(SiftExtractor().extract(IMAGE, CAMERA, everything).features) == 0


@pytest.mark.parametrize("angle_deg", [0.0, 40.0, 90.0, 180.0, 270.0, 301.5])
def test_a_mask_turns_with_its_photograph(angle_deg: float) -> None:
    view = extract_turned(SiftExtractor(), IMAGE, CAMERA, [angle_deg], left_half())
    assert len(view.features) > 100
    assert view.features.keypoints[:, 0].min() > CAMERA.width_px // 2 - 1 + MARGIN_PX - 0.5
    if angle_deg == 0:
        assert_same_view(view, SiftExtractor().extract(IMAGE, CAMERA, left_half()))
