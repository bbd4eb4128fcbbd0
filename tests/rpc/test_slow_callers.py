"""Callers that send or read late or not at all, and those that come again at once, take nothing from the others."""

from __future__ import annotations

import asyncio
import itertools
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, cast

import grpc
import pytest
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from support import raw_http2
from support.guarded import (
    CHECK,
    LIMIT_S,
    METHOD,
    WATCH,
    Channel,
    Counted,
    echo,
    failure,
    lines_of,
    listening,
    serving,
)
from support.waiting import until

from mapless.errors import from_rpc_error
from mapless_server.errors import Overloaded, RequestError, Unauthenticated, Unavailable
from mapless_server.rpc import Call, receiving, sending
from mapless_server.rpc.receiving import OpenMethods, Places, Receiver
from mapless_server.rpc.sending import Pace, Unread
from mapless_server.security import Principal


class Answered:
    """A call whose answer its caller may read."""

    def __init__(self) -> None:
        self._when_read: Callable[[object], None] = lambda _: None

    def add_done_callback(self, callback: Callable[[object], None]) -> None:
        self._when_read = callback

    def is_read(self) -> None:
        self._when_read(self)


def test_unread_answers_of_a_tenant_are_limited_but_for_small_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """One alone may be of any size; what is read makes room again, and other tenants' answers take none."""
    monkeypatch.setattr(sending, "UNREAD_BYTES", 1000)
    monkeypatch.setattr(sending, "SMALL_ANSWER_BYTES", 100)
    unread = Unread()

    def answer(size_bytes: int, tenant: str = "ours", caller: str = "") -> Answered:
        call = Answered()
        unread.add(tenant, caller, size_bytes, cast(Any, call))
        return call

    first = answer(1500)
    assert answer(400, "theirs")
    small = answer(100)
    with pytest.raises(Overloaded, match="wait to be read") as refused:
        answer(101)
    assert refused.value.reason == "UNREAD_ANSWERS"
    assert refused.value.retry_after_s
    first.is_read()
    large = answer(900)
    with pytest.raises(Overloaded):
        answer(101)
    for it in (small, large):
        it.is_read()
    assert answer(1500)


def test_a_token_that_reads_nothing_leaves_room_to_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sending, "UNREAD_BYTES", 1000)
    monkeypatch.setattr(sending, "SMALL_ANSWER_BYTES", 10)
    unread = Unread()

    def fits(caller: str) -> bool:
        try:
            unread.add("ours", caller, 50, cast(Any, Answered()))
        except Overloaded:
            return False
        return True

    def answers(caller: str) -> int:
        return len(list(itertools.takewhile(fits, itertools.repeat(caller))))

    assert [answers("deaf"), answers("robot"), answers("third")] == [15, 3, 1]


async def test_refusals_of_one_token_do_not_delay_those_of_another() -> None:
    pace, begin_s = Pace(), time.monotonic()
    flood = [asyncio.ensure_future(pace.turn(begin_s + 30, ("t", "flood"))) for _ in range(400)]
    await asyncio.sleep(0)
    asked_s = time.monotonic()
    await pace.turn(begin_s + 30, ("t", "robot"))
    assert time.monotonic() - asked_s < 0.5
    assert not all(it.done() for it in flood)
    await asyncio.gather(*flood)


async def test_a_token_takes_at_most_its_part_of_the_calls() -> None:
    places = Places()
    with ExitStack() as stack:
        for _ in range(receiving.MAX_CALLS_OF_CALLER):
            stack.enter_context(places.taken(("t", "many")))
        with pytest.raises(Overloaded) as refused, places.taken(("t", "many")):
            pass
        assert refused.value.reason == "TOO_MANY_CALLS"
        with places.taken(("t", "robot")), places.taken(("u", "many")):
            pass
    with places.taken(("t", "many")):
        pass


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

        def refuse(method: str, call: Call) -> None:
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


class ReadLater:
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
    call = ReadLater()
    watching = asyncio.ensure_future(OpenMethods(Receiver()).guarded(method).stream_stream(None, call))
    for now in (status.SERVING, status.NOT_SERVING, status.UNKNOWN, status.NOT_SERVING):
        await asyncio.wait_for(healthy.set("", now), LIMIT_S)
        await until(lambda: call.begun == 1)
        await asyncio.sleep(0)
    call.may_read.set()
    await until(lambda: call.seen[-1:] == [status.NOT_SERVING])
    assert len(call.seen) == 2  # the first, and how it is now
    watching.cancel()
