"""Photographs of one place with known poses, whatever the layout on the disk; `ingest.formats` reads them."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Container, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from mapless.cameras import with_slashes
from mapless.depth import DepthImage, DepthNoise, DepthSensor
from mapless.geodesy import Datum
from mapless.geometry import Array, Camera, RigidTransform
from mapless.provenance import GIVEN_POSE, Provenance
from mapless.scenes import Vector, unit_vector
from mapless.text_files import read_text
from mapless_server.images import ImageLimits, decode_image, decode_mask, upright_of
from mapless_server.method.features.extractors import FeatureExtractor
from mapless_server.method.features.extractors.turned import extract_upright
from mapless_server.method.features.views import View

MAX_NAME_LENGTH = 128
SPLITS = ("", "train", "test")
IMAGE_ENDINGS = (".png", ".jpg", ".jpeg", ".webp")
_MAX_QUOTED = 1000
"""Characters that messages quote of a file's content, which may be anything and of any length."""
Parsed = TypeVar("Parsed")


DecodeDepth = Callable[[bytes], tuple[bytes, tuple[int, int]]]
"""Float32 values and their size, as in `DepthImage`, of the bytes of a file; ValueError if these are damaged."""


@dataclass(frozen=True, eq=False)
class DepthFile:
    """The depth of a photograph in files: its values, and perhaps their confidence; the rest is as in `DepthImage`.

    `decode` reads a file that is neither a PNG nor plain float32 values.
    """

    path: Path
    unit_m: float
    sensor: DepthSensor = DepthSensor.UNKNOWN
    camera: Camera | None = None
    camera_from_depth_camera: RigidTransform | None = None
    confidence_path: Path | None = None
    min_confidence: int = 1
    noise: DepthNoise | None = None
    size: tuple[int, int] | None = None
    decode: DecodeDepth | None = None

    def scaled(self, scale: float) -> DepthFile:
        """The same depth in a unit of length of which there are `scale` in the present one; noise stays in metres."""
        pose = self.camera_from_depth_camera
        if pose is not None:
            pose = RigidTransform(pose.rotation, scale * pose.translation)
        return replace(self, unit_m=scale * self.unit_m, camera_from_depth_camera=pose)

    def read(self) -> DepthImage:
        """Reads the files; OSError, or ValueError, which names the file, if its format is not as it should be."""
        confidence = b"" if self.confidence_path is None else self.confidence_path.read_bytes()
        data, size = self.path.read_bytes(), self.size
        with named(str(self.path)):
            if self.decode is not None:
                data, size = self.decode(data)
            if size is not None and len(data) != 4 * size[0] * size[1]:
                raise ValueError(f"{size[0]}x{size[1]} values of 4 bytes are expected, {len(data)} bytes are there")
        return DepthImage(
            data,
            self.unit_m,
            size,
            self.sensor,
            self.camera,
            self.camera_from_depth_camera,
            confidence,
            self.min_confidence,
            self.noise,
        )


@dataclass(frozen=True, eq=False)
class Frame:
    """A photograph whose pose is known, in metres, or in the dataset's unit if it is not metric.

    Its name is a legal reference id; the EXIF orientation of its file is not to be applied. The split is "train" for
    frames that a benchmark builds its references from, "test" for its queries, empty if unknown. The mask, a PNG of the
    photograph's size, is 0 at the pixels to ignore; None without one. `provenance` says how the pose is known. The
    depth was measured with it; None without one.
    """

    name: str
    image_path: Path
    camera: Camera
    world_from_camera: RigidTransform
    split: str = ""
    mask_path: Path | None = None
    provenance: Provenance = GIVEN_POSE
    depth: DepthFile | None = None

    def __post_init__(self) -> None:
        if self.split not in SPLITS:
            raise ValueError(f"split must be one of {', '.join(map(repr, SPLITS))}, not {self.split!r}")

    def described(self, extractor: FeatureExtractor, limits: ImageLimits) -> View:
        """The photograph's view, as the server makes it; InvalidArgument or OSError if image or mask are bad."""
        data = self.image_path.read_bytes()
        pixels, upright_deg = decode_image(data, limits), upright_of(data).clockwise_deg
        return extract_upright(extractor, pixels, self.camera, upright_deg, ignored=self.read_ignored())

    def read_depth(self) -> DepthImage | None:
        """Its depth, None without one; OSError or ValueError as of `DepthFile.read`."""
        return None if self.depth is None else self.depth.read()

    def read_ignored(self) -> NDArray[np.bool_] | None:
        """The ignored pixels, (H, W); None if all are used. InvalidArgument or OSError if the mask is bad."""
        if self.mask_path is None:
            return None
        size = self.camera.width_px, self.camera.height_px
        return decode_mask(self.mask_path.read_bytes(), size, ImageLimits())


@dataclass(frozen=True)
class Refusal:
    """A frame of a dataset that cannot be used, as it is named there, and a clause with the reason: file and field."""

    frame: str
    reason: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "frame", printable(self.frame))
        object.__setattr__(self, "reason", printable(self.reason))


@dataclass(frozen=True)
class Dataset:
    """Frames of one place, in one world frame, in the order of the file; what the file does not say is empty or None.

    `ground_truth` says how the poses were found ("SfM (COLMAP)", "KinectFusion"), `notes` how the folder was read, such
    as a choice that was made or a unit other than metres. `down_in_world` is a unit vector of gravity.
    """

    name: str
    frames: tuple[Frame, ...]
    metric: bool
    source: str
    ground_truth: str = ""
    format: str = "cameras"
    refused: tuple[Refusal, ...] = ()
    notes: tuple[str, ...] = ()
    datum: Datum | None = None
    down_in_world: Vector | None = None


def printable(text: str) -> str:
    """Text of a file in a form for terminals: cut, and without characters that move the cursor."""
    text = text if len(text) <= _MAX_QUOTED else f"{text[:_MAX_QUOTED]}..."
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def read_place(file: Path, content: Mapping[str, Any]) -> tuple[Datum | None, Vector | None]:
    """Reads datum and direction of gravity, each None if it is missing; ValueError names the field."""
    return _parsed(file, content, "datum", Datum.from_json), _parsed(file, content, "down_in_world", _direction)


def read_json(file: Path) -> Any:
    """Reads a JSON file; ValueError, naming it, if it cannot be read or is not JSON."""
    try:
        text = read_text(file)
    except OSError as error:
        raise ValueError(f"{file} cannot be read: {error.strerror}") from error
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{file} is not JSON: {error}") from error


def _parsed(file: Path, content: Mapping[str, Any], field: str, read: Callable[[object], Parsed]) -> Parsed | None:
    if content.get(field) is None:
        return None
    with named(f"{file}: {field}"):
        return read(content[field])


def _direction(content: object) -> Vector:
    x, y, z = finite_numbers(content, "it", (3,)).tolist()
    return unit_vector(x, y, z)


def legal_id(stem: str, taken: Container[str]) -> str:
    """A text as a legal reference id that is not `taken` yet."""
    stem = re.sub(r"\.{2,}|[^A-Za-z0-9._-]", "_", stem) or "_"
    stem = re.sub(r"^[.-]|[.-]$", "_", stem[:MAX_NAME_LENGTH])
    name, copy = stem, 2
    while name in taken:
        name, copy = f"{stem[: MAX_NAME_LENGTH - 8]}_{copy}", copy + 1
    return name


def image_file(folder: Path, image: str) -> Path:
    """The file of an image that a layout names; ValueError if there is none, or the path leads out of the folder.

    Paths written on Windows are read, too (see `with_slashes`), absolute ones that lead into the folder, those without
    an ending, and those whose ending has other cases than the file's (.JPG).
    """
    with named("image"):
        return _file_in(folder, image)


def path_in(folder: Path, path: object) -> Path:
    """The file that a layout names beside an image, such as its depth; ValueError as `image_file`, or for no text."""
    if not isinstance(path, str) or not path:
        raise ValueError(f"must be a path, is {path!r}")
    return _file_in(folder, path)


def _file_in(folder: Path, image: str) -> Path:
    image = _within(folder, with_slashes(folder, image))
    file = folder / image
    try:
        found = file.is_file()
    except OSError as error:  # a name that no file can have
        raise ValueError(f"{image[:100]!r}: {error.strerror}") from error
    if found:
        return file
    for other in _other_endings(image):
        if os.path.isfile(folder / other):
            return folder / other
    raise ValueError(f"there is no file {file}")


def _within(folder: Path, image: str) -> str:
    """A path from the folder; ValueError if it leads out of it."""
    path = PurePosixPath(image)
    for root in (folder, folder.absolute(), folder.resolve()) if path.is_absolute() else ():
        if path.is_relative_to(root):
            path = path.relative_to(root)
            break
    if path.is_absolute() or ".." in path.parts:
        raise ValueError(f"{image!r} leads out of {folder}")
    return str(path)


def _other_endings(image: str) -> Iterator[str]:
    """Paths of an image with its own ending in other cases, or, without one, with each that images have."""
    stem, ending = os.path.splitext(image)
    is_known = ending.lower() in IMAGE_ENDINGS
    for known in (ending,) if is_known else IMAGE_ENDINGS:
        for written in (known.lower(), known.upper(), f".{known[1:].capitalize()}"):
            yield (stem if is_known else image) + written


@contextmanager
def named(what: str) -> Iterator[None]:
    """Puts what is wrong, a file or a field, before the message of a ValueError of the block."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{what}: {error}") from error


def finite_numbers(value: object, what: str, shape: tuple[int, ...] | None = None) -> Array:
    """Converts numbers, or their texts, to an array; ValueError, naming `what` they are, for other values or shapes."""
    try:
        values = np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError) as error:  # JSON's integers have any number of digits
        raise ValueError(f"{what} must be numbers") from error
    if shape is not None and values.shape != shape:
        raise ValueError(
            f"{what} must be {'x'.join(map(str, shape))} numbers, is {'x'.join(map(str, values.shape)) or 'a scalar'}"
        )
    if not np.isfinite(values).all():
        raise ValueError(f"{what} is not finite")
    return values
