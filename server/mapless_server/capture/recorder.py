"""Takes calls from the services, and keeps them, in a thread of its own: it never delays a call and never fails one.

What it cannot keep it counts. Calls wait for the disk in a queue that is bounded in number and bytes. What is too old
goes on time, whether calls come or not; what was made of a scene or of references that have been deleted since, by
whatever server, goes within `STORE_CHECK_S`.
"""

from __future__ import annotations

import logging
import random
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

from google.protobuf.message import Message

from mapless.names import parse_scene_name
from mapless.v1 import localization_service_pb2 as pb
from mapless.wire import FieldError

from ..call import Call
from ..errors import DataLoss, DeadlineExceeded, InvalidArgument, NotFound, Overloaded, RequestError, Unavailable
from ..query import Query, Result
from ..settings import Settings
from ..store import Store
from ..store.rows import time_us
from ..tenancy import key_of
from ..tiers import Tier
from .calls import CapturedCall, CapturedFailure
from .circumstances import circumstances_of
from .folder import CaptureFolder
from .gathering import Gatherer, Gone
from .staleness import Staleness

log = logging.getLogger(__name__)

CAPTURED_KEY = "x-mapless-captured"
"""Trailing metadata of an answer whose call is to be kept."""

MAX_WAITING = 32
"""Calls that wait for the disk."""
MAX_WAITING_BYTES = 64 * 2**20
"""Of their messages."""
STORE_CHECK_S = 30.0
"""How long after a scene or a reference was deleted what was made of it is there at most."""
FAULT_PAUSE_S = 60.0
"""After the disk has failed nothing is captured for so long; and of what is dropped the log tells no more often."""
CLOSING_LIMIT_S = 5.0
"""For what waits to be written when the server stops."""

Request = pb.LocalizeRequest | pb.LocalizeRigRequest | pb.LocalizeSequenceRequest
Response = pb.LocalizeResponse | pb.LocalizeRigResponse | pb.LocalizeSequenceResponse

NO_SCENE = "_"
"""Stands for the scene of a call whose scene has no well-formed name."""


class CaptureObserver(Protocol):
    """Counts what is captured; called from any thread, so it must return at once and never raise."""

    def captured(self) -> None:
        """A call is kept."""

    def capture_dropped(self, reason: str) -> None:
        """A call that was to be captured is not: "queue", "size", "disk", "deleted", "store" or "fault"."""


@dataclass(frozen=True, eq=False)
class Waiting:
    """A call that waits to be kept: what is known of it, its messages, and what was made of its photographs."""

    call: CapturedCall
    size_bytes: int
    request: Message | None = None
    response: Message | None = None
    parts: Sequence[tuple[Query, Result]] = ()


class Recorder:
    """Captures the calls of one server. Its methods are for the event loop, but for those that say otherwise.

    Attributes:
        folder: of the calls.
    """

    def __init__(
        self,
        folder: CaptureFolder,
        store: Store,
        observer: CaptureObserver,
        share: float = 1.0,
        tenants: frozenset[str] = frozenset(),
    ) -> None:
        """Deletes at once what should be gone, and begins to watch over the rest; may take a while.

        Args:
            folder: of the calls; closed at the end.
            store: of the references.
            observer: counts.
            share: of the calls, which are drawn by chance.
            tenants: whose calls; none for those of all.
        """
        self.folder = folder
        self._observer = observer
        self._share = share
        self._tenants = tenants
        self._gatherer = Gatherer(store, folder)
        self._staleness = Staleness(store)
        self._store = store
        self._random = random.Random()
        self._circumstances: Callable[[], Mapping[str, str]] = dict
        self._found: Mapping[str, str] | None = None
        self._extractors: tuple[str, ...] = ()
        self._waiting: deque[Waiting] = deque()
        self._waiting_bytes = 0
        self._paused_until_s = 0.0
        self._dropped: dict[str, int] = {}
        self._told_s = -FAULT_PAUSE_S
        self._closing_s: float | None = None
        self._news = threading.Condition()
        self._tidy()
        self._thread = threading.Thread(target=self._run, name="capture", daemon=True)
        self._thread.start()

    def describe(self, settings: Settings, tiers: Sequence[Tier]) -> None:
        """Says what computes the answers; to be said before there are any."""
        self._extractors = tuple(tier.extractor.name for tier in tiers)
        self._circumstances = partial(circumstances_of, settings, tiers)

    def answered(
        self,
        method: str,
        request: Request,
        response: Response,
        call: Call,
        parts: Sequence[tuple[Query, Result]],
    ) -> None:
        """A call has been answered, and its caller is told if it is to be kept.

        Args:
            method: "Localize", ...
            request: as it came.
            response: as it goes; neither is to be changed any more.
            call: whose they are.
            parts: its photographs, in order, and what was made of each.
        """
        tenant = call.principal.tenant
        if not self._is_wanted(tenant) or self._random.random() >= self._share:
            return
        captured = CapturedCall(call.request_id, time.time(), method, tenant, parse_scene_name(request.scene), 0)
        messages: list[Message] = [request, response]
        size_bytes = sum(it.ByteSize() for it in messages)
        if self._put(Waiting(captured, size_bytes, request, response, parts)):
            call.trailing.append((CAPTURED_KEY, "1"))

    def failed(self, method: str, request: Request, call: Call, failure: CapturedFailure) -> None:
        """A call has failed: a line is kept of it, without what it asked."""
        tenant = call.principal.tenant
        if not self._is_wanted(tenant):
            return
        try:
            scene_id = parse_scene_name(request.scene)
        except ValueError:
            scene_id = NO_SCENE
        self._put(Waiting(CapturedCall(call.request_id, time.time(), method, tenant, scene_id, 0, failure=failure), 0))

    def close(self) -> None:
        """Writes what waits, for as long as there is time, and lets the folder go; from any thread."""
        with self._news:
            self._closing_s = time.monotonic() + CLOSING_LIMIT_S
            self._news.notify()
        self._thread.join()
        self.folder.close()

    def _is_wanted(self, tenant: str) -> bool:
        return not self._tenants or tenant in self._tenants

    def _put(self, waiting: Waiting) -> bool:
        if time.monotonic() < self._paused_until_s:
            self._drop("disk")
            return False
        with self._news:
            fits = not self._waiting or self._waiting_bytes + waiting.size_bytes <= MAX_WAITING_BYTES
            is_full = len(self._waiting) >= MAX_WAITING or not fits
            if not is_full:
                self._waiting.append(waiting)
                self._waiting_bytes += waiting.size_bytes
                self._news.notify()
        if is_full:
            self._drop("queue")
        return not is_full

    def _run(self) -> None:
        due_s = self._tidy()
        while True:
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
            if time.monotonic() >= due_s:
                due_s = self._tidy()

    def _keep(self, waiting: Waiting) -> None:
        try:
            call, blobs = self._gather(waiting)
            if not self.folder.add(call, blobs):
                self._drop("size")
            elif call.failure is None:
                self._observer.captured()
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

    def _gather(self, waiting: Waiting) -> tuple[CapturedCall, dict[str, bytes]]:
        call, blobs = waiting.call, dict[str, bytes]()
        if waiting.request is None or waiting.response is None:
            return call, blobs
        if self._found is None:
            self._found = self._circumstances()
        # First: a scene that is made anew while its references are read has others, which is then found out.
        scene = self._store.get_scene(key_of(call.tenant, call.scene_id))
        parts = tuple(self._gatherer.part(query, result, self._extractors, blobs) for query, result in waiting.parts)
        call = replace(
            call,
            scene_created_us=time_us(scene.create_time),
            circumstances=self._found,
            attributes=waiting.parts[0][1].attempt.attributes,
            parts=parts,
            request=waiting.request.SerializeToString(),
            response=waiting.response.SerializeToString(),
        )
        return call, blobs

    def _tidy(self) -> float:
        """Deletes what should be gone; when to do so again, `time.monotonic`."""
        pause_s = STORE_CHECK_S
        try:
            pause_s = min(self.folder.expire(), STORE_CHECK_S)
            stale = self._staleness.delete_stale(self.folder)
            if stale:
                log.info("%d captured calls are deleted, since their scenes or references were", stale)
        except OSError as error:
            log.error("captured calls cannot be deleted: %s", error)
        return time.monotonic() + max(pause_s, 0.01)

    def _drop(self, reason: str) -> None:
        self._observer.capture_dropped(reason)
        self._dropped[reason] = self._dropped.get(reason, 0) + 1
        now_s = time.monotonic()
        if now_s - self._told_s >= FAULT_PAUSE_S:
            self._told_s = now_s
            told, self._dropped = self._dropped, {}
            log.warning("calls were not captured: %s", ", ".join(f"{name} {count}" for name, count in told.items()))


@contextmanager
def failures_of(recorder: Recorder | None, method: str, request: Request, call: Call) -> Iterator[None]:
    """Keeps a line of a call that fails, if there is a recorder; not of those there was no room or time for."""
    try:
        yield
    except (Overloaded, Unavailable, DeadlineExceeded):
        raise
    except Exception as error:
        if recorder is not None:
            recorder.failed(method, request, call, _failure_of(error))
        raise


def _failure_of(error: Exception) -> CapturedFailure:
    """As the caller is told."""
    if isinstance(error, RequestError):
        return CapturedFailure(error.code, error.reason, str(error))
    if isinstance(error, FieldError):
        return CapturedFailure(InvalidArgument.code, InvalidArgument.reason, str(error))
    return CapturedFailure(RequestError.code, type(error).__name__, "")
