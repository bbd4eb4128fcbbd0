"""Poses in the axes of other systems, against poses derived by hand from where a camera stands and looks."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapless import axes as module
from mapless.axes import Axes
from mapless.geometry import Array, Camera, Quaternion, RigidTransform, rotation_from_vector

coordinate = st.floats(-100.0, 100.0)
point = st.tuples(coordinate, coordinate, coordinate).map(np.array)
vector = st.tuples(*[st.floats(-3.0, 3.0)] * 3).map(np.array)
rigid = st.builds(lambda w, t: RigidTransform(rotation_from_vector(w), t), vector, point)
all_axes = st.sampled_from(Axes)

H = math.sqrt(0.5)

RIGHT = dict.fromkeys(Axes, (1, 0, 0)) | {Axes.ROS: (0, -1, 0)}
UP = dict.fromkeys(Axes, (0, 1, 0)) | {Axes.OPENCV: (0, -1, 0), Axes.ROS: (0, 0, 1)}
FORWARD = {
    Axes.OPENCV: (0, 0, 1),
    Axes.ARKIT: (0, 0, -1),
    Axes.ARCORE: (0, 0, -1),
    Axes.UNITY: (0, 0, 1),
    Axes.ROS: (1, 0, 0),
}
"""Camera axes by each system's documents."""


def pose(right: Array | tuple[float, ...], down: tuple[float, ...], forward: tuple[float, ...]) -> RigidTransform:
    """The OpenCV pose of a camera at (1, 2, 3) whose right, down and forward are these directions of the world."""
    return RigidTransform(np.column_stack([right, down, forward]).astype(float), np.array([1.0, 2.0, 3.0]))


# A world with y up. The camera stands at (1, 2, 3), looks along +x and is held upright, so that image up is +y. In a
# right-handed world what is right is forward x up = x x y = +z.
LOOKS_ALONG_X = pose(right=(0, 0, 1), down=(0, -1, 0), forward=(1, 0, 0))
# A world with z up. The camera looks along +y, upright: right is y x z = +x.
LOOKS_NORTH = pose(right=(1, 0, 0), down=(0, 0, -1), forward=(0, 1, 0))
# A world with y up. A phone upright in the hand, looking along -z: the raster's right, along the sensor's long side
# ("toward the Home button", says ARKit), is below. Its down is forward x right = (-z) x (-y) = z x y = -x.
PORTRAIT_PHONE = pose(right=(0, -1, 0), down=(-1, 0, 0), forward=(0, 0, -1))

GOLDEN = {
    # x -> z, y -> -y, z -> x: half a turn about the diagonal between x and z.
    ("looks along x", Axes.OPENCV): (LOOKS_ALONG_X, (H, 0, H, 0), (1, 2, 3)),
    # ARKit's camera looks along -z when its pose is the identity. To look along +x it turns right, which about y, up,
    # is a negative quarter turn in a right-handed world.
    ("looks along x", Axes.ARKIT): (LOOKS_ALONG_X, (0, -H, 0, H), (1, 2, 3)),
    ("looks along x", Axes.ARCORE): (LOOKS_ALONG_X, (0, -H, 0, H), (1, 2, 3)),
    # Unity's looks along +z when it is the identity; Quaternion.Euler(0, 90, 0) makes it look along +x. z is mirrored.
    ("looks along x", Axes.UNITY): (LOOKS_ALONG_X, (0, H, 0, H), (1, 2, -3)),
    # A body's forward, +x, stays; its up, +z, goes to the world's up, +y: a negative quarter turn about x.
    ("looks along x", Axes.ROS): (LOOKS_ALONG_X, (-H, 0, 0, H), (1, 2, 3)),
    # y, down, goes to -z and z, forward, to y: a negative quarter turn about x.
    ("looks north", Axes.OPENCV): (LOOKS_NORTH, (-H, 0, 0, H), (1, 2, 3)),
    # OpenGL's y, up, goes to +z, and its z, backward, to -y: a quarter turn about x.
    ("looks north", Axes.ARKIT): (LOOKS_NORTH, (H, 0, 0, H), (1, 2, 3)),
    # A yaw of 90 degrees: north in REP 103's east-north-up.
    ("looks north", Axes.ROS): (LOOKS_NORTH, (0, 0, H, H), (1, 2, 3)),
    # In the mirrored world up is -z: Unity's y, up, goes to -z and its z, forward, to +y. Hence y up for headsets.
    ("looks north", Axes.UNITY): (LOOKS_NORTH, (-H, 0, 0, H), (1, 2, -3)),
    # x -> -y, y -> -x, z -> -z: half a turn about (1, -1, 0).
    ("portrait", Axes.OPENCV): (PORTRAIT_PHONE, (H, -H, 0, 0), (1, 2, 3)),
    # ARKit's identity looks along -z with its sensor level. From behind, the phone is turned clockwise by a quarter,
    # which about z, towards the viewer, is negative.
    ("portrait", Axes.ARKIT): (PORTRAIT_PHONE, (0, 0, -H, H), (1, 2, 3)),
    # Unity's forward, +z, is +z of the mirrored world, which was -z; the roll about it is clockwise seen from behind,
    # which is along +z: right goes to -y and up to +x.
    ("portrait", Axes.UNITY): (PORTRAIT_PHONE, (0, 0, -H, H), (1, 2, -3)),
}


@pytest.mark.parametrize("case", GOLDEN, ids=lambda case: f"{case[0]}-{case[1].value}")
def test_a_camera_looks_where_the_derivation_by_hand_says(case: tuple[str, Axes]) -> None:
    world_from_camera, quaternion, position = GOLDEN[case]
    found = module.pose_to(case[1], world_from_camera)
    np.testing.assert_allclose(found.translation, position, atol=1e-12)
    np.testing.assert_allclose(found.rotation, Quaternion(*quaternion).matrix(), atol=1e-12)
    given = RigidTransform(Quaternion(*quaternion).matrix(), np.array(position, float))
    back = module.pose_from(case[1], given)
    np.testing.assert_allclose(back.matrix(), world_from_camera.matrix(), atol=1e-12)


@given(all_axes, rigid)
def test_what_is_right_of_above_or_before_a_camera_stays_so(axes: Axes, world_from_camera: RigidTransform) -> None:
    converted = module.pose_to(axes, world_from_camera)
    for x_in_camera, expected in (((1, 0, 0), RIGHT), ((0, -1, 0), UP), ((0, 0, 1), FORWARD)):
        x_in_world = module.points_to(axes, world_from_camera.apply(x_in_camera))
        np.testing.assert_allclose(converted.inverse().apply(x_in_world), expected[axes], atol=1e-9)
        np.testing.assert_allclose(module.camera_points_to(axes, x_in_camera), expected[axes], atol=0)
        np.testing.assert_allclose(module.camera_points_from(axes, expected[axes]), x_in_camera, atol=0)


@given(all_axes, rigid, point)
def test_there_and_back_is_the_same(axes: Axes, world_from_camera: RigidTransform, x: Array) -> None:
    there = module.pose_to(axes, world_from_camera)
    np.testing.assert_allclose(there.rotation @ there.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(there.rotation) == pytest.approx(1)
    np.testing.assert_allclose(module.pose_from(axes, there).matrix(), world_from_camera.matrix(), atol=1e-12)
    np.testing.assert_array_equal(module.points_from(axes, module.points_to(axes, x)), x)
    np.testing.assert_array_equal(module.camera_points_from(axes, module.camera_points_to(axes, x)), x)
    covariance = np.arange(36.0).reshape(6, 6)
    there_covariance = module.covariance_to(axes, covariance)
    np.testing.assert_array_equal(module.covariance_from(axes, there_covariance), covariance, strict=True)


# Sessions


@given(all_axes, rigid, rigid, rigid)
def test_a_session_leads_to_the_same_in_all_axes(
    axes: Axes, world_from_session: RigidTransform, capture: RigidTransform, now: RigidTransform
) -> None:
    """Planted: where the session is in the world, and where the device was then and is now, all OpenCV."""
    said_at_capture, said_now = module.pose_to(axes, capture), module.pose_to(axes, now)
    answer = world_from_session.compose(capture)
    found = module.world_from_session_in(axes, answer, said_at_capture).compose(said_now)
    expected = module.pose_to(axes, world_from_session.compose(now))
    np.testing.assert_allclose(found.matrix(), expected.matrix(), atol=1e-9)


# Covariances


@given(all_axes, rigid, vector)
def test_a_small_turn_is_the_same_turn_in_all_axes(axes: Axes, world_from_camera: RigidTransform, w: Array) -> None:
    """`covariance_to` for rotation vectors, against turning a pose and converting it."""
    turn = 1e-3 * np.append(np.zeros(3), w)
    turned = RigidTransform(rotation_from_vector(turn[3:]) @ world_from_camera.rotation, world_from_camera.translation)
    in_axes = module.pose_to(axes, turned).rotation @ module.pose_to(axes, world_from_camera).rotation.T
    converted = module.covariance_to(axes, np.outer(turn, turn))[3:, 3:]
    q = Quaternion.from_matrix(in_axes)
    vector_in_axes = 2 * np.array([q.x, q.y, q.z])
    np.testing.assert_allclose(np.outer(vector_in_axes, vector_in_axes), converted, atol=1e-9)


# Rasters


@given(rigid, st.integers(-5, 5), point)
def test_a_turned_raster_shows_the_same_at_the_turned_pixel(
    world_from_camera: RigidTransform, turns: int, x_in_camera: Array
) -> None:
    """Clockwise by a quarter, pixel (x, y) of a raster of height h goes to (h - 1 - y, x)."""
    camera = Camera(640, 480, 500.0, 510.0, 300.0, 250.0)
    x_in_camera = np.append(x_in_camera[:2], 200.0)
    x_in_world = world_from_camera.apply(x_in_camera)
    x, y = camera.project(x_in_camera)
    for _ in range(turns % 4):
        x, y = camera.height_px - 1 - y, x
        camera = Camera(
            camera.height_px,
            camera.width_px,
            camera.focal_y_px,
            camera.focal_x_px,
            camera.height_px - 1 - camera.principal_y_px,
            camera.principal_x_px,
        )
    turned = module.turned_raster(world_from_camera, turns)
    np.testing.assert_allclose(camera.project(turned.inverse().apply(x_in_world)), (x, y), atol=1e-6)
