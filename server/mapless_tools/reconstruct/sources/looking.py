"""Looks at one photograph: whether it can be used, and what duplicates and blur are found by."""

import base64
import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless_server.errors import InvalidArgument
from mapless_server.images import ImageLimits, decode_image, upright_of
from mapless_server.images.exif import Exif, read_exif

from .blur import SIDE_PX, blur_px
from .finding import SourceFile, is_heif
from .heif import jpeg_of_heif
from .remembered import Remembered, identity

SMALL_PX = 64


@dataclass(frozen=True, eq=False)
class Looked:
    """A photograph that can be used.

    `path` is the file itself, or the JPEG that was made of it. `digest` is that of the given file's bytes. `blur` is a
    standard deviation in pixels of a raster of `SIDE_PX`, None where the photograph does not show it. `small` is the
    upright photograph in grey, whatever its sides in SMALL_PX times SMALL_PX pixels.
    """

    file: SourceFile
    path: Path
    width_px: int
    height_px: int
    byte_count: int
    exif: Exif
    digest: str
    blur: float | None
    small: NDArray[np.uint8]

    @property
    def is_converted(self) -> bool:
        """Whether a JPEG was made of the given file."""
        return self.path != self.file.path


def look(file: SourceFile, folder: Path, limits: ImageLimits, remembered: Remembered) -> Looked:
    """Reads a photograph; of HEIC, HEIF and AVIF a JPEG is made in the folder. ValueError, a clause, if it is unusable.

    What takes long is remembered.
    """
    try:
        key = identity(file.path)
        data = file.path.read_bytes()
    except OSError as error:
        raise ValueError(f"it cannot be read: {error.strerror}") from error
    digest = hashlib.sha256(data).hexdigest()
    path = file.path
    if is_heif(data):
        path = folder / f"heif-{key}.jpg"
        if not path.exists():
            jpeg_of_heif(file.path, path, limits)
        data = path.read_bytes()
    exif = read_exif(data)
    result = remembered.get(key)
    if result is None:
        result = _measured(data, limits)
        remembered.put(key, result)
    if isinstance(result, str):
        raise ValueError(result)
    small = np.frombuffer(base64.b64decode(result["small"]), np.uint8).reshape(SMALL_PX, SMALL_PX)
    return Looked(file, path, result["width"], result["height"], len(data), exif, digest, result["blur"], small)


def upright_grey(data: bytes, image: NDArray[np.uint8], size_px: tuple[int, int]) -> NDArray[np.uint8]:
    """A file's decoded image (H, W, 3) in grey, upright as its EXIF asks, of this width and height."""
    turns = round(upright_of(data).clockwise_deg / 90)
    width, height = size_px if turns % 2 == 0 else size_px[::-1]
    small = cv2.cvtColor(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)
    return np.ascontiguousarray(np.rot90(small, -turns), np.uint8)


def _measured(data: bytes, limits: ImageLimits) -> dict[str, Any] | str:
    """The measures of an image file in JSON's types, or a clause with what is wrong."""
    try:
        image = decode_image(data, limits)
    except InvalidArgument as error:
        return str(error)
    height, width = image.shape[:2]
    scale = min(1.0, SIDE_PX / max(width, height))
    size_px = max(1, round(width * scale)), max(1, round(height * scale))
    grey = cv2.cvtColor(cv2.resize(image, size_px, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)
    blur = blur_px(np.asarray(grey, np.uint8))
    small = upright_grey(data, image, (SMALL_PX, SMALL_PX))
    return {
        "width": width,
        "height": height,
        "blur": None if blur is None else blur * SIDE_PX / max(size_px),
        "small": base64.b64encode(small.tobytes()).decode(),
    }
