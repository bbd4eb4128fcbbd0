"""The folder of captured calls, with a limit of age and one of size; readable by its owner alone.

    lock                            held by the server that writes
    tenants/{tenant}/calls/{scene}/{milliseconds}-{random}.call

A call's age is that of its name: what a file says, whether it is damaged, or when it was copied cannot prolong it. A
call that is ahead of the clock, which was set back since, has an unknown age, and is deleted. What version 0.3 left
beside its calls (`tenants/{tenant}/blobs/`) is limited in the same way, by the times of its files.
"""

import errno
import fcntl
import logging
import os
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from uuid import uuid4

from .calls import CapturedCall, CaptureError, encode_call

log = logging.getLogger(__name__)

LOCK_FILE = "lock"
TENANTS = "tenants"
CALL_SUFFIX = ".call"
UNFINISHED_SUFFIX = ".tmp"

SCAN_S = 30.0
"""Period in which the folder is read anew: files may have been deleted by hand, or the clock set."""
_FUTURE_S = 60.0
"""A call that is further ahead of the clock than this was captured while the clock was wrong."""
_MIN_PAUSE_S = 0.01
_BLOCK_BYTES = 4096
"""File systems allocate in blocks of this size."""


@dataclass(frozen=True)
class _File:
    time_s: float
    disk_bytes: int


def calls_of(folder: Path) -> list[Path]:
    """Files of calls, which are not checked, the oldest first; OSError if a folder cannot be read."""
    return sorted((it for it in _files_of(folder) if it.suffix == CALL_SUFFIX), key=lambda it: it.name)


class CaptureFolder:
    """The captured calls of one server; for one thread, except for `disk_bytes`."""

    def __init__(self, path: Path, keep_s: float, max_bytes: int, clock: Callable[[], float] = time.time) -> None:
        """Opens and locks the folder, creates it if it does not exist, and applies the limits to what is in it.

        Calls older than `keep_s` are deleted; all files together take at most `max_bytes`, in whole blocks of the disk.
        CaptureError if the folder cannot be read or written, has other files, or is in use.
        """
        self.path = path
        self.disk_bytes = 0
        self._keep_s = keep_s
        self._max_bytes = max_bytes
        self._clock = clock
        self._files: dict[Path, _File] = {}  # the oldest first
        self._scanned_s = 0.0
        self._lock = -1
        try:
            self._open()
            self._scan()
            self.tidy()
            self._make_room(0)
        except OSError as error:
            self.close()
            what = f"{error.filename or path}: {error.strerror or error}"
            raise CaptureError(f"capture folder {path} cannot be used: {what}") from error

    def close(self) -> None:
        """Releases the lock."""
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1

    def add(self, call: CapturedCall) -> bool:
        """Writes a call, after deleting as many of the oldest ones as it needs room.

        Its tenant and scene are valid names. Returns whether the call was written: one that exceeds the limit alone is
        not, and nothing is deleted for it. OSError if it cannot be written, for example because the disk is full, and
        no part of it is left; CaptureError if the folder was deleted by hand, and another server uses it now.
        """
        data = encode_call(call)
        disk_bytes = _disk_bytes(len(data))
        if disk_bytes > self._max_bytes:
            return False
        if not self._is_locked():
            self._open()
        self._make_room(disk_bytes)
        name = f"{round(1e3 * call.time_s):014d}-{uuid4().hex}{CALL_SUFFIX}"
        path = self.path / TENANTS / call.tenant / "calls" / call.scene_id / name
        _write_whole(path, data)
        self._files[path] = _File(call.time_s, disk_bytes)
        self.disk_bytes += disk_bytes
        return True

    def tidy(self) -> float:
        """Deletes calls that are too old, or whose age is unknown; returns the seconds until it is to be done again.

        What cannot be read or deleted is logged; a file that cannot be deleted stays counted.
        """
        if time.monotonic() - self._scanned_s >= SCAN_S:
            try:
                self._scan()
            except OSError as error:
                log.error("captured calls in %s cannot be read: %s", error.filename or self.path, error.strerror)
        now_s = self._clock()
        for path, file in list(self._files.items()):
            if not now_s - self._keep_s < file.time_s <= now_s + _FUTURE_S:
                self._remove(path)
        left = [it.time_s + self._keep_s - now_s for it in self._files.values()]
        return min([SCAN_S, *(max(it, _MIN_PAUSE_S) for it in left if it > 0)])

    def _scan(self) -> None:
        self._scanned_s = time.monotonic()
        found = {path: _File(*_time_and_size(path)) for path in _files_of(self.path)}
        self._files = dict(sorted(found.items(), key=lambda it: it[1].time_s))
        self.disk_bytes = sum(it.disk_bytes for it in found.values())

    def _make_room(self, wanted_bytes: int) -> None:
        """Deletes the oldest files until this many bytes fit; OSError if files that cannot be deleted prevent it."""
        for path in list(self._files):
            if self.disk_bytes + wanted_bytes <= self._max_bytes:
                return
            self._remove(path)
        if self.disk_bytes + wanted_bytes > self._max_bytes:
            raise OSError(errno.ENOSPC, "what cannot be deleted leaves no room within the limit", str(self.path))

    def _remove(self, path: Path) -> None:
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            log.error("captured call %s cannot be deleted: %s", path, error)
            return
        self.disk_bytes -= self._files.pop(path).disk_bytes
        with suppress(OSError):  # other calls are in it
            path.parent.rmdir()

    def _open(self) -> None:
        """Creates the folder if it does not exist, and locks it."""
        self.close()
        self.path.mkdir(mode=0o700, parents=True, exist_ok=True)
        names = {it.name for it in self.path.iterdir()}
        if TENANTS not in names and names - {LOCK_FILE, "mapless-capture.json"}:  # a file of version 0.3
            raise CaptureError(f"capture folder {self.path} holds something else; name an empty or a new one")
        if self.path.stat().st_mode & 0o077:
            self.path.chmod(0o700)
        self._lock = os.open(self.path / LOCK_FILE, os.O_RDWR | os.O_CREAT, 0o600)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.close()
            message = f"capture folder {self.path} is in use by another server; each needs one of its own"
            raise CaptureError(message) from None

    def _is_locked(self) -> bool:
        """Whether our lock is that of the folder, not of one that was deleted by hand."""
        try:
            return self._lock >= 0 and os.path.samestat(os.fstat(self._lock), os.lstat(self.path / LOCK_FILE))
        except FileNotFoundError:
            return False


def _disk_bytes(size_bytes: int) -> int:
    """The size of a file on the disk, in whole blocks."""
    return -(-size_bytes // _BLOCK_BYTES) * _BLOCK_BYTES


def _time_and_size(path: Path) -> tuple[float, int]:
    """When a file was written, Unix seconds, and its size on the disk; the time is 0 if it was left unfinished."""
    status = path.lstat()
    digits = path.name.partition("-")[0]
    time_s = int(digits) / 1e3 if path.suffix == CALL_SUFFIX and digits.isdecimal() else status.st_mtime
    return 0.0 if path.suffix == UNFINISHED_SUFFIX else time_s, _disk_bytes(status.st_size)


def _files_of(folder: Path) -> Iterator[Path]:
    """Yields the files that servers have written, none of others; OSError if a folder cannot be read."""

    def fail(error: OSError) -> None:
        if not isinstance(error, FileNotFoundError):
            raise error

    for place, _, names in os.walk(folder / TENANTS, onerror=fail, followlinks=True):
        match Path(place).relative_to(folder / TENANTS).parts:
            case (_, "calls", _):
                suffixes = (CALL_SUFFIX, CALL_SUFFIX + UNFINISHED_SUFFIX)
                yield from (Path(place, it) for it in names if it.endswith(suffixes))
            case (_, "blobs"):
                yield from (Path(place, it) for it in names if len(it.partition(".")[0]) == 64)


def _write_whole(path: Path, data: bytes) -> None:
    """Writes a file so that no reader ever sees a part of it.

    The file is not synchronized to the disk: after a power failure it may be empty or cut, which its checksum reveals.
    """
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    unfinished = path.with_name(path.name + UNFINISHED_SUFFIX)
    try:
        descriptor = os.open(unfinished, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW, 0o600)
        with open(descriptor, "wb") as file:
            file.write(data)
        unfinished.replace(path)
    except BaseException:
        unfinished.unlink(missing_ok=True)
        raise
