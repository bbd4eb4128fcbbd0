"""The handlers of all RPCs: both services, health and reflection, each behind the call guard."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import grpc
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection, reflection_pb2
from grpc_reflection.v1alpha._async import ReflectionServicer

from mapless.v1 import (
    localization_service_pb2,
    localization_service_pb2_grpc,
    reference_service_pb2,
    reference_service_pb2_grpc,
)
from mapless_server.errors import DeadlineExceeded, Unavailable
from mapless_server.observability.metrics import Metrics
from mapless_server.rpc import Authenticate, Call, CallGuard
from mapless_server.settings import Settings
from mapless_server.store import Store

from .capture.recorder import Recorder
from .localization import Count, LocalizationService, Offer
from .references import ReferenceService
from .watching import Watchers

if TYPE_CHECKING:
    from mapless_server.engine.queue_engine import QueueEngine
    from mapless_server.observability.otlp import OtlpTracer

log = logging.getLogger(__name__)

SERVICE_NAMES = (
    localization_service_pb2.DESCRIPTOR.services_by_name["LocalizationService"].full_name,
    reference_service_pb2.DESCRIPTOR.services_by_name["ReferenceService"].full_name,
)

_NEEDS_ROOM = {
    **{
        f"/{SERVICE_NAMES[0]}/{name}": True
        for name in ("Localize", "LocalizeProgressively", "LocalizeRig", "LocalizeSequence")
    },
    **{f"/{SERVICE_NAMES[1]}/{name}": False for name in ("CreateReference", "BatchCreateReferences")},
}
"""The methods whose messages are large and whose work waits in the queue, and whether they are queries."""

_LEAST_S = 0.002
"""Such a method takes longer, however small its photographs: with less time left its message is not read."""

_OF_STORE_ALONE = ("CreateScene", "ListScenes", "UpdateScene", "GetReference", "ListReferences", "GetSceneReport")
_OF_STORE = frozenset(f"/{SERVICE_NAMES[1]}/{name}" for name in _OF_STORE_ALONE)
"""The methods that need the store alone: they are answered while the server starts."""


class _Health(health.aio.HealthServicer):  # type: ignore[name-defined,misc]
    """Health service with the method List, which grpc's own implementation lacks."""

    def __init__(self) -> None:
        super().__init__()
        self._states: dict[str, Any] = {}

    async def set(self, service: str, status: Any) -> None:
        """Sets the state of a service."""
        self._states[service] = status
        await super().set(service, status)

    async def List(self, request: Any, context: Any) -> Any:  # noqa: N802  the RPC's name
        """Implements Health.List."""
        states = {name: health_pb2.HealthCheckResponse(status=it) for name, it in self._states.items()}
        return health_pb2.HealthListResponse(statuses=states)


class Services:
    """All services of a server; `drain` ends them in order.

    Until `open` sets the engine they answer calls that need the store alone, and UNAVAILABLE to others.

    `handlers`, by service and method, are for the server that listens.
    """

    def __init__(
        self,
        settings: Settings,
        store: Store,
        metrics: Metrics,
        *,
        authenticate: Authenticate | None = None,
        tracer: OtlpTracer | None = None,
        recorder: Recorder | None = None,
    ) -> None:
        self._metrics = metrics
        self._engine: QueueEngine | None = None
        self._health = _Health()
        self._is_serving = self._is_draining = False
        self._is_changeable = True
        self._start = "it opens its store"
        self._guard = CallGuard(
            settings.default_deadline_s,
            settings.max_deadline_s,
            authenticate=authenticate,
            check_admission=self._check_admission,
            observer=metrics,
            tracer=tracer,
        )
        self._watchers = Watchers(settings.allow_watching, settings.max_message_mib * 2**20)
        self._references = ReferenceService(self._ready_engine, store, settings.capture_hours)
        self.handlers: dict[str, dict[str, grpc.RpcMethodHandler]] = {}
        self._localization = LocalizationService(self._ready_engine, metrics, store, self._watchers, recorder)
        reference_service_pb2_grpc.add_ReferenceServiceServicer_to_server(self._references, self)
        localization_service_pb2_grpc.add_LocalizationServiceServicer_to_server(self._localization, self)
        health_pb2_grpc.add_HealthServicer_to_server(self._health, self)
        if settings.reflection:
            self._add_reflection((*SERVICE_NAMES, health.SERVICE_NAME, reflection.SERVICE_NAME))

    def add_to(self, server: Any) -> None:
        """Adds the handlers to a grpc.aio.Server that has not been started."""
        for service, methods in self.handlers.items():
            server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(service, methods),))

    def add_registered_method_handlers(self, service: str, methods: Mapping[str, Any]) -> None:
        """Receives a servicer's methods from grpc's generated code, which sees this object as its server."""
        self.handlers[service] = {
            name: self._guard.guarded(f"/{service}/{name}", handler) for name, handler in methods.items()
        }

    def add_generic_rpc_handlers(self, handlers: object) -> None:
        """Ignores the second registration of generated code, which is meant for older servers."""

    def _add_reflection(self, service_names: tuple[str, ...]) -> None:
        """Adds both versions of reflection: the package has only v1alpha; v1 is the same under another name."""
        method = grpc.stream_stream_rpc_method_handler(
            ReflectionServicer(service_names).ServerReflectionInfo,
            request_deserializer=reflection_pb2.ServerReflectionRequest.FromString,
            response_serializer=reflection_pb2.ServerReflectionResponse.SerializeToString,
        )
        for service in (reflection.SERVICE_NAME, "grpc.reflection.v1.ServerReflection"):
            self.add_registered_method_handlers(service, {"ServerReflectionInfo": method})

    def starts(self, step: str) -> None:
        """Says in the log, at "/ready" and to refused callers what the server does before it serves: "it loads ..."."""
        self._start = step
        self._metrics.not_serving_because = f"starting: {step}"
        log.info("the server starts: %s", step)

    async def open(self, engine: QueueEngine, offer: Offer | None = None, count: Count | None = None) -> None:
        """Starts to serve, with an engine that has been warmed up.

        `offer` receives answers to single photographs, `count` all photographs of answers that are not confidential.
        """
        self._engine = engine
        self._localization.offer, self._localization.count = offer, count
        await self.set_serving(True)

    async def drain(self, delay_s: float, grace_s: float) -> None:
        """Reports that the server stops serving; after a delay, refuses new calls and waits for the running ones.

        The delay is for load balancers, which send calls until their next health check; the wait is at most `grace_s`.
        """
        self._metrics.not_serving_because = "stopping"
        await self.set_serving(False)
        if delay_s:
            await asyncio.sleep(delay_s)
        self._is_draining = True
        self._watchers.close()
        await self._guard.wait_until_idle(grace_s)
        if self._engine is not None:
            self._engine.drain()

    async def close(self) -> None:
        """Returns when the store is no longer used; to be called after the server has stopped listening."""
        await asyncio.to_thread(self._references.close)

    async def set_serving(self, is_serving: bool) -> None:
        """Sets the health of all services."""
        status = health_pb2.HealthCheckResponse
        self._is_serving = is_serving
        for service in ("", *SERVICE_NAMES):
            serves = is_serving and (self._is_changeable or service != SERVICE_NAMES[1])
            await self._health.set(service, status.SERVING if serves else status.NOT_SERVING)
        self._metrics.set_serving(is_serving)

    async def set_changeable(self, is_changeable: bool) -> None:
        """Sets the health of the ReferenceService: queries are answered even while the store cannot be written."""
        self._is_changeable = is_changeable
        if self._is_serving:
            await self.set_serving(True)

    def _check_admission(self, method: str, call: Call) -> None:
        """Raises Unavailable while the server starts or stops, and Overloaded while it has no room for the caller.

        DeadlineExceeded if a photograph is to be computed in no time.
        """
        if self._is_draining:
            raise Unavailable("the server is stopping", reason="DRAINING", retry_after_s=1.0)
        if self._engine is None and method in _OF_STORE:
            return
        engine = self._ready_engine()
        if (is_query := _NEEDS_ROOM.get(method)) is not None:
            if call.deadline_s - time.monotonic() < _LEAST_S:
                raise DeadlineExceeded("no photograph is computed in so little time", reason="DEADLINE_INFEASIBLE")
            engine.check_room(call.flow, is_query)

    def _ready_engine(self) -> QueueEngine:
        if self._engine is None:
            raise Unavailable(f"the server is starting: {self._start}", reason="STARTING", retry_after_s=1.0)
        return self._engine
