"""Streams are counted once however they end, and closed; a drain waits for finite ones, and not for endless ones."""

from __future__ import annotations

import asyncio
import gc
import time
import warnings
import weakref
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any, cast

import grpc
import pytest
from support.waiting import until

from mapless.errors import from_rpc_error
from mapless.v1 import localization_service_pb2 as pb
from mapless.wire import FieldError
from mapless_server.errors import FailedPrecondition, Unauthenticated
from mapless_server.rpc import Call, CallGuard, sending
from mapless_server.rpc import guard as rpc
from mapless_server.security import Principal

METHOD = "/mapless.v1.LocalizationService/WatchQueries"
FINITE = "/mapless.v1.LocalizationService/LocalizeProgressively"
LIMIT_S = 30.0


@dataclass
class Counted:
    """Counts of calls."""

    started: int = 0
    handled: list[str] = field(default_factory=list)

    def call_started(self, method: str) -> None:
        assert method in {METHOD, FINITE}
        self.started += 1

    def call_handled(self, method: str, code: str, seconds: float, trace_id: str) -> None:
        self.handled.append(code)


class Numbers:
    """Messages that count up to `last`; then the stream ends, raises, or waits for ever."""

    def __init__(self, last: int, then: Exception | str = "end") -> None:
        self._last, self._then, self._count = last, then, 0
        self.is_closed = False

    def __aiter__(self) -> Numbers:
        return self

    async def __anext__(self) -> pb.WatchQueriesResponse:
        if self._count == self._last:
            if isinstance(self._then, Exception):
                raise self._then
            if self._then == "end":
                raise StopAsyncIteration
            await asyncio.Event().wait()
        self._count += 1
        return pb.WatchQueriesResponse(missed_count=self._count)

    async def aclose(self) -> None:
        self.is_closed = True


@asynccontextmanager
async def serving(
    numbers: Numbers | Exception,
    counted: Counted,
    understand: Callable[[bytes], pb.WatchQueriesRequest] = pb.WatchQueriesRequest.FromString,
    **options: Any,
) -> AsyncIterator[tuple[Any, CallGuard]]:
    """A channel to a server whose streams give these numbers; it buffers 64 KiB of an unread message."""

    async def watch(request: pb.WatchQueriesRequest, call: Call) -> Numbers:
        if isinstance(numbers, Exception):
            raise numbers
        assert request.scene == "scenes/hall"
        return numbers

    guard = CallGuard(observer=cast(Any, counted), **options)
    server = grpc.aio.server()
    method = grpc.unary_stream_rpc_method_handler(watch, understand, pb.WatchQueriesResponse.SerializeToString)
    service = {name.rpartition("/")[2]: guard.guarded(name, method) for name in (METHOD, FINITE)}
    server.add_generic_rpc_handlers([grpc.method_handlers_generic_handler("mapless.v1.LocalizationService", service)])
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    try:
        as_by_default = [("grpc.http2.bdp_probe", 0)]  # or the window would grow with what was read before
        async with grpc.aio.insecure_channel(f"127.0.0.1:{port}", as_by_default) as channel:
            yield channel, guard
    finally:
        await server.stop(5)


def watching(channel: Any, timeout: float | None = LIMIT_S, method: str = METHOD) -> Any:
    request = pb.WatchQueriesRequest(scene="scenes/hall").SerializeToString()
    return channel.unary_stream(method)(request, timeout=timeout)


async def read(call: Any, seen: list[int] | None = None) -> list[int]:
    """The messages' numbers; `seen` has them if it fails, too."""
    seen = [] if seen is None else seen
    async for data in call:
        seen += [pb.WatchQueriesResponse.FromString(data).missed_count]
    return seen


@pytest.mark.parametrize("method", [METHOD, FINITE])
async def test_all_messages_arrive_and_the_stream_is_counted(method: str) -> None:
    counted, numbers = Counted(), Numbers(5)
    async with serving(numbers, counted) as (channel, _):
        call = watching(channel, method=method)
        assert await read(call) == [1, 2, 3, 4, 5]
        assert "x-request-id" in dict(await call.trailing_metadata())
    assert (counted.started, counted.handled, numbers.is_closed) == (1, ["OK"], True)


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (FailedPrecondition("not now"), "FAILED_PRECONDITION"),
        (FieldError("scene", "is none"), "INVALID_ARGUMENT"),
        (RuntimeError("secret"), "INTERNAL"),
    ],
)
@pytest.mark.parametrize("when", ["at once", "later"])
@pytest.mark.parametrize("method", [METHOD, FINITE])
async def test_a_failing_stream_ends_with_the_error(error: Exception, code: str, when: str, method: str) -> None:
    counted, numbers, seen = Counted(), Numbers(2, error), list[int]()
    async with serving(error if when == "at once" else numbers, counted) as (channel, _):
        with pytest.raises(grpc.RpcError) as caught:
            await read(watching(channel, method=method), seen)
        failure = from_rpc_error(caught.value)
    assert (failure.code, counted.handled) == (code, [code])
    assert failure.request_id
    assert "secret" not in str(failure)
    assert (seen, numbers.is_closed) == (([], False) if when == "at once" else ([1, 2], True))


async def test_a_leaving_caller_ends_the_stream() -> None:
    counted, numbers = Counted(), Numbers(1, "wait")
    async with serving(numbers, counted) as (channel, _):
        call = watching(channel)
        await call.initial_metadata()
        await call.read()
        call.cancel()
        await until(lambda: numbers.is_closed)
        await until(lambda: counted.handled == ["CANCELLED"])


class Photographs(Numbers):
    """Messages that are larger than a connection buffers."""

    async def __anext__(self) -> pb.WatchQueriesResponse:
        await asyncio.sleep(0.001)
        message = await super().__anext__()
        message.image = bytes(2**20)
        return message


@pytest.mark.parametrize("how", ["cancels", "closes its channel", "reaches its deadline"])
async def test_a_watcher_leaving_during_a_photo_is_no_server_fault(how: str, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("WARNING"):
        counted, numbers = Counted(), Photographs(10**9)
        async with serving(numbers, counted) as (channel, _):
            call = watching(channel, 1.0 if how == "reaches its deadline" else LIMIT_S)
            await call.initial_metadata()
            await asyncio.sleep(0.3)  # the server waits in the middle of a message
            if how == "cancels":
                call.cancel()
            elif how == "closes its channel":
                await channel.close()
            await until(lambda: len(counted.handled) == 1)
        assert numbers.is_closed
        assert counted.handled == ["DEADLINE_EXCEEDED" if how == "reaches its deadline" else "CANCELLED"]
    assert not caplog.records


async def test_it_outlasts_other_deadlines_and_ends_at_its_own() -> None:
    counted, numbers = Counted(), Numbers(0, "wait")
    async with serving(numbers, counted, default_deadline_s=0.2, max_deadline_s=0.3) as (channel, _):
        call = watching(channel, timeout=None)
        await call.initial_metadata()
        await asyncio.sleep(0.5)
        assert not numbers.is_closed
        call.cancel()
        await until(lambda: numbers.is_closed)
        with pytest.raises(grpc.RpcError) as caught:
            await read(watching(channel, timeout=0.4))
        assert from_rpc_error(caught.value).code == "DEADLINE_EXCEEDED"
        await until(lambda: len(counted.handled) == 2)


async def test_a_missing_message_ends_an_endless_call_too() -> None:
    counted = Counted()
    async with serving(Numbers(0), counted, default_deadline_s=0.2) as (channel, _):
        call = channel.stream_stream(METHOD)()
        with pytest.raises(grpc.RpcError) as caught:
            await call.read()
        assert from_rpc_error(caught.value).reason == "MESSAGE_LATE"
    assert counted.handled == ["DEADLINE_EXCEEDED"]


async def test_a_drain_does_not_wait_for_an_endless_stream() -> None:
    async with serving(Numbers(0, "wait"), Counted()) as (channel, guard):
        call = watching(channel)
        await call.initial_metadata()
        start_s = time.monotonic()
        await guard.wait_until_idle(LIMIT_S)
        assert time.monotonic() - start_s < LIMIT_S / 2
        call.cancel()


async def test_a_revoked_token_ends_the_stream() -> None:
    allowed = [
        True,
        True,
        True,
        True,
        False,
    ]  # with the headers, with the message, and before each message that is sent

    def authenticate(*_: Any) -> Principal:
        if not allowed.pop(0):
            raise Unauthenticated("it has been revoked", reason="TOKEN_INVALID")
        return Principal()

    counted, numbers, seen = Counted(), Numbers(9), list[int]()
    async with serving(numbers, counted, authenticate=authenticate) as (channel, _):
        with pytest.raises(grpc.RpcError) as caught:
            await read(watching(channel), seen)
        assert from_rpc_error(caught.value).reason == "TOKEN_INVALID"
    assert seen == [1, 2]
    assert (counted.handled, numbers.is_closed) == (["UNAUTHENTICATED"], True)


class Large(Numbers):
    """Messages that are together larger than a connection buffers."""

    async def __anext__(self) -> pb.WatchQueriesResponse:
        message = await super().__anext__()
        message.image = bytes(3_000_000)
        return message


class Asked:
    """A parsed request."""

    scene = "scenes/hall"


class TestFiniteStreams:
    @pytest.mark.parametrize("options", [{"default_deadline_s": 0.3}, {"max_deadline_s": 0.3}])
    async def test_their_deadline_is_that_of_unary_calls(self, options: dict[str, Any]) -> None:
        counted, numbers, seen = Counted(), Numbers(1, "wait"), list[int]()
        async with serving(numbers, counted, **options) as (channel, _):
            with pytest.raises(grpc.RpcError) as caught:
                await read(watching(channel, LIMIT_S if "max_deadline_s" in options else None, FINITE), seen)
            failure = from_rpc_error(caught.value)
            await until(lambda: numbers.is_closed)
        assert (failure.code, failure.reason, seen) == ("DEADLINE_EXCEEDED", "DEADLINE_EXCEEDED", [1])
        assert failure.request_id
        assert counted.handled == ["DEADLINE_EXCEEDED"]

    async def test_a_drain_waits_for_them(self) -> None:
        numbers = Numbers(1, "wait")
        async with serving(numbers, Counted()) as (channel, guard):
            call = watching(channel, method=FINITE)
            await call.read()
            idle = asyncio.ensure_future(guard.wait_until_idle(LIMIT_S))
            await asyncio.sleep(0.05)
            assert not idle.done()
            call.cancel()
            await asyncio.wait_for(idle, LIMIT_S)
            assert numbers.is_closed

    async def test_messages_in_time_wait_for_a_slow_reader(self, caplog: pytest.LogCaptureFixture) -> None:
        with caplog.at_level("WARNING"):
            counted, numbers = Counted(), Large(8)
            async with serving(numbers, counted, default_deadline_s=0.2) as (channel, _):
                call = watching(channel, None, FINITE)
                await call.initial_metadata()
                await until(lambda: numbers.is_closed)
                await asyncio.sleep(0.4)
                assert not counted.handled
                assert await read(call) == [*range(1, 9)]
            assert counted.handled == ["OK"]
        assert not caplog.records

    async def test_a_slow_reader_does_not_keep_the_request_in_memory(self) -> None:
        requests: list[weakref.ref[Asked]] = []

        def understand(data: bytes) -> Any:
            asked = Asked()
            requests.append(weakref.ref(asked))
            return asked

        counted, numbers = Counted(), Large(8)
        async with serving(numbers, counted, understand) as (channel, _):
            call = watching(channel, method=FINITE)
            await until(lambda: numbers.is_closed)
            assert [it() for it in requests] == [None]
            assert not counted.handled
            assert await read(call) == [*range(1, 9)]

    async def test_one_that_expired_before_it_began_leaves_nothing(self) -> None:
        def authenticate(*_: Any) -> Principal:
            time.sleep(0.15)  # with the headers, and with the message
            return Principal()

        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            late = serving(Numbers(1), Counted(), default_deadline_s=0.2, authenticate=authenticate)
            async with late as (channel, _):
                with pytest.raises(grpc.RpcError) as caught:
                    await read(watching(channel, None, FINITE))
            assert from_rpc_error(caught.value).reason == "DEADLINE_EXCEEDED"
            gc.collect()
        assert not warned


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> Iterator[None]:
    """A server with short limits for readers, which logs no warning."""
    for limit in ("SEND_LIMIT_S", "ENDLESS_SEND_LIMIT_S"):
        monkeypatch.setattr(rpc, limit, 0.1)
    monkeypatch.setattr(sending, "_STATUS_LIMIT_S", 0.1)
    with caplog.at_level("WARNING"):
        yield
    assert not caplog.records


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("method", [METHOD, FINITE])
class TestSlowReaders:
    """The call has no deadline."""

    @pytest.mark.parametrize("read_before", [0, 1])
    async def test_one_gets_the_error_when_it_reads_again(self, method: str, read_before: int) -> None:
        counted, numbers = Counted(), Large(8)
        async with serving(numbers, counted) as (channel, guard):
            before = len(asyncio.all_tasks())
            call, seen = watching(channel, None, method), list[int]()
            for _ in range(read_before):
                await anext(aiter(call))
            await until(lambda: len(counted.handled) == 1)
            await guard.wait_until_idle(LIMIT_S)
            assert numbers.is_closed
            with pytest.raises(grpc.RpcError) as caught:
                await asyncio.wait_for(read(call, seen), LIMIT_S)
            failure = from_rpc_error(caught.value)
            await until(lambda: len(asyncio.all_tasks()) == before + 1)  # the one that asks
        assert (failure.code, failure.reason) == ("DEADLINE_EXCEEDED", "READ_LATE")
        assert failure.request_id
        assert seen == [read_before + 1]
        assert counted.handled == ["DEADLINE_EXCEEDED"]

    async def test_one_that_leaves_without_reading_leaves_no_task(self, method: str) -> None:
        counted = Counted()
        async with serving(Large(8), counted) as (channel, _):
            before = len(asyncio.all_tasks())
            call = watching(channel, None, method)
            await until(lambda: len(counted.handled) == 1)
            call.cancel()
            await until(lambda: len(asyncio.all_tasks()) == before + 1)  # the one that asks
        assert counted.handled == ["DEADLINE_EXCEEDED"]
