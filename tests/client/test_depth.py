"""Depth images as messages: nothing is lost, and numbers out of range are named."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapless import Camera, DepthImage, DepthNoise, DepthSensor, Fisheye, RigidTransform
from mapless.depth import depth_from_message, depth_to_message
from mapless.geometry import rotation_from_vector
from mapless.v1 import geometry_pb2 as pb
from mapless.wire import FieldError

FULL = DepthImage(
    b"values",
    0.0002,
    None,
    DepthSensor.STRUCTURED_LIGHT,
    Camera(320, 240, 285.0, 286.0, 160.0, 120.0, Fisheye(0.1, 0.0, 0.0, 0.0)),
    RigidTransform(rotation_from_vector([0.1, -0.2, 1.5]), np.array([-0.0225, -0.005, 0.001])),
    b"confidence",
    2,
    DepthNoise(0.001, 0.002, 0.003, 0.004),
)


def test_a_depth_comes_back_from_its_message() -> None:
    found = depth_from_message(depth_to_message(FULL), "depth")
    assert found.sha256 == FULL.sha256
    assert (found.camera, found.noise, found.sensor) == (FULL.camera, FULL.noise, FULL.sensor)
    metres = DepthImage.of_metres(np.full((48, 64), 2, np.float32), DepthSensor.RENDERED)
    assert depth_from_message(depth_to_message(metres), "depth").sha256 == metres.sha256


@pytest.mark.parametrize(
    "change",
    [
        {"data": b"other"},
        {"unit_m": 0.001},
        {"sensor": DepthSensor.STEREO},
        {"camera": None},
        {"camera_from_depth_camera": None},
        {"confidence": b""},
        {"min_confidence": 1},
        {"noise": None},
    ],
    ids=lambda it: next(iter(it)),
)
def test_depths_that_differ_in_anything_have_other_hashes(change: dict[str, object]) -> None:
    assert replace(FULL, **change).sha256 != FULL.sha256  # type: ignore[arg-type]


def test_the_hash_is_of_numbers_whatever_their_type() -> None:
    whole = Camera(320, 240, 285, 286, 160, 120, Fisheye(0, 0, 0, 0))
    floats = Camera(320, 240, 285.0, 286.0, 160.0, 120.0, Fisheye(0.0, 0.0, 0.0, 0.0))
    assert replace(FULL, camera=whole, unit_m=1).sha256 == replace(FULL, camera=floats, unit_m=1.0).sha256
    pinhole = DepthImage(b"values", 0.001, camera=Camera(320, 240, 285, 286, 160, 120))
    assert pinhole.sha256 == "b62b3e9db4d6f01ecbc3c400bf4abe3a2b2bdb6862b82749ff782379eb6ef09a", "it is stored"


def extrinsics(x_m: float = 0.0, turn_rad: float = 0.0) -> pb.RigidTransform:
    pose = RigidTransform(rotation_from_vector([0, turn_rad, 0]), np.array([x_m, 0, 0]))
    return depth_to_message(replace(FULL, camera_from_depth_camera=pose)).camera_from_depth_camera


BAD = {
    "no values": (pb.DepthImage(unit_m=1), "png"),
    "no unit": (pb.DepthImage(png=b"x"), "unit_m"),
    "a unit of NaN": (pb.DepthImage(png=b"x", unit_m=float("nan")), "unit_m"),
    "confidence beyond 8 bits": (pb.DepthImage(png=b"x", unit_m=1, min_confidence=256), "min_confidence"),
    "an unknown sensor": (pb.DepthImage(png=b"x", unit_m=1, sensor=99), "sensor"),  # type: ignore[arg-type]
    "values without size": (pb.DepthImage(float32=b"1234", unit_m=1), "width_px"),
    "values of another size": (pb.DepthImage(float32=b"1234", unit_m=1, width_px=32, height_px=32), "float32"),
    "a camera without focal length": (
        pb.DepthImage(png=b"x", unit_m=1, intrinsics=pb.CameraIntrinsics(width_px=64, height_px=48)),
        "intrinsics.focal_x_px",
    ),
    "millimetres of extrinsics": (
        pb.DepthImage(png=b"x", unit_m=1, camera_from_depth_camera=extrinsics(x_m=-22.5)),
        "camera_from_depth_camera.translation_m",
    ),
    "turned by 90 degrees": (
        pb.DepthImage(png=b"x", unit_m=1, camera_from_depth_camera=extrinsics(turn_rad=np.pi / 2)),
        "camera_from_depth_camera.rotation",
    ),
    "no noise": (pb.DepthImage(png=b"x", unit_m=1, noise=pb.DepthNoise()), "noise"),
    "negative noise": (pb.DepthImage(png=b"x", unit_m=1, noise=pb.DepthNoise(linear=-1)), "noise.linear"),
    "noise of kilometres": (
        pb.DepthImage(png=b"x", unit_m=1, noise=pb.DepthNoise(constant_m=1e300)),
        "noise.constant_m",
    ),
    "noise of NaN": (
        pb.DepthImage(png=b"x", unit_m=1, noise=pb.DepthNoise(quadratic_per_m=float("nan"))),
        "noise.quadratic_per_m",
    ),
    "an exact scale": (
        pb.DepthImage(png=b"x", unit_m=1, noise=pb.DepthNoise(linear=1, common=1e-160)),
        "noise.common",
    ),
    "a scale beyond 100 %": (
        pb.DepthImage(png=b"x", unit_m=1, noise=pb.DepthNoise(linear=1, common=2)),
        "noise.common",
    ),
}


@pytest.mark.parametrize(("message", "field"), BAD.values(), ids=BAD)
def test_numbers_out_of_range_are_named(message: pb.DepthImage, field: str) -> None:
    with pytest.raises(FieldError) as raised:
        depth_from_message(message, "depth")
    assert raised.value.field == f"depth.{field}"


def test_a_depth_is_made_from_the_path_of_its_file(tmp_path: Path) -> None:
    (tmp_path / "depth.png").write_bytes(b"values")
    (tmp_path / "sure.png").write_bytes(b"confidence")
    read = DepthImage(tmp_path / "depth.png", 0.001, confidence=str(tmp_path / "sure.png"))
    assert read.sha256 == DepthImage(b"values", 0.001, confidence=b"confidence").sha256
    with pytest.raises(FileNotFoundError):
        DepthImage("lost.png", 0.001)
    with pytest.raises(TypeError, match="data is bytes or the path of a file, not ndarray: of_metres"):
        DepthImage(np.ones((48, 64)), 0.001)  # type: ignore[arg-type]


def test_rows_of_metres_are_a_depth() -> None:
    rows = [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]
    assert DepthImage.of_metres(rows).sha256 == DepthImage.of_metres(np.array(rows, np.float32)).sha256
    with pytest.raises(ValueError, match="rows and columns"):
        DepthImage.of_metres([1.0, 2.0])


@pytest.mark.parametrize("size", [(2**33, 480), (640.5, 480), (640, 16), (640,)])
def test_a_size_that_is_none_is_named(size: tuple[int, int]) -> None:
    with pytest.raises(FieldError, match=r"depth\.size: must be"):
        depth_to_message(DepthImage(b"", 1.0, size), "depth")
