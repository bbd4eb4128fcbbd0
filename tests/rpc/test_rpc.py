"""Every call has an id, a caller and a deadline, and ends once: in the counts, in the log and in its trace."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Mapping
from typing import Any

import grpc
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc
from support.guarded import (
    LIMIT_S,
    METHOD,
    Answer,
    Counted,
    ask,
    echo,
    failure,
    lines_of,
    raising,
    serving,
)
from support.waiting import until

from mapless.errors import from_rpc_error
from mapless.v1 import localization_service_pb2 as pb
from mapless.wire import FieldError
from mapless_server.errors import NotFound, Overloaded, PermissionDenied, Unauthenticated
from mapless_server.rpc import Call
from mapless_server.rpc.guard import ANSWER_MARGIN_SHARE
from mapless_server.scheduling import Flow, StageRecord
from mapless_server.security import Principal, Role


async def unserializable(request: Any, call: Call) -> Any:
    return "not a message"


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
    assert call.flow == Flow("acme", "robot-7", "headset-3")
    assert {method for method, _ in asked} == {METHOD}
    unknown, _, known = lines_of(caplog)
    assert "tenant" not in unknown
    assert (known["tenant"], known["principal"], known["client"]) == ("acme", "robot-7", "headset-3")
    assert not any("good-secret" in str(value) for line in lines_of(caplog) for value in line.values())


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
    assert call.flow == Flow("default", call.client)
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
