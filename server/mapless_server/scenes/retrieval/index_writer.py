"""Writes the index file of a large scene, in memory that grows little with it.

References come in portions. Their rows and records are first written as they come, to temporary files; after the lists
are known, in the order of these. The file has another name until it is complete and on the disk.
"""

from __future__ import annotations

import fcntl
import mmap
import os
import shutil
import tempfile
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from mapless_server.store import IndexedReference

from .index_file import BLOCK_ROWS, CHECK, HEADER_BYTES, RECORD, Header, Identity, Part, name_hash
from .lists import ListOptions, nearest_lists, order_of, train
from .quantizing import quantized

Floats = NDArray[np.float32]

_ROWS_AT_A_TIME = 4096
_BYTES_BESIDE_ROW = 400
"""Space on the disk for a reference besides its row, while a file is made."""


class BeingMade(Exception):
    """Another server makes the same file at the moment."""


@dataclass(frozen=True)
class Making:
    """How a file is made.

    Attributes:
        options: see `ListOptions`.
        pause: called between short steps; may raise to give up.
    """

    options: ListOptions = field(default_factory=ListOptions)
    pause: Callable[[], None] = lambda: None


@dataclass(frozen=True, eq=False)
class Content:
    """The content from which an index is made.

    Attributes:
        identity, generation, last_change: see `Header`.
        portions: the references, at least one, in portions: those of the generation, and maybe of later ones.
        damaged_ids: ids of references that are left out; added to while portions are read.
    """

    identity: Identity
    generation: int
    last_change: str
    portions: Iterable[Sequence[IndexedReference]]
    damaged_ids: Collection[str] = ()


def write_index(path: Path, file: BinaryIO, content: Content, making: Making | None = None) -> None:
    """Writes an index to an unfinished file, which then replaces that of the path; OSError if it cannot be written."""
    making = making or Making()
    with ExitStack() as stack:
        rows, records = (stack.enter_context(tempfile.TemporaryFile(dir=path.parent)) for _ in range(2))
        spooled = _Spooled(content.identity.dimension, rows, records)
        for portion in content.portions:
            making.pause()
            spooled.add(portion)
        rows.flush()
        records.flush()
        _write(file, content, spooled, making)
    file.flush()
    os.fsync(file.fileno())
    os.replace(_unfinished(path), path)
    _sync_folder(path.parent)


def has_room(folder: Path, count: int, dimension: int) -> bool:
    """Whether the disk has room for making the index of so many references, and as much again for the store."""
    return shutil.disk_usage(folder).free > 4 * count * (dimension + _BYTES_BESIDE_ROW)


UNFINISHED = ".part"
"""Ending of the name of a file that is being made."""


@contextmanager
def unfinished(path: Path) -> Iterator[BinaryIO]:
    """An empty file for the index of a path, which one process has at a time; deleted at the end unless it is finished.

    BeingMade while another process has it; OSError if the folder is missing or cannot be written.
    """
    path = _unfinished(path)
    with open(os.open(path, os.O_RDWR | os.O_CREAT, 0o600), "r+b") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise BeingMade(str(path)) from error
        inode = os.fstat(file.fileno()).st_ino
        if not path.exists() or path.stat().st_ino != inode:  # another process has just renamed it
            raise BeingMade(str(path))
        file.truncate(0)
        try:
            yield file
        finally:
            if path.exists() and path.stat().st_ino == inode:
                path.unlink()


def _unfinished(path: Path) -> Path:
    return path.with_suffix(UNFINISHED)


@dataclass(eq=False)
class _Spooled:
    """References as they came: their rows (N, D) and records in files, the rest in portions."""

    dimension: int
    rows: BinaryIO
    records: BinaryIO
    inverse_norms: list[Floats] = field(default_factory=list)
    viewpoints: list[NDArray[np.float64]] = field(default_factory=list)
    id_hashes: list[NDArray[np.uint64]] = field(default_factory=list)
    key_hashes: list[NDArray[np.uint64]] = field(default_factory=list)
    sizes: list[NDArray[np.int64]] = field(default_factory=list)

    def add(self, references: Sequence[IndexedReference]) -> None:
        blank = np.zeros(self.dimension, np.float32)
        vectors = np.array([blank if it.descriptor is None else it.descriptor for it in references], np.float32)
        rows, norms = quantized(vectors)
        norms[[it.descriptor is None for it in references]] = np.nan
        records = list(map(_record, references))
        self.rows.write(rows.tobytes())
        self.records.write(b"".join(records))
        self.inverse_norms.append(norms)
        poses = [it.world_from_camera for it in references]
        self.viewpoints.append(np.array([[*it.translation, *it.rotation[:, 2]] for it in poses]))
        self.sizes.append(np.array(list(map(len, records))))
        self.id_hashes.append(np.array([name_hash(it.reference_id) for it in references], np.uint64))
        self.key_hashes.append(np.array([name_hash(it.key) for it in references], np.uint64))

    def take(self, rows: NDArray[np.intp]) -> NDArray[np.int8]:
        """Some rows (N, D)."""
        return np.memmap(self.rows, np.int8, "r").reshape(-1, self.dimension)[rows]

    def unit_rows(self, rows: NDArray[np.intp]) -> Floats:
        """The same as unit vectors (N, D); zeros for those without a descriptor."""
        norms = np.nan_to_num(np.concatenate(self.inverse_norms)[rows])
        return np.asarray(self.take(rows) * norms[:, None], np.float32)


def _record(reference: IndexedReference) -> bytes:
    name, rotation = reference.reference_id.encode(), reference.world_from_camera.rotation
    text = RECORD.pack(*rotation[:, 0], *rotation[:, 1], len(name)) + name + reference.key.encode()
    return text + CHECK.pack(zlib.crc32(text))


def _write(file: BinaryIO, content: Content, spooled: _Spooled, making: Making) -> None:
    """Writes the parts, and then the header, without which the file is no index."""
    sizes = np.concatenate(spooled.sizes)
    means, order, starts = _lists(spooled, len(sizes), making)
    writer = _Writer(file)
    writer.add("means", [means.tobytes()])
    writer.add("starts", [starts.tobytes()])
    writer.add("norms", [np.concatenate(spooled.inverse_norms)[order].tobytes()])
    checks = list[int]()
    writer.add("rows", _rows(spooled, order, checks, making.pause))
    writer.add("checks", [np.array(checks, np.uint32).tobytes()])
    viewpoints = np.concatenate(spooled.viewpoints)[order]
    writer.add("viewpoints", [viewpoints.tobytes()])
    for name, hashes in (("id", spooled.id_hashes), ("key", spooled.key_hashes)):
        ordered = np.concatenate(hashes)[order]
        by_hash = np.argsort(ordered, kind="stable")
        writer.add(f"{name}_hashes", [ordered[by_hash].tobytes()])
        writer.add(f"{name}_rows", [by_hash.astype(np.uint32).tobytes()])
    writer.add("places", [np.cumsum([0, *sizes[order]]).tobytes()])
    writer.add("records", _records(spooled, sizes, order, making.pause))
    writer.add("damaged", ["\n".join(sorted(content.damaged_ids)).encode()])
    file.seek(0)
    extent_m = float(np.linalg.norm(viewpoints[:, :3], axis=1).max())
    header = Header(content.identity, content.generation, content.last_change, len(sizes), extent_m, writer.parts)
    file.write(header.encode())


def _lists(spooled: _Spooled, count: int, making: Making) -> tuple[Floats, NDArray[np.intp], NDArray[np.int64]]:
    """Means of the lists, the order (N,) of the rows by lists, and where each begins (L + 1,)."""
    options, pause = making.options, making.pause
    list_count = options.list_count(count)
    sampled = np.unique(np.linspace(0, count - 1, min(count, options.sampled * list_count)).round().astype(np.intp))
    means = train(spooled.unit_rows(sampled), list_count, options.rounds, pause)
    nearest = (nearest_lists(spooled.unit_rows(rows), means, pause) for rows in _parts(np.arange(count)))
    return means, *order_of(nearest, len(means))


def _rows(spooled: _Spooled, order: NDArray[np.intp], checks: list[int], pause: Callable[[], None]) -> Iterator[bytes]:
    """The rows in an order, in parts of whole blocks; the blocks' checksums are added to `checks`."""
    for part in _parts(order):
        pause()
        rows, length = spooled.take(part).tobytes(), BLOCK_ROWS * spooled.dimension
        checks += [zlib.crc32(rows[i : i + length]) for i in range(0, len(rows), length)]
        yield rows


def _records(
    spooled: _Spooled, sizes: NDArray[np.int64], order: NDArray[np.intp], pause: Callable[[], None]
) -> Iterator[bytes]:
    """The records in an order; `sizes` are those of the records as they came."""
    ends = np.cumsum(sizes)
    with mmap.mmap(spooled.records.fileno(), 0, prot=mmap.PROT_READ) as records:
        for part in _parts(order):
            pause()
            ranges = zip((ends - sizes)[part].tolist(), ends[part].tolist(), strict=True)
            yield b"".join(records[first:last] for first, last in ranges)


def _parts(rows: NDArray[np.intp]) -> Iterator[NDArray[np.intp]]:
    for start in range(0, len(rows), _ROWS_AT_A_TIME):
        yield rows[start : start + _ROWS_AT_A_TIME]


class _Writer:
    """Writes parts one after the other, behind the room for the header."""

    def __init__(self, file: BinaryIO) -> None:
        self.parts: dict[str, Part] = {}
        self._file = file
        file.seek(HEADER_BYTES)

    def add(self, name: str, chunks: Iterable[bytes]) -> None:
        offset, size, check = self._file.tell(), 0, 0
        for data in chunks:
            size += self._file.write(data)
            check = zlib.crc32(data, check)
        self.parts[name] = Part(offset, size, check)


def _sync_folder(folder: Path) -> None:
    """Makes a new name in a folder last."""
    file = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(file)
    finally:
        os.close(file)
