"""Loads a network's weights from a safetensors file, whose tensors must be exactly the network's."""

import hashlib
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from io import BufferedReader
from pathlib import Path

import torch

from .weights.catalogue import CheckpointError
from .weights.safetensors_header import Entry, Header, check_fit, opened, read_header

IMAGE_NORMALIZATION: Mapping[str, Sequence[float]] = {
    "image_mean": (0.485, 0.456, 0.406),
    "image_std": (0.229, 0.224, 0.225),
}
"""ImageNet's constants, red, green, blue, for images in 0..1: buffers of Pi3 and Pi3X that a checkpoint may lack."""


def _no_further_words(_: Mapping[str, tuple[int, ...]]) -> str:
    return ""


@dataclass(frozen=True)
class FileNames:
    """How a network's file may differ from its tensors; a class has it as its attribute `file_names`.

    Attributes:
        canonical: function from any name that a file may give to a tensor to its name in the network.
        unused_prefixes: files may hold further tensors with these prefixes, which are not loaded.
        describe_misfit: function that says, from the shapes of its tensors, what a file is that does not fit; empty if
            unknown.
    """

    canonical: Callable[[str], str] = str
    unused_prefixes: tuple[str, ...] = ()
    describe_misfit: Callable[[Mapping[str, tuple[int, ...]]], str] = _no_further_words


def file_names_of(network: type[torch.nn.Module]) -> FileNames:
    """The file names of a network's class; by default, a file must have exactly the network's names."""
    names: FileNames = getattr(network, "file_names", FileNames())
    return names


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
    module: torch.nn.Module, file: Path, *, optional: Mapping[str, Sequence[float] | None] = IMAGE_NORMALIZATION
) -> str:
    """Replaces all parameters and persistent buffers of a module by a file's; other buffers are not changed.

    The file is read once, and the bytes that are hashed are those that are loaded; a digest recorded beside the file
    could belong to another file (copying tools preserve sizes and times). Tensors are read one at a time, so a module
    on the meta device (`with torch.device("meta")`) needs memory for itself and one tensor. Numbers are converted to
    the dtype of the module's tensor.

    Args:
        module: the network, on any device; the meta device saves memory.
        file: a safetensors file of any floating-point type.
        optional: names that the file may lack, with their default values; None leaves the module's own.

    Returns:
        The weights' identity: SHA-256 of the file, 64 hexadecimal digits.

    Raises:
        CheckpointError: the file cannot be read, is not a safetensors file or a damaged one, holds other tensors than
            the module (see FileNames for what is allowed), two of one name that differ, or numbers that are not finite.
            The module is then unchanged.
    """
    state = module.state_dict()
    header = read_header(file)
    names = file_names_of(type(module))
    compare_tensors(header, module, str(file), optional)
    with opened(file) as stream:
        digest = hashlib.sha256(stream.read(header.size_bytes))
        loaded: dict[str, torch.Tensor] = {}
        for given, entry in header.entries.items():
            name = names.canonical(given)
            if entry.dtype not in _DTYPES:
                raise CheckpointError(f"{file} holds numbers of type {entry.dtype}, in {given}, which no network uses")
            tensor = _read(stream, entry, file)
            digest.update(_bytes_of(tensor))
            if name in state:
                if not _is_finite(tensor):
                    raise CheckpointError(f"{file} holds numbers that are not finite, in {given}")
                tensor = tensor.to(state[name].dtype)
                if name in loaded and not torch.equal(tensor, loaded[name]):
                    raise CheckpointError(f"{file} holds {name} twice, with other numbers as {given}")
                loaded[name] = tensor
        if stream.read(1):
            raise CheckpointError(f"{file} changed while it was read")
    loaded |= _defaults(state, loaded.keys(), optional)
    module.load_state_dict(loaded, strict=True, assign=True)
    return digest.hexdigest()


def compare_tensors(
    header: Header,
    module: torch.nn.Module,
    description: str,
    optional: Mapping[str, Sequence[float] | None] = IMAGE_NORMALIZATION,
) -> None:
    """Raises CheckpointError unless a file has the module's tensors, under any of their names.

    Args:
        header: the file's header.
        module: the network, on any device.
        description: name of the file in messages.
        optional: names that the file may lack.
    """
    names = file_names_of(type(module))
    renamed = replace(header, entries={names.canonical(name): entry for name, entry in header.entries.items()})
    message = f"{description} does not fit {type(module).__name__}"
    further = names.describe_misfit({name: entry.shape for name, entry in renamed.entries.items()})
    if further:
        message += f": {further}"
    check_fit(renamed, expected_tensors(module), optional.keys(), names.unused_prefixes, message)


def expected_tensors(module: torch.nn.Module) -> dict[str, tuple[tuple[int, ...], bool]]:
    """Shape of every tensor that a file must hold, and whether it is a floating-point number, by name."""
    return {name: (tuple(tensor.shape), tensor.is_floating_point()) for name, tensor in module.state_dict().items()}


def _defaults(
    state: Mapping[str, torch.Tensor], loaded: Collection[str], optional: Mapping[str, Sequence[float] | None]
) -> dict[str, torch.Tensor]:
    """Values of the optional tensors that the file lacks."""
    values: dict[str, torch.Tensor] = {}
    for name, given in optional.items():
        if name not in state or name in loaded:
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
    """Whether all numbers are finite, tested by their extremes in a thirtieth of the time of torch.isfinite."""
    return not tensor.is_floating_point() or tensor.numel() == 0 or all(map(math.isfinite, tensor.aminmax()))


def _bytes_of(tensor: torch.Tensor) -> memoryview:
    return tensor.reshape(-1).view(torch.uint8).numpy().data
