"""Pixels and files of sensor_msgs/Image and sensor_msgs/CompressedImage."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.deep_pixels import eight_bits

JPEG_QUALITY = 90
"""A tenth of a PNG's bytes, with the same features."""

PNG_COMPRESSION = 1
"""The fastest: others take several times as long, for a few per cent of the bytes."""

_SIGNATURES = (b"\xff\xd8", b"\x89PNG\r\n\x1a\n", b"RIFF")


@dataclass(frozen=True)
class _Encoding:
    """How the pixels of an encoding lie, and OpenCV's conversion of them to BGR."""

    channels: int = 1
    to_bgr: int | None = None
    bytes_per_value: int = 1
    rows_per_pixel: float = 1.0


def _encodings() -> dict[str, _Encoding]:
    bayer = {  # OpenCV names a pattern by its second row
        "rggb": cv2.COLOR_BayerBG2BGR,
        "bggr": cv2.COLOR_BayerRG2BGR,
        "gbrg": cv2.COLOR_BayerGR2BGR,
        "grbg": cv2.COLOR_BayerGB2BGR,
    }
    colours: dict[str, tuple[int, int | None]] = {
        "mono": (1, None),
        "bgr": (3, None),
        "rgb": (3, cv2.COLOR_RGB2BGR),
        "bgra": (4, cv2.COLOR_BGRA2BGR),
        "rgba": (4, cv2.COLOR_RGBA2BGR),
        **{f"bayer_{pattern}": (1, code) for pattern, code in bayer.items()},
    }
    found = {
        f"{name}{8 * size}": _Encoding(channels, code, size)
        for name, (channels, code) in colours.items()
        for size in (1, 2)
    }
    found |= {"8UC1": found["mono8"], "8UC3": found["bgr8"], "8UC4": found["bgra8"]}
    uyvy, yuyv = _Encoding(2, cv2.COLOR_YUV2BGR_UYVY), _Encoding(2, cv2.COLOR_YUV2BGR_YUY2)
    found |= {"yuv422": uyvy, "uyvy": uyvy, "yuv422_yuy2": yuyv, "yuyv": yuyv}
    nv12, nv21 = cv2.COLOR_YUV2BGR_NV12, cv2.COLOR_YUV2BGR_NV21
    return found | {"nv12": _Encoding(1, nv12, 1, 1.5), "nv21": _Encoding(1, nv21, 1, 1.5)}


ENCODINGS: Mapping[str, _Encoding] = _encodings()
"""Encodings of sensor_msgs/Image that show what a camera saw; those of depths are not among them."""


def pixels_from_image(message: Any) -> NDArray[np.uint8]:
    """Pixels of a sensor_msgs/Image or CompressedImage: (H, W) grey, or (H, W, 3) BGR.

    Values of 16 bits are stretched to 8, see `mapless.deep_pixels`. ValueError for an unsupported encoding, fewer bytes
    than the size needs, or a file that cannot be decoded.
    """
    if not hasattr(message, "encoding"):
        return _decoded(message)
    encoding = ENCODINGS.get(message.encoding)
    if encoding is None:
        raise ValueError(f"encoding {message.encoding!r} is none of {', '.join(sorted(ENCODINGS))}")
    height, width, step = message.height, message.width, message.step
    rows = int(height * encoding.rows_per_pixel)
    if encoding.rows_per_pixel != 1 and (height % 2 or width % 2):
        raise ValueError(f"{width} x {height} pixels in encoding {message.encoding}, which needs even numbers")
    row_bytes = width * encoding.channels * encoding.bytes_per_value
    data = np.frombuffer(bytes(message.data), np.uint8)
    if not (height > 0 and width > 0 and step >= row_bytes and len(data) >= rows * step):
        raise ValueError(
            f"an image of {width} x {height} in encoding {message.encoding} with rows of {step} bytes cannot have "
            f"{len(data)} bytes: rows need {row_bytes}, there must be {rows}"
        )
    values = np.ascontiguousarray(data[: rows * step].reshape(rows, step)[:, :row_bytes])
    if encoding.bytes_per_value == 2:
        deep = values.view(">u2" if message.is_bigendian else "<u2")
        values = eight_bits(deep if encoding.channels == 1 else deep.reshape(rows, width, encoding.channels))
    pixels = values if encoding.channels == 1 else values.reshape(rows, width, encoding.channels)
    return pixels if encoding.to_bgr is None else np.asarray(cv2.cvtColor(pixels, encoding.to_bgr), np.uint8)


def file_from_image(message: Any, lossless: bool = False) -> bytes:
    """The file that a CompressedImage holds, bit by bit, or an Image as a JPEG, or as a PNG if `lossless`.

    A PNG with 16 bits is stretched to 8, as in `pixels_from_image`. ValueError as there; a JPEG is not decoded.
    """
    if not hasattr(message, "encoding"):
        data = _file(message)
        if not (data.startswith(b"\x89PNG") and data[24:25] == b"\x10"):
            return data
    return encoded(pixels_from_image(message), lossless)


def encoded(pixels: NDArray[np.uint8], lossless: bool = False) -> bytes:
    """Pixels as a JPEG, or as a PNG if `lossless`."""
    options = [cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION] if lossless else [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    done, file = cv2.imencode(".png" if lossless else ".jpg", pixels, options)
    if not done:
        raise ValueError(f"OpenCV cannot encode an image of shape {pixels.shape}")
    return file.tobytes()


def _file(message: Any) -> bytes:
    data = bytes(message.data)
    if not data.startswith(_SIGNATURES):
        raise ValueError(f"a compressed image of format {message.format!r} is no JPEG, PNG or WebP file")
    return data


def _decoded(message: Any) -> NDArray[np.uint8]:
    # EXIF orientation is never applied: intrinsics belong to the raster as it is stored.
    flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
    pixels = cv2.imdecode(np.frombuffer(_file(message), np.uint8), flags)
    if pixels is None:
        raise ValueError(f"a compressed image of format {message.format!r} cannot be decoded")
    return eight_bits(pixels) if pixels.dtype == np.uint16 else np.asarray(pixels, np.uint8)
