"""Takes answered calls from the services and writes them to the folder, without delaying or failing any call.

Calls wait for the disk in a queue that is bounded in number and bytes, and one thread writes them and deletes old ones.
What is not written is counted.
"""

import logging
import math
import os
import platform
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib.metadata import PackageNotFoundError, version

from google.protobuf.message import Message

from mapless.names import parse_reference_name
from mapless_server import __version__
from mapless_server.engine.query import Query, Result, Tier
from mapless_server.observability.metrics import Metrics
from mapless_server.observability.provenance import ROOT, commit_of, cpu_model
from mapless_server.rpc import Call
from mapless_server.scenes.observer import BackgroundObserver
from mapless_server.security import check_tenant, scene_id_of
from mapless_server.settings import Settings
from mapless_server.store import SceneAttributes

from .calls import CapturedCall, CapturedPart, CaptureError, Request, Response, diagnostics_of
from .folder import CaptureFolder

log = logging.getLogger(__name__)

PACKAGES = ("numpy", "scipy", "opencv-python-headless", "poselib", "torch", "kornia")
"""Packages whose arithmetic decides answers."""

DECISIVE_SETTINGS = ("device", "coverage", "retrieval", "reference_depth", "max_batch", "compiled_views")
"""Settings of which another value may change an answer, beside features, backend and weights."""

MAX_QUEUED = 32
"""Calls that wait for the disk."""
MAX_QUEUED_BYTES = 64 * 2**20
"""Size of their messages together."""
FAULT_PAUSE_S = 60.0
"""After a fault of the disk, the time in which nothing is captured, queued calls neither."""
CLOSING_LIMIT_S = 5.0
"""For writing the queued calls when the server stops."""


def captured_part(query: Query, result: Result) -> CapturedPart:
    """Extracts what an answered photograph was compared with, by key only: a queued call needs little memory."""
    choices = () if result.choice is None else (result.choice, *result.other_choices)
    references = {it.reference_id: it.key for choice in choices for it in choice.references}
    if not choices:
        references = {parse_reference_name(it.name)[1]: it.key for it in result.references}
    return CapturedPart(query.photo.field, result.generation, references, choices)


class Recorder:
    """Captures the calls of one server in a folder."""

    def __init__(
        self,
        folder: CaptureFolder,
        observer: BackgroundObserver,
        circumstances: Callable[[Sequence[Tier]], Mapping[str, str]] = lambda _: {},
        tenants: frozenset[str] = frozenset(),
    ) -> None:
        """Starts the thread that writes and deletes; the folder is closed with the recorder.

        For `circumstances`, which also decide the tiers' answers, see `circumstances_of`. Only calls of the tenants are
        captured; of all, if there are none.
        """
        self.folder = folder
        self._observer = observer
        self._tenants = tenants
        self._circumstances = circumstances
        self._known_circumstances: Mapping[str, str] | None = None
        self._queue: deque[tuple[CapturedCall, Sequence[Tier]]] = deque()
        self._queued_bytes = 0
        self._paused_until_s = 0.0
        self._closing_s = math.inf
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="capture", daemon=True)
        self._thread.start()

    def record(
        self,
        request: Request,
        response: Response,
        call: Call,
        parts: Sequence[tuple[Query, Result]],
        tiers: Sequence[Tier],
        prior_attributes: SceneAttributes | None = None,
    ) -> None:
        """Queues an answered call for writing, with its photographs in order and their results.

        Called on the event loop. Of several scenes, the call is kept with the one of its answer. The response's
        diagnostics are set to say whether the call is captured. The tiers are all of the server; `prior_attributes` are
        as of `CapturedCall`.
        """
        tenant = call.principal.tenant
        if self._tenants and tenant not in self._tenants:
            return
        messages: tuple[Message, Message] = request, response
        if reason := self._refusal(sum(it.ByteSize() for it in messages)):
            self._drop(reason)
            return
        for diagnostics in diagnostics_of(response):
            diagnostics.captured = True
        query, result = parts[0]
        captured = CapturedCall(
            call.request_id,
            time.time(),
            type(request).__name__.removesuffix("Request"),
            tenant,
            scene_id_of(result.scene_key or query.scene_key),
            attributes=result.attributes,
            prior_attributes=prior_attributes,
            parts=tuple(captured_part(*part) for part in parts),
            request=messages[0].SerializeToString(),
            response=messages[1].SerializeToString(),
        )
        with self._changed:
            self._queue.append((captured, tiers))
            self._queued_bytes += captured.size_bytes
            self._changed.notify()

    @property
    def is_closing(self) -> bool:
        """Whether the recorder closes, so that only queued calls are still written."""
        return self._closing_s < math.inf

    def close(self) -> None:
        """Writes queued calls within `CLOSING_LIMIT_S`, and closes the folder; from any thread."""
        with self._changed:
            self._closing_s = time.monotonic() + CLOSING_LIMIT_S
            self._changed.notify()
        self._thread.join()
        self.folder.close()

    def _refusal(self, size_bytes: int) -> str:
        """Why another call of this size cannot be queued; empty if it can. Only the event loop adds calls."""
        if time.monotonic() < self._paused_until_s:
            return "disk"
        is_full = len(self._queue) >= MAX_QUEUED or self._queued_bytes + size_bytes > MAX_QUEUED_BYTES
        return "queue" if self._queue and is_full else ""

    def _run(self) -> None:
        pause_s = 0.0
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._queue or self.is_closing, pause_s)
                if self.is_closing and not self._queue:
                    return
                call, tiers = self._queue.popleft() if self._queue else (None, ())
                self._queued_bytes -= 0 if call is None else call.size_bytes
            if call is not None:
                self._write(call, tiers)
            try:
                pause_s = self.folder.tidy()
            except Exception as error:  # must not end the deletion
                log.error("captured calls that are too old cannot be deleted: %s", error, exc_info=error)
                pause_s = 1.0

    def _write(self, call: CapturedCall, tiers: Sequence[Tier]) -> None:
        now_s = time.monotonic()
        if now_s < self._paused_until_s or now_s >= self._closing_s:
            self._drop("disk" if now_s < self._paused_until_s else "queue")
            return
        try:
            if self._known_circumstances is None:
                self._known_circumstances = self._circumstances(tiers)
            if self.folder.add(replace(call, circumstances=self._known_circumstances)):
                self._observer.count("captured")
            else:
                self._drop("size")
        except (OSError, CaptureError) as error:
            self._paused_until_s = time.monotonic() + FAULT_PAUSE_S
            self._drop("disk")
            log.error("nothing is captured for %g s: %s", FAULT_PAUSE_S, error)
        except Exception as error:
            self._drop("fault")
            log.error("capturing a call failed: %s", error, exc_info=error, extra={"request_id": call.request_id})

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


def open_recorder(settings: Settings, metrics: Metrics) -> Recorder | None:
    """Opens the recorder if the settings want one; logs a warning, since photographs are then stored.

    CaptureError if the folder cannot be used, or capture_tenants has an invalid name.
    """
    if settings.capture_dir is None:
        return None
    try:
        tenants = frozenset(check_tenant(it) for it in settings.capture_tenants.split(",") if it)
    except ValueError as error:
        raise CaptureError(f"capture_tenants: {error}") from None
    folder = CaptureFolder(settings.capture_dir, 3600 * settings.capture_hours, settings.capture_mib * 2**20)
    log.warning(
        "calls are captured, photographs and all: %s, for %g hours, %d MiB at most",
        settings.capture_dir,
        settings.capture_hours,
        settings.capture_mib,
    )
    metrics.watch_captures(lambda: folder.disk_bytes)
    return Recorder(folder, metrics, partial(circumstances_of, settings), tenants)
