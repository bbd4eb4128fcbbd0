"""How photographs are rolled against one another, and the rasters in which they are upright."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from support import corner
from support.scenes import random_for

from mapless_server.images import ImageLimits, decode_image
from mapless_server.method.features.extractors import SiftExtractor
from mapless_server.method.features.extractors.turned import extract_turned
from mapless_server.method.features.matching import mutual_matches
from mapless_server.method.features.rolls import (
    LEAST_AGREEMENT,
    apart_deg,
    are_alike,
    rasters_of,
    roll_about_axis,
    roll_of_directions,
    roll_of_rotation,
    similarity_of,
)
from mapless_server.method.features.views import View, view_of

CAMERA = corner.CAMERA
IMAGE = decode_image(corner.photograph(corner.pose(0.0)), ImageLimits())
SIFT = SiftExtractor()


def seen(pixels: NDArray[np.float64]) -> View:
    return view_of(CAMERA, pixels, np.zeros((len(pixels), 128), np.uint8), np.ones(len(pixels), np.float32))


@pytest.mark.parametrize("angle_deg", [0.0, 33.0, -120.0, 179.0])
def test_matches_show_the_roll_despite_wrong_ones(angle_deg: float) -> None:
    random = random_for("roll", angle_deg)
    ours = random.uniform((0, 0), (CAMERA.width_px, CAMERA.height_px), (100, 2))
    theirs = 0.7 * ours @ roll_about_axis(angle_deg)[:2, :2].T + 50.0
    theirs[:50] = random.uniform((0, 0), (CAMERA.width_px, CAMERA.height_px), (50, 2))
    roll = similarity_of(seen(ours), seen(theirs), np.repeat(np.arange(100, dtype=np.int32)[:, None], 2, axis=1))
    assert roll is not None
    assert roll.agreement > LEAST_AGREEMENT
    assert apart_deg(roll.clockwise_deg, angle_deg) < 3
    assert roll.agreeing >= 50


def test_matches_by_chance_show_no_roll() -> None:
    random, shown = random_for("chance"), 0
    matches = np.repeat(np.arange(30, dtype=np.int32)[:, None], 2, axis=1)
    for _ in range(50):
        ours, theirs = random.uniform((0, 0), (CAMERA.width_px, CAMERA.height_px), (2, 30, 2))
        found = similarity_of(seen(ours), seen(theirs), matches)
        shown += found is not None and found.agreement >= LEAST_AGREEMENT
    assert shown == 0


def test_the_roll_of_a_rotation_is_its_turn_about_the_axis() -> None:
    swing = Rotation.from_rotvec([0.4, -0.3, 0.0]).as_matrix()
    assert roll_of_rotation(swing @ roll_about_axis(-70.0)) == pytest.approx(-70.0)


@pytest.mark.parametrize("swing_deg", [59.0, 61.0, 180.0])
def test_cameras_that_look_elsewhere_have_no_roll(swing_deg: float) -> None:
    swing = Rotation.from_rotvec([0.0, np.radians(swing_deg), 0.0]).as_matrix()
    assert (roll_of_rotation(swing) is None) == (swing_deg > 60)


def test_a_direction_seen_by_both_shows_the_roll() -> None:
    down = np.array([0.2, 0.9, 0.3])
    down /= np.linalg.norm(down)
    roll_deg = roll_of_directions(down, roll_about_axis(130.0) @ down)
    assert roll_deg is not None
    assert apart_deg(roll_deg, 130.0) < 1e-9
    assert roll_of_directions(np.array([0.1, 0.1, 0.99]), down) is None


@pytest.mark.parametrize(
    ("rolls_deg", "counts", "expected"),
    [
        ([5.0, -15.0], [9, 8], ()),
        ([], [], ()),
        ([44.0, 50.0, 60.0], [5, 30, 7], (50.0,)),
        ([-90.0, 10.0], [9, 8], (270.0, 0.0)),
        ([None, 10.0, 90.0], [9, 8, 10], (90.0, 0.0)),
        ([90.0, None, 95.0], None, (90.0,)),
        ([0.0, 60.0, 120.0, 180.0], [1, 2, 3, 4], (180.0, 120.0, 60.0)),
    ],
)
def test_rasters_are_those_of_most_matches(
    rolls_deg: list[float | None], counts: list[int] | None, expected: tuple[float, ...]
) -> None:
    assert rasters_of(rolls_deg, counts) == expected


def test_rasters_turned_by_nearly_the_same_are_alike() -> None:
    assert are_alike((355.0, 90.0), (3.0, 85.0))
    assert not are_alike((355.0,), (15.0,))
    assert not are_alike((90.0,), (90.0, 270.0))
    assert are_alike((), ())


@pytest.mark.parametrize("angles_deg", [[37.0], [200.0, 0.0]])
def test_features_of_turned_rasters_are_where_they_are_as_it_is(angles_deg: list[float]) -> None:
    plain, turned = SIFT.extract(IMAGE, CAMERA), extract_turned(SIFT, IMAGE, CAMERA, angles_deg)
    assert turned.camera == plain.camera
    matches = mutual_matches(turned.features, plain.features, 0.999)
    apart_px = np.linalg.norm(turned.features.pixels(matches[:, 0]) - plain.features.pixels(matches[:, 1]), axis=1)
    assert len(matches) > 100
    assert np.median(apart_px) < 0.3


def test_sift_of_a_mirror_image_is_known_without_it() -> None:
    plain, mirrored = SIFT.extract(IMAGE, CAMERA), SIFT.extract(np.ascontiguousarray(IMAGE[:, ::-1]), CAMERA)
    matches = mutual_matches(SIFT.mirrored(plain).features, mirrored.features, 0.8)
    there = mirrored.features.pixels(matches[:, 1])
    there[:, 0] = mirrored.camera.width_px - 1 - there[:, 0]
    assert len(matches) > 0.6 * len(plain.features)
    assert np.median(np.linalg.norm(plain.features.pixels(matches[:, 0]) - there, axis=1)) < 0.1
    assert len(mutual_matches(plain.features, mirrored.features, 0.8)) < 0.2 * len(matches)
