"""A connection to a server, which makes calls: with deadlines and retries, and each answer read in one place.

The calls of `mapless.calls` are coroutines on a `Connection`. `aio.Client` is one for asyncio. The connection of the
blocking `Client` blocks wherever the other waits, so that its coroutines end without ever waiting.

gRPC's own retries are not used. They ignore RetryInfo, so they cannot distinguish a server at its limit (retry in 3 s)
from a message over the limit (never retry), and they repeat a creation without checking who created what then exists.
"""

from __future__ import annotations

import math
import random
import time
from collections.abc import AsyncGenerator, AsyncIterable, AsyncIterator, Awaitable, Callable, Iterable, Iterator
from contextlib import aclosing, contextmanager
from copy import copy
from dataclasses import replace
from inspect import isawaitable, isfunction, signature
from typing import Any, TypeVar

import grpc
from google.protobuf import wrappers_pb2
from google.protobuf.message import Message

from . import names
from .errors import DeadlineExceeded, Internal, MaplessError, from_rpc_error
from .options import ConnectOptions, explained, is_unreached
from .v1.localization_service_pb2_grpc import LocalizationServiceStub
from .v1.reference_service_pb2_grpc import ReferenceServiceStub
from .wire import FieldError

# grpc.health.v1 in protobuf's own messages, which saves a dependency: the request has the service's name in field 1,
# empty for the whole server, and the answer an enum in field 1.
_WRAPPERS: Any = wrappers_pb2  # the module is not annotated
HealthRequest, _HealthResponse = _WRAPPERS.StringValue, _WRAPPERS.UInt32Value

SCENE_KEY = "x-mapless-scene"
_FIELDS = ("scene", "name", "scene_id")
"""Fields of requests that contain it: the scene's name, the name of a scene or reference, or the id of a new scene."""

T = TypeVar("T")
C = TypeVar("C", bound="Connection")

MALFORMED_ANSWER = "MALFORMED_ANSWER"
"""Reason of the error for an answer that violates the interface."""

_JITTER = 0.2  # relative, of our own pauses, as in gRPC
_LOST = frozenset({"UNAVAILABLE", "CANCELLED"})
"""Codes of a lost server or connection. The client does not wait for calls that it cancels, so CANCELLED comes from a
load balancer whose server disappeared during the answer."""
_LATENESS = 0.25  # relative, added to the server's RetryInfo at random: many refused clients retry, but none earlier


def scene_metadata(request: Message) -> tuple[tuple[str, str], ...]:
    """("x-mapless-scene", "scenes/{scene}") of a request that concerns one scene, for load balancers; else empty.

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
        if name_field == "scene_id":
            return ((SCENE_KEY, names.scene_name(names.check_id(value))),)
        is_reference = "/references/" in value
        scene_id = names.parse_reference_name(value)[0] if is_reference else names.parse_scene_name(value)
    except ValueError:
        return ()
    return ((SCENE_KEY, names.scene_name(scene_id)),)


class Connection:
    """A channel, blocking or asynchronous, with the options and metadata of its calls."""

    def __init_subclass__(cls) -> None:
        """Its calls are methods: `help` shows their first parameter, the connection, as self."""
        super().__init_subclass__()
        for call in filter(isfunction, vars(cls).values()):
            first, *others = signature(call).parameters.values()
            if first.name == "connection":
                shown: Any = call
                shown.__signature__ = signature(call).replace(parameters=[first.replace(name="self"), *others])

    def __init__(self, address: str, options: ConnectOptions, channel: Any) -> None:
        self.options = options
        self.address = address
        self._channel = channel
        self._methods = {
            **vars(LocalizationServiceStub(channel)),
            **vars(ReferenceServiceStub(channel)),
            "Check": channel.unary_unary(
                "/grpc.health.v1.Health/Check",
                request_serializer=HealthRequest.SerializeToString,
                response_deserializer=_HealthResponse.FromString,
            ),
        }
        self._deadline_s = math.inf

    def acting_for(self: C, token: str | None, client_id: str = "") -> C:
        """A client on the same connection with another token and client id, for programs that serve several users.

        Closing this client also ends the returned one. ValueError as of `ConnectOptions`.
        """
        other = copy(self)
        other.options = replace(self.options, token=token, client_id=client_id)
        return other

    async def call(
        self,
        method: str,
        request: Message,
        read: Callable[[Any], T],
        timeout_s: float | None = None,
        *,
        is_upload: bool = False,
        on_repeat: Callable[[Connection, MaplessError], Awaitable[T]] | None = None,
    ) -> T:
        """Makes a call with retries; returns what `read` makes of its response.

        It is repeated if the server is UNAVAILABLE or lost, or RESOURCE_EXHAUSTED with RetryInfo; never if the pause
        would exceed the deadline. Attempts are counted, except those that the server's RetryInfo requests.

        Args:
            method: name of the method, "GetScene"; no two services have one of the same name.
            request: the request.
            read: converts the response; its ValueErrors are faults of the server, `Internal`.
            timeout_s: deadline in seconds for all attempts, pauses and calls of `on_repeat`; None for the default.
                ValueError if it is not above 0.
            is_upload: whether the default is `upload_timeout_s`.
            on_repeat: for calls that change something. An earlier attempt may have succeeded although its answer was
                lost; then a retry fails with ALREADY_EXISTS or NOT_FOUND. Given a connection with the call's deadline
                and that error, it determines who made the change, and returns the lost result or raises the error.
        """
        retries = _Retries(self, method, timeout_s, is_upload)
        while True:
            try:
                response = await self._response(method, request, retries.left_s())
                break
            except MaplessError as error:
                if on_repeat and retries.may_be_done and error.code in {"ALREADY_EXISTS", "NOT_FOUND"}:
                    limited = copy(self)
                    limited._deadline_s = retries.deadline_s
                    return await on_repeat(limited, error)
                await retries.pause_after(error)
        with _reading(method, response):
            return read(response)

    async def listed(
        self, method: str, request: Any, read: Callable[[Any], Iterable[T]], timeout_s: float | None
    ) -> AsyncIterator[T]:
        """Yields the items of a list, which is fetched page by page when needed; `read` returns those of a page."""

        def of_page(page: Any) -> tuple[list[T], str]:
            return [*read(page)], page.next_page_token

        while True:
            items, request.page_token = await self.call(method, request, of_page, timeout_s)
            for item in items:
                yield item
            if not request.page_token:
                return

    async def streamed(
        self, method: str, request: Message, read: Callable[[Any], Any], timeout_s: float | None
    ) -> AsyncGenerator[Any, None]:
        """Yields the answers of a call whose response is a stream: the first early one, if any, and the final one.

        `is_final` of an answer distinguishes them. A call that fails after its early answer is retried like any other,
        and then only the final answer is yielded. The stream is cancelled when the caller stops reading.
        """
        retries, had_early = _Retries(self, method, timeout_s), False
        while True:
            final = None
            try:
                async with aclosing(self._responses(method, request, retries.left_s())) as responses:
                    async for response in responses:
                        with _reading(method, response):
                            answer = read(response)
                        if answer.is_final:
                            final = answer
                        elif not had_early:
                            had_early = True
                            yield answer
                if final is None:
                    message = f"the stream of {method} ended before the answer"
                    raise Internal("INTERNAL", message, reason=MALFORMED_ANSWER)
            except MaplessError as error:
                if final is None:
                    await retries.pause_after(error)
                    continue
            yield final
            return

    async def _response(self, method: str, request: Message, timeout_s: float) -> Any:
        """Makes one attempt of a call."""
        try:
            started = self._start(method, request, timeout_s)
            return await started if isawaitable(started) else started
        except grpc.RpcError as error:
            raise await self._explained(error) from error

    async def _responses(self, method: str, request: Message, timeout_s: float) -> AsyncGenerator[Any, None]:
        """Makes one attempt of a call that is answered by a stream."""
        started = None
        try:
            started = self._start(method, request, timeout_s)
            if isinstance(started, AsyncIterable):
                async for response in started:
                    yield response
            else:
                for response in started:
                    yield response
        except grpc.RpcError as error:
            raise await self._explained(error) from error
        finally:
            if started is not None:
                started.cancel()

    def _start(self, method: str, request: Message, timeout_s: float) -> Any:
        metadata = self.options.metadata() + scene_metadata(request)
        return self._methods[method](request, timeout=timeout_s, metadata=metadata)

    async def _explained(self, error: grpc.RpcError) -> MaplessError:
        failure = from_rpc_error(error)
        if is_unreached(failure):
            return await self.unblocked(explained, failure, self.address, self.options)
        return failure

    async def unblocked(self, function: Callable[..., T], *arguments: Any) -> T:
        """Calls a function that may wait for a file or the network: asyncio's client in another thread."""
        return function(*arguments)

    async def _pause(self, duration_s: float, error: MaplessError) -> None:
        """Waits before the next attempt; if there is none, the call ends with `error`."""
        raise NotImplementedError

    def _now_s(self) -> float:
        return time.monotonic()

    def _uniform(self, low: float, high: float) -> float:
        return random.uniform(low, high)


@contextmanager
def _reading(method: str, response: Any) -> Iterator[None]:
    """Turns errors of reading a response, such as FieldError, into an error of the server."""
    try:
        yield
    except (ValueError, OverflowError) as error:
        field_path = error.field if isinstance(error, FieldError) else None
        message = f"the answer of {method} violates the interface: {error}"
        request_id = getattr(getattr(response, "diagnostics", None), "request_id", "")
        raise Internal("INTERNAL", message, reason=MALFORMED_ANSWER, field=field_path, request_id=request_id) from error


class _Retries:
    """The attempts of one call: the time left to each, and the pauses between them.

    `may_be_done` says whether an attempt whose answer was lost may have succeeded.
    """

    def __init__(self, connection: Connection, method: str, timeout_s: float | None, is_upload: bool = False) -> None:
        if timeout_s is None:
            timeout_s = connection.options.upload_timeout_s if is_upload else connection.options.timeout_s
        if not timeout_s > 0:
            raise ValueError(f"timeout_s must be above 0, is {timeout_s:g}")
        self._connection = connection
        self.deadline_s = min(connection._now_s() + timeout_s, connection._deadline_s)
        if not self.left_s():
            raise DeadlineExceeded("DEADLINE_EXCEEDED", f"no time left for {method}")
        self.may_be_done = False
        self._count = 0

    def left_s(self) -> float:
        return max(self.deadline_s - self._connection._now_s(), 0.0)

    async def pause_after(self, error: MaplessError) -> None:
        """Pauses before the next attempt; raises the error of the last one if a retry would not help or is too late."""
        self._count += 1
        options, pause_s = self._connection.options, self._pause_s(error)
        is_last = self._count >= options.max_attempts and (error.retry_after_s is None or options.max_attempts == 1)
        if pause_s is None or is_last or pause_s >= self.left_s():
            raise error
        self.may_be_done |= error.code in _LOST
        await self._connection._pause(pause_s, error)

    def _pause_s(self, error: MaplessError) -> float | None:
        """Seconds to wait after this many attempts; None if a retry would not help."""
        options, uniform, requested_s = self._connection.options, self._connection._uniform, error.retry_after_s
        backoff_s = min(options.initial_backoff_s * 2.0 ** min(self._count - 1, 30), options.max_backoff_s)
        backoff_s *= uniform(1 - _JITTER, 1 + _JITTER)
        if error.code in _LOST and (requested_s is None or self._count == 1):
            return backoff_s  # the first retry is early: another server of the same name may be available
        if error.code in {"UNAVAILABLE", "RESOURCE_EXHAUSTED"} and requested_s is not None:
            return max(options.initial_backoff_s, requested_s * uniform(1, 1 + _LATENESS))
        return None
