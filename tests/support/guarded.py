"""A server on loopback whose calls are guarded, and what is counted of them."""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any, cast

import grpc
import pytest
from grpc_health.v1 import health, health_pb2

from mapless.errors import from_rpc_error
from mapless.v1 import localization_service_pb2 as pb
from mapless_server.rpc import Call, CallGuard
from mapless_server.scheduling import StageRecord

CHECK, WATCH = "/grpc.health.v1.Health/Check", "/grpc.health.v1.Health/Watch"
METHOD = "/mapless.v1.LocalizationService/Localize"
LIMIT_S = 30.0


Channel = Any
"""grpc.aio.Channel, whose annotations are wrong in places."""


Answer = Callable[[Any, Call], Awaitable[Any]]


@dataclass
class Counted:
    """Counts and traces of calls."""

    trace_id: str = ""
    started: list[str] = field(default_factory=list)
    handled: list[tuple[str, str, float, str]] = field(default_factory=list)
    ended: list[tuple[str, Sequence[StageRecord], Mapping[str, object]]] = field(default_factory=list)

    def call_started(self, method: str) -> None:
        self.started.append(method)

    def call_handled(self, method: str, code: str, seconds: float, trace_id: str) -> None:
        self.handled.append((method, code, seconds, trace_id))

    def begin(self, method: str, metadata: Any, start_s: float) -> Counted:
        return self

    def end(self, code: str, stages: Sequence[StageRecord], attributes: Mapping[str, object]) -> None:
        self.ended.append((code, stages, attributes))

    def close(self, limit_s: float) -> None:
        pass

    @property
    def codes(self) -> list[str]:
        """Statuses; checks that counts and traces agree."""
        assert len(self.started) == len(self.handled) == len(self.ended)
        assert [code for _, code, *_ in self.handled] == [code for code, *_ in self.ended]
        return [code for _, code, *_ in self.handled]


@asynccontextmanager
async def serving(answer: Answer, counted: Counted, **options: Any) -> AsyncIterator[Channel]:
    """A channel to a server on loopback whose Localize gives this answer."""
    async with listening(answer, counted, **options) as port, grpc.aio.insecure_channel(f"127.0.0.1:{port}") as channel:
        yield channel


@asynccontextmanager
async def listening(answer: Answer, counted: Counted, **options: Any) -> AsyncIterator[int]:
    """The port of such a server."""
    guard = CallGuard(observer=cast(Any, counted), tracer=cast(Any, counted), **options)
    server = grpc.aio.server(options=[("grpc.max_receive_message_length", 2**20)])
    method = grpc.unary_unary_rpc_method_handler(
        answer, pb.LocalizeRequest.FromString, pb.LocalizeResponse.SerializeToString
    )
    server.add_generic_rpc_handlers(
        [
            grpc.method_handlers_generic_handler(
                "mapless.v1.LocalizationService", {"Localize": guard.guarded(METHOD, method)}
            )
        ]
    )
    healthy = health.aio.HealthServicer()  # type: ignore[attr-defined]
    forms = health_pb2.HealthCheckRequest.FromString, health_pb2.HealthCheckResponse.SerializeToString
    check = grpc.unary_unary_rpc_method_handler(healthy.Check, *forms)
    watch = grpc.unary_stream_rpc_method_handler(healthy.Watch, *forms)
    guarded = {"Check": guard.guarded(CHECK, check), "Watch": guard.guarded(WATCH, watch)}
    server.add_generic_rpc_handlers([grpc.method_handlers_generic_handler("grpc.health.v1.Health", guarded)])
    await healthy.set("", health_pb2.HealthCheckResponse.SERVING)
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    try:
        yield port
    finally:
        await server.stop(5)


async def ask(channel: Channel, data: bytes = b"", timeout: float | None = LIMIT_S, **metadata: str) -> Any:
    """The answer's bytes."""
    pairs = [(name.replace("_", "-"), value) for name, value in metadata.items()]
    return await channel.unary_unary(METHOD)(data, timeout=timeout, metadata=pairs)


async def failure(channel: Channel, data: bytes = b"", **arguments: Any) -> Any:
    with pytest.raises(grpc.RpcError) as caught:
        await ask(channel, data, **arguments)
    return from_rpc_error(caught.value)


def lines_of(caplog: pytest.LogCaptureFixture) -> list[dict[str, Any]]:
    """The fields of the calls' lines in the log."""
    return [vars(it)["fields"] for it in caplog.records if hasattr(it, "fields")]


async def echo(request: Any, call: Call) -> Any:
    return pb.LocalizeResponse()


def raising(error: Exception) -> Answer:
    async def answer(request: Any, call: Call) -> Any:
        raise error

    return answer
