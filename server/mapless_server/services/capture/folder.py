"""The folder of captured calls, with a limit of age and one of size; readable by its owner alone.

    mapless-capture.json            marks the folder as one of captured calls
    lock                            held by the server that writes
    tenants/{tenant}/calls/{scene}/{milliseconds}-{random}.call

A call's age is that of its name: what a file says, whether it is damaged, or when it was copied cannot prolong it. Nor
can setting the clock: a call also expires when its time has passed since it was written or found, by a clock that is
never set, and one that is more than a minute ahead of the clock has an unknown age, and is deleted. What version 0.3
left beside its calls (`tenants/{tenant}/blobs/`) is limited in the same way, by the times of its files.

Nothing outside the folder is read, written or deleted: a symbolic link in place of one of these folders is an error.
"""

import errno
import fcntl
import logging
import os
import re
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from uuid import uuid4

from .calls import CapturedCall, CaptureError, encode_call

log = logging.getLogger(__name__)

MARKER_FILE = "mapless-capture.json"
LOCK_FILE = "lock"
TENANTS = "tenants"
CALL_SUFFIX = ".call"
UNFINISHED_SUFFIX = ".tmp"

SCAN_S = 30.0
"""Period in which the folder is read anew: files may have been deleted by hand, or the clock set."""
_FUTURE_S = 60.0
"""A call that is further ahead of the clock than this was captured while the clock was wrong."""
_MIN_PAUSE_S = 0.01
_CALL_NAME = re.compile(r".*\.call(\.tmp)?")
_COPY_NAME = re.compile(r"[0-9a-f]{64}(\.tmp)?")
"""A copy of a reference that version 0.3 made."""
_BLOCK_BYTES = 4096
"""File systems allocate in blocks of this size."""


@dataclass(frozen=True)
class _File:
    """When it was written by the clock, Unix seconds, and when it expires by `time.monotonic`."""

    time_s: float
    deadline_s: float
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
        self._refuse_links(path)
        _write_whole(path, data)
        self._files[path] = self._file(call.time_s, disk_bytes)
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
        now_s, monotonic_s = self._clock(), time.monotonic()

        def left_s(file: _File) -> float:
            return min(file.time_s + self._keep_s - now_s, file.deadline_s - monotonic_s)

        for path, file in list(self._files.items()):
            if left_s(file) <= 0 or file.time_s > now_s + _FUTURE_S:
                self._remove(path)
        left = map(left_s, self._files.values())
        return min([SCAN_S, *(max(it, _MIN_PAUSE_S) for it in left if it > 0)])

    def _file(self, time_s: float, disk_bytes: int) -> _File:
        """A file that is seen for the first time now."""
        left_s = min(time_s + self._keep_s - self._clock(), self._keep_s)
        return _File(time_s, time.monotonic() + left_s, disk_bytes)

    def _scan(self) -> None:
        self._scanned_s = time.monotonic()
        found = {path: self._file(*_time_and_size(path)) for path in _files_of(self.path)}
        for path in found.keys() & self._files.keys():  # seen before
            found[path] = replace(found[path], deadline_s=self._files[path].deadline_s)
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
            self._refuse_links(path)
            path.unlink(missing_ok=True)
        except OSError as error:
            log.error("captured call %s cannot be deleted: %s", path, error)
            return
        self.disk_bytes -= self._files.pop(path).disk_bytes
        with suppress(OSError):  # other calls are in it
            path.parent.rmdir()

    def _refuse_links(self, path: Path) -> None:
        """OSError if a symbolic link stands in place of a folder on the way to a file; the folder itself may be one."""
        for place in path.parents:
            if place == self.path:
                return
            _refuse_link(place)

    def _open(self) -> None:
        """Creates the folder if it does not exist, locks and marks it; what is not ours is left as it was."""
        self.close()
        self.path.mkdir(mode=0o700, parents=True, exist_ok=True)
        is_marked = _is_marked(self.path)
        if not is_marked and _is_foreign(self.path):
            raise CaptureError(f"capture folder {self.path} holds something else; name an empty or a new one")
        if self.path.stat().st_mode & 0o077:
            self.path.chmod(0o700)
        self._lock = os.open(self.path / LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.close()
            message = f"capture folder {self.path} is in use by another server; each needs one of its own"
            raise CaptureError(message) from None
        if not is_marked:
            _write_whole(self.path / MARKER_FILE, b'{"format": 1}')

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


def _refuse_link(place: Path) -> None:
    if place.is_symlink():
        raise OSError(errno.ELOOP, "a symbolic link stands in place of a folder", str(place))


def _files_of(folder: Path) -> Iterator[Path]:
    """Yields the files that servers have written, none of others; OSError if a folder is a link or cannot be read."""
    for tenant in _folders_in(folder / TENANTS):
        for place in _folders_in(tenant):
            match place.name:
                case "calls":
                    for scene in _folders_in(place):
                        yield from _files_in(scene, _CALL_NAME)
                case "blobs":
                    yield from _files_in(place, _COPY_NAME)


def _folders_in(place: Path) -> Iterator[Path]:
    return (Path(it) for it in _entries(place) if it.is_dir())


def _files_in(place: Path, name: re.Pattern[str]) -> Iterator[Path]:
    return (Path(it) for it in _entries(place) if it.is_file(follow_symlinks=False) and name.fullmatch(it.name))


def _entries(place: Path) -> list[os.DirEntry[str]]:
    """Entries of a folder; none if it does not exist."""
    _refuse_link(place)
    try:
        with os.scandir(place) as entries:
            return list(entries)
    except FileNotFoundError:
        return []


def _is_marked(folder: Path) -> bool:
    """Whether a server has marked the folder; a marker may be empty after a power failure."""
    marker = folder / MARKER_FILE
    return marker.is_file() and marker.stat().st_size > 0


def _is_foreign(folder: Path) -> bool:
    """Whether a folder holds anything that no server has written; OSError if a part of it cannot be read."""
    names = {it.name for it in folder.iterdir()}
    if names - {MARKER_FILE, MARKER_FILE + UNFINISHED_SUFFIX, LOCK_FILE, TENANTS}:
        return True
    ours = set(_files_of(folder))

    def fail(error: OSError) -> None:
        raise error

    walk = os.walk(folder / TENANTS, onerror=fail) if TENANTS in names else ()
    found = (Path(place, it) for place, folders, files in walk for it in (*folders, *files))
    return any(it not in ours and (it.is_symlink() or not it.is_dir()) for it in found)


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
