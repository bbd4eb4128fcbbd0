"""Cameras, poses and sizes of images from files: what is written is read, and what is wrong is named."""

import contextlib
import json
import math
import re
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from google.protobuf import json_format
from support.images import encode
from support.planted_answers import localized, rejected

from mapless import Camera, RadialTangential, read_camera, read_cameras, read_pose, wire
from mapless.cli.output import plain
from mapless.geometry import RigidTransform, rotation_from_vector
from mapless.pixels import size_of_image

CAMERA = Camera(640, 480, 500.0, 501.0, 319.0, 239.0, RadialTangential(0.1, 0.2, 0.3, 0.4, 0.5))


def test_a_camera_and_a_pose_as_the_interface_writes_them(tmp_path: Path) -> None:
    text = json_format.MessageToJson(wire.camera_to_message(CAMERA))
    (tmp_path / "camera.json").write_text(text)
    assert read_camera(text) == read_camera(tmp_path / "camera.json") == CAMERA
    pose = RigidTransform(rotation_from_vector([0.1, 0.2, 0.3]), np.array([1.0, 2.0, 3.0]))
    read = read_pose(json_format.MessageToJson(wire.transform_to_message(pose)))
    np.testing.assert_allclose(read.matrix(), pose.matrix(), atol=1e-12)


def test_the_pose_of_a_printed_answer(tmp_path: Path) -> None:
    file = tmp_path / "answer.json"
    file.write_text(json.dumps(plain(localized())))
    np.testing.assert_allclose(read_pose(file).matrix(), localized().world_from_camera.matrix(), atol=1e-12)
    with pytest.raises(ValueError, match="reason is no field"):
        read_pose(json.dumps(plain(rejected())))
    with pytest.raises(ValueError, match="world_from_camera is no field"):
        read_pose('{"world_from_camera": "there.json"}')
    file.write_text('{"world_from_camera": {"rotation": {"w": 1}}}')
    with pytest.raises(ValueError, match=r"answer.json: .*translation_m"):
        read_pose(file)


def test_four_numbers_take_the_size_of_the_photograph(tmp_path: Path) -> None:
    photo = tmp_path / "photo.jpg"
    photo.write_bytes(encode(".jpg", np.zeros((480, 640, 3), np.uint8)))
    assert read_camera("500,501,319,239", photo) == Camera(640, 480, 500.0, 501.0, 319.0, 239.0)
    with pytest.raises(ValueError, match="needs a photograph"):
        read_camera("500,501,319,239")
    with pytest.raises(ValueError, match="focal_x_px"):
        read_camera("-500,501,319,239", photo)


GOOD = {"width_px": 640, "height_px": 480, "focal_x_px": 9, "focal_y_px": 9, "principal_x_px": 3, "principal_y_px": 2}


@pytest.mark.parametrize(
    ("changes", "error_text"),
    [
        ({"focal_x_px": -5}, "focal_x_px: must be 6.4 to 64000, is -5"),
        ({"focal_x_px": None}, "focal_x_px is missing"),
        ({"focal_z_px": 5}, "focal_z_px is no field, perhaps focal_y_px; known: width_px, "),
        ({"focal_x": 5}, "focal_x is no field, perhaps focal_x_px; known: width_px, "),
        ({"spherical": {"k1": 1}}, "spherical is no field; known: .* fisheye"),
        ({"fisheye": {"k9": 1}}, "fisheye.k9 is no field; known: k1, k2, k3, k4"),
        ({"fisheye": {"k1": 1000}}, "fisheye.k1: must be at most 100 in magnitude, is 1000"),
        ({"fisheye": 3}, "fisheye must be an object, {...}, is 3"),
        ({"fisheye": {}, "radialTangential": {}}, "radialTangential and fisheye exclude each other"),
        ({"width_px": 0}, "width_px: must be 32 to 16384, is 0"),
        ({"width_px": "wide"}, 'width_px must be a whole number, is "wide"'),
        ({"width_px": 640.5}, "width_px must be a whole number, is 640.5"),
        ({"width_px": True}, "width_px must be a whole number, is true"),
        ({"focal_y_px": [1]}, "focal_y_px must be a number, is [1]"),
        ({"focal_y_px": math.nan}, "focal_y_px: must be 6.4 to 64000, is nan"),
        ({"width_px": 10**400}, "width_px must be a whole number, is 1000"),
    ],
)
def test_a_wrong_camera_names_file_field_and_value(tmp_path: Path, changes: dict[str, Any], error_text: str) -> None:
    file = tmp_path / "camera.json"
    file.write_text(json.dumps(GOOD | changes))
    with pytest.raises(ValueError, match=f"^{re.escape(f'{file}: {error_text}').replace(re.escape('.*'), '.*')}"):
        read_camera(file)


def test_a_field_is_named_as_it_was_written(tmp_path: Path) -> None:
    content = {"widthPx" if key == "width_px" else key: value for key, value in GOOD.items()}
    with pytest.raises(ValueError, match=r"^camera: widthPx: must be 32 to 16384, is 3"):
        read_camera(json.dumps(content | {"widthPx": 3}))
    with pytest.raises(ValueError, match=r"^camera: focal_x_px, principal_y_px are missing"):
        read_camera(json.dumps({key: GOOD[key] for key in GOOD if key not in ("focal_x_px", "principal_y_px")}))


@pytest.mark.parametrize(
    ("content", "error_text"),
    [
        (b"", "is empty"),
        (b"hello", "is not JSON: Expecting value in line 1, column 1"),
        (b'{\n"width_px": 3,}', "is not JSON: .* in line 2"),
        (b"[1, 2]", r"(must be an object, {\.\.\.}, is \[1, 2\]|.* as a matrix: must be 3 or 4 rows of 4)"),
        (b'{"width_px": 3, "width_px": 3}', "width_px is given twice"),
    ],
)
def test_a_file_without_a_camera_says_what_it_is(tmp_path: Path, content: bytes, error_text: str) -> None:
    for read in (read_camera, read_pose):
        (tmp_path / "it.json").write_bytes(content)
        with pytest.raises(ValueError, match=rf"it\.json: {error_text}"):
            read(tmp_path / "it.json")


@pytest.mark.parametrize(
    ("pose", "error_text"),
    [
        ({"rotation": {"w": 2}, "translation_m": {}}, "pose: rotation: quaternion must have norm 1, has 2"),
        ({"rotation": {"w": 1}}, "pose: translation_m is missing"),
        ({"rotation": {"w": 1}, "translation": {}}, "pose: translation is no field, perhaps translation_m"),
        ({"rotation": {"w": 1}, "translation_m": {"y": "a"}}, 'pose: translation_m.y must be a number, is "a"'),
        ({"rotation": {"w": 1}, "translation_m": {"y": "Infinity"}}, "pose: translation_m.y: must be finite, is inf"),
    ],
)
def test_a_wrong_pose_names_the_field(pose: dict[str, Any], error_text: str) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(error_text)}"):
        read_pose(json.dumps(pose))


def frame(**changes: Any) -> dict[str, Any]:
    k = [[500.0, 0, 319.0], [0, 501.0, 239.0], [0, 0, 1]]
    return {"image": "images/a.jpg", "width": 640, "height": 480, "K": k, "dist": [0.1, 0.2, 0.3, 0.4, 0.5]} | changes


def test_the_cameras_of_a_folder(tmp_path: Path) -> None:
    file = tmp_path / "cameras.json"
    file.write_text(json.dumps({"frames": [frame(), frame(image="b.jpg", dist=None)]}))
    assert read_cameras(file) == {tmp_path / "images" / "a.jpg": CAMERA, tmp_path / "b.jpg": CAMERA.pinhole()}


@pytest.mark.parametrize(
    ("wrong", "error_text"),
    [
        ({"K": [[1]]}, "K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], is [[1]]"),
        ({"K": [[-5, 0, 3], [0, 5, 2], [0, 0, 1]]}, "K[0][0]: must be 6.4 to 64000, is -5"),
        ({"width": 3}, "width: must be 32 to 16384, is 3"),
        ({"height": 480.5}, "height must be a whole number of pixels, above 0, is 480.5"),
        ({"K": [[5, 0, 0], [0, 5, 0], [3, 2, 1]]}, "K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], is [[5, 0, 0]"),
        ({"dist": [1, 2, 3, 4, 5, 6]}, "dist of a radial_tangential lens must be null or 4 or 5 coefficients"),
        ({"dist": [1, 2, 3, 400]}, "dist: must be at most 100 in magnitude, is 400"),
        ({"dist": "none"}, 'dist must be null or a list of numbers, is "none"'),
        ({"image": None}, "image must be a path, is null"),
    ],
)
def test_a_frame_that_is_none_is_named(tmp_path: Path, wrong: dict[str, Any], error_text: str) -> None:
    file = tmp_path / "cameras.json"
    file.write_text(json.dumps({"frames": [frame(), frame(**wrong)]}))
    with pytest.raises(ValueError, match=re.escape(f"cameras.json: frames[1]: {error_text}")):
        read_cameras(file)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"frames": 3}', "nonsense"])
def test_a_file_that_is_none_is_named(tmp_path: Path, text: str) -> None:
    file = tmp_path / "cameras.json"
    file.write_text(text)
    with pytest.raises(ValueError, match=r"cameras.json: no cameras"):
        read_cameras(file)


@pytest.mark.parametrize("fov_deg", [20.0, 66.0, 120.0])
def test_edges_of_a_camera_span_its_field_of_view(fov_deg: float) -> None:
    camera = Camera.from_fov(640, 480, fov_deg)
    left, right = camera.rays([[-0.5, 239.5], [639.5, 239.5]])
    assert math.degrees(math.atan(right[0]) - math.atan(left[0])) == pytest.approx(fov_deg)
    assert left[1] == right[1] == 0
    with pytest.raises(ValueError, match="horizontal_fov_deg"):
        Camera.from_fov(640, 480, 180)


@pytest.mark.parametrize("size", [(33, 70), (640, 480), (1001, 37)])
@pytest.mark.parametrize(
    ("ending", "options"),
    [
        (".jpg", []),
        (".jpg", [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]),
        (".png", []),
        (".webp", [cv2.IMWRITE_WEBP_QUALITY, 80]),
        (".webp", [cv2.IMWRITE_WEBP_QUALITY, 101]),
    ],
)
def test_every_format(ending: str, options: list[int], size: tuple[int, int]) -> None:
    width, height = size
    noise = np.random.default_rng(1).integers(0, 255, (height, width, 3), np.uint8)
    written, data = cv2.imencode(ending, noise, options)
    assert written
    assert size_of_image(data.tobytes()) == size


def test_an_extended_webp() -> None:
    chunk = b"VP8X" + struct.pack("<I", 10) + bytes(4) + (639).to_bytes(3, "little") + (479).to_bytes(3, "little")
    assert size_of_image(b"RIFF" + struct.pack("<I", 4 + len(chunk)) + b"WEBP" + chunk) == (640, 480)


def test_thumbnails_and_padding_are_passed_over() -> None:
    """The thumbnail that a camera puts into EXIF is a JPEG of its own, with a size of its own."""
    small, large = (encode(".jpg", np.zeros((height, 2 * height, 3), np.uint8)) for height in (40, 100))
    exif = b"\xff\xe1" + struct.pack(">H", 2 + 6 + len(small)) + b"Exif\0\0" + small
    assert size_of_image(large[:2] + exif + b"\xff\xff\xff" + large[3:]) == (200, 100)


@pytest.mark.parametrize("ending", [".jpg", ".png", ".webp"])
def test_truncated_and_other_files_are_refused_by_name(ending: str) -> None:
    data = encode(ending, np.zeros((40, 50, 3), np.uint8))
    for length in range(32 if ending != ".jpg" else 150):
        with contextlib.suppress(ValueError):
            assert size_of_image(data[:length]) == (50, 40)
    for junk in (b"", b"GIF89a", b"\xff\xd8" + bytes(100), b"\xff\xd8\xff\xe0\0\0", b"RIFF\0\0\0\0WEBPXXXX"):
        with pytest.raises(ValueError, match=r"photograph|the JPEG is damaged|the WebP holds no image"):
            size_of_image(junk)
