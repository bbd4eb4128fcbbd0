"""Every call has an id, a caller and a deadline, and ends once: in the counts, in the log and in its trace."""

from __future__ import annotations

import asyncio
import logging
import re
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any, cast

import grpc
import pytest
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from support import raw_http2
from support.waiting import until

from mapless.errors import from_rpc_error
from mapless.v1 import localization_service_pb2 as pb
from mapless.wire import FieldError
from mapless_server.errors import NotFound, Overloaded, PermissionDenied, RequestError, Unauthenticated, Unavailable
from mapless_server.rpc import Call, CallGuard, receiving, sending
from mapless_server.rpc.guard import ANSWER_MARGIN_SHARE
from mapless_server.rpc.receiving import OpenMethods, Receiver
from mapless_server.scheduling import Flow, StageRecord
from mapless_server.security import Principal, Role

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


async def unserializable(request: Any, call: Call) -> Any:
    return "not a message"


def raising(error: Exception) -> Answer:
    async def answer(request: Any, call: Call) -> Any:
        raise error

    return answer


@pytest.fixture
def counted(caplog: pytest.LogCaptureFixture) -> Counted:
    caplog.set_level(logging.INFO, "mapless_server.rpc.guard")
    return Counted()


@pytest.mark.parametrize(
    ("answer", "code", "reason"),
    [
        (echo, "OK", None),
        (raising(NotFound("no such scene")), "NOT_FOUND", "NOT_FOUND"),
        (raising(Overloaded("full", retry_after_s=1.0)), "RESOURCE_EXHAUSTED", "OVERLOADED"),
        (raising(FieldError("scene", "is required")), "INVALID_ARGUMENT", "INVALID_ARGUMENT"),
        (raising(RuntimeError("secret")), "INTERNAL", "RuntimeError"),
        (raising(asyncio.TimeoutError()), "INTERNAL", "TimeoutError"),
        (unserializable, "INTERNAL", "TypeError"),
    ],
)
async def test_a_call_ends_once_however_it_ends(
    counted: Counted, caplog: pytest.LogCaptureFixture, answer: Answer, code: str, reason: str | None
) -> None:
    async with serving(answer, counted) as channel:
        if code == "OK":
            await ask(channel)
        else:
            error = await failure(channel)
            assert error.code == code
            assert "secret" not in error.message
        await until(lambda: len(counted.ended) == 1)
    assert counted.codes == [code]
    assert counted.started == [METHOD]
    (line,) = lines_of(caplog)
    assert (line["code"], line.get("reason"), line["method"]) == (code, reason, METHOD)


async def test_bytes_that_are_no_message_are_counted_and_logged(
    counted: Counted, caplog: pytest.LogCaptureFixture
) -> None:
    async with serving(echo, counted) as channel:
        assert (await failure(channel, b"\xff" * 40)).reason == "MALFORMED_MESSAGE"
    assert counted.codes == ["INVALID_ARGUMENT"]
    assert lines_of(caplog)[0]["bytes_in"] == 40


@pytest.mark.parametrize("stubborn", [False, True])
async def test_a_leaving_caller_cancels_the_servicer(counted: Counted, stubborn: bool) -> None:
    begun, ended = asyncio.Event(), asyncio.Event()

    async def slow(request: Any, call: Call) -> Any:
        begun.set()
        try:
            await asyncio.sleep(LIMIT_S)
        finally:
            if stubborn:
                await asyncio.sleep(0.1)
            ended.set()

    async with serving(slow, counted) as channel:
        call = channel.unary_unary(METHOD)(b"", timeout=LIMIT_S)
        answered = asyncio.ensure_future(call)  # what is not waited for is not sent
        await asyncio.wait_for(begun.wait(), LIMIT_S)
        call.cancel()
        with pytest.raises(asyncio.CancelledError):
            await answered
        await until(lambda: len(counted.ended) == 1)
        await asyncio.wait_for(ended.wait(), LIMIT_S)
    assert counted.codes == ["CANCELLED"]


async def test_a_passed_deadline_is_answered_before_the_servicer_ends(
    counted: Counted, caplog: pytest.LogCaptureFixture
) -> None:
    answered = asyncio.Event()

    async def stubborn(request: Any, call: Call) -> Any:
        try:
            await asyncio.sleep(LIMIT_S)
        except asyncio.CancelledError:
            await answered.wait()
            raise RuntimeError("after the end") from None

    async with serving(stubborn, counted, default_deadline_s=0.3) as channel:
        error = await failure(channel, timeout=None)
        assert (error.code, error.reason) == ("DEADLINE_EXCEEDED", "DEADLINE_EXCEEDED")
        answered.set()
        await until(lambda: "after the end" in caplog.text)
    assert counted.codes == ["DEADLINE_EXCEEDED"]
    assert "abandoned" in caplog.text


def test_the_server_itself_answers_at_the_deadline(counted: Counted) -> None:
    """It answers a little before, so that the caller gets a reason, which its own library would not give."""

    async def slow(request: Any, call: Call) -> Any:
        await asyncio.sleep(LIMIT_S)

    async def run() -> set[str]:
        async with serving(slow, counted) as channel:
            reasons: set[str] = set()
            while "DEADLINE_EXCEEDED" not in reasons:  # a busy machine may answer too late
                error = await failure(channel, timeout=0.5)
                assert error.code == "DEADLINE_EXCEEDED"
                reasons.add(error.reason)
            return reasons

    assert asyncio.run(run()) <= {"DEADLINE_EXCEEDED", ""}


@pytest.mark.parametrize(
    ("asked_s", "given_s"), [(None, 20.0), (5.0, 5.0), (50.0, 50.0), (500.0, 100.0), (10**9, 100.0)]
)
async def test_deadlines_have_a_default_and_an_end(counted: Counted, asked_s: float | None, given_s: float) -> None:
    calls: list[Call] = []

    async def answer(request: Any, call: Call) -> Any:
        calls.append(call)
        return pb.LocalizeResponse()

    async with serving(answer, counted, default_deadline_s=20.0, max_deadline_s=100.0) as channel:
        await ask(channel, timeout=asked_s)
    (call,) = calls
    assert call.deadline_s - call.arrived_s == pytest.approx(given_s * (1 - ANSWER_MARGIN_SHARE), abs=1.0)
    assert call.deadline_s - call.arrived_s < given_s


async def test_the_caller_is_authenticated_before_its_message(
    counted: Counted, caplog: pytest.LogCaptureFixture
) -> None:
    seen: list[Call] = []
    asked: list[tuple[str, Any]] = []

    def authenticate(metadata: Any, method: str, auth_context: Mapping[str, Any]) -> Principal:
        token = dict(metadata).get("authorization")
        asked.append((method, auth_context))
        if token is None:
            raise Unauthenticated("a token is needed", reason="TOKEN_MISSING")
        if token == "Bearer reader":
            raise PermissionDenied("not this", reason="ROLE_TOO_LOW")
        return Principal("acme", Role.LOCALIZE, "robot-7")

    async def answer(request: Any, call: Call) -> Any:
        seen.append(call)
        return pb.LocalizeResponse()

    async with serving(answer, counted, authenticate=authenticate) as channel:
        assert (await failure(channel, b"\xff" * 9)).reason == "TOKEN_MISSING"
        assert (await failure(channel, authorization="Bearer reader")).code == "PERMISSION_DENIED"
        await ask(channel, authorization="Bearer good-secret", x_client_id="headset-3")
        stub = health_pb2_grpc.HealthStub(channel)
        assert (await stub.Check(health_pb2.HealthCheckRequest())).status == health_pb2.HealthCheckResponse.SERVING
    assert counted.codes == ["UNAUTHENTICATED", "PERMISSION_DENIED", "OK"]  # health is not counted
    (call,) = seen
    assert call.principal == Principal("acme", Role.LOCALIZE, "robot-7")
    assert call.client == "headset-3"
    assert {method for method, _ in asked} == {METHOD}
    unknown, _, known = lines_of(caplog)
    assert "tenant" not in unknown
    assert (known["tenant"], known["principal"], known["client"]) == ("acme", "robot-7", "headset-3")
    assert not any("good-secret" in str(value) for line in lines_of(caplog) for value in line.values())


class TestCallsWithHeadersOnly:
    @staticmethod
    async def ended(port: int, *begun: bytes, stream: int = 1) -> None:
        """Returns when the server has ended the stream, one of those begun."""
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(raw_http2.hello() + b"".join(begun))
        await asyncio.wait_for(raw_http2.until_ended(reader, stream), LIMIT_S)
        writer.close()

    async def test_a_rejected_call_needs_no_message(self, counted: Counted) -> None:
        def authenticate(*_: Any) -> Principal:
            raise Unauthenticated("a token is needed", reason="TOKEN_MISSING")

        async with listening(echo, counted, authenticate=authenticate) as port:
            await self.ended(port, raw_http2.begin(1, METHOD))
        assert counted.codes == ["UNAUTHENTICATED"]

    @pytest.mark.parametrize(("error", "is_paced"), [(Overloaded("full"), True), (Unavailable("stopping"), False)])
    async def test_refusals_beyond_a_rate_wait_for_their_turn(
        self, counted: Counted, monkeypatch: pytest.MonkeyPatch, error: RequestError, is_paced: bool
    ) -> None:
        monkeypatch.setattr(sending, "PER_S", 20)
        monkeypatch.setattr(sending, "BURST", 2)

        def refuse(method: str, flow: Flow) -> None:
            raise error

        start_s = time.monotonic()
        async with serving(echo, counted, check_admission=refuse) as channel:
            failures = await asyncio.gather(*(failure(channel) for _ in range(10)))
        took_s = time.monotonic() - start_s
        assert {it.code for it in failures} == {error.code}
        assert (took_s > 7 / 20) is is_paced

    async def test_the_message_has_to_come_before_the_deadline(
        self, counted: Counted, caplog: pytest.LogCaptureFixture
    ) -> None:
        async with listening(echo, counted, default_deadline_s=0.2) as port:
            await self.ended(port, raw_http2.begin(1, METHOD))
        assert counted.codes == ["DEADLINE_EXCEEDED"]
        assert lines_of(caplog)[0]["reason"] == "MESSAGE_LATE"

    @pytest.mark.parametrize("method", [CHECK, WATCH])
    async def test_the_message_of_an_open_method_has_little_time(
        self, counted: Counted, monkeypatch: pytest.MonkeyPatch, method: str
    ) -> None:
        monkeypatch.setattr(receiving, "OPEN_MESSAGE_LIMIT_S", 0.2)
        async with listening(echo, counted) as port:
            await self.ended(port, raw_http2.begin(1, method))

    async def test_of_many_waiting_calls_the_oldest_is_evicted(
        self, counted: Counted, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(receiving, "OPEN_MESSAGE_LIMIT_S", 1000.0)
        monkeypatch.setattr(receiving, "MAX_OPEN_WAITING", 2)
        async with listening(echo, counted) as port:
            await self.ended(port, *(raw_http2.begin(stream, CHECK) for stream in (1, 3, 5)), stream=1)
            async with grpc.aio.insecure_channel(f"127.0.0.1:{port}") as channel:
                await check_health(channel)


async def check_health(channel: Channel) -> None:
    answer = await health_pb2_grpc.HealthStub(channel).Check(health_pb2.HealthCheckRequest(), timeout=LIMIT_S)
    assert answer.status == health_pb2.HealthCheckResponse.SERVING


async def test_open_streams_are_limited_and_block_no_probe(counted: Counted, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(receiving, "MAX_OPEN_STREAMS", 2)
    async with serving(echo, counted) as channel:
        stub = health_pb2_grpc.HealthStub(channel)

        async def watch() -> Any:
            """One that has begun."""
            watching = stub.Watch(health_pb2.HealthCheckRequest(), timeout=LIMIT_S)
            assert (await watching.read()).status == health_pb2.HealthCheckResponse.SERVING
            return watching

        async def is_let_in() -> bool:
            try:
                await watch()
            except grpc.RpcError as error:
                codes.add(from_rpc_error(error).code)
                return False
            return True

        codes: set[str] = set()
        first, _ = await watch(), await watch()
        assert not await is_let_in()
        await check_health(channel)
        first.cancel()
        while not await is_let_in():
            await asyncio.sleep(0.01)
        assert not await is_let_in()
        assert codes == {"RESOURCE_EXHAUSTED"}


class Unread:
    """A call whose caller reads only later."""

    def __init__(self) -> None:
        self.may_read = asyncio.Event()
        self.begun, self.seen = 0, list[int]()

    async def read(self) -> bytes:
        return b""

    async def write(self, message: health_pb2.HealthCheckResponse) -> None:
        self.begun += 1
        await self.may_read.wait()
        self.seen.append(message.status)


async def test_a_health_watcher_that_reads_nothing_blocks_no_change() -> None:
    """Its servicer holds a lock while it writes, which a server that stops needs, too."""
    status = health_pb2.HealthCheckResponse
    healthy = health.aio.HealthServicer()  # type: ignore[attr-defined]
    method = grpc.unary_stream_rpc_method_handler(
        healthy.Watch, health_pb2.HealthCheckRequest.FromString, status.SerializeToString
    )
    call = Unread()
    watching = asyncio.ensure_future(OpenMethods(Receiver()).guarded(method).stream_stream(None, call))
    for now in (status.SERVING, status.NOT_SERVING, status.UNKNOWN, status.NOT_SERVING):
        await asyncio.wait_for(healthy.set("", now), LIMIT_S)
        await until(lambda: call.begun == 1)
        await asyncio.sleep(0)
    call.may_read.set()
    await until(lambda: call.seen[-1:] == [status.NOT_SERVING])
    assert len(call.seen) == 2  # the first, and how it is now
    watching.cancel()


async def test_a_call_without_a_message_is_rejected(counted: Counted) -> None:
    async with serving(echo, counted) as channel:
        with pytest.raises(grpc.RpcError) as caught:
            await channel.stream_unary(METHOD)(iter(()), timeout=LIMIT_S)
        assert from_rpc_error(caught.value).reason == "MALFORMED_MESSAGE"
    assert counted.codes == ["INVALID_ARGUMENT"]


async def test_a_message_that_is_too_large_is_counted_once(counted: Counted) -> None:
    async with serving(echo, counted) as channel:
        assert (await failure(channel, bytes(2**20 + 1))).code == "RESOURCE_EXHAUSTED"
        await until(lambda: len(counted.ended) == 1)
    # grpc answers the caller itself and cancels the call at the same time: either may be seen first.
    assert counted.codes in (["CANCELLED"], ["INVALID_ARGUMENT"])


async def test_an_error_in_authentication_admits_no_caller(counted: Counted) -> None:
    def broken(*_: Any) -> Principal:
        raise OSError("the file of tokens is gone")

    async with serving(echo, counted, authenticate=broken) as channel:
        error = await failure(channel)
        assert error.code == "INTERNAL"
        assert "tokens" not in error.message
    assert counted.codes == ["INTERNAL"]


@pytest.mark.parametrize("given", ["a b", "x" * 65, "", "a%0a", 'id="1"'])
async def test_every_caller_is_admitted_by_default_by_address(counted: Counted, given: str) -> None:
    seen: list[Call] = []

    async def answer(request: Any, call: Call) -> Any:
        seen.append(call)
        return pb.LocalizeResponse()

    async with serving(answer, counted) as channel:
        await ask(channel, x_client_id=given, x_request_id=given)
    (call,) = seen
    assert call.principal == Principal()
    assert re.fullmatch(r"ipv4:127\.0\.0\.1:\d+", call.client)
    assert len(call.request_id) == 32


async def test_a_servicers_notes_are_in_the_log_and_in_the_trace(
    counted: Counted, caplog: pytest.LogCaptureFixture
) -> None:
    async def answer(request: Any, call: Call) -> Any:
        start_s = call.arrived_s
        call.note(scene="hall", reference_count=10, code="forged", msg="not the record's")
        prepared = StageRecord("prepare", start_s, start_s + 0.010, start_s + 0.040, batch=1, jobs=1)
        call.record([prepared, StageRecord("coarse", start_s + 0.040, start_s + 0.045, start_s + 0.145, 2, jobs=3)])
        return pb.LocalizeResponse()

    counted.trace_id = "0af7651916cd43dd8448eb211c80319c"
    async with serving(answer, counted) as channel:
        await ask(channel, b"\x0a\x01s", x_request_id="logged")
    (line,) = lines_of(caplog)
    assert line["queue_ms"] == pytest.approx(15)
    assert line["stages_ms"] == {"prepare": 30.0, "coarse": 100.0}
    assert (line["request_id"], line["scene"], line["reference_count"]) == ("logged", "hall", 10)
    assert (line["code"], line["msg"]) == ("OK", "not the record's")
    assert (line["bytes_in"], line["bytes_out"], line["deadline_ms"]) == (3, 0, pytest.approx(30_000, abs=2000))
    assert line["trace_id"] == counted.trace_id == counted.handled[0][3]
    _, stages, attributes = counted.ended[0]
    assert [it.stage for it in stages] == ["prepare", "coarse"]
    assert (attributes["scene"], attributes["request_id"]) == ("hall", "logged")


async def test_cancellation_inside_a_servicer_is_no_cancelled_call(counted: Counted) -> None:
    async def answer(request: Any, call: Call) -> Any:
        dropped: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        dropped.cancel()
        await dropped

    async with serving(answer, counted) as channel:
        assert (await failure(channel)).reason == "GIVEN_UP"
    assert counted.codes == ["UNAVAILABLE"]
