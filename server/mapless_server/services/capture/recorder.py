"""Takes answered calls from the services and writes them to the folder, without delaying or failing any call.

Calls wait for the disk in a queue that is bounded in number and bytes, and one thread writes them. What is not written
is counted. `deletion` deletes them on time.
"""

import logging
import os
import platform
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, version

from google.protobuf.message import Message

from mapless.names import parse_scene_name
from mapless_server import __version__
from mapless_server.engine.query import Query, Result, Tier
from mapless_server.errors import DataLoss, NotFound, Unavailable
from mapless_server.observability.metrics import Metrics
from mapless_server.observability.provenance import ROOT, commit_of, cpu_model
from mapless_server.rpc import Call
from mapless_server.scenes.observer import BackgroundObserver
from mapless_server.security import check_tenant, key_of
from mapless_server.settings import Settings
from mapless_server.store import SceneAttributes, Store, time_us

from .calls import BlobDeleted, CapturedCall, CaptureError, Request, Response, diagnostics_of
from .collecting import Collector, ReferencesDeleted, UsedReferences, used_references
from .deletion import Deletion
from .folder import CaptureFolder, Retention

log = logging.getLogger(__name__)

PACKAGES = ("numpy", "scipy", "opencv-python-headless", "poselib", "torch", "kornia")
"""Packages whose arithmetic decides answers."""

DECISIVE_SETTINGS = ("device", "coverage", "retrieval", "max_batch", "compiled_views")
"""Settings of which another value may change an answer, beside features, backend and weights."""

MAX_QUEUED = 32
"""Calls that wait for the disk."""
MAX_QUEUED_BYTES = 64 * 2**20
"""Size of their messages together."""
FAULT_PAUSE_S = 60.0
"""After a fault of the disk, the time in which nothing is captured, queued calls neither."""
CLOSING_LIMIT_S = 5.0
"""For writing the queued calls when the server stops."""


@dataclass(frozen=True, eq=False)
class QueuedCall:
    """A call that waits to be written, with both messages and their size, and the references of each photograph.

    It was answered at `time_s`, Unix seconds; the tiers are all of the server.
    """

    call: Call
    scene_id: str
    time_s: float
    request: Message
    response: Message
    size_bytes: int
    parts: tuple[UsedReferences, ...]
    attributes: SceneAttributes
    tiers: Sequence[Tier]


class Recorder:
    """Captures the calls of one server in a folder."""

    def __init__(
        self,
        folder: CaptureFolder,
        store: Store,
        observer: BackgroundObserver,
        circumstances: Callable[[Sequence[Tier]], Mapping[str, str]] = lambda _: {},
        tenants: frozenset[str] = frozenset(),
    ) -> None:
        """Starts the threads that write and delete.

        Does not wait for the store, which is to be closed after the recorder. The folder is closed with the recorder.
        For `circumstances`, which also decide the tiers' answers, see `circumstances_of`. Only calls of the tenants are
        captured; of all, if there are none.
        """
        self.folder = folder
        self._observer = observer
        self._tenants = tenants
        self._store = store.uncached()
        self._collector = Collector(self._store, folder)
        self._circumstances = circumstances
        self._known_circumstances: Mapping[str, str] | None = None
        self._queue: deque[QueuedCall] = deque()
        self._queued_bytes = 0
        self._paused_until_s = 0.0
        self._closing_s: float | None = None
        self._changed = threading.Condition()
        self._deletion = Deletion(folder, self._store)
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
        """Queues an answered call for writing, with its photographs in order and their results.

        Called on the event loop. The response's diagnostics are set to say whether the call is captured. Neither
        message may change later.
        """
        if self._tenants and call.principal.tenant not in self._tenants:
            return
        messages: tuple[Message, Message] = request, response
        size_bytes = sum(it.ByteSize() for it in messages)
        used = tuple(used_references(*part) for part in parts)
        attributes = parts[0][1].attributes
        scene_id, now_s = parse_scene_name(request.scene), time.time()
        if self._has_room(size_bytes):
            for diagnostics in diagnostics_of(response):
                diagnostics.captured = True
            queued = QueuedCall(call, scene_id, now_s, *messages, size_bytes, used, attributes, tiers)
            with self._changed:
                self._queue.append(queued)
                self._queued_bytes += size_bytes
                self._changed.notify()

    @property
    def is_closing(self) -> bool:
        """Whether the recorder closes, so that only queued calls are still written."""
        return self._closing_s is not None

    def close(self) -> None:
        """Writes queued calls within `CLOSING_LIMIT_S`, and closes the folder; from any thread."""
        with self._changed:
            self._closing_s = time.monotonic() + CLOSING_LIMIT_S
            self._changed.notify()
        self._thread.join()
        self._deletion.close()
        self.folder.close()

    def _has_room(self, size_bytes: int) -> bool:
        """Whether another call may be queued; only the event loop adds calls."""
        if self._is_paused():
            self._drop("disk")
            return False
        with self._changed:
            fits = not self._queue or self._queued_bytes + size_bytes <= MAX_QUEUED_BYTES
            has_room = fits and len(self._queue) < MAX_QUEUED
        if not has_room:
            self._drop("queue")
        return has_room

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._queue or self.is_closing)
                if not self._queue:
                    return
                queued = self._queue.popleft()
                self._queued_bytes -= queued.size_bytes
                is_late = self._closing_s is not None and time.monotonic() >= self._closing_s
            if is_late:
                self._drop("queue")
            else:
                self._write(queued)

    def _is_paused(self) -> bool:
        return time.monotonic() < self._paused_until_s

    def _write(self, queued: QueuedCall) -> None:
        if self._is_paused():
            self._drop("disk")
            return
        try:
            if self._add(queued):
                self._observer.count("captured")
            else:
                self._drop("size")
        except OSError as error:
            self._paused_until_s = time.monotonic() + FAULT_PAUSE_S
            self._drop("disk")
            log.error("nothing is captured for %g s: %s", FAULT_PAUSE_S, error)
        except (ReferencesDeleted, NotFound):
            self._drop("deleted")
        except (DataLoss, Unavailable):
            self._drop("store")
        except Exception as error:
            self._drop("fault")
            log.error(
                "capturing a call failed: %s", error, exc_info=error, extra={"request_id": queued.call.request_id}
            )

    def _add(self, queued: QueuedCall, more_tries: int = 2) -> bool:
        try:
            return self.folder.add(*self._collect(queued))
        except BlobDeleted:
            if not more_tries:
                raise
            return self._add(queued, more_tries - 1)

    def _collect(self, queued: QueuedCall) -> tuple[CapturedCall, dict[str, bytes]]:
        if self._known_circumstances is None:
            self._known_circumstances = self._circumstances(queued.tiers)
        tenant = queued.call.principal.tenant
        extractors, blobs = tuple(tier.features for tier in queued.tiers), dict[str, bytes]()
        # First, so that a scene that is created anew while its references are read is found to have others.
        scene = self._store.get_scene(key_of(tenant, queued.scene_id))
        parts = tuple(self._collector.part(scene, used, extractors, blobs) for used in queued.parts)
        call = CapturedCall(
            queued.call.request_id,
            queued.time_s,
            type(queued.request).__name__.removesuffix("Request"),
            tenant,
            queued.scene_id,
            time_us(scene.create_time),
            self._known_circumstances,
            queued.attributes,
            parts,
            queued.request.SerializeToString(),
            queued.response.SerializeToString(),
        )
        return call, blobs

    def _drop(self, reason: str) -> None:
        self._observer.count("capture_dropped", 1, reason)
        log.warning("a call was not captured: %s", reason)  # the log limits how often


def circumstances_of(settings: Settings, tiers: Sequence[Tier]) -> dict[str, str]:
    """Collects what decides the answers of a server with these settings and tiers on this machine, by name."""
    found = {
        "mapless": __version__,
        "commit": commit_of(ROOT),
        "backend": tiers[0].backend,
        "weights_sha256": tiers[0].weights_sha256,
        "features": ", ".join(tier.features for tier in tiers),
        "processor": f"{cpu_model()}, {platform.machine()}",
        "python": platform.python_version(),
        "blas_threads": os.environ.get("OPENBLAS_NUM_THREADS", ""),
        **{name: str(getattr(settings, name)) for name in DECISIVE_SETTINGS},
        **{name: _version_of(name) for name in PACKAGES},
    }
    return {name: value for name, value in found.items() if value}


def _version_of(package: str) -> str:
    if package in ("torch", "kornia") and package not in sys.modules:
        return ""  # it may be installed, but this server does not use it
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def open_recorder(settings: Settings, store: Store, metrics: Metrics) -> Recorder | None:
    """Opens the recorder if the settings want one; logs a warning, since photographs are then stored.

    CaptureError if the folder cannot be used, or capture_tenants has an invalid name.
    """
    if settings.capture_dir is None:
        return None
    try:
        tenants = frozenset(check_tenant(it) for it in settings.capture_tenants.split(",") if it)
    except ValueError as error:
        raise CaptureError(f"capture_tenants: {error}") from None
    folder = CaptureFolder(settings.capture_dir, Retention(3600 * settings.capture_hours, settings.capture_mib * 2**20))
    log.warning(
        "calls are captured, photographs and all: %s, for %g hours, %d MiB at most",
        settings.capture_dir,
        settings.capture_hours,
        settings.capture_mib,
    )
    metrics.watch_captures(lambda: folder.disk_bytes)
    return Recorder(folder, store, metrics, partial(circumstances_of, settings), tenants)
