"""COLMAP's binary files: little endian, without any checksum, so every step is checked against the file's size."""

from __future__ import annotations

import mmap
import struct
from collections.abc import Iterator
from pathlib import Path

from .cameras import MODEL_NAMES, PARAMETERS, ColmapCamera
from .records import ImageRecord

_POINT_BYTES = 24  # x, y, point3D_id of an observation
_MAX_NAME_BYTES = 4096


class _Cursor:
    """Reads a file from front to back; whatever ends too early is a ValueError with the place."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self.position = 0
        self.record = "header"
        self._data: mmap.mmap | bytes
        try:
            with file.open("rb") as stream:
                # Observations make files of gigabytes, of which little is looked at. An empty file cannot be mapped.
                size = file.stat().st_size
                self._data = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) if size else b""
        except OSError as error:
            raise ValueError(f"{file} cannot be read: {error.strerror}") from error

    def take(self, layout: str) -> tuple[int | float, ...]:
        """The next values."""
        size = struct.calcsize("<" + layout)
        self.need(size)
        values = struct.unpack_from("<" + layout, self._data, self.position)
        self.position += size
        return values

    def count(self, smallest_record: int, what: str) -> int:
        """The next value, a number of records that there must be room for."""
        number = int(self.take("Q")[0])
        left = len(self._data) - self.position
        if number * smallest_record > left:
            raise self.fault(f"{number} {what} are announced, {left} bytes are left")
        return number

    def text(self) -> str:
        """The next text, which ends with a zero byte."""
        end = self._data.find(b"\0", self.position, self.position + _MAX_NAME_BYTES)
        if end < 0:
            raise self.fault("the name does not end")
        try:
            name = self._data[self.position : end].decode()
        except UnicodeDecodeError as error:
            raise self.fault("the name is not UTF-8") from error
        self.position = end + 1
        return name

    def skip(self, size: int) -> None:
        """Passes over bytes."""
        self.need(size)
        self.position += size

    def need(self, size: int) -> None:
        """There must be so many bytes."""
        if self.position + size > len(self._data):
            raise self.fault(f"the file ends after {len(self._data)} bytes")

    def end(self) -> None:
        """There must be nothing more."""
        if self.position != len(self._data):
            self.record = "end"
            raise self.fault(f"{len(self._data) - self.position} bytes are left over")

    def fault(self, what: str) -> ValueError:
        """What is wrong, and where."""
        return ValueError(f"{self.file}: {self.record}, byte {self.position}: {what}; the file is cut off or damaged")


def read_cameras(file: Path) -> Iterator[ColmapCamera]:
    """The cameras of a cameras.bin."""
    cursor = _Cursor(file)
    for i in range(cursor.count(24, "cameras")):
        cursor.record = f"camera record {i}"
        camera_id, number, width_px, height_px = map(int, cursor.take("IiQQ"))
        if not 0 <= number < len(MODEL_NAMES):
            raise cursor.fault(f"camera {camera_id}: there is no camera model {number}")
        model = MODEL_NAMES[number]
        parameters = cursor.take(f"{len(PARAMETERS[model])}d")
        yield ColmapCamera(camera_id, model, width_px, height_px, parameters)
    cursor.end()


def read_images(file: Path) -> Iterator[ImageRecord]:
    """The images of an images.bin; their observations are passed over."""
    cursor = _Cursor(file)
    for i in range(cursor.count(73, "images")):
        cursor.record = f"image record {i}"
        image_id, *pose, camera_id = cursor.take("I7dI")
        name = cursor.text()
        cursor.skip(cursor.count(_POINT_BYTES, "observations") * _POINT_BYTES)
        yield ImageRecord(int(image_id), pose, int(camera_id), name)
    cursor.end()
