"""Calls as data, independent of how they are executed.

An exchange is a generator that yields calls, is sent their responses and returns the caller's result. The blocking and
the asynchronous client execute the same exchanges, so each request is built and each answer read in one place.
`attempts` adds retries and deadlines to an exchange and leaves two actions to the client: make an attempt, and pause.

gRPC's own retries are not used. They ignore RetryInfo, so they cannot distinguish a server at its limit (retry in 3 s)
from a message over the limit (never retry), and they repeat a creation without checking who created what then exists.
"""

import math
import random
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from google.protobuf.message import Message

from . import names
from .errors import DeadlineExceeded, Internal, MaplessError
from .options import ConnectOptions
from .wire import FieldError

SCENE_KEY = "x-mapless-scene"
_FIELDS = ("scene", "name", "scene_id")
"""Fields of requests that contain it: the scene's name, the name of a scene or reference, or the id of a new scene."""


def scene_metadata(request: Message) -> tuple[tuple[str, str], ...]:
    """("x-mapless-scene", "scenes/{scene}") of a request that concerns one scene; else empty.

    Also empty for an invalid name, which may be unfit for metadata and which the server reports. A valid name is
    visible ASCII of at most 135 bytes.
    """
    descriptor: Any = request.DESCRIPTOR
    name_field = next((field for field in _FIELDS if field in descriptor.fields_by_name), None)
    if name_field is None:
        return ()
    value = getattr(request, name_field)
    if isinstance(value, Message):  # the scene itself
        value = getattr(value, "name", "")
    try:
        scene_id = names.check_id(value) if name_field == "scene_id" else _scene_of(value)
    except ValueError:
        return ()
    return ((SCENE_KEY, names.scene_name(scene_id)),)


def _scene_of(name: str) -> str:
    """The scene's id in the name of a scene or a reference."""
    return names.parse_reference_name(name)[0] if "/references/" in name else names.parse_scene_name(name)


T = TypeVar("T")

MALFORMED_ANSWER = "MALFORMED_ANSWER"
"""Reason of the error for an answer that violates the interface."""

_JITTER = 0.2  # relative, of our own pauses, as in gRPC
_LOST = frozenset({"UNAVAILABLE", "CANCELLED"})
"""Codes of a lost server or connection. The client does not wait for calls that it cancels, so CANCELLED comes from a
load balancer whose server disappeared during the answer."""
_LATENESS = 0.25  # relative, added to the server's RetryInfo at random: many refused clients retry, but none earlier


@dataclass(frozen=True)
class Call:
    """One call, of one request and one answer, "package.Service/Method".

    Attributes:
        timeout_s: deadline in seconds, above 0, for all attempts, pauses and calls of `on_repeat`; None for the
            default.
        is_upload: whether the default is `upload_timeout_s`.
        on_repeat: for calls that change something. An earlier attempt may have succeeded although its answer was lost;
            then a retry fails with ALREADY_EXISTS or NOT_FOUND. Given that error, `on_repeat` yields the calls that
            determine who made the change, and returns the lost answer or raises the error.
        early: for calls that are answered by a stream whose last message is the response: the early answer that a
            message contains, or None for the last one.
    """

    method: str
    request: Message
    response_type: type[Message]
    timeout_s: float | None = None
    is_upload: bool = False
    on_repeat: "Callable[[MaplessError], Exchange[Any]] | None" = None
    early: Callable[[Any], Any] | None = None

    @property
    def metadata(self) -> tuple[tuple[str, str], ...]:
        """The call's own metadata: its scene, for load balancers."""
        return scene_metadata(self.request)


Exchange = Generator[Call, Any, T]
"""Yields calls, is sent their responses (or thrown their errors), returns the caller's result."""


@dataclass(frozen=True)
class Pages(Generic[T]):
    """A list fetched page by page: `fetch(token)` gives a page's items and the next token, "" after the last."""

    fetch: Callable[[str], Exchange[tuple[list[T], str]]]


@dataclass(frozen=True)
class Attempt:
    """Execute this call once, within `timeout_s`; send back the response or the error."""

    call: Call
    timeout_s: float


@dataclass(frozen=True)
class Pause:
    """Wait before the next attempt; if there is none, the call ends with `error`."""

    duration_s: float
    error: MaplessError


class Methods:
    """The methods of a channel, blocking or asynchronous, made when a call first needs them."""

    def __init__(self, channel: Any, metadata: tuple[tuple[str, str], ...]) -> None:
        self._channel = channel
        self._metadata = metadata
        self._by_name: dict[str, Callable[..., Any]] = {}

    def start(self, attempt: Attempt) -> Any:
        """The response of an attempt: a message or a stream, to be awaited if the channel is asynchronous."""
        call = attempt.call
        if call.method not in self._by_name:
            make = self._channel.unary_unary if call.early is None else self._channel.unary_stream
            self._by_name[call.method] = make(
                f"/{call.method}",
                request_serializer=type(call.request).SerializeToString,
                response_deserializer=call.response_type.FromString,
            )
        metadata = self._metadata + call.metadata
        return self._by_name[call.method](call.request, timeout=attempt.timeout_s, metadata=metadata)


@dataclass
class _Clock:
    """Time and random numbers; tests replace them."""

    now_s: Callable[[], float] = time.monotonic
    uniform: Callable[[float, float], float] = field(default=random.uniform)


def attempts(
    exchange: Exchange[T], options: ConnectOptions, clock: _Clock | None = None, deadline_s: float = math.inf
) -> Generator[Attempt | Pause, Any, T]:
    """The exchange with retries: yields actions, returns the exchange's result.

    A call is retried if the server is UNAVAILABLE or lost, or RESOURCE_EXHAUSTED with RetryInfo; never if the pause
    would exceed the deadline. Attempts are counted, except those that the server's RetryInfo requests. An answer that
    the exchange cannot read is an error of the server, `Internal`. `deadline_s` is that of all calls together, in the
    clock's time, in addition to each call's own; ValueError if a call's `timeout_s` is not above 0.
    """
    clock = clock or _Clock()
    try:
        call = next(exchange)
        while True:
            outcome = yield from _with_retries(call, options, clock, deadline_s)
            if isinstance(outcome, MaplessError):
                call = exchange.throw(outcome)
            else:
                with _reading(call, outcome):
                    call = exchange.send(outcome)
    except StopIteration as end:
        value: T = end.value
        return value
    finally:
        exchange.close()


@contextmanager
def _reading(call: Call, response: Message) -> Iterator[None]:
    """Turns errors of reading a response, such as FieldError, into an error of the server."""
    try:
        yield
    except (ValueError, OverflowError) as error:
        field_path = error.field if isinstance(error, FieldError) else None
        message = f"the answer of {call.method} violates the interface: {error}"
        request_id = getattr(getattr(response, "diagnostics", None), "request_id", "")
        raise Internal("INTERNAL", message, reason=MALFORMED_ANSWER, field=field_path, request_id=request_id) from error


class Reader:
    """Reads the messages of a call's attempts: a stream's early answer, once, and the outcome of each attempt.

    An attempt that fails after its early answer is retried like any other; the retry yields the final answer only.
    """

    outcome: Message | MaplessError

    def __init__(self) -> None:
        self._had_early = False

    def begin(self, call: Call) -> None:
        """Starts an attempt."""
        self._call = call
        message = f"the stream of {call.method} ended before the answer"
        self.outcome = Internal("INTERNAL", message, reason=MALFORMED_ANSWER)

    def read(self, message: Message) -> Any | None:
        """The early answer of a message; None if it is the final answer, or if an early one was returned before."""
        early = None
        if self._call.early is not None:
            with _reading(self._call, message):
                early = self._call.early(message)
        if early is None:
            self.outcome = message
        elif not self._had_early:
            self._had_early = True
            return early
        return None

    def fail(self, error: MaplessError) -> None:
        """Ends the attempt with an error, unless the answer was already received."""
        if not isinstance(self.outcome, Message):
            self.outcome = error


def _with_retries(
    call: Call, options: ConnectOptions, clock: _Clock, deadline_s: float
) -> Generator[Attempt | Pause, Any, Any]:
    """One call until it succeeds, fails permanently, or has no attempts or time left; its response or error."""
    deadline_s = min(clock.now_s() + _timeout_s(call, options), deadline_s)
    if clock.now_s() >= deadline_s:
        return DeadlineExceeded("DEADLINE_EXCEEDED", f"no time left for {call.method}")
    may_be_done = False  # by an attempt whose answer was lost
    attempt = 0
    while True:
        outcome = yield Attempt(call, max(deadline_s - clock.now_s(), 0.0))
        attempt += 1
        if not isinstance(outcome, MaplessError):
            return outcome
        if may_be_done and call.on_repeat is not None and outcome.code in {"ALREADY_EXISTS", "NOT_FOUND"}:
            return (yield from _resolved(call.on_repeat(outcome), options, clock, deadline_s))
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


def _resolved(
    exchange: Exchange[Any], options: ConnectOptions, clock: _Clock, deadline_s: float
) -> Generator[Attempt | Pause, Any, Any]:
    try:
        return (yield from attempts(exchange, options, clock, deadline_s))
    except MaplessError as error:
        return error


def _pause_s(error: MaplessError, attempt: int, options: ConnectOptions, clock: _Clock) -> float | None:
    """Seconds to wait after this many attempts; None if a retry would not help."""
    requested_s = error.retry_after_s
    backoff_s = min(options.initial_backoff_s * 2.0 ** min(attempt - 1, 30), options.max_backoff_s)
    backoff_s *= clock.uniform(1 - _JITTER, 1 + _JITTER)
    if error.code in _LOST and (requested_s is None or attempt == 1):
        return backoff_s  # the first retry is early: another server of the same name may be available
    if error.code in {"UNAVAILABLE", "RESOURCE_EXHAUSTED"} and requested_s is not None:
        return max(options.initial_backoff_s, requested_s * clock.uniform(1, 1 + _LATENESS))
    return None
