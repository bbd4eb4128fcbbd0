"""Captured calls under a limit of time and one of size, both kept at every moment that the server runs.

What is to be written is made room for first: the oldest calls go. A blob goes with the last call that needs it; one
that cannot be deleted stays counted, and is tried again. Its methods may be called from any thread.
"""

from __future__ import annotations

import hashlib
import logging
import os
import threading
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from ..tenancy import SceneKey, key_of
from .calls import CapturedCall, decode_call, encode_call
from .errors import BlobGone, CaptureError, DamagedCapture
from .files import (
    blob_path,
    blobs_of,
    call_path,
    calls_of,
    foreign_in,
    open_folder,
    space_of,
    unfinished_in,
    write_whole,
)

log = logging.getLogger(__name__)

_FUTURE_S = 60.0
"""A call that is further ahead of the clock than this was captured while the clock was wrong."""


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


@dataclass(frozen=True, eq=False)
class Held:
    """A call in the folder.

    Attributes:
        path: its file.
        scene_key: of its scene.
        scene_created_us: which of the scenes that had this name.
        references: id and key of each.
        blobs: files that it needs.
        space_bytes: of its own file.
        expiry_s: when it goes, Unix seconds.
        expiry_monotonic_s: the same by a clock that nobody sets.
    """

    path: Path
    scene_key: SceneKey
    scene_created_us: int
    references: frozenset[tuple[str, str]]
    blobs: frozenset[Path]
    space_bytes: int
    expiry_s: float
    expiry_monotonic_s: float


class CaptureFolder:
    """The calls of one server. Opening deletes what is too old, cut, or too much.

    Attributes:
        path: of the folder.
        space_bytes: what its calls and blobs take.
    """

    def __init__(self, path: Path, retention: Retention, clock: Callable[[], float] = time.time) -> None:
        """Opens the folder and locks it; makes it where there is none.

        Raises:
            CaptureError: see `files.open_folder`; or something in it cannot be read or deleted.
        """
        self.path = path
        self.space_bytes = 0
        self._retention = retention
        self._clock = clock
        self._guard = threading.RLock()
        self._lock = open_folder(path)
        self._calls: OrderedDict[Path, Held] = OrderedDict()  # the oldest first
        self._blob_space: dict[Path, int] = {}
        self._unverified: set[Path] = set()  # blobs of before: a power failure may have cut them
        self._uses: Counter[Path] = Counter()
        self._unused: set[Path] = set()  # blobs to be deleted
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
            if path in self._unverified:
                self._verify(path)
            return path in self._blob_space

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
        """
        data = encode_call(call)
        with self._guard:
            needed = {blob_path(self.path, call.tenant, name): name for name in call.blobs}
            missing = [path for path in needed if path not in self._blob_space]
            if any(needed[path] not in blobs for path in missing):
                raise BlobGone
            space = {path: space_of(len(blobs[needed[path]])) for path in missing}
            whole = {path: self._blob_space.get(path, space.get(path, 0)) for path in needed}
            if space_of(len(data)) + sum(whole.values()) > self._retention.max_bytes:
                return False
            self._use(needed)  # before room is made, so that none of them goes
            try:
                self._make_room(space_of(len(data)) + sum(space.values()))
                for path in missing:
                    write_whole(path, blobs[needed[path]])
                    self._blob_space[path] = space[path]
                    self.space_bytes += space[path]
                self._number += 1
                name = f"{round(1e3 * call.time_s):014d}-{os.getpid()}-{self._number}"
                path = call_path(self.path, call.tenant, call.scene_id, name)
                write_whole(path, data)
            except BaseException:
                self._release(needed)
                with suppress(OSError):  # what stays is tried again
                    self._sweep()
                raise
            self._enter(self._held(path, call, len(data)))
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
            held = self._calls.values()
            self._remove_all([it for it in held if it.expiry_s <= now_s or it.expiry_monotonic_s <= monotonic_s])
            rest = [min(it.expiry_s - now_s, it.expiry_monotonic_s - monotonic_s) for it in self._calls.values()]
            return min(rest, default=self._retention.keep_s)

    def forget_deleted(self) -> None:
        """Forgets what somebody deleted by hand, and deletes what is of no use without it; OSError as `expire`."""
        with self._guard:
            gone = {path for path in self._blob_space if not os.path.lexists(path)}
            held = self._calls.values()
            self._remove_all([it for it in held if it.blobs & gone or not os.path.lexists(it.path)])

    def remove(self, held: Held) -> None:
        """Deletes a call, and what no other call needs."""
        with self._guard:
            if held.path in self._calls:
                self._remove(held)

    def _take_stock(self) -> None:
        foreign = foreign_in(self.path)
        if foreign:
            log.warning("capture folder %s: %d files are not ours, and left alone", self.path, len(foreign))
        for path in unfinished_in(self.path):
            path.unlink()
        for path in blobs_of(self.path):
            self._blob_space[path] = space_of(path.stat().st_size)
        self._unverified.update(self._blob_space)
        self.space_bytes = sum(self._blob_space.values())
        found = [it for path in calls_of(self.path) if (it := self._read(path)) is not None]
        for held in sorted(found, key=lambda it: (it.expiry_s, it.path.name)):
            self._use(held.blobs)
            self._enter(held)
        self._unused = self._blob_space.keys() - self._uses.keys()
        self._sweep()
        self.expire()
        self._make_room(0)

    def _read(self, path: Path) -> Held | None:
        """The call of a file; one that cannot be read, or is of the future, is deleted: nothing limits its time."""
        try:
            data = path.read_bytes()
            call = decode_call(data)
            if not path.is_relative_to(call_path(self.path, call.tenant, call.scene_id, "").parent):
                raise DamagedCapture("it is another tenant's or scene's")
            held = self._held(path, call, len(data))
            if not held.blobs <= self._blob_space.keys():
                raise DamagedCapture("a part of it is gone")
            if call.time_s > self._clock() + _FUTURE_S:
                raise DamagedCapture("it was captured later than now")
            return held
        except DamagedCapture as error:
            log.warning("captured call %s is deleted: %s", path.name, error)
            path.unlink()
            return None

    def _verify(self, path: Path) -> None:
        with suppress(OSError):  # what cannot be read is of no use to a replay either
            if hashlib.sha256(path.read_bytes()).hexdigest() == path.name:
                self._unverified.discard(path)
                return
        log.warning("captured blob %s is not what was written, and is deleted with the calls that need it", path.name)
        self._remove_all([it for it in self._calls.values() if path in it.blobs])

    def _held(self, path: Path, call: CapturedCall, size_bytes: int) -> Held:
        now_s, expiry_s = self._clock(), call.time_s + self._retention.keep_s
        return Held(
            path,
            key_of(call.tenant, call.scene_id),
            call.scene_created_us,
            call.keys,
            frozenset(blob_path(self.path, call.tenant, name) for name in call.blobs),
            space_of(size_bytes),
            expiry_s,
            time.monotonic() + min(expiry_s - now_s, self._retention.keep_s),
        )

    def _enter(self, held: Held) -> None:
        self._calls[held.path] = held
        self.space_bytes += held.space_bytes

    def _make_room(self, wanted_bytes: int) -> None:
        while self._calls and self.space_bytes + wanted_bytes > self._retention.max_bytes:
            self._remove(next(iter(self._calls.values())))

    def _remove_all(self, gone: Collection[Held]) -> None:
        """Deletes calls, each that can be, and what was left of others; OSError if there are some that cannot be."""
        _do_each([*(partial(self._remove, it) for it in gone), self._sweep])

    def _remove(self, held: Held) -> None:
        held.path.unlink(missing_ok=True)
        del self._calls[held.path]
        self.space_bytes -= held.space_bytes
        self._release(held.blobs)
        with suppress(OSError):  # other calls are in it, or somebody was faster
            held.path.parent.rmdir()
        self._sweep()

    def _use(self, blobs: Collection[Path]) -> None:
        self._uses.update(list(blobs))
        self._unused.difference_update(blobs)

    def _release(self, blobs: Collection[Path]) -> None:
        for path in blobs:
            self._uses[path] -= 1
            if self._uses[path] <= 0:
                del self._uses[path]
                if path in self._blob_space:
                    self._unused.add(path)

    def _sweep(self) -> None:
        """Deletes the blobs that no call needs, each that can be; OSError if there are some that cannot be."""
        _do_each([partial(self._delete_blob, it) for it in self._unused])

    def _delete_blob(self, path: Path) -> None:
        path.unlink(missing_ok=True)
        self._unused.discard(path)
        self._unverified.discard(path)
        self.space_bytes -= self._blob_space.pop(path)


def _do_each(actions: Iterable[Callable[[], None]]) -> None:
    """Does all of it; then OSError, if some of it failed."""
    faults = [fault for it in actions if (fault := _fault_of(it)) is not None]
    if faults:
        raise faults[0]


def _fault_of(action: Callable[[], None]) -> OSError | None:
    try:
        action()
    except OSError as error:
        return error
    return None
