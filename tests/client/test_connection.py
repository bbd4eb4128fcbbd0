"""When a call is tried again, and when not: decided without a server, by a planted clock."""

from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from contextlib import aclosing
from types import SimpleNamespace
from typing import Any

import grpc
import pytest
from google.protobuf import empty_pb2
from hypothesis import given, settings
from hypothesis import strategies as st
from support.clients import _CHANNEL, Played

from mapless.client import Client, _iterated
from mapless.connection import Connection
from mapless.errors import (
    AlreadyExists,
    DeadlineExceeded,
    Internal,
    InvalidArgument,
    MaplessError,
    NotFound,
    ResourceExhausted,
    Unavailable,
    from_rpc_error,
)
from mapless.options import ConnectOptions
from mapless.servers import Servers
from mapless.wire import FieldError

Empty: Any = empty_pb2.Empty  # type: ignore[attr-defined]
UNAVAILABLE = Unavailable("UNAVAILABLE", "gone")


def full(retry_after_s: float | None) -> MaplessError:
    return ResourceExhausted("RESOURCE_EXHAUSTED", "full", retry_after_s=retry_after_s)


def asking(**given: Any) -> Callable[[Connection], Coroutine[Any, Any, Any]]:
    """Makes one call, and returns what it is answered."""
    return lambda connection: connection.call("M", Empty(), lambda it: it, **given)


def test_pauses_double_up_to_the_longest_and_are_counted() -> None:
    options = ConnectOptions(max_attempts=6, initial_backoff_s=0.2, max_backoff_s=1.0)
    played = Played(asking(), [UNAVAILABLE], options)
    assert played.result is UNAVAILABLE
    assert len(played.tries) == 6
    assert played.pauses == pytest.approx([0.2, 0.4, 0.8, 1.0, 1.0])


def test_a_call_is_repeated_until_shortly_before_its_deadline() -> None:
    played = Played(asking(timeout_s=30.0), [UNAVAILABLE], ConnectOptions())
    assert played.result is UNAVAILABLE
    assert 30 - 1.5 < played.took_s <= 31  # an attempt takes a second
    assert max(played.pauses) <= 2.0


def absent(reason: str) -> MaplessError:
    return Unavailable("UNAVAILABLE", f"cannot connect to 127.0.0.1:1: {reason}")


def test_a_first_connection_has_a_time_of_its_own() -> None:
    options = ConnectOptions(connect_timeout_s=6.0)
    missing = absent("no server listens there (connection refused)")
    assert Played(asking(timeout_s=30.0), [missing], options).took_s < 7
    stopped = Played(asking(timeout_s=30.0), [UNAVAILABLE], options)  # it was reached
    assert stopped.took_s > 25


@pytest.mark.parametrize("reason", ["the server does not use TLS", "the server's certificate is for another name"])
def test_what_another_attempt_does_not_change_ends_soon(reason: str) -> None:
    assert len(Played(asking(timeout_s=30.0), [absent(reason)], ConnectOptions()).tries) == 4


def test_a_check_asks_how_the_server_is_now() -> None:
    assert len(Played(asking(timeout_s=30.0, is_check=True), [UNAVAILABLE], ConnectOptions()).tries) == 4


def test_an_attempt_without_answer_names_the_error_before() -> None:
    late = DeadlineExceeded("DEADLINE_EXCEEDED", "no answer in time")
    error = Played(asking(timeout_s=30.0), [UNAVAILABLE, late], ConnectOptions()).result
    assert str(error) == "DEADLINE_EXCEEDED: no answer in time; before that: gone"


class Broken(grpc.RpcError):
    """A status as gRPC raises it."""

    def __init__(self, status: grpc.StatusCode, text: str, *trailers: tuple[str, str]) -> None:
        self.code, self.details, self.trailing_metadata = lambda: status, lambda: text, lambda: trailers


@pytest.mark.parametrize(
    ("details", "is_lost"),
    [
        ("Received RST_STREAM with error code 2", True),
        ("Received RST_STREAM with error code 0", True),
        ("Received RST_STREAM with error code 1", False),
        ("Stream removed", True),
        ("recvmsg:Connection reset by peer", True),
        ("Received http2 header with status: 500", True),
        ("internal error, id=7", False),
        ("Exception iterating responses", False),
    ],
)
def test_a_broken_connection_is_no_fault_of_the_server(details: str, is_lost: bool) -> None:
    for code in (grpc.StatusCode.INTERNAL, grpc.StatusCode.UNKNOWN):
        assert (from_rpc_error(Broken(code, details)).code == "UNAVAILABLE") is is_lost
        assert from_rpc_error(Broken(code, details, ("x-request-id", "7"))).code == code.name


def test_servers_take_turns_and_a_lost_one_is_passed_over() -> None:
    servers = Servers("abc", [_CHANNEL] * 3)
    assert [servers.next(0.0).address for _ in range(4)] == ["a", "b", "c", "a"]
    servers.all[1].lost_until_s = 2.0
    assert [servers.next(1.0).address for _ in range(3)] == ["c", "c", "a"]
    assert {servers.next(2.0).address for _ in range(3)} == {"a", "b", "c"}
    for server, until_s in zip(servers.all, (9.0, 8.0, 7.0), strict=True):
        server.lost_until_s = until_s
    assert {servers.next(3.0).address for _ in range(3)} == {"c"}


def test_all_attempts_share_one_deadline() -> None:
    played = Played(asking(timeout_s=10.0), [UNAVAILABLE, UNAVAILABLE, Empty()], ConnectOptions())
    assert played.tries == pytest.approx([10.0, 10 - 1.2, 10 - 2.6])


@settings(max_examples=100, deadline=None)
@given(
    outcomes=st.lists(st.sampled_from([None, 0.05, 0.7, 3.0, 40.0]), min_size=1, max_size=8),
    code=st.sampled_from(["UNAVAILABLE", "RESOURCE_EXHAUSTED"]),
    timeout_s=st.floats(0.5, 60),
    dice=st.floats(0, 1),
)
def test_laws(outcomes: list[float | None], code: str, timeout_s: float, dice: float) -> None:
    """No attempt begins after the deadline, none earlier than a server at its limit has asked for."""
    kinds = {"UNAVAILABLE": Unavailable, "RESOURCE_EXHAUSTED": ResourceExhausted}
    errors = [kinds[code](code, "", retry_after_s=after_s) for after_s in outcomes]
    options = ConnectOptions(timeout_s=timeout_s)
    played = Played(asking(), errors, options, dice)
    assert played.result in errors
    assert 1 <= len(played.tries) <= timeout_s + 1
    assert all(0 < left_s <= timeout_s for left_s in played.tries)
    for pause_s, error in zip(played.pauses, errors + errors[-1:] * 8, strict=False):
        asked_s = error.retry_after_s or 0.0
        assert pause_s <= max(1.2 * options.max_backoff_s, 1.25 * asked_s)
        assert code == "UNAVAILABLE" or pause_s >= asked_s > 0


def test_a_call_cancelled_by_a_proxy_is_retried_as_maybe_done() -> None:
    """A load balancer says so whose server went in the middle of the answer."""
    cancelled = MaplessError("CANCELLED", "CANCELLED")
    played = Played(asking(timeout_s=10.0), [cancelled, Empty()], ConnectOptions())
    assert played.result == Empty()
    played = Played(asking(on_repeat=found), [cancelled, TAKEN, Empty()], ConnectOptions())
    assert played.result == "found after ALREADY_EXISTS"


def test_a_message_over_the_limit_is_not_sent_again() -> None:
    played = Played(asking(), [full(None)], ConnectOptions())
    assert (len(played.tries), played.pauses) == (1, [])


def test_no_retry_is_started_that_would_miss_the_deadline() -> None:
    refused = full(3.0)
    played = Played(asking(timeout_s=3.5), [refused], ConnectOptions())
    assert (played.result, len(played.tries), played.pauses) == (refused, 1, [])


def test_retries_follow_the_servers_delay_until_the_deadline() -> None:
    starting = Unavailable("UNAVAILABLE", "starting", retry_after_s=1.0)
    played = Played(asking(timeout_s=30.0), [starting], ConnectOptions())
    assert played.pauses == pytest.approx([0.2] + [1.125] * 13)
    assert played.took_s <= 30
    assert Played(asking(timeout_s=30.0), [starting], ConnectOptions(max_attempts=1)).pauses == []


@pytest.mark.parametrize(
    "error",
    [
        InvalidArgument("INVALID_ARGUMENT", "wrong"),
        DeadlineExceeded("DEADLINE_EXCEEDED", "read too late", reason="READ_LATE"),
    ],
)
def test_other_errors_are_final(error: MaplessError) -> None:
    played = Played(asking(), [error], ConnectOptions())
    assert (played.result, len(played.tries)) == (error, 1)


def test_every_upload_has_the_time_of_uploads() -> None:
    options = ConnectOptions(timeout_s=5, upload_timeout_s=50)
    assert Played(asking(is_upload=True), [Empty()], options).tries == [50.0]
    assert Played(asking(is_upload=True, timeout_s=2.0), [Empty()], options).tries == [2.0]


async def found(connection: Connection, error: MaplessError) -> str:
    await connection.call("Get", Empty(), lambda it: it)
    return f"found after {error.code}"


TAKEN, ABSENT = AlreadyExists("ALREADY_EXISTS", "taken"), NotFound("NOT_FOUND", "absent")


def test_a_change_whose_answer_was_lost_is_looked_up() -> None:
    played = Played(asking(on_repeat=found), [UNAVAILABLE, TAKEN, Empty()], ConnectOptions())
    assert played.result == "found after ALREADY_EXISTS"
    assert played.methods == ["M", "M", "Get"]


@pytest.mark.parametrize("outcomes", [[TAKEN], [full(0.1), TAKEN]])
def test_a_conflict_without_a_lost_try_is_an_error(outcomes: list[Any]) -> None:
    """A server at its limit has done nothing, and says so."""
    assert Played(asking(on_repeat=found), outcomes, ConnectOptions()).result is TAKEN


def test_the_error_is_raised_if_the_found_resource_differs() -> None:
    async def foreign(connection: Connection, error: MaplessError) -> str:
        await connection.call("Get", Empty(), lambda it: it)
        raise error

    assert Played(asking(on_repeat=foreign), [UNAVAILABLE, ABSENT, Empty()], ConnectOptions()).result is ABSENT


def test_the_lookup_after_a_lost_answer_has_the_remaining_time() -> None:
    """Each attempt takes a second, and there are 32 things to look up."""

    async def each(connection: Connection, error: MaplessError) -> None:
        for _ in range(32):
            await connection.call("Get", Empty(), lambda it: it)

    played = Played(asking(timeout_s=10.0, on_repeat=each), [UNAVAILABLE, TAKEN, Empty()], ConnectOptions())
    assert isinstance(played.result, DeadlineExceeded)
    assert played.took_s < 10 + 1
    assert played.tries == pytest.approx([10.0, *(8.8 - i for i in range(9))])


def test_a_look_up_has_the_deadline_of_any_call() -> None:
    options = ConnectOptions(timeout_s=5, upload_timeout_s=300)
    played = Played(asking(is_upload=True, on_repeat=found), [UNAVAILABLE, TAKEN, Empty()], options)
    assert played.tries == pytest.approx([300.0, 298.8, 5.0])


@pytest.mark.parametrize("timeout_s", [0, 0.0, -1.0, float("nan")])
def test_no_time_is_not_the_usual_time(timeout_s: float) -> None:
    with pytest.raises(ValueError, match="timeout_s must be above 0"):
        Played(asking(timeout_s=timeout_s), [Empty()], ConnectOptions())


class Stream:
    """A gRPC stream of an early answer, and then an interruption by the keyboard."""

    def __init__(self) -> None:
        self.cancelled = 0

    def __iter__(self) -> Iterator[Any]:
        yield SimpleNamespace(is_final=False)
        raise KeyboardInterrupt

    def cancel(self) -> None:
        self.cancelled += 1


@pytest.mark.parametrize("end", ["interrupted", "closed", "forgotten", "raised"])
def test_a_blocking_stream_is_cancelled_however_it_ends(end: str, monkeypatch: pytest.MonkeyPatch) -> None:
    stream = Stream()

    async def call(connection: Connection) -> AsyncIterator[Any]:
        async with aclosing(connection.streamed("M", Empty(), lambda it: it, None)) as answers:
            async for answer in answers:
                yield answer

    monkeypatch.setattr(Client, "_start", lambda *_: stream)
    with Client("localhost:1") as client:
        answers: Any = _iterated(call)(client)
        assert not next(answers).is_final
        if end == "closed":
            answers.close()
        elif end == "forgotten":
            del answers
        elif end == "raised":
            with pytest.raises(LookupError):
                answers.throw(LookupError())
        else:
            with pytest.raises(KeyboardInterrupt):
                next(answers)
    assert stream.cancelled == 1


def test_an_answer_that_cannot_be_read_is_the_servers_fault() -> None:
    def read(response: Any) -> None:
        raise FieldError("pose.translation_m.x", "must be finite, is nan")

    error = Played(lambda it: it.call("M", Empty(), read), [Empty()], ConnectOptions()).result
    assert isinstance(error, Internal)
    assert (error.code, error.reason, error.field) == ("INTERNAL", "MALFORMED_ANSWER", "pose.translation_m.x")
    assert "answer of M violates" in error.message
    assert isinstance(error.__cause__, FieldError)
