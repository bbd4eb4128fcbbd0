"""Reads cameras and poses: the interface's JSON, four numbers, or a folder's cameras.json."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any, TypeVar

from google.protobuf import json_format
from google.protobuf.message import Message

from . import wire
from .geometry import DEFAULT_LENS_MODEL, Camera, RigidTransform, lens_from_coefficients
from .pixels import size_of_image
from .v1 import geometry_pb2

M = TypeVar("M", bound=Message)

FOLDER_FILE = "cameras.json"
_NUMBERS = re.compile(r"[-+0-9.eE]+(,[-+0-9.eE]*)+")


def read_camera(source: str | Path, photo: str | Path | None = None) -> Camera:
    """A camera: a JSON file or JSON text as the interface defines CameraIntrinsics, or "fx,fy,cx,cy" in pixels.

    Args:
        source: the file, the JSON text, or the numbers.
        photo: a photograph of the camera; four numbers need its header for the image size.

    Raises:
        OSError: a file cannot be read.
        ValueError: the source is no valid camera.
    """
    text = str(source)
    if not _NUMBERS.fullmatch(text):
        if Path(text).name == FOLDER_FILE:
            raise ValueError(f"{text} holds the cameras of a folder's photographs, but a single camera is needed")
        return wire.camera_from_message(_read_json(text, geometry_pb2.CameraIntrinsics()), "camera")
    numbers = text.split(",")
    if len(numbers) != 4 or not all(numbers):
        raise ValueError(f"{text}: a camera must be four numbers, fx,fy,cx,cy")
    if photo is None:
        raise ValueError(f"{text}: a camera of four numbers needs a photograph, for the image size")
    try:
        width_px, height_px = size_of_image(Path(photo).read_bytes())
    except ValueError as error:
        raise ValueError(f"{photo}: {error}") from None
    focal_x_px, focal_y_px, principal_x_px, principal_y_px = map(float, numbers)
    camera = Camera(width_px, height_px, focal_x_px, focal_y_px, principal_x_px, principal_y_px)
    return wire.camera_from_message(wire.camera_to_message(camera), "camera")  # checks the bounds


def read_pose(source: str | Path) -> RigidTransform:
    """A pose: a JSON file or JSON text as the interface defines RigidTransform.

    Raises:
        OSError: the file cannot be read.
        ValueError: the source is no valid pose.
    """
    return wire.transform_from_message(_read_json(str(source), geometry_pb2.RigidTransform()), "pose")


def read_cameras(file: str | Path) -> dict[Path, Camera]:
    """The photographs of a cameras.json with their cameras, in the file's order.

    The file has `frames`, each with `image` (path beside the file), `width`, `height`, `K` (3x3, pixels) and perhaps
    `dist` (OpenCV's k1 k2 p1 p2 k3) and `lens` ("fisheye": `dist` is then k1 k2 k3 k4); poses are ignored.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file has another form; names the frame.
    """
    path = Path(file)
    try:
        frames = list(json.loads(path.read_text())["frames"])
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: no cameras: {error!r}") from None
    return dict(_photograph(path, index, frame) for index, frame in enumerate(frames))


def _photograph(path: Path, index: int, frame: Any) -> tuple[Path, Camera]:
    try:
        k, dist = frame["K"], frame.get("dist") or None
        camera = Camera(
            frame["width"],
            frame["height"],
            float(k[0][0]),
            float(k[1][1]),
            float(k[0][2]),
            float(k[1][2]),
            lens_from_coefficients(frame.get("lens", DEFAULT_LENS_MODEL), dist and [*map(float, dist)]),
        )
        checked = wire.camera_from_message(wire.camera_to_message(camera), "camera")
        return path.parent / frame["image"], checked
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise ValueError(f"{path}: frames[{index}] is no photograph with a camera: {error!r}") from None


def _read_json(source: str, message: M) -> M:
    """The message of a JSON file or JSON text."""
    text = source if source.lstrip().startswith("{") else Path(source).read_text()
    try:
        json_format.Parse(text, message)
    except json_format.ParseError as error:
        raise ValueError(f"{source}: {error}") from None
    return message
