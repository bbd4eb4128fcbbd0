"""Depths in files of floating-point numbers: OpenEXR, as of Record3D, and NumPy's .npy, as of nerfstudio."""

from io import BytesIO
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

MAX_PIXELS = 4 * 2**20
"""More than any depth camera has: a damaged header would ask for gigabytes."""


def decode_exr(data: bytes) -> tuple[bytes, tuple[int, int]]:
    """Float32 values and size (width, height) of the only channel; ValueError if the file is damaged or has several."""
    from OpenEXR import File

    try:
        parts = File(BytesIO(data), header_only=True).parts
        names = [channel.name for part in parts for channel in part.header["channels"]]
        if len(names) != 1:  # before anything is inflated
            raise ValueError(f"it has the channels {', '.join(names) or 'none'}, a depth has one")
        (low, high) = parts[0].header["dataWindow"]
        width, height = (int(it) for it in high - low + 1)
        _check_size(width, height)
        channels = File(BytesIO(data), separate_channels=True).channels()
    except (RuntimeError, KeyError, ValueError) as error:
        raise ValueError(f"it is no EXR, or damaged: {error}") from error
    (channel,) = channels.values()
    values = np.asarray(channel.pixels)
    if values.shape != (height, width) or values.dtype.kind != "f":
        raise ValueError(f"its channel has the shape {values.shape} and the type {values.dtype}")
    return _float32(values)


def decode_npy(data: bytes) -> tuple[bytes, tuple[int, int]]:
    """Float32 values and size (width, height) of an array (H, W) or (H, W, 1); ValueError for another or damaged."""
    stream = BytesIO(data)
    readers = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
    try:
        shape, _, kind = readers[npy.read_magic(stream)](stream)
        if kind.kind not in "fu" or not (len(shape) == 2 or (len(shape) == 3 and shape[2] == 1)):
            raise ValueError(f"an array of the shape {shape} and the type {kind} is no depth")
        _check_size(shape[1], shape[0])
        values = np.load(BytesIO(data), allow_pickle=False)
    except (EOFError, KeyError, SyntaxError, TokenError, TypeError, ValueError) as error:  # its header is Python
        raise ValueError(f"it is no .npy, or damaged: {error}") from error
    return _float32(values.reshape(shape[:2]))


def _check_size(width: int, height: int) -> None:
    if not (width > 0 < height and width * height <= MAX_PIXELS):
        raise ValueError(f"it has {width}x{height} pixels")


def _float32(values: NDArray[Any]) -> tuple[bytes, tuple[int, int]]:
    height, width = values.shape
    return np.ascontiguousarray(values, "<f4").tobytes(), (width, height)
