"""Valid and invalid safetensors files."""

import json
from collections.abc import Mapping
from typing import Any

from numpy.typing import NDArray

DTYPES = {"float64": "F64", "float32": "F32", "float16": "F16", "int64": "I64", "uint8": "U8"}


def with_header(header: Any, data: bytes = b"") -> bytes:
    """A file of a header, as it is, and data."""
    text = header if isinstance(header, bytes) else json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + data


def entry(dtype: str = "F32", shape: tuple[int, ...] = (2,), begin: int = 0, end: int = 8) -> dict[str, Any]:
    """A header's entry."""
    return {"dtype": dtype, "shape": list(shape), "data_offsets": [begin, end]}


def safetensors(tensors: Mapping[str, NDArray[Any]]) -> bytes:
    """A file of tensors."""
    header, data = {}, b""
    for name, tensor in tensors.items():
        begin, data = len(data), data + tensor.tobytes()
        header[name] = entry(DTYPES[tensor.dtype.name], tensor.shape, begin, len(data))
    return with_header(header, data)
