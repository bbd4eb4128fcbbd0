"""The index of a large scene in a file: parts that are read when they are needed, and verified whenever they are read.

A file is never changed: it is the scene at one generation, and what has changed since is held in memory (`index`). It
begins with a header in JSON, with the scene, the descriptor and, for each part, its place, length and checksum:

means, starts       the lists of similar rows, and where each begins; read when the file is opened
norms, checks       inverse norms, NaN for rows without a descriptor, and checksums of `BLOCK_ROWS` rows; so, too
rows                descriptors as 8-bit integers, list after list; blocks are read for a search
viewpoints          camera centres and optical axes; read whole by the first search
id_*, key_*         hashes, sorted, and their rows; read whole when a reference is first looked up by id or key
places, records     where each record begins, and the records: the rest of the pose, id and key, a checksum
damaged             ids of references that are left out because they are damaged in the store

Nothing is mapped into memory: a disk that fails then raises an error, instead of ending the process; and memory does
not grow with the rows, which the operating system caches as far as there is room.
"""

from __future__ import annotations

import json
import os
import struct
import sys
import weakref
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from hashlib import blake2b
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform
from mapless_server.errors import Unavailable

from .lists import inverse_lengths
from .quantizing import CHUNK_BYTES, Vector, products

Scalar = TypeVar("Scalar", bound=np.generic)

MAGIC = f"mapless index {sys.byteorder[:3]}".encode()
VERSION = 1
"""Version of the layout. A file of another one is not read, but made again."""

BLOCK_ROWS = 8
"""Rows with a common checksum. More are verified faster one after the other; fewer, where single rows are wanted."""

PREFIX = struct.Struct("<17sHII")
"""Magic, version, length of the JSON and its CRC-32."""
RECORD = struct.Struct("<6dH")
"""The first two columns of a rotation, and the length of the id; id, key and CRC-32 follow."""
CHECK = struct.Struct("<I")

HEADER_BYTES = 4096
"""Room for the header, which is written last."""


class NotThisIndex(Exception):
    """A file is not the index that is wanted: it is of another version, scene or descriptor, damaged or incomplete."""


class IndexDamaged(Unavailable):
    """A part of an open index file is damaged. The file is not used any more; another attempt does without it."""


@dataclass(frozen=True)
class Identity:
    """The scene and the descriptor that an index is of.

    Attributes:
        store: hash of the database's name.
        scene: key of the scene.
        create_time_us: when it was created, microseconds since 1970; another scene of the same key has another.
        descriptor: name of the global descriptor.
        dimension: D, its length.
    """

    store: str
    scene: str
    create_time_us: int
    descriptor: str
    dimension: int

    def file_name(self) -> str:
        """Name of the scene's file: the same for all versions, and for a scene that is created again."""
        text = "\n".join((self.store, self.scene, self.descriptor))
        return f"{blake2b(text.encode(), digest_size=16).hexdigest()}.index"


@dataclass(frozen=True)
class Part:
    """A part's place in the file, bytes, and its CRC-32; rows and records are verified by others, of smaller pieces."""

    offset: int
    size: int
    check: int


@dataclass(frozen=True)
class Header:
    """The beginning of a file.

    Attributes:
        identity: what the file is of.
        generation: generation of the scene that is in the file; some later changes may be in it, too.
        last_change: key of the reference that was added or deleted last until then, see `IndexState`.
        count: N, number of rows.
        extent_m: distance of the furthest camera from the world's origin.
        parts: by name.
    """

    identity: Identity
    generation: int
    last_change: str
    count: int
    extent_m: float
    parts: Mapping[str, Part]

    def encode(self) -> bytes:
        """The header as it stands in the file; ValueError if there is no room for it."""
        text = json.dumps(asdict(self)).encode()
        if PREFIX.size + len(text) > HEADER_BYTES:
            raise ValueError(f"the header of an index has at most {HEADER_BYTES} bytes, not {PREFIX.size + len(text)}")
        return PREFIX.pack(MAGIC, VERSION, len(text), zlib.crc32(text)) + text

    @staticmethod
    def read(file: int) -> Header:
        """Reads the header of an open file; NotThisIndex if it is none of this version, or damaged."""
        prefix = os.pread(file, PREFIX.size, 0)
        if len(prefix) < PREFIX.size or not prefix.startswith(MAGIC):
            raise NotThisIndex("it is no index")
        _, version, length, check = PREFIX.unpack(prefix)
        if version != VERSION:
            raise NotThisIndex(f"it has version {version}, not {VERSION}")
        text = os.pread(file, length, PREFIX.size)
        if zlib.crc32(text) != check:
            raise NotThisIndex("its header is damaged")
        content = json.loads(text)
        parts = {name: Part(**part) for name, part in content["parts"].items()}
        return Header(**content | {"identity": Identity(**content["identity"]), "parts": parts})


def _end(header: Header) -> int:
    return max(it.offset + it.size for it in header.parts.values())


class IndexFile:
    """An open file; thread-safe. Rows are numbered in their order in the file.

    Methods raise IndexDamaged if what they read is damaged or cannot be read; `is_damaged` is True from then on.

    Attributes:
        path: the file.
        header: its header.
        means, inverse_lengths: (L, D), of the unit vectors of each list, and (L,), see `lists`.
        starts: (L + 1,), first row of each list, and the number of rows.
        inverse_norms: (N,), see `quantizing`; NaN for a row without a descriptor.
        made_time_s: when it was made, Unix seconds.
        damaged_ids: ids of references that are left out because they are damaged in the store.
        is_damaged: whether damage of the file was found.
    """

    def __init__(self, path: Path, identity: Identity) -> None:
        """Opens a file; NotThisIndex if it is not that of the identity, or cannot be used; OSError if there is none."""
        self.path = path
        self.is_damaged = False
        self._file = os.open(path, os.O_RDONLY)
        weakref.finalize(self, os.close, self._file)
        self.made_time_s = os.fstat(self._file).st_mtime
        self.header = Header.read(self._file)
        if self.header.identity != identity:
            raise NotThisIndex("it is of another scene, store or descriptor")
        if os.fstat(self._file).st_size != _end(self.header):
            raise NotThisIndex("it has another length than was written")
        try:
            self.means = self._part("means", np.float32).reshape(-1, identity.dimension)
            self.starts, self.inverse_norms = self._part("starts", np.int64), self._part("norms", np.float32)
            self._checks = self._part("checks", np.uint32).tolist()
            self.inverse_lengths = inverse_lengths(self.means)
            self.damaged_ids = frozenset(bytes(self._part("damaged", np.uint8)).decode().split())
        except IndexDamaged as error:
            raise NotThisIndex(str(error)) from error

    def __len__(self) -> int:
        return self.header.count

    @property
    def size_bytes(self) -> int:
        """Size of the file, bytes."""
        return _end(self.header)

    @property
    def memory_bytes(self) -> int:
        """Memory of the parts that have been read, bytes."""
        lazy = (self.__dict__.get(name) for name in ("viewpoints", "_places", "_ids", "_keys"))
        arrays = [it for part in lazy if part is not None for it in (part if isinstance(part, tuple) else (part,))]
        held = (self.means, self.starts, self.inverse_norms, *arrays)
        return sum(int(it.nbytes) for it in held) + 40 * len(self._checks)

    @cached_property
    def viewpoints(self) -> Array:
        """(N, 6), camera centre, world, metres, and optical axis, unit length, of each row."""
        return self._part("viewpoints", np.float64).reshape(-1, 6)

    def products(self, vector: Vector, rows: NDArray[np.intp]) -> NDArray[np.float32]:
        """Products (N,) of a vector (D,) with rows (N,), ascending."""
        found = np.empty(len(rows), np.float32)
        for first, last, wanted in self._pieces(rows):
            found[wanted] = products(self._read_rows(first, last), vector)[rows[wanted] - first]
        return found

    def row(self, row: int) -> NDArray[np.int8]:
        """The 8-bit integers (D,) of a row."""
        first = row // BLOCK_ROWS * BLOCK_ROWS
        rows = self._read_rows(first, min(first + BLOCK_ROWS, len(self)))
        return np.asarray(rows[row - first])

    def reference(self, row: int) -> tuple[str, str, RigidTransform]:
        """Id, key and world_from_camera of a row."""
        first, last = self._places[row : row + 2].tolist()
        record = self._read("records", first, last - first)
        text, check = record[: -CHECK.size], CHECK.unpack(record[-CHECK.size :])
        if check != (zlib.crc32(text),):
            raise self._damaged(f"record {row}")
        columns, length = RECORD.unpack_from(text)[:6], RECORD.unpack_from(text)[6]
        viewpoint = self.viewpoints[row]
        rotation = np.column_stack((np.reshape(columns, (2, 3)).T, viewpoint[3:]))
        names = text[RECORD.size :]
        return names[:length].decode(), names[length:].decode(), RigidTransform(rotation, viewpoint[:3].copy())

    def find_id(self, reference_id: str) -> int | None:
        """The row of an id; None if the file has none."""
        return next((row for row in _find(self._ids, reference_id) if self.reference(row)[0] == reference_id), None)

    def find_key(self, key: str) -> int | None:
        """The row of a key; None if the file has none."""
        return next((row for row in _find(self._keys, key) if self.reference(row)[1] == key), None)

    @cached_property
    def _places(self) -> NDArray[np.int64]:
        return self._part("places", np.int64)

    @cached_property
    def _ids(self) -> _Hashed:
        return self._part("id_hashes", np.uint64), self._part("id_rows", np.uint32)

    @cached_property
    def _keys(self) -> _Hashed:
        return self._part("key_hashes", np.uint64), self._part("key_rows", np.uint32)

    def _pieces(self, rows: NDArray[np.intp]) -> Iterator[tuple[int, int, slice]]:
        """Ranges of whole blocks to read for rows, with which of `rows` each serves; at most a chunk's length."""
        if not len(rows):
            return
        longest = max(1, CHUNK_BYTES // (4 * BLOCK_ROWS * self.header.identity.dimension))
        blocks = rows // BLOCK_ROWS
        begins = np.flatnonzero(np.diff(blocks, prepend=-2) > 1).tolist()
        for begin, end in zip(begins, [*begins[1:], len(rows)], strict=True):
            while begin < end:
                first = int(blocks[begin])
                stop = begin + int(np.searchsorted(blocks[begin:end], first + longest))
                last = min((int(blocks[stop - 1]) + 1) * BLOCK_ROWS, len(self))
                yield first * BLOCK_ROWS, last, slice(begin, stop)
                begin = stop

    def _read_rows(self, first: int, last: int) -> NDArray[np.int8]:
        """Rows (N, D) from the first of a block to the last of one, verified."""
        dimension = self.header.identity.dimension
        data = memoryview(self._read("rows", first * dimension, (last - first) * dimension))
        length, checks = BLOCK_ROWS * dimension, self._checks
        for i, block in enumerate(range(first // BLOCK_ROWS, -(-last // BLOCK_ROWS))):
            if zlib.crc32(data[i * length : (i + 1) * length]) != checks[block]:
                raise self._damaged(f"block {block} of the rows")
        return np.frombuffer(data, np.int8).reshape(-1, dimension)

    def _part(self, name: str, kind: type[Scalar]) -> NDArray[Scalar]:
        """Reads the numbers of a part, verified."""
        part = self.header.parts[name]
        data = self._read(name, 0, part.size)
        if zlib.crc32(data) != part.check:
            raise self._damaged(name)
        return np.frombuffer(data, kind)

    def _read(self, name: str, start: int, length: int) -> bytes:
        """Reads bytes of a part, not verified."""
        part = self.header.parts[name]
        try:
            data = os.pread(self._file, length, part.offset + start)
        except OSError as error:
            raise self._damaged(f"{name}: {error.strerror}") from error
        if len(data) != length:
            raise self._damaged(name)
        return data

    def _damaged(self, what: str) -> IndexDamaged:
        self.is_damaged = True
        scene = self.header.identity.scene
        return IndexDamaged(f"the index of scene {scene!r} is damaged ({what}) and is made again", retry_after_s=0.1)


_Hashed = tuple[NDArray[np.uint64], NDArray[np.uint32]]
"""Hashes, sorted, and the row of each."""


def name_hash(name: str) -> int:
    """Hash of an id or key, 64 bits."""
    return int.from_bytes(blake2b(name.encode(), digest_size=8).digest(), "little")


def _find(hashed: _Hashed, name: str) -> list[int]:
    """Rows of the names with the same hash."""
    hashes, rows = hashed
    wanted = np.uint64(name_hash(name))
    first, last = np.searchsorted(hashes, wanted), np.searchsorted(hashes, wanted, side="right")
    return list(map(int, rows[first:last]))
