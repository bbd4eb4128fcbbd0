"""Loads a network's weights from a safetensors file, whose tensors must be exactly the network's."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from io import BufferedReader
from pathlib import Path

import torch

from .weights.errors import CheckpointError
from .weights.safetensors_header import Entry, check_fit, opened, read_header

IMAGE_NORMALIZATION: Mapping[str, Sequence[float]] = {
    "image_mean": (0.485, 0.456, 0.406),
    "image_std": (0.229, 0.224, 0.225),
}
"""ImageNet's constants, red, green, blue, for images in 0..1: buffers of Pi3 and Pi3X that a checkpoint may lack."""

UNUSED = (
    *("omega", "flow_decoder.", "flow_head.", "global_points_decoder.", "global_point_head."),
    *("depth_encoder.", "depth_emb"),
)
"""Prefixes of names in checkpoints of Pi3 and Pi3X that are not used here: for training, and for given depths."""

_DTYPES = {
    "F64": torch.float64,
    "F32": torch.float32,
    "F16": torch.float16,
    "BF16": torch.bfloat16,
    "I64": torch.int64,
    "I32": torch.int32,
    "I16": torch.int16,
    "I8": torch.int8,
    "U8": torch.uint8,
    "BOOL": torch.bool,
}


def load_strictly(
    module: torch.nn.Module,
    file: Path,
    *,
    optional: Mapping[str, Sequence[float] | None] = IMAGE_NORMALIZATION,
    ignored_prefixes: tuple[str, ...] = (),
) -> str:
    """Replaces all parameters and persistent buffers of a module by those of a file; other buffers are not changed.

    The file is read once, and the bytes that are hashed are those that are loaded; a digest recorded beside the file
    could belong to another file (copying tools preserve sizes and times). Tensors are read one at a time, so a module
    on the meta device (`with torch.device("meta")`) needs memory for itself and one tensor. Numbers are converted to
    the dtype of the module's tensor.

    Args:
        module: on any device; the meta device saves memory.
        file: safetensors, of any floating-point type.
        optional: names that the file may lack, with their default values; None leaves the module's own.
        ignored_prefixes: further names with these prefixes are allowed; their tensors are hashed and dropped.

    Returns:
        The weights' identity: SHA-256 of the file, 64 hexadecimal digits.

    Raises:
        CheckpointError: the file cannot be read, is not a safetensors file or a damaged one, holds other tensors than
            the module, or numbers that are not finite. The module is then unchanged.
    """
    state = module.state_dict()
    header = read_header(file)
    message = f"{file} does not fit {type(module).__name__}"
    check_fit(header, expected_tensors(module), optional.keys(), ignored_prefixes, message)
    with opened(file) as stream:
        digest = hashlib.sha256(stream.read(header.size_bytes))
        loaded = _defaults(state, header.entries, optional)
        for name, entry in header.entries.items():
            if entry.dtype not in _DTYPES:
                raise CheckpointError(f"{file} holds numbers of type {entry.dtype}, in {name}, which no network uses")
            tensor = _read(stream, entry, file)
            digest.update(_bytes_of(tensor))
            if name in state:
                if not _is_finite(tensor):
                    raise CheckpointError(f"{file} holds numbers that are not finite, in {name}")
                loaded[name] = tensor.to(state[name].dtype)
        if stream.read(1):
            raise CheckpointError(f"{file} changed while it was read")
    module.load_state_dict(loaded, strict=True, assign=True)
    return digest.hexdigest()


def expected_tensors(module: torch.nn.Module) -> dict[str, tuple[tuple[int, ...], bool]]:
    """Shape, and whether it is a floating-point number, of every tensor that a file must hold, by name."""
    return {name: (tuple(tensor.shape), tensor.is_floating_point()) for name, tensor in module.state_dict().items()}


def _defaults(
    state: Mapping[str, torch.Tensor], entries: Mapping[str, Entry], optional: Mapping[str, Sequence[float] | None]
) -> dict[str, torch.Tensor]:
    """Values of the optional tensors that the file lacks."""
    values: dict[str, torch.Tensor] = {}
    for name, given in optional.items():
        if name not in state or name in entries:
            continue
        own = state[name]
        if given is None and own.is_meta:
            raise ValueError(f"{name} is on the meta device and has no value to keep")
        values[name] = own if given is None else torch.tensor(given, dtype=own.dtype).reshape(own.shape)
    return values


def _read(stream: BufferedReader, entry: Entry, file: Path) -> torch.Tensor:
    tensor = torch.empty(entry.shape, dtype=_DTYPES[entry.dtype], device="cpu")
    view = _bytes_of(tensor)
    if stream.readinto(view) != len(view):
        raise CheckpointError(f"{file} changed while it was read")
    return tensor


def _is_finite(tensor: torch.Tensor) -> bool:
    """Whether all numbers are finite; by their extremes, in a thirtieth of the time of torch.isfinite."""
    return not tensor.is_floating_point() or tensor.numel() == 0 or all(map(math.isfinite, tensor.aminmax()))


def _bytes_of(tensor: torch.Tensor) -> memoryview:
    """The tensor's own memory."""
    return tensor.reshape(-1).view(torch.uint8).numpy().data
