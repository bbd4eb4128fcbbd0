"""ROS messages and mapless: pixels, cameras and poses, with OpenCV as oracle; messages to the byte by `rosbags`."""

from datetime import datetime, timezone
from typing import Any

import cv2
import numpy as np
import pytest
from support.bags import (
    BASE_FROM_CAMERA,
    EQUIDISTANT,
    MESSAGES,
    PLUMB_BOB,
    TYPES,
    compressed,
    image,
    info,
    make,
    pose_stamped,
)
from support.images import encode, textured
from support.servers import CAMERA

from mapless import Camera, Fisheye, RadialTangential, RigidTransform
from mapless.geometry import rotation_from_vector
from mapless.ros import (
    Outcome,
    camera_from_info,
    pixels_from_image,
    pose_of_body,
    stamp_ns_of,
    transform_from_message,
    transform_from_pose,
)
from mapless.ros.images import ENCODINGS, file_from_image
from mapless.ros.poses import time_of

BLURRED = cv2.GaussianBlur(textured().astype(np.float32), (0, 0), 5.0)
SMOOTH = np.asarray(cv2.normalize(BLURRED, np.empty(0), 40, 215, cv2.NORM_MINMAX), np.uint8)
"""BGR; smooth, so that half the colours lose little."""

COLOURS = {
    "bgr8": None,
    "8UC3": None,
    "rgb8": cv2.COLOR_BGR2RGB,
    "bgra8": cv2.COLOR_BGR2BGRA,
    "8UC4": cv2.COLOR_BGR2BGRA,
    "rgba8": cv2.COLOR_BGR2RGBA,
    "mono8": cv2.COLOR_BGR2GRAY,
    "8UC1": cv2.COLOR_BGR2GRAY,
}
BAYER = {"bayer_rggb": "RGGB", "bayer_bggr": "BGGR", "bayer_gbrg": "GBRG", "bayer_grbg": "GRBG"}


def mosaic(pattern: str) -> np.ndarray:
    """SMOOTH as a sensor with these filters sees it, its first two rows named from the left."""
    seen = np.zeros(SMOOTH.shape[:2], np.uint8)
    for place, colour in enumerate(pattern):
        rows, columns = slice(place // 2, None, 2), slice(place % 2, None, 2)
        seen[rows, columns] = SMOOTH[rows, columns, "BGR".index(colour)]
    return seen


def yuv(encoding: str) -> np.ndarray:
    """SMOOTH in a YUV encoding, by its definition."""
    y, cr, cb = cv2.split(cv2.cvtColor(SMOOTH, cv2.COLOR_BGR2YCrCb).astype(float))
    y, cb, cr = (16 + y * 219 / 255, 128 + (cb - 128) * 224 / 255, 128 + (cr - 128) * 224 / 255)
    if encoding in ("nv12", "nv21"):
        small = [it.reshape(32, 2, 48, 2).mean((1, 3)) for it in ((cb, cr) if encoding == "nv12" else (cr, cb))]
        return np.concatenate([y, np.stack(small, -1).reshape(32, 96)]).round().astype(np.uint8)
    halves = np.stack([it.reshape(64, 48, 2).mean(2) for it in (cb, cr)], -1).reshape(64, 96)
    parts = [halves, y] if encoding in ("uyvy", "yuv422") else [y, halves]
    return np.stack(parts, -1).round().astype(np.uint8)


def message_in(encoding: str, padding: int = 0) -> Any:
    if encoding.removesuffix("8") in BAYER:
        return image(1, mosaic(BAYER[encoding[:-1]]), encoding, padding=padding)
    if encoding in COLOURS:
        code = COLOURS[encoding]
        return image(1, SMOOTH if code is None else cv2.cvtColor(SMOOTH, code), encoding, padding=padding)
    if encoding.endswith("16"):
        eight = message_in(f"{encoding[:-2]}8")
        values = eight.data.reshape(64, -1, 1).astype("<u2") * 16  # 12 bits
        made = image(1, values, encoding, padding=padding)
        made.width = 96
        return made
    return image(1, yuv(encoding), encoding, padding=padding)


@pytest.mark.parametrize("padding", [0, 6])
@pytest.mark.parametrize("encoding", sorted(ENCODINGS))
def test_every_encoding_is_the_same_photograph(encoding: str, padding: int) -> None:
    message = message_in(encoding, padding)
    got = pixels_from_image(message).astype(float)
    is_grey = encoding.startswith("mono") or encoding == "8UC1"
    want = np.asarray(cv2.cvtColor(SMOOTH, cv2.COLOR_BGR2GRAY) if is_grey else SMOOTH, float)
    assert got.shape == want.shape
    if encoding.endswith("16"):  # stretched to the whole range: the same but for one gain and offset
        gain, offset = np.polyfit(got.ravel(), want.ravel(), 1)
        got = gain * got + offset
    assert np.abs(got - want)[2:-2, 2:-2].mean() < 2.5
    assert np.corrcoef(got.ravel(), want.ravel())[0, 1] > 0.99


def test_big_endian_values_are_read_as_such() -> None:
    values = (np.arange(64 * 96).reshape(64, 96) % 4096).astype("<u2")
    little, big = image(1, values, "mono16"), image(1, values.astype(">u2"), "mono16")
    assert (little.is_bigendian, big.is_bigendian) == (0, 1)
    np.testing.assert_array_equal(pixels_from_image(little), pixels_from_image(big))


def test_a_lossless_file_has_the_pixels() -> None:
    file = file_from_image(image(1, SMOOTH, "bgr8"), lossless=True)
    np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_COLOR), SMOOTH)


def test_compressed_images_stay_as_they_are_but_for_16_bits() -> None:
    for suffix in (".jpg", ".png"):
        file = encode(suffix, textured())
        assert file_from_image(compressed(1, file, suffix)) == file
    deep = encode(".png", textured()[..., 0].astype(np.uint16) * 16)
    got = cv2.imdecode(
        np.frombuffer(file_from_image(compressed(1, deep, "mono16; png")), np.uint8), cv2.IMREAD_ANYDEPTH
    )
    assert got is not None
    assert got.dtype == np.uint8
    assert np.ptp(got) > 200


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"encoding": "32FC1"}, "'32FC1' is none of"),
        ({"step": 10}, "rows need 288"),
        ({"height": 65}, "there must be 65"),
        ({"width": 0, "height": 0}, "an image of 0 x 0"),
        ({"encoding": "nv12", "height": 41}, "even numbers"),
    ],
)
def test_an_image_that_is_none_is_named(wrong: dict[str, Any], says: str) -> None:
    message = image(1, SMOOTH, "bgr8")
    for name, value in wrong.items():
        setattr(message, name, value)
    with pytest.raises(ValueError, match=says):
        pixels_from_image(message)


def test_a_compressed_image_of_another_kind_is_named() -> None:
    with pytest.raises(ValueError, match="format 'h264' is no JPEG"):
        file_from_image(compressed(1, b"\0\0\0\1", "h264"))
    with pytest.raises(ValueError, match="cannot be decoded"):
        pixels_from_image(compressed(1, encode(".png", textured())[:60], "png"))


POINTS = np.random.default_rng(3).uniform([-0.5, -0.35, 0.9], [0.5, 0.35, 1.1], (50, 3))


def test_plumb_bob_is_opencvs_lens() -> None:
    lens = Camera(640, 480, 500.0, 501.0, 320.5, 239.0, PLUMB_BOB)
    for d in (list(vars(PLUMB_BOB).values()), [*vars(PLUMB_BOB).values(), 0.0, 0.0, 0.0]):
        model = "plumb_bob" if len(d) == 5 else "rational_polynomial"
        found = camera_from_info(info(lens, d=np.array(d), distortion_model=model))
        oracle = cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), lens.matrix(), np.array(d))[0][:, 0]
        assert found.undistortion is None
        np.testing.assert_allclose(found.camera.project(POINTS), oracle, atol=1e-9)


def test_equidistant_is_opencvs_fisheye() -> None:
    for lens in (EQUIDISTANT, Fisheye()):
        camera = Camera(640, 480, 300.0, 301.0, 320.5, 239.0, lens)
        found = camera_from_info(info(camera)).camera
        d = np.array(list(vars(lens).values()))
        oracle = cv2.fisheye.projectPoints(POINTS[:, None], np.zeros(3), np.zeros(3), camera.matrix(), d)[0][:, 0]
        assert isinstance(found.distortion, Fisheye)
        np.testing.assert_allclose(found.project(POINTS), oracle, atol=1e-6)


def test_rational_images_become_those_of_their_pinhole() -> None:
    """A pixel of the undistorted image equals the lens's where OpenCV projects the point."""
    d = np.array([0.45, -0.21, 0.0006, -0.0003, 0.02, 0.78, -0.33, 0.03])
    lens = Camera(640, 480, 500.0, 501.0, 320.5, 239.0)
    ros = camera_from_info(info(lens, d=d, distortion_model="rational_polynomial"))
    raw = cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), lens.matrix(), d)[0][:, 0]
    picture = np.zeros((480, 640), np.uint8)
    for place in np.rint(raw).astype(int):
        cv2.circle(picture, tuple(map(int, place)), 3, 255, -1)
    shown = cv2.imdecode(np.frombuffer(ros.photo(image(1, picture, "mono8"), True), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert shown is not None
    pixels = ros.camera.project(POINTS)
    inside = ((pixels > 5) & (pixels < [634, 474])).all(1)
    assert inside.sum() > 30
    assert all(shown[y, x] > 200 for x, y in np.rint(pixels[inside]).astype(int))
    corners = shown[[0, 0, -1, -1], [0, -1, 0, -1]]
    assert not corners.any()


def test_rectified_images_have_the_projections_camera() -> None:
    p = np.array([70.0, 0, 40.0, 0, 0, 71.0, 30.0, 0, 0, 0, 1.0, 0])
    lens = Camera(96, 64, 80.0, 81.0, 47.5, 31.5, PLUMB_BOB)
    assert camera_from_info(info(lens, p=p), rectified=True).camera == Camera(96, 64, 70.0, 71.0, 40.0, 30.0)


def test_cameras_without_a_lens() -> None:
    for d in ([], [0.0] * 5):
        assert camera_from_info(info(CAMERA, d=np.array(d))).camera == CAMERA
    four = camera_from_info(info(CAMERA, d=np.array([0.1, 0.2, 0.3, 0.4]))).camera
    assert four.distortion == RadialTangential(0.1, 0.2, 0.3, 0.4)


@pytest.mark.parametrize(
    "wrong",
    [
        {"k": np.zeros(9)},
        {"k": np.full(9, np.nan)},
        {"binning_x": 2},
        {"d": np.ones(8)},
        {"d": np.ones(6), "distortion_model": "rational_polynomial"},
        {"d": np.ones(5), "distortion_model": "equidistant"},
        {"d": np.ones(4), "distortion_model": "double_sphere"},
        {"d": np.full(5, np.inf)},
        {"width": 0},
    ],
)
def test_a_camera_that_would_be_guessed_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"calibrated|binned|lens|finite|size"):
        camera_from_info(info(CAMERA, **wrong))


def test_a_part_of_the_sensor_is_refused_but_not_all_of_it() -> None:
    roi = {"x_offset": 0, "y_offset": 0, "do_rectify": False}
    whole = make("sensor_msgs/msg/RegionOfInterest", width=96, height=64, **roi)
    assert camera_from_info(info(CAMERA, roi=whole)).camera == CAMERA
    with pytest.raises(ValueError, match="a part of the sensor"):
        camera_from_info(info(CAMERA, roi=make("sensor_msgs/msg/RegionOfInterest", width=48, height=32, **roi)))


def test_an_image_of_another_size_than_its_camera_is_refused() -> None:
    with pytest.raises(ValueError, match="96 x 64 pixels, its CameraInfo 48 x 32"):
        camera_from_info(info(Camera(48, 32, 40.0, 40.0, 24.0, 16.0))).photo(image(1, SMOOTH, "bgr8"))


def test_a_stamp_keeps_its_microseconds() -> None:
    stamp = MESSAGES.header(1_800_000_000_123_456_789, "").stamp
    assert stamp_ns_of(stamp) == 1_800_000_000_123_456_789
    assert time_of(stamp_ns_of(stamp)) == datetime(2027, 1, 15, 8, 0, 0, 123456, timezone.utc)


def test_a_pose_comes_back_and_one_without_rotation_is_named() -> None:
    message = pose_stamped(1, "map", BASE_FROM_CAMERA)
    np.testing.assert_allclose(transform_from_pose(message.pose).matrix(), BASE_FROM_CAMERA.matrix(), atol=1e-12)
    message.pose.orientation.w = message.pose.orientation.x = 0.0
    with pytest.raises(ValueError, match="quaternion must have norm 1"):
        transform_from_pose(message.pose)
    message.pose.position.x = float("nan")
    with pytest.raises(ValueError, match="not finite"):
        transform_from_pose(message.pose)


@pytest.mark.parametrize("axis", range(6))
def test_a_variance_about_one_axis_stays_at_its_place(axis: int) -> None:
    """A planted perturbation of one degree of freedom of the camera is one of the body, in the map's axes."""
    camera = RigidTransform(rotation_from_vector([0.3, -1.0, 2.0]), np.array([1.0, 2.0, 3.0]))
    step = np.eye(6)[axis] * 1e-5
    moved = RigidTransform(rotation_from_vector(step[3:]) @ camera.rotation, camera.translation + step[:3])
    body, covariance = pose_of_body(camera, np.outer(step, step), BASE_FROM_CAMERA)
    after = moved.compose(BASE_FROM_CAMERA.inverse())
    small = after.rotation @ body.rotation.T
    change = np.array([*(after.translation - body.translation), small[2, 1], small[0, 2], small[1, 0]])
    np.testing.assert_allclose(covariance, np.outer(change, change), atol=1e-14)
    message = MESSAGES.pose(Outcome(1, "OK", "", map_from_body=body, covariance=covariance, map_frame="map"))
    assert message.pose.covariance[7 * axis] == covariance[axis, axis]  # ROS: x, y, z, and rotations about them


def sent(message: Any) -> Any:
    """A message after its bytes."""
    return TYPES.deserialize_cdr(TYPES.serialize_cdr(message, message.__msgtype__), message.__msgtype__)


def test_published_messages_come_back_from_their_bytes() -> None:
    covariance = np.arange(36.0).reshape(6, 6)
    pose = RigidTransform(rotation_from_vector([0.1, 0.2, -0.3]), np.array([1.0, -2.0, 3.5]))
    odom = RigidTransform(np.eye(3), np.array([9.0, 8.0, 7.0]))
    outcome = Outcome(
        1_700_000_000_000_000_001, "WARN", "why", {"reason": "X"}, "base_link", pose, covariance, ("odom", odom), "map"
    )
    filled = MESSAGES.pose(outcome)
    back = sent(filled)
    assert (back.header.frame_id, stamp_ns_of(back.header.stamp)) == ("map", outcome.stamp_ns)
    assert back.pose.covariance.tolist() == list(range(36))
    np.testing.assert_allclose(transform_from_pose(back.pose.pose).matrix(), pose.matrix(), atol=1e-15)
    (edge,) = sent(MESSAGES.tf(outcome)).transforms
    assert (edge.header.frame_id, edge.child_frame_id) == ("map", "odom")
    np.testing.assert_allclose(transform_from_message(edge.transform).matrix(), odom.matrix(), atol=1e-15)
    (status,) = sent(MESSAGES.diagnostics(outcome, "hall")).status
    assert (status.level, status.message, status.hardware_id) == (1, "why", "hall")
    assert [(it.key, it.value) for it in status.values] == [("reason", "X")]
