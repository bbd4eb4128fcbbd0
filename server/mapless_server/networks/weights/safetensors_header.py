"""What a safetensors file says it holds, and whether that can be true.

The format (https://github.com/huggingface/safetensors): the header's length as 8 bytes, little-endian; the header, a
JSON object of name to dtype, shape and range of bytes; the tensors' bytes, one after another without a hole.

Read here and not by the library for three reasons: a person is told what is wrong with a file in words, `weights`
needs no torch, and whoever loads can hash the very bytes that are loaded, in one pass.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from io import BufferedReader
from pathlib import Path
from typing import Any, BinaryIO

from .errors import CheckpointError

ITEM_BYTES: Mapping[str, int] = {
    "F64": 8,
    "F32": 4,
    "F16": 2,
    "BF16": 2,
    "I64": 8,
    "I32": 4,
    "I16": 2,
    "I8": 1,
    "U8": 1,
    "BOOL": 1,
}
"""Bytes of one element, for every dtype that is read."""

FLOATS = frozenset({"F64", "F32", "F16", "BF16"})

_LENGTH_BYTES = 8
_MAX_HEADER_BYTES = 100_000_000
"""The format's own limit."""

_OTHER_FORMATS: tuple[tuple[bytes, str], ...] = (
    (b"PK\x03\x04", "a zip archive, as PyTorch's pickles are"),
    *((b"\x80" + bytes([protocol]), "a pickle") for protocol in range(2, 6)),
    (b"version https://git-lfs", "a Git LFS pointer, not the file it stands for"),
    (b"<", "a web page"),
    (b"\x1f\x8b", "gzip"),
)
_BLOCK_BYTES = 1 << 20
_NAMES_SHOWN = 3


@dataclass(frozen=True)
class Entry:
    """One tensor of a file.

    Attributes:
        dtype: the format's name, a key of ITEM_BYTES.
        shape: its shape.
        begin, end: its bytes, counted from the end of the header.
    """

    dtype: str
    shape: tuple[int, ...]
    begin: int
    end: int


@dataclass(frozen=True)
class Header:
    """A header that fits its file.

    Attributes:
        raw: the file's bytes up to the first tensor.
        entries: the tensors by name, in the order of their bytes, which follow `raw` without a hole.
    """

    raw: bytes
    entries: Mapping[str, Entry]


@contextmanager
def opened(file: Path) -> Iterator[BufferedReader]:
    """The file, open for reading; what the system refuses, there or in the block, is a CheckpointError."""
    try:
        with file.open("rb") as stream:
            yield stream
    except OSError as error:
        raise CheckpointError(f"{file} cannot be read: {error.strerror}") from None


def read_header(stream: BinaryIO, called: str) -> Header:
    """Reads and checks the header; the stream is left at the first tensor.

    Args:
        stream: the file, at its beginning.
        called: its name in messages.

    Raises:
        CheckpointError: it is no safetensors file, or cut short, or contradicts itself.
    """
    size = stream.seek(0, 2)
    stream.seek(0)
    start = stream.read(64)
    if not start:
        raise CheckpointError(f"{called} is empty")
    length = int.from_bytes(start[:_LENGTH_BYTES], "little")
    # A header's length may begin like another format, but then a brace follows it.
    if start[_LENGTH_BYTES : _LENGTH_BYTES + 1] != b"{" or length > _MAX_HEADER_BYTES:
        raise CheckpointError(f"{called} is not a safetensors file{_other_format(start)}")
    if _LENGTH_BYTES + length > size:
        raise CheckpointError(f"{called} is cut short: it ends within its header")
    stream.seek(0)
    raw = stream.read(_LENGTH_BYTES + length)
    try:
        content = json.loads(raw[_LENGTH_BYTES:], object_pairs_hook=_without_repetition)
        content.pop("__metadata__", None)
        entries = {name: _entry(name, value) for name, value in content.items()}
    except (ValueError, RecursionError) as error:
        raise CheckpointError(f"{called} has a damaged safetensors header: {error}") from None
    _check_ranges(entries, size - len(raw), called)
    return Header(raw, dict(sorted(entries.items(), key=lambda item: item[1].begin)))


def check_fit(
    header: Header,
    expected: Mapping[str, tuple[tuple[int, ...], bool]],
    optional: Collection[str],
    ignored_prefixes: tuple[str, ...],
    who: str,
) -> None:
    """Raises CheckpointError, with everything that differs, unless the tensors are those expected.

    Args:
        header: of the file.
        expected: shape, and whether it is a floating-point number, by name.
        optional: names that may be missing.
        ignored_prefixes: a name that begins so may be surplus.
        who: begins the message: which file does not fit what.
    """
    entries = header.entries
    missing = [name for name in expected if name not in entries and name not in optional]
    surplus = [name for name in entries if name not in expected and not name.startswith(ignored_prefixes)]
    both = [(name, entries[name], *expected[name]) for name in expected if name in entries]
    misshapen = [f"{name} is {e.shape}, not {shape}" for name, e, shape, _ in both if e.shape != shape]
    mistyped = [f"{name} is {e.dtype}" for name, e, _, is_float in both if (e.dtype in FLOATS) != is_float]
    faults = [
        f"{len(names)} {what}: {_some(names)}"
        for names, what in (
            (missing, "missing"),
            (surplus, "surplus"),
            (misshapen, "of another shape"),
            (mistyped, "of another type"),
        )
        if names
    ]
    if faults:
        raise CheckpointError(f"{who}: of its tensors {'; '.join(faults)}")


def sha256_of(stream: BinaryIO, to: Callable[[bytes], object] | None = None) -> str:
    """SHA-256 of the rest of a stream, in hexadecimal digits; each block is also handed `to` a writer, if given."""
    digest = hashlib.sha256()
    while block := stream.read(_BLOCK_BYTES):
        digest.update(block)
        if to is not None:
            to(block)
    return digest.hexdigest()


def _other_format(start: bytes) -> str:
    return next((f": it is {what}" for magic, what in _OTHER_FORMATS if start.startswith(magic)), "")


def _without_repetition(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) != len(pairs):
        raise ValueError("a name occurs twice")
    return content


def _entry(name: str, value: Any) -> Entry:
    try:
        dtype, shape, (begin, end) = value["dtype"], tuple(value["shape"]), value["data_offsets"]
    except (KeyError, TypeError, ValueError):
        raise ValueError(f"{name} lacks its dtype, shape or offsets") from None
    if not isinstance(dtype, str) or dtype not in ITEM_BYTES:
        raise ValueError(f"{name} is of dtype {dtype}, which is not read")
    if not all(type(number) is int and number >= 0 for number in (*shape, begin, end)):
        raise ValueError(f"{name} has numbers that are none")
    if end - begin != math.prod(shape) * ITEM_BYTES[dtype]:
        raise ValueError(f"the bytes of {name} are not those of its shape")
    return Entry(dtype, shape, begin, end)


def _check_ranges(entries: Mapping[str, Entry], available: int, called: str) -> None:
    position = 0
    for begin, end in sorted((entry.begin, entry.end) for entry in entries.values()):
        if begin != position:
            raise CheckpointError(f"{called} has a damaged safetensors header: a gap or an overlap at byte {position}")
        position = end
    if position > available:
        raise CheckpointError(f"{called} is cut short: {available} of {position} bytes of tensors are there")
    if position < available:
        raise CheckpointError(f"{called} has {available - position} bytes after its tensors")


def _some(names: list[str]) -> str:
    shown = ", ".join(names[:_NAMES_SHOWN])
    return shown if len(names) <= _NAMES_SHOWN else f"{shown}, and {len(names) - _NAMES_SHOWN} more"
