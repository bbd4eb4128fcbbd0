"""Takes calls from the services, and keeps them, in a thread of its own: it never delays a call and never fails one.

What it cannot keep it counts. Calls wait for the disk in a queue that is bounded in number and bytes. `deletion` sees
to it that what is kept goes when it is to go.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from google.protobuf.message import Message

from mapless.names import parse_scene_name
from mapless_server.engine.query import Query, Result, Tier
from mapless_server.errors import DataLoss, NotFound, Unavailable
from mapless_server.rpc.call import Call
from mapless_server.security.tenancy import key_of
from mapless_server.store import SceneAttributes, Store, time_us

from .calls import BlobGone, CapturedCall, Request, Response, diagnostics_of
from .deletion import Deletion
from .folder import CaptureFolder
from .gathering import Gatherer, Gone, Used, used_of
from .telling import Telling

MAX_WAITING = 32
"""Calls that wait for the disk."""
MAX_WAITING_BYTES = 64 * 2**20
"""Of their messages."""
FAULT_PAUSE_S = 60.0
"""After the disk has failed nothing is captured for so long, not what waits already either."""
CLOSING_LIMIT_S = 5.0
"""For what waits to be written when the server stops."""


class CaptureObserver(Protocol):
    """Counts what is captured; called from any thread, so it must return at once and never raise."""

    def captured(self) -> None:
        """A call is kept."""

    def capture_dropped(self, reason: str) -> None:
        """A call that was to be captured is not: "queue", "size", "disk", "deleted", "store" or "fault".

        "queue" if too many waited, or if it still did when the server stopped.
        """


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
        self._circumstances = circumstances
        self._found: Mapping[str, str] | None = None
        self._waiting: deque[Waiting] = deque()
        self._waiting_bytes = 0
        self._paused_until_s = 0.0
        self._closing_s: float | None = None
        self._news = threading.Condition()
        self._telling = Telling()
        self._deletion = Deletion(folder, self._store, self._telling)
        self._thread = threading.Thread(target=self._run, name="capture", daemon=True)
        self._thread.start()

    def record(
        self,
        request: Request,
        response: Response,
        call: Call,
        parts: Sequence[tuple[Query, Result]],
        tiers: Sequence[Tier],
    ) -> None:
        """A call has been answered; the answer says so if it is to be kept.

        Args:
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
        attributes = parts[0][1].attributes
        scene_id, now_s = parse_scene_name(request.scene), time.time()
        if self._has_room(size_bytes):
            for diagnostics in diagnostics_of(response):
                diagnostics.captured = True
            method = request.DESCRIPTOR.name.removesuffix("Request")
            self._put(Waiting(call, scene_id, now_s, method, *messages, size_bytes, used, attributes, tiers))

    @property
    def is_closing(self) -> bool:
        """Whether no more than what waits is written."""
        return self._closing_s is not None

    def close(self) -> None:
        """Writes what waits, for as long as there is time, and lets the folder go; from any thread."""
        with self._news:
            self._closing_s = time.monotonic() + CLOSING_LIMIT_S
            self._news.notify()
        self._thread.join()
        self._telling.tell_dropped()
        self._deletion.close()
        self.folder.close()

    def _has_room(self, size_bytes: int) -> bool:
        """Whether another call may wait; only the event loop adds any."""
        if self._is_paused():
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

    def _run(self) -> None:
        while True:
            with self._news:
                self._news.wait_for(lambda: self._waiting or self.is_closing)
                if not self._waiting:
                    return
                waiting = self._waiting.popleft()
                self._waiting_bytes -= waiting.size_bytes
                is_late = self._closing_s is not None and time.monotonic() >= self._closing_s
            if is_late:
                self._drop("queue")
            else:
                self._keep(waiting)

    def _is_paused(self) -> bool:
        return time.monotonic() < self._paused_until_s

    def _keep(self, waiting: Waiting) -> None:
        if self._is_paused():
            self._drop("disk")
            return
        try:
            if self._add(waiting):
                self._observer.captured()
            else:
                self._drop("size")
        except OSError as error:
            self._paused_until_s = time.monotonic() + FAULT_PAUSE_S
            self._drop("disk")
            self._telling.complain(f"nothing is captured for {FAULT_PAUSE_S:g} s", error)
        except (Gone, NotFound):
            self._drop("deleted")
        except (DataLoss, Unavailable):
            self._drop("store")
        except Exception as error:
            self._drop("fault")
            self._telling.complain("a call was not captured", error, waiting.call.request_id)

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
        extractors, blobs = tuple(tier.features for tier in waiting.tiers), dict[str, bytes]()
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
        self._telling.dropped(reason)
