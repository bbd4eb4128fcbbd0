"""Captured calls under a limit of time and one of size, both kept at every moment that the server runs.

What is to be written is made room for first: the oldest calls go. A blob goes with the last call that needs it. One
thread uses a folder; others may ask how much it holds.
"""

from __future__ import annotations

import logging
import os
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from ..tenancy import SceneKey, key_of
from .calls import HEAD_BYTES, CapturedCall, decode_summary, encode_call, header_end
from .errors import DamagedCapture
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

MAX_FAILURES = 1000
"""Calls that failed are kept as a line; more of them must not push out those that can be computed again."""

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
        has_failed: whether it is the line of a call that failed.
    """

    path: Path
    scene_key: SceneKey
    scene_created_us: int
    references: frozenset[tuple[str, str]]
    blobs: frozenset[Path]
    space_bytes: int
    expiry_s: float
    expiry_monotonic_s: float
    has_failed: bool


class CaptureFolder:
    """The calls of one server. Opening deletes what is too old, cut, or too much.

    Attributes:
        path: of the folder.
        space_bytes: what its calls and blobs take.
    """

    def __init__(self, path: Path, retention: Retention, clock: Callable[[], float] = time.time) -> None:
        """Opens the folder and locks it; makes it where there is none.

        Raises:
            CaptureError: see `files.open_folder`.
        """
        self.path = path
        self.space_bytes = 0
        self._retention = retention
        self._clock = clock
        self._lock = open_folder(path)
        self._calls: OrderedDict[Path, Held] = OrderedDict()  # the oldest first
        self._blob_space: dict[Path, int] = {}
        self._uses: Counter[Path] = Counter()
        self._failures = 0
        self._number = 0
        try:
            self._take_stock()
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
        return list(self._calls.values())

    def has_blob(self, tenant: str, sha256: str) -> bool:
        """Whether a blob need not be given again."""
        return blob_path(self.path, tenant, sha256) in self._blob_space

    def add(self, call: CapturedCall, blobs: Mapping[str, bytes]) -> bool:
        """Keeps a call, and deletes the oldest ones for it where there is no room.

        Args:
            call: with names that have been checked.
            blobs: by SHA-256, those of its that the folder lacks.

        Returns:
            Whether it is kept: one that is larger than the limit alone is not, and deletes nothing.

        Raises:
            OSError: the disk is full, or the like; what was written of it is gone.
        """
        data = encode_call(call)
        needed = {blob_path(self.path, call.tenant, name): name for name in call.blobs}
        space = {path: self._blob_space.get(path) or space_of(len(blobs[name])) for path, name in needed.items()}
        if space_of(len(data)) + sum(space.values()) > self._retention.max_bytes:
            return False
        self._uses.update(needed.keys())  # before room is made, so that none of them goes
        try:
            missing = [it for it in needed if it not in self._blob_space]
            self._make_room(space_of(len(data)) + sum(space[it] for it in missing))
            for path in missing:
                write_whole(path, blobs[needed[path]])
                self._blob_space[path] = space[path]
                self.space_bytes += space[path]
            self._number += 1
            name = f"{round(1e3 * call.time_s):014d}-{os.getpid()}-{self._number}"
            path = call_path(self.path, call.tenant, call.scene_id, name)
            write_whole(path, data)
            held = self._held(path, call, len(data))
        except BaseException:
            self._release(needed)
            raise
        self._enter(held)
        if self._failures > MAX_FAILURES:
            self._remove(next(it for it in self._calls.values() if it.has_failed))
        return True

    def expire(self) -> float:
        """Deletes what is too old, and forgets what somebody deleted by hand.

        Returns:
            Seconds until the next one is too old; those of the limit if there is none.
        """
        now_s, monotonic_s = self._clock(), time.monotonic()
        gone = {path for path in self._blob_space if not path.exists()}
        for held in self.held():
            is_old = held.expiry_s <= now_s or held.expiry_monotonic_s <= monotonic_s
            if is_old or not held.path.exists() or held.blobs & gone:
                self._remove(held)
        rest = [min(it.expiry_s - now_s, it.expiry_monotonic_s - monotonic_s) for it in self._calls.values()]
        return min(rest, default=self._retention.keep_s)

    def remove(self, held: Held) -> None:
        """Deletes a call, and what no other call needs."""
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
        self.space_bytes = sum(self._blob_space.values())
        found = [it for path in calls_of(self.path) if (it := self._read(path)) is not None]
        for held in sorted(found, key=lambda it: (it.expiry_s, it.path.name)):
            self._uses.update(held.blobs)
            self._enter(held)
        for path in [it for it in self._blob_space if not self._uses[it]]:
            self._delete_blob(path)
        self.expire()
        self._make_room(0)

    def _read(self, path: Path) -> Held | None:
        """The call of a file; one that cannot be read, or is of the future, is deleted: nothing limits its time."""
        try:
            with path.open("rb") as file:
                head = file.read(HEAD_BYTES)
                head += file.read(header_end(head) - HEAD_BYTES)
                size_bytes = os.fstat(file.fileno()).st_size
            call = decode_summary(head, size_bytes)
            if not path.is_relative_to(call_path(self.path, call.tenant, call.scene_id, "").parent):
                raise DamagedCapture("it is another tenant's or scene's")
            held = self._held(path, call, size_bytes)
            if not held.blobs <= self._blob_space.keys():
                raise DamagedCapture("a part of it is gone")
            if call.time_s > self._clock() + _FUTURE_S:
                raise DamagedCapture("it was captured later than now")
            return held
        except DamagedCapture as error:
            log.warning("captured call %s is deleted: %s", path.name, error)
            path.unlink()
            return None

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
            call.failure is not None,
        )

    def _enter(self, held: Held) -> None:
        self._calls[held.path] = held
        self.space_bytes += held.space_bytes
        self._failures += held.has_failed

    def _make_room(self, wanted_bytes: int) -> None:
        while self._calls and self.space_bytes + wanted_bytes > self._retention.max_bytes:
            self._remove(next(iter(self._calls.values())))

    def _remove(self, held: Held) -> None:
        held.path.unlink(missing_ok=True)
        del self._calls[held.path]
        self.space_bytes -= held.space_bytes
        self._failures -= held.has_failed
        self._release(held.blobs)
        with suppress(OSError):  # other calls are in it, or somebody was faster
            held.path.parent.rmdir()

    def _release(self, blobs: Collection[Path]) -> None:
        for path in blobs:
            self._uses[path] -= 1
            if self._uses[path] <= 0:
                del self._uses[path]
                if path in self._blob_space:
                    self._delete_blob(path)

    def _delete_blob(self, path: Path) -> None:
        path.unlink(missing_ok=True)
        self.space_bytes -= self._blob_space.pop(path)
