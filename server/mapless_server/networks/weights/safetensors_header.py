"""The header of a safetensors file, read by its library; faults of a file are reported in one line.

No tensor is read, and torch is not needed.
"""

import hashlib
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from io import BufferedReader
from pathlib import Path
from typing import BinaryIO

from safetensors import SafetensorError, safe_open

from .catalogue import CheckpointError

FLOATS = frozenset({"F64", "F32", "F16", "BF16"})

_OTHER_FORMATS: tuple[tuple[bytes, str], ...] = (
    (b"PK\x03\x04", "a zip archive, as PyTorch's pickles are"),
    *((b"\x80" + bytes([protocol]), "a pickle") for protocol in range(2, 6)),
    (b"version https://git-lfs", "a Git LFS pointer, not the file itself"),
    (b"<", "a web page"),
    (b"\x1f\x8b", "gzip"),
)
_DAMAGE = {
    "incomplete metadata": "it is cut short, or longer than its tensors",
    "invalid header length": "it is cut short within its header",
}
"""The library's messages, and those that the operator gets."""
_BLOCK_BYTES = 1 << 20
_NAMES_SHOWN = 3


@dataclass(frozen=True)
class Entry:
    """One tensor of a file: its type by the format's name ("F32"), and its shape."""

    dtype: str
    shape: tuple[int, ...]


@dataclass(frozen=True)
class Header:
    """A header that fits its file.

    `size_bytes` are those before the first tensor; the tensors follow without a gap.
    """

    size_bytes: int
    entries: Mapping[str, Entry]


@contextmanager
def opened(file: Path) -> Iterator[BufferedReader]:
    """Opens a file for reading; an OSError of opening it, or in the block, becomes a CheckpointError."""
    try:
        with file.open("rb") as stream:
            yield stream
    except OSError as error:
        raise CheckpointError(f"{file} cannot be read: {error.strerror}") from None


def read_header(file: Path, description: str = "") -> Header:
    """Reads and checks the header.

    CheckpointError if the file is not a safetensors file, truncated, or inconsistent.
    """
    description = description or str(file)
    with opened(file) as stream:
        start = stream.read(64)
        if not start:
            raise CheckpointError(f"{description} is empty")
        try:
            with safe_open(file, "numpy") as tensors:
                slices = {name: tensors.get_slice(name) for name in tensors.offset_keys()}
                entries = {name: Entry(it.get_dtype(), tuple(it.get_shape())) for name, it in slices.items()}
        except SafetensorError as error:
            # The header's length may begin like another format, but then a brace follows it.
            if start[8:9] != b"{":
                raise CheckpointError(f"{description} is not a safetensors file{_other_format(start)}") from None
            reason = str(error).removeprefix("Error while deserializing header: ")
            damage = next(
                (ours for theirs, ours in _DAMAGE.items() if theirs in reason), f"its header is damaged: {reason}"
            )
            raise CheckpointError(f"{description} is not a whole safetensors file: {damage}") from None
    return Header(8 + int.from_bytes(start[:8], "little"), entries)


def check_fit(
    header: Header,
    expected: Mapping[str, tuple[tuple[int, ...], bool]],
    optional: Collection[str],
    ignored_prefixes: tuple[str, ...],
    message: str,
) -> None:
    """Raises CheckpointError, with all differences, unless the tensors are the expected ones.

    Expected are, by name, a shape and whether it is a floating-point number. Optional names may be missing; further
    names with ignored prefixes are allowed. The error begins with the message: which file does not fit which network.
    """
    entries = header.entries
    missing = [name for name in expected if name not in entries and name not in optional]
    surplus = [name for name in entries if name not in expected and not name.startswith(ignored_prefixes)]
    both = [(name, entries[name], *expected[name]) for name in expected if name in entries]
    misshapen = [f"{name} is {e.shape}, not {shape}" for name, e, shape, _ in both if e.shape != shape]
    mistyped = [f"{name} is {e.dtype}" for name, e, _, is_float in both if (e.dtype in FLOATS) != is_float]
    faults = [
        f"{len(names)} {what}: {', '.join(names[:_NAMES_SHOWN])}"
        + (f", and {len(names) - _NAMES_SHOWN} more" if len(names) > _NAMES_SHOWN else "")
        for names, what in (
            (missing, "missing"),
            (surplus, "surplus"),
            (misshapen, "of another shape"),
            (mistyped, "of another type"),
        )
        if names
    ]
    if faults:
        raise CheckpointError(f"{message}: of its tensors {'; '.join(faults)}")


def sha256_of(stream: BinaryIO, to: Callable[[bytes], object] | None = None) -> str:
    """SHA-256 of the rest of a stream, in hexadecimal digits; each block is also passed `to` a writer, if given."""
    digest = hashlib.sha256()
    while block := stream.read(_BLOCK_BYTES):
        digest.update(block)
        if to is not None:
            to(block)
    return digest.hexdigest()


def _other_format(start: bytes) -> str:
    return next((f": it is {what}" for magic, what in _OTHER_FORMATS if start.startswith(magic)), "")
