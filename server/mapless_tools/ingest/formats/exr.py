"""Depths in OpenEXR files: one channel of half or single floats, metres (Record3D's export "EXR + RGB")."""

from io import BytesIO

import numpy as np

MAX_PIXELS = 4 * 2**20
"""More than any depth camera has: a damaged header would ask for gigabytes."""


def decode_exr(data: bytes) -> tuple[bytes, tuple[int, int]]:
    """Float32 values and size (width, height) of the only channel; ValueError if the file is damaged or has several."""
    from OpenEXR import File

    try:
        (low, high) = File(BytesIO(data), header_only=True).header()["dataWindow"]
        width, height = (int(it) for it in high - low + 1)
        if not 0 < width * height <= MAX_PIXELS:
            raise ValueError(f"it has {width}x{height} pixels")
        channels = File(BytesIO(data), separate_channels=True).channels()
    except (RuntimeError, KeyError, ValueError) as error:
        raise ValueError(f"it is no EXR, or damaged: {error}") from error
    if len(channels) != 1:
        raise ValueError(f"it has the channels {', '.join(channels) or 'none'}, a depth has one")
    (channel,) = channels.values()
    values = np.asarray(channel.pixels)
    if values.shape != (height, width) or values.dtype.kind != "f":
        raise ValueError(f"its channel has the shape {values.shape} and the type {values.dtype}")
    return np.ascontiguousarray(values, "<f4").tobytes(), (width, height)
