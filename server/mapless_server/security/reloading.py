"""Reads files again when they change, while the server runs; the old values stay in use if that fails."""

import asyncio
import logging
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Generic, TypeVar

log = logging.getLogger(__name__)

CHECK_INTERVAL_S = 1.0
"""A revoked token is accepted for this long; a check costs one stat of each file."""

T = TypeVar("T")
Stamp = tuple[tuple[int, int, int, int], ...]


class SecurityError(Exception):
    """A file cannot be used, or a token cannot be created; the message is one sentence for the operator."""


class Reloading(Generic[T]):
    """A value that is read from files; `value` may be read from any thread and never waits."""

    def __init__(self, paths: Sequence[Path], read: Callable[[], T], what: str) -> None:
        """Reads the files; SecurityError if one is missing or wrong. `what` names the value in the log, "tokens"."""
        self._paths = tuple(paths)
        self._read = read
        self._what = what
        self._last_error = ""
        self._stamp, self._value = self._load()

    @property
    def value(self) -> T:
        """The value of the newest files that could be read."""
        return self._value

    def refresh(self) -> bool:
        """Reads the files if they have changed, and returns whether the value is new.

        An error is logged once, and the files are read again by every call: files that are replaced one after the other
        do not fit together until the last one is. One thread at a time.
        """
        try:
            if self._stamp_files() == self._stamp:
                return False
            self._stamp, self._value = self._load()
        except SecurityError as error:
            if str(error) != self._last_error:
                log.error("%s; the %s read before stay in use", error, self._what)
            self._last_error = str(error)
            return False
        self._last_error = ""
        log.info("the %s have changed and are in use", self._what)
        return True

    def _load(self) -> tuple[Stamp, T]:
        # The stamp is taken first, so that a file that changes while it is read is read again.
        return self._stamp_files(), self._read()

    def _stamp_files(self) -> Stamp:
        try:
            found = [os.stat(path) for path in self._paths]
        except OSError as error:
            raise SecurityError(f"{error.filename}: {error.strerror}") from error
        return tuple((it.st_ino, it.st_size, it.st_mtime_ns, it.st_ctime_ns) for it in found)


async def keep_fresh(refreshes: Sequence[Callable[[], bool]]) -> None:
    """Calls each `refresh` in a thread, until it is cancelled, so that the event loop never waits for the disk."""
    while True:
        await asyncio.sleep(CHECK_INTERVAL_S)
        for refresh in refreshes:
            await asyncio.to_thread(refresh)


def read_file(path: Path) -> bytes:
    """A file's bytes; SecurityError if it cannot be read."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise SecurityError(f"{path}: {error.strerror}") from error
