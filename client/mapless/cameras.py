"""Reads cameras and poses: the interface's JSON, four numbers, or a folder's cameras.json."""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from . import wire
from .geometry import DEFAULT_LENS_MODEL, Camera, RigidTransform, lens_from_coefficients
from .json_input import read_json, read_message, shown
from .pixels import size_of_image
from .v1 import geometry_pb2
from .wire import FieldError

FOLDER_FILE = "cameras.json"


def read_camera(source: str | Path, photo: str | Path | None = None) -> Camera:
    """A camera: a JSON file or JSON text as the interface defines CameraIntrinsics, or "fx,fy,cx,cy" in pixels.

    Args:
        source: the file, the JSON text, or the numbers.
        photo: a photograph of the camera; four numbers need its header for the image size.

    Raises:
        OSError: a file cannot be read.
        ValueError: the source is no valid camera; names the file and the field.
    """
    text = str(source)
    if not _NUMBERS.fullmatch(text):
        if Path(text).name == FOLDER_FILE:
            raise ValueError(f"{text} holds the cameras of a folder's photographs, but a single camera is needed")
        message = geometry_pb2.CameraIntrinsics()
        return read_message(text, message, _REQUIRED_OF_CAMERAS, wire.camera_from_message, "camera")
    try:
        focal_x_px, focal_y_px, principal_x_px, principal_y_px = map(float, text.split(","))
    except ValueError:
        raise ValueError(f"{text}: a camera must be four numbers, fx,fy,cx,cy") from None
    if photo is None:
        raise ValueError(f"{text}: a camera of four numbers needs a photograph, for the image size")
    try:
        width_px, height_px = size_of_image(Path(photo).read_bytes())
    except ValueError as error:
        raise ValueError(f"{photo}: {error}") from None
    camera = Camera(width_px, height_px, focal_x_px, focal_y_px, principal_x_px, principal_y_px)
    try:
        return _checked(camera)
    except ValueError as error:
        raise ValueError(f"{text}: {error}") from None


def read_pose(source: str | Path) -> RigidTransform:
    """A pose: a JSON file or JSON text as the interface defines RigidTransform.

    Raises:
        OSError: the file cannot be read.
        ValueError: the source is no valid pose; names the file and the field.
    """
    required = ("rotation", "translation_m")
    return read_message(str(source), geometry_pb2.RigidTransform(), required, wire.transform_from_message, "pose")


def read_cameras(file: str | Path) -> dict[Path, Camera]:
    """The photographs of a cameras.json with their cameras, in the file's order.

    The file has `frames`, each with `image` (path beside the file), `width`, `height`, `K` (3x3, pixels) and perhaps
    `dist` (OpenCV's k1 k2 p1 p2 k3) and `lens` ("fisheye": `dist` is then k1 k2 k3 k4); poses are ignored.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file has another form; names the frame and the field.
    """
    path = Path(file)
    try:
        content = read_json(path.read_bytes())
        frames = content.get("frames") if isinstance(content, dict) else None
        if not isinstance(frames, list):
            raise ValueError("has no list `frames`")
    except ValueError as error:
        raise ValueError(f"{path}: no cameras: {error}") from None
    return dict(_photograph(path, index, frame) for index, frame in enumerate(frames))


_NUMBERS = re.compile(r"[-+0-9.eE]+(,[-+0-9.eE]*)+")
_REQUIRED_OF_CAMERAS = [it.name for it in fields(Camera) if it.name != "distortion"]
_FIELDS_OF_FRAMES = {
    "width_px": "width",
    "height_px": "height",
    "focal_x_px": "K[0][0]",
    "focal_y_px": "K[1][1]",
    "principal_x_px": "K[0][2]",
    "principal_y_px": "K[1][2]",
}
"""Where a cameras.json has the fields of a camera."""


def _checked(camera: Camera) -> Camera:
    """The camera; FieldError if it is out of the bounds of the interface."""
    return wire.camera_from_message(wire.camera_to_message(camera), "")


def _photograph(path: Path, index: int, frame: Any) -> tuple[Path, Camera]:
    name = f"{path}: frames[{index}]"
    try:
        if not isinstance(frame, dict):
            raise ValueError(f"must be an object, {{...}}, is {shown(frame)}")
        if missing := [it for it in ("image", "width", "height", "K") if it not in frame]:
            raise ValueError(f"{', '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing")
        if not isinstance(frame["image"], str):
            raise ValueError(f"image must be a path, is {shown(frame['image'])}")
        return path.parent / frame["image"], _checked(_camera(frame))
    except FieldError as error:
        model, _, _ = error.field.partition(".")
        where = _FIELDS_OF_FRAMES.get(model, "dist")
        raise ValueError(f"{name}: {str(error).replace(error.field, where, 1)}") from None
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


def _camera(frame: dict[str, Any]) -> Camera:
    for side in ("width", "height"):
        if not isinstance(frame[side], int) or isinstance(frame[side], bool) or abs(frame[side]) > 2**30:
            raise ValueError(f"{side} must be a whole number of pixels, is {shown(frame[side])}")
    try:
        k = np.array(frame["K"], float)
    except (TypeError, ValueError, OverflowError):
        k = np.empty(0)
    if k.shape != (3, 3):
        raise ValueError(f"K must be 3x3 numbers, is {shown(frame['K'])}")
    dist = frame.get("dist") or None
    try:
        coefficients = None if dist is None else [*map(float, dist)]
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"dist must be null or a list of numbers, is {shown(dist)}") from None
    lens = lens_from_coefficients(frame.get("lens", DEFAULT_LENS_MODEL), coefficients)
    focal_x_px, focal_y_px, principal_x_px, principal_y_px = k[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    return Camera(frame["width"], frame["height"], focal_x_px, focal_y_px, principal_x_px, principal_y_px, lens)
