"""COLMAP's files of cameras and images, binary and text, record by record; observations are skipped.

They are not read by pycolmap, which accepts truncated files: see docs/decisions/035-own-readers.md. Binary files are
little endian and have no checksum, so every step is compared with the file's size. Observations make files of
gigabytes: binary ones are mapped, text is read by the line.
"""

import mmap
import re
import struct
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from mapless_tools.dataset import named

from ..collecting import filled_lines, text_lines
from .cameras import MODEL_NAMES, PARAMETERS, ColmapCamera

_POINT_BYTES = 24  # x, y, point3D_id of an observation
_MAX_NAME_BYTES = 4096
_ANNOUNCED = re.compile(r"\s*#\s*Number of (?:images|cameras):\s*(\d+)", re.IGNORECASE)


@dataclass(frozen=True)
class ImageRecord:
    """An image: its pose is qw qx qy qz tx ty tz of camera_from_world, its name the path from the images' folder."""

    image_id: int
    pose: Sequence[float]
    camera_id: int
    name: str


def read_cameras(file: Path) -> Iterator[ColmapCamera]:
    """Reads the cameras of a cameras.bin or cameras.txt; ValueError, naming file and record, if malformed."""
    return _cameras_bin(file) if file.suffix == ".bin" else _cameras_txt(file)


def read_images(file: Path) -> Iterator[ImageRecord]:
    """Reads the images of an images.bin or images.txt; ValueError, naming file and record, if malformed."""
    return _images_bin(file) if file.suffix == ".bin" else _images_txt(file)


def _cameras_bin(file: Path) -> Iterator[ColmapCamera]:
    cursor = _Cursor(file)
    for i in range(cursor.count(24, "cameras")):
        cursor.record = f"camera record {i}"
        camera_id, number, width_px, height_px = map(int, cursor.take("IiQQ"))
        if not 0 <= number < len(MODEL_NAMES):
            raise cursor.fault(f"camera {camera_id}: there is no camera model {number}")
        model = MODEL_NAMES[number]
        yield ColmapCamera(camera_id, model, width_px, height_px, cursor.take(f"{len(PARAMETERS[model])}d"))
    cursor.end()


def _images_bin(file: Path) -> Iterator[ImageRecord]:
    cursor = _Cursor(file)
    for i in range(cursor.count(73, "images")):
        cursor.record = f"image record {i}"
        image_id, *pose, camera_id = cursor.take("I7dI")
        name = cursor.text()
        cursor.take(f"{cursor.count(_POINT_BYTES, 'observations') * _POINT_BYTES}x")
        yield ImageRecord(int(image_id), pose, int(camera_id), name)
    cursor.end()


class _Cursor:
    """Reads a binary file from beginning to end; raises ValueError with the position if it ends too early."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self.position = 0
        self.record = "header"
        self._data: mmap.mmap | bytes
        try:
            with file.open("rb") as stream:
                size = file.stat().st_size  # an empty file cannot be mapped
                self._data = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) if size else b""
        except OSError as error:
            raise ValueError(f"{file} cannot be read: {error.strerror}") from error

    def take(self, layout: str) -> tuple[int | float, ...]:
        size = struct.calcsize("<" + layout)
        if self.position + size > len(self._data):
            raise self.fault(f"the file ends after {len(self._data)} bytes")
        values = struct.unpack_from("<" + layout, self._data, self.position)
        self.position += size
        return values

    def count(self, smallest_record: int, what: str) -> int:
        """Reads a number of records, for which there must be room in the file."""
        number = int(self.take("Q")[0])
        left = len(self._data) - self.position
        if number * smallest_record > left:
            raise self.fault(f"{number} {what} are announced, {left} bytes are left")
        return number

    def text(self) -> str:
        end = self._data.find(b"\0", self.position, self.position + _MAX_NAME_BYTES)
        if end < 0:
            raise self.fault("the name does not end")
        try:
            name = self._data[self.position : end].decode()
        except UnicodeDecodeError as error:
            raise self.fault("the name is not UTF-8") from error
        self.position = end + 1
        return name

    def end(self) -> None:
        if self.position != len(self._data):
            self.record = "end"
            raise self.fault(f"{len(self._data) - self.position} bytes are left over")

    def fault(self, what: str) -> ValueError:
        return ValueError(f"{self.file}: {self.record}, byte {self.position}: {what}; the file is cut off or damaged")


def _cameras_txt(file: Path) -> Iterator[ColmapCamera]:
    for number, line in filled_lines(file):
        place = f"{file}:{number}"
        words = line.split()
        if len(words) < 4 or words[1] not in PARAMETERS:
            raise ValueError(f"{place}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS, found {line.strip()[:80]!r}")
        wanted = PARAMETERS[words[1]]
        if len(words) != 4 + len(wanted):
            raise ValueError(f"{place}: {words[1]} has parameters {' '.join(wanted)}, found {len(words) - 4} numbers")
        with named(place):
            camera_id, width_px, height_px = int(words[0]), int(words[2]), int(words[3])
            yield ColmapCamera(camera_id, words[1], width_px, height_px, [float(word) for word in words[4:]])


def _images_txt(file: Path) -> Iterator[ImageRecord]:
    """Reads images.txt: a line for an image, then one for its observations, which may be empty."""
    lines = text_lines(file)
    for number, line in lines:
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        place = f"{file}:{number}"
        words = line.split(maxsplit=9)  # a name may have spaces
        if len(words) != 10:
            raise ValueError(
                f"{place}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, found {line.strip()[:80]!r}"
            )
        with named(place):
            yield ImageRecord(int(words[0]), [float(w) for w in words[1:8]], int(words[8]), words[9].rstrip())
        number, line = next(lines, (number, ""))
        _check_observations(line, f"{file}:{number}", number - 1)


def _check_observations(line: str, place: str, image_line: int) -> None:
    """Raises ValueError if a line is not the points of an image, such as where the empty lines were left out."""
    words = line.split()
    try:
        if len(words) % 3:
            raise ValueError
        deque(map(int, words[2::3]), maxlen=0)
        deque(map(float, words[:2]), maxlen=0)
    except ValueError:
        found = "ten words that are an image" if _is_image(line) else f"{len(words)} words"
        raise ValueError(
            f"{place}: expected the points of the image of line {image_line}, X Y POINT3D_ID for each, or an empty "
            f"line; found {found}: {line.strip()[:80]!r}"
        ) from None


def _is_image(line: str) -> bool:
    words = line.split(maxsplit=9)
    try:
        return len(words) == 10 and len([float(w) for w in words[:9]]) == 9
    except ValueError:
        return False


def announced(file: Path) -> int | None:
    """The number of images or cameras that a text file's comments announce; None if they do not."""
    for _, line in text_lines(file):
        if not line.lstrip().startswith("#"):
            return None
        if found := _ANNOUNCED.match(line):
            return int(found[1][:18])
    return None
