"""Points of a reference's depth: where the depth says, in the photograph's colours, few, and none at edges."""

from dataclasses import replace
from datetime import datetime, timezone

import numpy as np
import pytest
from support.depths import png

from mapless import Camera, DepthImage, DepthSensor, Reference, RigidTransform
from mapless.geometry import rotation_from_vector
from mapless_tools.depth_points import DEPTH_POINTS, MAX_OF_REFERENCE, depth_points, share_of, thinned, without_edges

CAMERA = Camera(640, 480, 500.0, 505.0, 321.0, 238.0)
DEPTH_CAMERA = Camera(320, 240, 290.0, 290.0, 158.0, 121.0)
POSE = RigidTransform(rotation_from_vector([0.2, -0.1, 0.3]), np.array([1.0, 2.0, 3.0]))
BESIDE = RigidTransform(np.eye(3), np.array([-0.03, 0.0, 0.0]))
LEFT, RIGHT = (200, 30, 30), (30, 30, 200)


def reference(depth: DepthImage | None) -> Reference:
    return Reference("hall", "r", CAMERA, POSE, "", 0, datetime.now(timezone.utc), b"", depth=depth)


def picture() -> np.ndarray:
    """Red to the left, blue to the right; half the photograph's size."""
    halves = np.empty((240, 320, 3), np.uint8)
    halves[:, :160], halves[:, 160:] = LEFT, RIGHT
    return halves


@pytest.mark.parametrize("own_camera", [False, True])
def test_points_lie_on_the_wall_in_its_colours(own_camera: bool) -> None:
    depth = DepthImage.of_metres(np.full((240, 320), 2.0, np.float32), DepthSensor.STEREO)
    if own_camera:
        depth = replace(depth, camera=DEPTH_CAMERA, camera_from_depth_camera=BESIDE)
    found = depth_points(reference(depth), picture(), 5000)
    assert found is not None
    assert 4000 < len(found.points) <= 5000
    x = POSE.inverse().apply(found.points)
    np.testing.assert_allclose(x[:, 2], 2.0, atol=1e-6)
    pixels = CAMERA.project(x)
    sides = [pixels[:, 0] < 316, (pixels[:, 0] > 324) & (pixels[:, 0] < 639)]
    sides = [it & (pixels[:, 1] > 0) & (pixels[:, 1] < 479) & (pixels[:, 0] > 0) for it in sides]
    for side, colour in zip(sides, (LEFT, RIGHT), strict=True):
        assert (found.colours[side] == colour).all()


@pytest.mark.parametrize(
    "depth",
    [
        None,
        DepthImage(png(np.zeros((240, 320), np.uint16)), 0.001),
        DepthImage.of_metres(np.full((240, 320), np.nan, np.float32)),
        DepthImage(b"no file", 0.001),
    ],
    ids=["none", "zero", "invalid", "no-file"],
)
def test_a_reference_without_usable_depth_has_no_points(depth: DepthImage | None) -> None:
    assert depth_points(reference(depth), picture(), 5000) is None


def test_millimetres_taken_for_metres_are_left_out_with_a_note(caplog: pytest.LogCaptureFixture) -> None:
    depth = replace(DepthImage(png(np.full((240, 320), 2000, np.uint16)), 0.001), unit_m=1.0)
    assert depth_points(reference(depth), picture(), 5000) is None
    assert caplog.messages == ["the depth of reference 'r' is left out: its median is 2000 m, outside 0.05 to 200 m"]
    drawn = depth_points(reference(depth), picture(), 5000, is_metric=False)
    assert drawn is not None
    assert np.median(POSE.inverse().apply(drawn.points)[:, 2]) == pytest.approx(2000)


def test_edges_have_no_points_and_slanted_floors_do() -> None:
    depth = np.tile(np.linspace(1, 4, 240, dtype=np.float32)[:, None], (1, 320))
    depth[:, 160:] = 0.5
    depth[10, 10] = np.nan
    found = without_edges(depth)
    assert np.isnan(found[:, 159:161]).all()
    assert np.isfinite(found[:, :159]).sum() == 240 * 159 - 1
    assert np.isfinite(found[:, 161:]).all()


def test_a_picture_of_many_references_is_bounded() -> None:
    for count in (1, 9, 10, 11, 200, 300, 500):
        assert count * share_of(count) <= DEPTH_POINTS or count < DEPTH_POINTS / MAX_OF_REFERENCE
        assert np.isfinite(thinned(np.ones((1440, 1920), np.float32), share_of(count))).sum() <= share_of(count)
    assert share_of(1) == MAX_OF_REFERENCE
