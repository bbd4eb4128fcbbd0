"""Calls as data: what is asked and how the answer is read, apart from who waits for it.

An exchange is a generator that yields calls, is sent their responses and returns what the caller wanted. The blocking
and the asynchronous client drive the same exchanges, so each request is built and each answer read in one place.
`attempts` puts retries and deadlines around an exchange; what is left to a client are two things: make an attempt, and
pause.

gRPC's own retries are not used. They know no RetryInfo, so they would take a server at its limit (come back in 3 s) for
a message over the limit (never come back), and they repeat a creation without being able to tell whose it then was.
"""

from __future__ import annotations

import math
import random
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from google.protobuf.message import Message

from .errors import DeadlineExceeded, Internal, MaplessError
from .options import ConnectOptions
from .routing import scene_metadata
from .wire import FieldError

T = TypeVar("T")

MALFORMED_ANSWER = "MALFORMED_ANSWER"
"""The reason of the error that an answer is which breaks its contract."""

_JITTER = 0.2  # of a pause of ours, either way, as gRPC has it
_LOST = frozenset({"UNAVAILABLE", "CANCELLED"})
"""The server, or what is between, is gone. Nobody here cancels a call and waits for it: if it is said to be, then by a
load balancer, whose server went in the middle of the answer."""
_LATENESS = 0.25  # at most so much longer than the server asked for, never earlier: it refused many, and all will come


@dataclass(frozen=True)
class Call:
    """One call, of one request and one answer.

    Attributes:
        method: "package.Service/Method".
        request: the message.
        response_type: of which the answer is.
        timeout_s: deadline, above 0, with all retries and pauses, and with what `on_repeat` asks; None for the
            options' own.
        is_upload: whether that is then `upload_timeout_s`.
        on_repeat: for calls that change something: an earlier try may have succeeded though its answer was lost, and
            then the next one fails as if somebody else had done it. Given the error, it raises it, or yields the calls
            that find out, and returns what the lost answer would have been. All of them have the deadline of this one.
        early: for calls that are answered by a stream, whose last message is the response: what a message tells before
            that; None if it is the last.
    """

    method: str
    request: Message
    response_type: type[Message]
    timeout_s: float | None = None
    is_upload: bool = False
    on_repeat: Callable[[MaplessError], Exchange[Any]] | None = None
    early: Callable[[Any], Any] | None = None

    @property
    def metadata(self) -> tuple[tuple[str, str], ...]:
        """What it carries besides what all calls do: which scene it concerns, for load balancers."""
        return scene_metadata(self.request)


Exchange = Generator[Call, Any, T]
"""Yields calls, is sent their responses (or thrown their errors), returns what the caller wanted."""


@dataclass(frozen=True)
class Pages(Generic[T]):
    """A list fetched page by page: `fetch(token)` gives a page's items and the next token, "" after the last."""

    fetch: Callable[[str], Exchange[tuple[list[T], str]]]


@dataclass(frozen=True)
class Attempt:
    """Make this call once, within `timeout_s`; send back the response, or the error."""

    call: Call
    timeout_s: float


@dataclass(frozen=True)
class Pause:
    """Wait; if there is to be no further attempt, `error` is how the call ended."""

    duration_s: float
    error: MaplessError


class Methods:
    """The methods of a channel, of either kind, by the calls that need them."""

    def __init__(self, channel: Any) -> None:
        self._channel = channel
        self._by_name: dict[str, Callable[..., Any]] = {}

    def of(self, call: Call) -> Callable[..., Any]:
        """What makes the call: takes the request, `timeout` in seconds and `metadata`."""
        if call.method not in self._by_name:
            make = self._channel.unary_unary if call.early is None else self._channel.unary_stream
            self._by_name[call.method] = make(
                f"/{call.method}",
                request_serializer=type(call.request).SerializeToString,
                response_deserializer=call.response_type.FromString,
            )
        return self._by_name[call.method]


@dataclass
class _Clock:
    """What time it is and what the dice say; tests have their own."""

    now_s: Callable[[], float] = time.monotonic
    uniform: Callable[[float, float], float] = field(default=random.uniform)


def attempts(
    exchange: Exchange[T], options: ConnectOptions, clock: _Clock | None = None, deadline_s: float = math.inf
) -> Generator[Attempt | Pause, Any, T]:
    """The exchange with retries: yields what is to be done, returns what the exchange does.

    A call is tried again if the server is UNAVAILABLE or lost, or RESOURCE_EXHAUSTED and says when to come back; never
    if the pause before would outlast its deadline. A server that says when to come back is taken at its word until
    then; other attempts are counted. An answer that the exchange cannot read is an error of the server, `Internal`.

    Args:
        exchange: the calls.
        options: how often to try, and for how long.
        clock: another than the computer's.
        deadline_s: of all calls together, by that clock, beside each call's own.

    Raises:
        ValueError: a call's `timeout_s` is not above 0.
    """
    clock = clock or _Clock()
    try:
        call = next(exchange)
        while True:
            outcome = yield from _with_retries(call, options, clock, deadline_s)
            call = exchange.throw(outcome) if isinstance(outcome, MaplessError) else _answered(exchange, call, outcome)
    except StopIteration as end:
        value: T = end.value
        return value
    finally:
        exchange.close()


def _answered(exchange: Exchange[Any], call: Call, response: Message) -> Call:
    """The exchange's next call; what it cannot read in the response breaks the contract."""
    with _reading(call, response):
        return exchange.send(response)


@contextmanager
def _reading(call: Call, response: Message) -> Iterator[None]:
    """What cannot be read in a response is an error of the server.

    `wire` calls that a FieldError, which in a request is the caller's fault and here the server's.
    """
    try:
        yield
    except (ValueError, OverflowError) as error:
        field_path = error.field if isinstance(error, FieldError) else None
        message = f"the answer of {call.method} breaks its contract: {error}"
        request_id = getattr(getattr(response, "diagnostics", None), "request_id", "")
        raise Internal("INTERNAL", message, reason=MALFORMED_ANSWER, field=field_path, request_id=request_id) from error


class Heard:
    """What the streams of a call's attempts say: what is told early, once, and how each of them ends.

    An attempt that breaks after it has told something is followed by another like any other, and that tells nothing but
    the answer.

    Attributes:
        outcome: of the attempt at hand, for `attempts`.
    """

    outcome: Message | MaplessError

    def __init__(self) -> None:
        self._has_told = False

    def begin(self, call: Call) -> None:
        """Another attempt."""
        self._call = call
        message = f"the stream of {call.method} ended before the answer"
        self.outcome = Internal("INTERNAL", message, reason=MALFORMED_ANSWER)

    def hear(self, message: Message) -> Any | None:
        """What a message tells early; None if it is the answer, or if so much has been told."""
        assert self._call.early is not None
        with _reading(self._call, message):
            early = self._call.early(message)
        if early is None:
            self.outcome = message
        elif not self._has_told:
            self._has_told = True
            return early
        return None

    def fail(self, error: MaplessError) -> None:
        """The stream broke; after the answer that does not matter."""
        if not isinstance(self.outcome, Message):
            self.outcome = error


def _with_retries(
    call: Call, options: ConnectOptions, clock: _Clock, deadline_s: float
) -> Generator[Attempt | Pause, Any, Any]:
    """One call until it succeeds, fails for good, or has no attempts or no time left; its response, or its error."""
    deadline_s = min(clock.now_s() + _timeout_s(call, options), deadline_s)
    if clock.now_s() >= deadline_s:
        return DeadlineExceeded("DEADLINE_EXCEEDED", f"no time was left for {call.method}")
    may_be_done = False  # by a try whose answer never came
    attempt = 0
    while True:
        outcome = yield Attempt(call, max(deadline_s - clock.now_s(), 0.0))
        attempt += 1
        if not isinstance(outcome, MaplessError):
            return outcome
        if may_be_done and call.on_repeat is not None and outcome.code in {"ALREADY_EXISTS", "NOT_FOUND"}:
            return (yield from _found_out(call.on_repeat(outcome), options, clock, deadline_s))
        pause_s = _pause_s(outcome, attempt, options, clock)
        is_last = attempt >= options.max_attempts and (outcome.retry_after_s is None or options.max_attempts == 1)
        if pause_s is None or is_last or clock.now_s() + pause_s >= deadline_s:
            return outcome
        may_be_done |= outcome.code in _LOST
        yield Pause(pause_s, outcome)


def _timeout_s(call: Call, options: ConnectOptions) -> float:
    if call.timeout_s is None:
        return options.upload_timeout_s if call.is_upload else options.timeout_s
    if not call.timeout_s > 0:
        raise ValueError(f"timeout_s must be above 0, is {call.timeout_s:g}")
    return call.timeout_s


def _found_out(
    exchange: Exchange[Any], options: ConnectOptions, clock: _Clock, deadline_s: float
) -> Generator[Attempt | Pause, Any, Any]:
    try:
        return (yield from attempts(exchange, options, clock, deadline_s))
    except MaplessError as error:
        return error


def _pause_s(error: MaplessError, attempt: int, options: ConnectOptions, clock: _Clock) -> float | None:
    """How long to wait after so many attempts, seconds; None if another would be of no use."""
    asked_s = error.retry_after_s
    backoff_s = min(options.initial_backoff_s * 2.0 ** min(attempt - 1, 30), options.max_backoff_s)
    backoff_s *= clock.uniform(1 - _JITTER, 1 + _JITTER)
    if error.code in _LOST and (asked_s is None or attempt == 1):
        return backoff_s  # the first time soon: behind one name there may be another server, which is not unavailable
    if error.code in {"UNAVAILABLE", "RESOURCE_EXHAUSTED"} and asked_s is not None:
        return max(options.initial_backoff_s, asked_s * clock.uniform(1, 1 + _LATENESS))
    return None
