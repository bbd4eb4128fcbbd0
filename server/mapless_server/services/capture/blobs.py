"""Photographs and features of references in a capture folder: what they take on the disk, and which calls need them.

A blob goes with the last call that needs it; one that cannot be deleted stays counted, and is tried again.
"""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from collections.abc import Collection
from contextlib import suppress
from functools import partial
from pathlib import Path

from .files import blobs_of, do_each, space_of, write_whole


class BlobLedger:
    """The blobs of a folder, by their paths; for one thread at a time.

    Attributes:
        space_bytes: what they take on the disk.
    """

    def __init__(self) -> None:
        self.space_bytes = 0
        self._space: dict[Path, int] = {}
        self._uses: Counter[Path] = Counter()
        self._unused: set[Path] = set()  # to be deleted
        self._unverified: set[Path] = set()  # of before: a power failure may have cut them

    def __contains__(self, path: Path) -> bool:
        return path in self._space

    def take_stock(self, folder: Path) -> None:
        """Enters all that are there; those that no call will need by then go with the first `sweep`."""
        for path in blobs_of(folder):
            self._enter(path, path.stat().st_size)
        self._unverified.update(self._space)
        self._unused.update(self._space)

    def space_of(self, path: Path) -> int:
        """What one takes; 0 if it is not there."""
        return self._space.get(path, 0)

    def write(self, path: Path, data: bytes) -> None:
        """Writes one that is needed; OSError as `write_whole`."""
        write_whole(path, data)
        self._enter(path, len(data))

    def is_intact(self, path: Path) -> bool:
        """Whether what lies there is what was written, as far as that is not known; not if it cannot be read."""
        if path in self._unverified:
            with suppress(OSError):
                if hashlib.sha256(path.read_bytes()).hexdigest() == path.name:
                    self._unverified.discard(path)
        return path not in self._unverified

    def deleted_by_hand(self) -> set[Path]:
        """Those that are there no more, although nobody asked for it."""
        return {path for path in self._space if not os.path.lexists(path)}

    def use(self, paths: Collection[Path]) -> None:
        """One more call needs them."""
        self._uses.update(list(paths))
        self._unused.difference_update(paths)

    def release(self, paths: Collection[Path]) -> None:
        """One call less needs them."""
        for path in paths:
            self._uses[path] -= 1
            if self._uses[path] <= 0:
                del self._uses[path]
                if path in self._space:
                    self._unused.add(path)

    def sweep(self) -> None:
        """Deletes those that no call needs, each that can be; OSError if there are some that cannot be."""
        do_each([partial(self._delete, it) for it in self._unused])

    def _enter(self, path: Path, size_bytes: int) -> None:
        self._space[path] = space_of(size_bytes)
        self.space_bytes += self._space[path]

    def _delete(self, path: Path) -> None:
        path.unlink(missing_ok=True)
        self._unused.discard(path)
        self._unverified.discard(path)
        self.space_bytes -= self._space.pop(path)
