"""Captured calls under a limit of time and one of size, both kept at every moment that the server runs.

The limit of time is that of `held`, and `expire` keeps it; `_make_room` keeps that of size: what is to be written is
made room for first, and the oldest calls go. What cannot be deleted stays counted, and is tried again. When a folder is
opened anything may be in it: a call that is not as it was written, or not within the limits, is deleted. Methods may be
called from any thread.
"""

from __future__ import annotations

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

from .calls import BlobGone, CapturedCall, CaptureError, DamagedCapture, encode_call
from .files import (
    BlobLedger,
    blob_path,
    call_path,
    calls_of,
    do_each,
    foreign_in,
    is_locked_by,
    open_folder,
    space_of,
    unfinished_in,
    write_whole,
)
from .held import Held, held_of, read_held

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Retention:
    """What is kept.

    Attributes:
        keep_s: how long, seconds.
        max_bytes: of all files, each counted as the whole blocks that it takes.
    """

    keep_s: float
    max_bytes: int

    def __post_init__(self) -> None:
        if not (self.keep_s > 0 and self.max_bytes > 0):
            raise ValueError(f"senseless limits: {self}")


class CaptureFolder:
    """The calls of one server. Opening deletes what is too old, cut, or too much.

    Attributes:
        path: of the folder.
    """

    def __init__(self, path: Path, retention: Retention, clock: Callable[[], float] = time.time) -> None:
        """Opens the folder and locks it; makes it where there is none.

        Raises:
            CaptureError: see `files.open_folder`; or something in it cannot be read or deleted.
        """
        self.path = path
        self._retention = retention
        self._clock = clock
        self._guard = threading.RLock()
        self._lock = open_folder(path)
        self._calls: OrderedDict[Path, Held] = OrderedDict()  # the oldest first
        self._calls_bytes = 0
        self._blobs = BlobLedger()
        self._number = 0
        try:
            self._take_stock()
        except OSError as error:
            self.close()
            what = f"{error.filename or path}: {error.strerror or error}"
            raise CaptureError(f"capture folder {path} cannot be used: {what}") from error
        except BaseException:
            self.close()
            raise

    def __len__(self) -> int:
        return len(self._calls)

    @property
    def space_bytes(self) -> int:
        """What its calls and blobs take on the disk."""
        return self._calls_bytes + self._blobs.space_bytes

    def close(self) -> None:
        """Lets other servers in."""
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1

    def held(self) -> list[Held]:
        """All calls, the oldest first."""
        with self._guard:
            return list(self._calls.values())

    def has_blob(self, tenant: str, sha256: str) -> bool:
        """Whether a blob need not be given again; one that is not what was written goes, and what needs it."""
        path = blob_path(self.path, tenant, sha256)
        with self._guard:
            if not self._blobs.is_intact(path):
                log.warning("captured blob %s is damaged, and is deleted with the calls that need it", path.name)
                self.remove_all([it for it in self._calls.values() if path in it.blobs])
            return path in self._blobs

    def add(self, call: CapturedCall, blobs: Mapping[str, bytes]) -> bool:
        """Keeps a call, and deletes the oldest ones for it where there is no room.

        Args:
            call: with names that have been checked.
            blobs: by SHA-256, those of its that the folder lacks.

        Returns:
            Whether it is kept: one that is larger than the limit alone is not, and deletes nothing.

        Raises:
            OSError: the disk is full, or the like; what was written of it is gone.
            BlobGone: one that the folder had went meanwhile; gather the call again.
            CaptureError: somebody deleted the folder by hand, and another server has it now.
        """
        data = encode_call(call)
        with self._guard:
            self._see_that_it_is_ours()
            needed = {blob_path(self.path, call.tenant, name): name for name in call.blobs}
            missing = [path for path in needed if path not in self._blobs]
            if any(needed[path] not in blobs for path in missing):
                raise BlobGone
            new_bytes = space_of(len(data)) + sum(space_of(len(blobs[needed[path]])) for path in missing)
            if new_bytes + sum(map(self._blobs.space_of, needed)) > self._retention.max_bytes:
                return False
            self._blobs.use(needed)  # before room is made, so that none of them goes
            try:
                self._make_room(new_bytes)
                for path in missing:
                    self._blobs.write(path, blobs[needed[path]])
                path = self._new_path(call)
                write_whole(path, data)
            except BaseException:
                self._blobs.release(needed)
                with suppress(OSError):  # what stays is tried again
                    self._blobs.sweep()
                raise
            self._enter(held_of(self.path, path, call, len(data), self._retention.keep_s, self._clock()))
            return True

    def expire(self) -> float:
        """Deletes what is too old.

        Returns:
            Seconds until the next one is too old; those of the limit if there is none.

        Raises:
            OSError: the first of the files that cannot be deleted; all others are. It is tried again next time.
        """
        with self._guard:
            now_s, monotonic_s = self._clock(), time.monotonic()
            self.remove_all([it for it in self._calls.values() if it.left_s(now_s, monotonic_s) <= 0])
            rest = (it.left_s(now_s, monotonic_s) for it in self._calls.values())
            return min(rest, default=self._retention.keep_s)

    def forget_deleted(self) -> None:
        """Forgets what somebody deleted by hand, and deletes what is of no use without it; OSError as `remove_all`."""
        with self._guard:
            gone = self._blobs.deleted_by_hand()
            held = self._calls.values()
            self.remove_all([it for it in held if it.blobs & gone or not os.path.lexists(it.path)])

    def remove_all(self, gone: Collection[Held]) -> None:
        """Deletes calls, and what no other call needs, each that can be; OSError if there are some that cannot be."""
        with self._guard:
            do_each([*(partial(self._remove, it) for it in gone), self._blobs.sweep])

    def _take_stock(self) -> None:
        foreign = sum(1 for _ in foreign_in(self.path))
        if foreign:
            log.warning("capture folder %s: %d files are not ours, and left alone", self.path, foreign)
        for path in list(unfinished_in(self.path)):
            path.unlink()
        self._blobs.take_stock(self.path)
        found = [it for path in list(calls_of(self.path)) if (it := self._read(path)) is not None]
        for held in sorted(found, key=lambda it: (it.expiry_s, it.path.name)):
            self._blobs.use(held.blobs)
            self._enter(held)
        self._blobs.sweep()
        self.expire()
        self._make_room(0)

    def _read(self, path: Path) -> Held | None:
        """The call of a file; None if it had to be deleted, see `read_held`."""
        try:
            held = read_held(self.path, path, self._retention.keep_s, self._retention.max_bytes, self._clock())
            if not all(it in self._blobs for it in held.blobs):
                raise DamagedCapture("a part of it is gone")
            return held
        except DamagedCapture as error:
            log.warning("captured call %s is deleted: %s", path.name, error)
            path.unlink()
            return None
        except CaptureError as error:
            raise CaptureError(f"captured call {path} cannot be used: {error}") from error

    def _see_that_it_is_ours(self) -> None:
        """Makes and locks the folder anew if somebody deleted it by hand."""
        if not is_locked_by(self.path, self._lock):
            lock = open_folder(self.path)
            os.close(self._lock)
            self._lock = lock
            self.forget_deleted()

    def _new_path(self, call: CapturedCall) -> Path:
        """Where a call is to lie; a server before this one, with the clock set back since, may have had the name."""
        while True:
            self._number += 1
            name = f"{round(1e3 * call.time_s):014d}-{os.getpid()}-{self._number}"
            path = call_path(self.path, call.tenant, call.scene_id, name)
            if path not in self._calls and not os.path.lexists(path):
                return path

    def _enter(self, held: Held) -> None:
        self._calls[held.path] = held
        self._calls_bytes += held.space_bytes

    def _make_room(self, wanted_bytes: int) -> None:
        """Deletes the oldest calls until so much more fits; OSError if it does not, since some cannot be deleted."""
        for held in self.held():
            if self._fits(wanted_bytes):
                return
            with suppress(OSError):  # others may do
                self.remove_all([held])
        if not self._fits(wanted_bytes):
            raise OSError(errno.ENOSPC, "what cannot be deleted leaves no room within the limit", str(self.path))

    def _fits(self, wanted_bytes: int) -> bool:
        return self.space_bytes + wanted_bytes <= self._retention.max_bytes

    def _remove(self, held: Held) -> None:
        held.path.unlink(missing_ok=True)
        if self._calls.pop(held.path, None) is not None:
            self._calls_bytes -= held.space_bytes
            self._blobs.release(held.blobs)
        with suppress(OSError):  # other calls are in it, or somebody was faster
            held.path.parent.rmdir()
