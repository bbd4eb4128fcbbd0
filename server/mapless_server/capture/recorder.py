"""Takes calls from the services, and keeps them, in a thread of its own: it never delays a call and never fails one.

What it cannot keep it counts. Calls wait for the disk in a queue that is bounded in number and bytes. What is too old
goes on time, whether calls come or not and whether the store answers or not: a second thread sees to that alone. What
was made of a scene or of references that have been deleted since, by whatever server, goes within `STORE_CHECK_S`.
Neither thread ends before the recorder is closed.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from google.protobuf.message import Message

from mapless.names import parse_scene_name

from ..call import Call
from ..errors import DataLoss, NotFound, Unavailable
from ..query import Query, Result
from ..store import SceneAttributes, Store
from ..store.rows import time_us
from ..tenancy import key_of
from ..tiers import Tier
from .calls import CapturedCall
from .errors import BlobGone
from .folder import CaptureFolder
from .gathering import Gatherer, Gone, Used, used_of
from .messages import Request, Response, diagnostics_of
from .staleness import Staleness

log = logging.getLogger(__name__)

MAX_WAITING = 32
"""Calls that wait for the disk."""
MAX_WAITING_BYTES = 64 * 2**20
"""Of their messages."""
STORE_CHECK_S = 30.0
"""How long after a scene or a reference was deleted what was made of it is there at most."""
EXPIRY_CHECK_S = 1.0
"""How late a call may go, where the clock has been set; else it goes on time."""
FAULT_PAUSE_S = 60.0
"""After the disk has failed nothing is captured for so long; and of what fails the log tells no more often."""
CLOSING_LIMIT_S = 5.0
"""For what waits to be written when the server stops."""
_MIN_PAUSE_S = 0.01


class CaptureObserver(Protocol):
    """Counts what is captured; called from any thread, so it must return at once and never raise."""

    def captured(self) -> None:
        """A call is kept."""

    def capture_dropped(self, reason: str) -> None:
        """A call that was to be captured is not: "queue", "size", "disk", "deleted", "store" or "fault"."""


@dataclass(frozen=True, eq=False)
class Waiting:
    """A call that waits to be kept: its messages, and by name what its photographs were compared with.

    Attributes:
        call: whose it is.
        scene_id: where.
        time_s: when it was answered, Unix seconds.
        method: "Localize", ...
        request: as it came.
        response: as it went.
        size_bytes: of both.
        parts: of each photograph.
        attributes: of the scene.
        tiers: what computed the answer.
    """

    call: Call
    scene_id: str
    time_s: float
    method: str
    request: Message
    response: Message
    size_bytes: int
    parts: tuple[Used, ...]
    attributes: SceneAttributes
    tiers: Sequence[Tier]


class Recorder:
    """Captures the calls of one server. `answered` is for the event loop.

    Attributes:
        folder: of the calls.
    """

    def __init__(
        self,
        folder: CaptureFolder,
        store: Store,
        observer: CaptureObserver,
        circumstances: Callable[[Sequence[Tier]], Mapping[str, str]] = lambda _: {},
        tenants: frozenset[str] = frozenset(),
    ) -> None:
        """Begins to watch over the folder; asks the store nothing yet.

        Args:
            folder: of the calls; closed at the end.
            store: of the references; must not be closed before.
            observer: counts.
            circumstances: what else decides the answers of these tiers, see `circumstances_of`.
            tenants: whose calls; none for those of all.
        """
        self.folder = folder
        self._observer = observer
        self._tenants = tenants
        self._store = store.uncached()
        self._gatherer = Gatherer(self._store, folder)
        self._staleness = Staleness(self._store)
        self._circumstances = circumstances
        self._found: Mapping[str, str] | None = None
        self._waiting: deque[Waiting] = deque()
        self._waiting_bytes = 0
        self._paused_until_s = 0.0
        self._dropped: dict[str, int] = {}
        self._told_s: dict[str, float] = {}
        self._closing_s: float | None = None
        self._news = threading.Condition()
        self._closing = threading.Event()
        self._threads = [
            threading.Thread(target=self._run, name="capture", daemon=True),
            threading.Thread(target=self._expire, name="capture-expiry", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def answered(
        self,
        method: str,
        request: Request,
        response: Response,
        call: Call,
        parts: Sequence[tuple[Query, Result]],
        tiers: Sequence[Tier],
    ) -> None:
        """A call has been answered; the answer says so if it is to be kept.

        Args:
            method: "Localize", ...
            request: as it came.
            response: as it goes; neither is to be changed afterwards.
            call: whose they are.
            parts: its photographs, in order, and what was made of each.
            tiers: all that the server has.
        """
        if self._tenants and call.principal.tenant not in self._tenants:
            return
        messages: tuple[Message, Message] = request, response
        size_bytes = sum(it.ByteSize() for it in messages)
        used = tuple(used_of(*part) for part in parts)
        attributes = parts[0][1].attempt.attributes
        scene_id, now_s = parse_scene_name(request.scene), time.time()
        if self._has_room(size_bytes):
            for diagnostics in diagnostics_of(response):
                diagnostics.captured = True
            self._put(Waiting(call, scene_id, now_s, method, *messages, size_bytes, used, attributes, tiers))

    def close(self) -> None:
        """Writes what waits, for as long as there is time, and lets the folder go; from any thread."""
        with self._news:
            self._closing_s = time.monotonic() + CLOSING_LIMIT_S
            self._news.notify()
        self._closing.set()
        for thread in self._threads:
            thread.join()
        self.folder.close()

    def _has_room(self, size_bytes: int) -> bool:
        """Whether another call may wait; only the event loop adds any."""
        if time.monotonic() < self._paused_until_s:
            self._drop("disk")
            return False
        with self._news:
            fits = not self._waiting or self._waiting_bytes + size_bytes <= MAX_WAITING_BYTES
            has_room = fits and len(self._waiting) < MAX_WAITING
        if not has_room:
            self._drop("queue")
        return has_room

    def _put(self, waiting: Waiting) -> None:
        with self._news:
            self._waiting.append(waiting)
            self._waiting_bytes += waiting.size_bytes
            self._news.notify()

    def _expire(self) -> None:
        """Of the expiry's thread: asks nobody but the folder."""
        pause_s = 0.0
        while not self._closing.wait(pause_s):
            pause_s = EXPIRY_CHECK_S
            try:
                pause_s = min(max(self.folder.expire(), _MIN_PAUSE_S), EXPIRY_CHECK_S)
            except Exception as error:  # whatever it is, the time limit holds for all others
                self._complain("captured calls that are too old cannot be deleted", error)

    def _run(self) -> None:
        due_s = 0.0
        while True:
            if time.monotonic() >= due_s:
                self._check()
                due_s = time.monotonic() + STORE_CHECK_S
            with self._news:
                if not self._waiting and self._closing_s is None:
                    self._news.wait(max(due_s - time.monotonic(), 0.0))
                is_closing = self._closing_s is not None
                waiting = self._waiting.popleft() if self._waiting else None
                self._waiting_bytes -= waiting.size_bytes if waiting else 0
            if waiting is not None and not (is_closing and time.monotonic() > (self._closing_s or 0.0)):
                self._keep(waiting)
            elif is_closing:
                return

    def _check(self) -> None:
        """Deletes what should be gone for another reason than its age."""
        try:
            self.folder.forget_deleted()
            stale = self._staleness.delete_stale(self.folder)
            if stale:
                log.info("%d captured calls are deleted, since their scenes or references were", stale)
        except Unavailable:
            log.debug("the store is away; captured calls are checked later")
        except Exception as error:  # whatever it is, what can be kept is kept, and this is tried again
            self._complain("captured calls cannot be compared with the store", error)

    def _keep(self, waiting: Waiting) -> None:
        try:
            if self._add(waiting):
                self._observer.captured()
            else:
                self._drop("size")
        except OSError as error:
            self._paused_until_s = time.monotonic() + FAULT_PAUSE_S
            self._drop("disk")
            log.error("nothing is captured for %g s: %s", FAULT_PAUSE_S, error)
        except (Gone, NotFound):
            self._drop("deleted")
        except (DataLoss, Unavailable):
            self._drop("store")
        except Exception:
            self._drop("fault")
            log.exception("a call was not captured", extra={"request_id": waiting.call.request_id})

    def _add(self, waiting: Waiting, more_tries: int = 2) -> bool:
        try:
            return self.folder.add(*self._gather(waiting))
        except BlobGone:
            if not more_tries:
                raise
            return self._add(waiting, more_tries - 1)

    def _gather(self, waiting: Waiting) -> tuple[CapturedCall, dict[str, bytes]]:
        if self._found is None:
            self._found = self._circumstances(waiting.tiers)
        tenant, scene_id = waiting.call.principal.tenant, waiting.scene_id
        extractors, blobs = tuple(tier.extractor.name for tier in waiting.tiers), dict[str, bytes]()
        # First: a scene that is made anew while its references are read has others, which is then found out.
        scene = self._store.get_scene(key_of(tenant, scene_id))
        parts = tuple(self._gatherer.part(scene, used, extractors, blobs) for used in waiting.parts)
        call = CapturedCall(
            waiting.call.request_id,
            waiting.time_s,
            waiting.method,
            tenant,
            scene_id,
            time_us(scene.create_time),
            self._found,
            waiting.attributes,
            parts,
            waiting.request.SerializeToString(),
            waiting.response.SerializeToString(),
        )
        return call, blobs

    def _drop(self, reason: str) -> None:
        self._observer.capture_dropped(reason)
        self._dropped[reason] = self._dropped.get(reason, 0) + 1
        if self._is_time_to_tell("dropped"):
            told, self._dropped = self._dropped, {}
            log.warning("calls were not captured: %s", ", ".join(f"{name} {count}" for name, count in told.items()))

    def _complain(self, what: str, error: Exception) -> None:
        if self._is_time_to_tell(what):
            log.error("%s: %s", what, error, exc_info=None if isinstance(error, OSError) else error)

    def _is_time_to_tell(self, what: str) -> bool:
        now_s = time.monotonic()
        is_time = now_s - self._told_s.get(what, -FAULT_PAUSE_S) >= FAULT_PAUSE_S
        if is_time:
            self._told_s[what] = now_s
        return is_time
