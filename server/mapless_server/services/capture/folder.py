"""Captured calls in a folder, with a limit of age and one of size, which always hold while the server runs.

A call expires by the clock, or when its time has passed since it was written or found, whichever is earlier: setting
the clock cannot prolong it. `expire` deletes expired calls; `_make_room` deletes the oldest before a file is
written. A file that cannot be deleted stays counted, and is tried again. Opening a folder deletes every call that
is damaged, incomplete or outside the limits. Methods may be called from any thread.
"""

import errno
import logging
import os
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from mapless_server.bounds import check_bounds
from mapless_server.security import SceneKey, key_of

from .calls import BlobDeleted, CapturedCall, CaptureError, DamagedCapture, decode_call, encode_call
from .files import (
    BlobLedger,
    blob_path,
    call_path,
    calls_of,
    disk_bytes,
    do_each,
    foreign_in,
    is_locked_by,
    open_folder,
    unfinished_in,
    write_whole,
)

log = logging.getLogger(__name__)

_FUTURE_S = 60.0
"""A call that is further ahead of the clock than this was captured while the clock was wrong."""


@dataclass(frozen=True)
class Retention:
    """Limits of a folder: the age at which a call is deleted, and the size of all files together.

    The size is in whole blocks of the disk.
    """

    keep_s: float
    max_bytes: int

    def __post_init__(self) -> None:
        check_bounds(self, "keep_s max_bytes", above=0)


@dataclass(frozen=True, eq=False)
class CapturedEntry:
    """A captured call in the folder: its file and size, its references' ids and keys, the blobs that it needs.

    The time of the scene's creation, Unix microseconds, distinguishes scenes of one name. The call is deleted at
    `expiry_s`, Unix seconds; `expiry_monotonic_s` is the same time by `time.monotonic`.
    """

    path: Path
    scene_key: SceneKey
    scene_created_us: int
    references: frozenset[tuple[str, str]]
    blobs: frozenset[Path]
    disk_bytes: int
    expiry_s: float
    expiry_monotonic_s: float

    def remaining_s(self, now_s: float, monotonic_s: float) -> float:
        """Time until it expires; 0 or less if it has."""
        return min(self.expiry_s - now_s, self.expiry_monotonic_s - monotonic_s)


class CaptureFolder:
    """The captured calls of one server."""

    def __init__(self, path: Path, retention: Retention, clock: Callable[[], float] = time.time) -> None:
        """Opens and locks the folder, creates it if it does not exist, and applies the limits to what is in it.

        CaptureError as in `files.open_folder`, or if a file in the folder cannot be read or deleted.
        """
        self.path = path
        self._retention = retention
        self._clock = clock
        self._guard = threading.RLock()
        self._lock = open_folder(path)
        self._calls: OrderedDict[Path, CapturedEntry] = OrderedDict()  # the oldest first
        self._calls_bytes = 0
        self._blobs = BlobLedger()
        self._number = 0
        try:
            self._load()
        except OSError as error:
            self.close()
            what = f"{error.filename or path}: {error.strerror or error}"
            raise CaptureError(f"capture folder {path} cannot be used: {what}") from error
        except BaseException:
            self.close()
            raise

    @property
    def disk_bytes(self) -> int:
        """Size of its calls and blobs on the disk."""
        return self._calls_bytes + self._blobs.disk_bytes

    def close(self) -> None:
        """Releases the lock."""
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1

    def entries(self) -> list[CapturedEntry]:
        """Returns all calls, the oldest first."""
        with self._guard:
            return list(self._calls.values())

    def has_blob(self, tenant: str, sha256: str) -> bool:
        """Whether the folder has an intact blob; a damaged one is deleted, with the calls that need it."""
        path = blob_path(self.path, tenant, sha256)
        with self._guard:
            if not self._blobs.is_intact(path):
                log.warning("captured blob %s is damaged, and is deleted with the calls that need it", path.name)
                self.remove_all([it for it in self._calls.values() if path in it.blobs])
            return path in self._blobs

    def add(self, call: CapturedCall, blobs: Mapping[str, bytes]) -> bool:
        """Writes a call, after deleting as many of the oldest ones as it needs room.

        Its tenant and scene are valid names. The blobs, by SHA-256, are those that the folder lacks. Returns whether
        the call was written: one that exceeds the limit alone is not, and nothing is deleted for it. OSError if it
        cannot be written, for example because the disk is full, and no part of it is left; BlobDeleted if a blob that
        the folder had was deleted meanwhile, so that the call's blobs must be collected again; CaptureError if the
        folder was deleted by hand, and another server uses it now.
        """
        data = encode_call(call)
        with self._guard:
            self._reopen_if_deleted()
            needed = {blob_path(self.path, call.tenant, name): name for name in call.blobs}
            missing = [path for path in needed if path not in self._blobs]
            if any(needed[path] not in blobs for path in missing):
                raise BlobDeleted
            new_bytes = disk_bytes(len(data)) + sum(disk_bytes(len(blobs[needed[path]])) for path in missing)
            if new_bytes + sum(map(self._blobs.disk_bytes_of, needed)) > self._retention.max_bytes:
                return False
            self._blobs.use(needed)  # before room is made, so that none of them is deleted
            try:
                self._make_room(new_bytes)
                for path in missing:
                    self._blobs.write(path, blobs[needed[path]])
                path = self._new_path(call)
                write_whole(path, data)
            except BaseException:
                self._blobs.release(needed)
                with suppress(OSError):  # what is left is tried again
                    self._blobs.sweep()
                raise
            self._enter(self._entry(path, call, len(data)))
            return True

    def expire(self) -> float:
        """Deletes expired calls; returns the seconds until the next one expires, or the limit of time if there is none.

        OSError if a file cannot be deleted; all others are deleted, and it is tried again next time.
        """
        with self._guard:
            now_s, monotonic_s = self._clock(), time.monotonic()
            self.remove_all([it for it in self._calls.values() if it.remaining_s(now_s, monotonic_s) <= 0])
            remaining_s = (it.remaining_s(now_s, monotonic_s) for it in self._calls.values())
            return min(remaining_s, default=self._retention.keep_s)

    def forget_deleted(self) -> None:
        """Removes calls of which a file was deleted by hand, with their other files; OSError as in `remove_all`."""
        with self._guard:
            missing = self._blobs.missing()
            entries = self._calls.values()
            self.remove_all([it for it in entries if it.blobs & missing or not os.path.lexists(it.path)])

    def remove_all(self, entries: Collection[CapturedEntry]) -> None:
        """Deletes calls and the blobs that no other call needs; finally raises OSError if one could not be deleted."""
        with self._guard:
            do_each([*(partial(self._remove, it) for it in entries), self._blobs.sweep])

    def _load(self) -> None:
        foreign = sum(1 for _ in foreign_in(self.path))
        if foreign:
            log.warning("capture folder %s: %d files are not ours, and left alone", self.path, foreign)
        for path in list(unfinished_in(self.path)):
            path.unlink()
        self._blobs.load(self.path)
        found = [it for path in list(calls_of(self.path)) if (it := self._read(path)) is not None]
        for entry in sorted(found, key=lambda it: (it.expiry_s, it.path.name)):
            self._blobs.use(entry.blobs)
            self._enter(entry)
        self._blobs.sweep()
        self.expire()
        self._make_room(0)

    def _read(self, path: Path) -> CapturedEntry | None:
        """Returns the call of a file; a damaged file is deleted, and None is returned."""
        try:
            if path.stat().st_size > self._retention.max_bytes:
                raise DamagedCapture("it is larger than all calls may be")
            data = path.read_bytes()
            call = decode_call(data)
            if path.parent != call_path(self.path, call.tenant, call.scene_id, "").parent:
                raise DamagedCapture("it belongs to another tenant or scene than its folder")
            if call.time_s > self._clock() + _FUTURE_S:
                raise DamagedCapture("it was captured later than now")  # so nothing would limit its time
            entry = self._entry(path, call, len(data))
            if not all(it in self._blobs for it in entry.blobs):
                raise DamagedCapture("one of its blobs is missing")
            return entry
        except DamagedCapture as error:
            log.warning("captured call %s is deleted: %s", path.name, error)
            path.unlink()
            return None
        except CaptureError as error:
            raise CaptureError(f"captured call {path} cannot be used: {error}") from error

    def _entry(self, path: Path, call: CapturedCall, size_bytes: int) -> CapturedEntry:
        keep_s = self._retention.keep_s
        expiry_s = call.time_s + keep_s
        return CapturedEntry(
            path,
            key_of(call.tenant, call.scene_id),
            call.scene_created_us,
            call.keys,
            frozenset(blob_path(self.path, call.tenant, name) for name in call.blobs),
            disk_bytes(size_bytes),
            expiry_s,
            time.monotonic() + min(expiry_s - self._clock(), keep_s),
        )

    def _reopen_if_deleted(self) -> None:
        """Creates and locks the folder again if it was deleted by hand."""
        if not is_locked_by(self.path, self._lock):
            lock = open_folder(self.path)
            os.close(self._lock)
            self._lock = lock
            self.forget_deleted()

    def _new_path(self, call: CapturedCall) -> Path:
        """Path for a new call; an earlier server may have used the name, if the clock was set back since."""
        while True:
            self._number += 1
            name = f"{round(1e3 * call.time_s):014d}-{os.getpid()}-{self._number}"
            path = call_path(self.path, call.tenant, call.scene_id, name)
            if path not in self._calls and not os.path.lexists(path):
                return path

    def _enter(self, entry: CapturedEntry) -> None:
        self._calls[entry.path] = entry
        self._calls_bytes += entry.disk_bytes

    def _make_room(self, wanted_bytes: int) -> None:
        """Deletes the oldest calls until this many bytes fit; OSError if files that cannot be deleted prevent it."""
        for entry in self.entries():
            if self._fits(wanted_bytes):
                return
            with suppress(OSError):  # the next ones may suffice
                self.remove_all([entry])
        if not self._fits(wanted_bytes):
            raise OSError(errno.ENOSPC, "what cannot be deleted leaves no room within the limit", str(self.path))

    def _fits(self, wanted_bytes: int) -> bool:
        return self.disk_bytes + wanted_bytes <= self._retention.max_bytes

    def _remove(self, entry: CapturedEntry) -> None:
        entry.path.unlink(missing_ok=True)
        if self._calls.pop(entry.path, None) is not None:
            self._calls_bytes -= entry.disk_bytes
            self._blobs.release(entry.blobs)
        with suppress(OSError):  # other calls are in it, or it is gone already
            entry.path.parent.rmdir()
