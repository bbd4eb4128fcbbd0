"""Disk space that a data folder keeps for deleting: on a full disk SQLite's journal has no room for what it deletes.

Deleted photographs are overwritten, so that deleting writes as much to the journal as it deletes. Without a reserve a
disk that the store itself has filled could not be emptied by deleting.
"""

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

RESERVE_FILE = "mapless.reserve"
RESERVE_BYTES = 8 * 2**20
"""Twice what a portion of a deleted scene needs; a reference with its photograph is seldom larger."""
LARGEST_SHARE = 8
"""At most an eighth of the free space is kept: on a small disk most of it is for references."""


class Reserve:
    """A file without contents that keeps disk space. Never raises: where there is none to keep, there is no reserve."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / RESERVE_FILE
        self._in_use = threading.Lock()

    def keep(self) -> None:
        """Keeps the space, or as much as the disk can spare."""
        self._grow(min(RESERVE_BYTES, self._kept_bytes() + self._free_bytes() // LARGEST_SHARE))

    @contextmanager
    def used(self) -> Iterator[None]:
        """The space is free within the block, for one thread after the other; after it what is left is kept again."""
        with self._in_use:
            kept_bytes = self._kept_bytes()
            with suppress(OSError):
                self._path.unlink(missing_ok=True)
            try:
                yield
            finally:
                self._grow(min(kept_bytes, self._free_bytes()))

    def _grow(self, wanted_bytes: int) -> None:
        if wanted_bytes <= self._kept_bytes():
            return
        with suppress(OSError):
            file = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o600)
            try:
                os.posix_fallocate(file, 0, wanted_bytes)
            finally:
                os.close(file)

    def _kept_bytes(self) -> int:
        with suppress(OSError):
            return self._path.stat().st_size
        return 0

    def _free_bytes(self) -> int:
        with suppress(OSError):
            disk = os.statvfs(self._path.parent)
            return disk.f_bavail * disk.f_frsize
        return 0
