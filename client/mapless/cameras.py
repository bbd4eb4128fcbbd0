"""Reads cameras and poses from the interface's JSON, from four numbers, or from a folder's cameras.json."""

import json
import os
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from . import wire
from .geometry import Array, Camera, RigidTransform
from .json_input import is_inline, read_json, read_message, shown
from .lenses import DEFAULT_LENS_MODEL, lens_from_coefficients
from .pixels import size_of_image
from .text_files import read_text, without_mark
from .v1 import geometry_pb2
from .wire import FieldError

FOLDER_FILE = "cameras.json"
MAX_SIDE_PX = 2**30
"""In a cameras.json: more than any image's, and few enough for arithmetic with doubles and 32 bits."""


def read_camera(source: str | Path, photo: str | Path | None = None) -> Camera:
    """Reads a camera: JSON (a file or text) in the form of CameraIntrinsics, or "fx,fy,cx,cy" in pixels.

    From a cameras.json it reads the camera of one photograph.

    Args:
        source: the file, the JSON text, or the numbers.
        photo: a photograph of the camera, which gives the image size if the source is four numbers, and which a
            cameras.json lists.

    Raises:
        OSError: a file cannot be read.
        ValueError: the source is not a valid camera; the message names the file and the field.
    """
    text = str(source)
    if is_inline(text) or "," not in text or Path(text).is_file():
        if Path(text).name == FOLDER_FILE:
            return _listed_camera(text, photo)
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


def _listed_camera(file: str, photo: str | Path | None) -> Camera:
    if photo is None:
        raise ValueError(f"{file} holds the cameras of a folder's photographs, but a single camera is needed")
    cameras = {known.resolve(): its for known, its in read_cameras(file).items()}
    if (path := Path(photo).resolve()) not in cameras:
        raise ValueError(f"{file} does not list {photo}")
    return cameras[path]


def read_pose(source: str | Path) -> RigidTransform:
    """Reads a pose: JSON (a file or text) in the form of RigidTransform, a 4x4 or 3x4 matrix, or an answer with a pose.

    ValueError, for what is no valid pose, names the file and the field; OSError, if the file cannot be read.
    """
    text = str(source)
    is_text = is_inline(text)
    content = without_mark(text) if is_text else read_text(Path(text))
    if content.lstrip().startswith("["):
        return _pose_from_matrix(content, "pose" if is_text else text)
    if (pose := _pose_of_answer(content)) is not None:
        try:
            return read_pose(json.dumps(pose))
        except ValueError as error:
            raise ValueError(str(error) if is_text else f"{text}: {error}") from None
    required = ("rotation", "translation_m")
    return read_message(str(source), geometry_pb2.RigidTransform(), required, wire.transform_from_message, "pose")


def _pose_of_answer(content: str) -> dict[str, Any] | None:
    """The pose of an answer as `mapless localize` prints it; None if the text is something else."""
    try:
        answer = read_json(content)
    except ValueError:
        return None
    pose = answer.get("world_from_camera") if isinstance(answer, dict) else None
    return pose if isinstance(pose, dict) else None


def _pose_from_matrix(content: str, name: str) -> RigidTransform:
    try:
        value = read_json(content)
        matrix = _numbers(value)
        if matrix.shape not in ((4, 4), (3, 4)):
            raise ValueError(f"must be 3 or 4 rows of 4 finite numbers, is {shown(value)}")
        pose = RigidTransform.from_matrix(matrix)
        return wire.transform_from_message(wire.transform_to_message(pose), "")
    except ValueError as error:
        raise ValueError(f"{name}: world_from_camera as a matrix: {error}") from None


def read_cameras(file: str | Path) -> dict[Path, Camera]:
    """Reads the photographs of a cameras.json with their cameras, in the file's order.

    The file has `frames`, each with `image` (path beside the file), `width`, `height`, `K` (3x3, pixels) and optionally
    `dist` (OpenCV's k1 k2 p1 p2 k3) and `lens` ("fisheye": `dist` is then k1 k2 k3 k4); poses are ignored. OSError if
    the file cannot be read. ValueError if the file has another form; the message names the frame and the field.
    """
    path = Path(file)
    text = read_text(path)
    try:
        content = read_json(text)
        frames = content.get("frames") if isinstance(content, dict) else None
        if not isinstance(frames, list):
            raise ValueError("has no list `frames`")
    except ValueError as error:
        raise ValueError(f"{path}: no cameras: {error}") from None
    return dict(_photograph(path, index, frame) for index, frame in enumerate(frames))


def read_masks(file: str | Path) -> dict[Path, Path]:
    """The masks of a cameras.json, the field `mask` of frames that have one, by the photograph's path.

    Paths are relative to the file. Errors as of `read_cameras`.
    """
    read_cameras(file)
    path = Path(file)
    found: dict[Path, Path] = {}
    content: Any = read_json(read_text(path))
    for index, frame in enumerate(content["frames"]):
        mask = frame.get("mask")
        if mask is None:
            continue
        if not isinstance(mask, str) or not mask:
            raise ValueError(f"{path}: frames[{index}]: mask must be a path, is {shown(mask)}")
        image = path.parent / with_slashes(path.parent, frame["image"])
        found[image] = path.parent / with_slashes(path.parent, mask)
    return found


def with_slashes(folder: Path, path: str) -> str:
    """A path from a folder, as a file in it names it: written on Windows, with slashes in place of backslashes.

    Where there is a file of that very name, it stays as it is: elsewhere a backslash may be a character of a name.
    """
    # Not Path.is_file, which raises where a name is longer than any file's.
    return path if "\\" not in path or os.path.isfile(folder / path) else path.replace("\\", "/")


def camera_of_frame(frame: Mapping[str, Any]) -> Camera:
    """Camera of a frame of a cameras.json; ValueError names a field that is missing or wrong.

    Its numbers are finite, but the interface's bounds are not checked.
    """
    if missing := [it for it in ("width", "height", "K") if it not in frame]:
        raise ValueError(f"{', '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing")
    for side in ("width", "height"):
        if not isinstance(frame[side], int) or isinstance(frame[side], bool) or not 0 < frame[side] <= MAX_SIDE_PX:
            raise ValueError(f"{side} must be a whole number of pixels, above 0, is {shown(frame[side])}")
    k = _numbers(frame["K"])
    if k.shape != (3, 3) or max(abs(k[0, 1]), abs(k[1, 0])) > 1e-6 or not np.allclose(k[2], [0, 0, 1]):
        raise ValueError(f"K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], is {shown(frame['K'])}")
    dist = frame.get("dist")
    coefficients = None if dist is None else _numbers(dist)
    if coefficients is not None and coefficients.ndim != 1:
        raise ValueError(f"dist must be null or a list of numbers, is {shown(dist)}")
    model = frame.get("lens", DEFAULT_LENS_MODEL)
    lens = lens_from_coefficients(model, None if coefficients is None else coefficients.tolist())
    focal_x_px, focal_y_px, principal_x_px, principal_y_px = k[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    return Camera(frame["width"], frame["height"], focal_x_px, focal_y_px, principal_x_px, principal_y_px, lens)


def _numbers(value: object) -> Array:
    """Returns an array of finite numbers, or one without dimensions if the value is not such an array."""
    try:
        numbers = np.array(value, float)
    except (TypeError, ValueError, OverflowError):  # JSON's integers have any number of digits
        return np.zeros(())
    return numbers if np.isfinite(numbers).all() else np.zeros(())


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
    """Returns the camera; raises FieldError if it exceeds the interface's bounds."""
    return wire.camera_from_message(wire.camera_to_message(camera), "")


def _photograph(path: Path, index: int, frame: Any) -> tuple[Path, Camera]:
    name = f"{path}: frames[{index}]"
    try:
        if not isinstance(frame, dict):
            raise ValueError(f"must be an object, {{...}}, is {shown(frame)}")
        if not isinstance(frame.get("image"), str):
            raise ValueError(f"image must be a path, is {shown(frame.get('image'))}")
        return path.parent / with_slashes(path.parent, frame["image"]), _checked(camera_of_frame(frame))
    except FieldError as error:
        model, _, _ = error.field.partition(".")
        where = _FIELDS_OF_FRAMES.get(model, "dist")
        raise ValueError(f"{name}: {str(error).replace(error.field, where, 1)}") from None
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None
