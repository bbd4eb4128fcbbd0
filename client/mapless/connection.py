"""A connection to a server, which makes calls: with deadlines and retries, and each answer read in one place.

The calls of `mapless.calls` are coroutines on a `Connection`. `aio.Client` is one for asyncio. The connection of the
blocking `Client` blocks wherever the other waits, so that its coroutines end without ever waiting.

gRPC's own retries are not used. They ignore RetryInfo, so they cannot distinguish a server at its limit (retry in 3 s)
from a message over the limit (never retry), they repeat a creation without checking who created what then exists, and
they end after five attempts. Nor does `wait_for_ready` replace them: a call that has been sent is lost with its server
all the same, and one that waits for a connection cannot say why there is none.
"""

from __future__ import annotations

import math
import random
import time
import warnings
from collections.abc import (
    AsyncGenerator,
    AsyncIterable,
    AsyncIterator,
    Awaitable,
    Callable,
    Coroutine,
    Iterable,
    Iterator,
)
from contextlib import aclosing, contextmanager
from copy import copy
from dataclasses import replace
from inspect import isawaitable, isfunction, signature
from typing import Any, TypeVar

import grpc
from google.protobuf.message import Message

from .addresses import addresses_of
from .errors import DeadlineExceeded, Internal, MaplessError, from_rpc_error, is_misconfigured, is_unconnected
from .masks import IgnoredMask, carries_mask
from .options import ConnectOptions
from .reaching import explained
from .routing import scene_metadata
from .servers import Server, Servers
from .wire import FieldError

VERSION_KEY = "x-mapless-version"
"""In the trailers of servers since 0.3.0."""

T = TypeVar("T")
ItemT = TypeVar("ItemT")
C = TypeVar("C", bound="Connection")

MALFORMED_ANSWER = "MALFORMED_ANSWER"
"""Reason of the error for an answer that violates the interface."""

_JITTER = 0.2  # relative, of our own pauses, as in gRPC
_LOST = frozenset({"UNAVAILABLE", "CANCELLED"})
"""Codes of a lost server or connection. The client does not wait for calls that it cancels, so CANCELLED comes from a
load balancer, or a server that stops, in the middle of the answer."""
IN_FLIGHT = 2
"""Messages of an upload at a time: one is computed while the next is read and sent."""

_FEW_ATTEMPTS = 4
"""After so many, in about 1.4 s, it is examined why no connection is made; what is wrong with certificates or protocol,
and the answer of a health check, are not waited for any longer."""
_LATENESS = 0.25  # relative, added to the server's RetryInfo at random: many refused clients retry, but none earlier


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

    def __init__(self, address: str, options: ConnectOptions, make_channel: Callable[[str], Any]) -> None:
        """Makes a channel for each address; ValueError if the address is none."""
        self.options = options
        self.address = address
        addresses = addresses_of(address)
        self._servers = Servers(addresses, [*map(make_channel, addresses)])
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
        is_check: bool = False,
        on_repeat: Callable[[Connection, MaplessError], Awaitable[T]] | None = None,
    ) -> T:
        """Makes a call with retries; returns what `read` makes of its response.

        It is repeated until the deadline if the server is away, UNAVAILABLE or lost during the answer, or
        RESOURCE_EXHAUSTED with RetryInfo; at another server, if there are several. The pause doubles from
        `initial_backoff_s` to `max_backoff_s`, or is what RetryInfo requests, which must not exceed the deadline.
        Options may limit the number of attempts, except of those that RetryInfo requests, and the time in which the
        first connection must be made. An error of certificates or protocol is raised after four attempts.

        Args:
            method: name of the method, "GetScene"; no two services have one of the same name.
            request: the request.
            read: converts the response; its ValueErrors are faults of the server, `Internal`.
            timeout_s: deadline in seconds for all attempts, pauses and calls of `on_repeat`; None for the default.
                ValueError if it is not above 0.
            is_upload: whether the default is `upload_timeout_s`.
            is_check: whether the call asks how the server is now: at most four attempts.
            on_repeat: for calls that change something. An earlier attempt may have succeeded although its answer was
                lost; then a retry fails with ALREADY_EXISTS or NOT_FOUND. Given a connection with the call's deadline
                and that error, it determines who made the change, and returns the lost result or raises the error.
        """
        retries = Retries(self, method, timeout_s, is_upload, _FEW_ATTEMPTS if is_check else None)
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
        while True:
            items, request.page_token = await self.call(
                method, request, lambda page: ([*read(page)], page.next_page_token), timeout_s
            )
            for item in items:
                yield item
            if not request.page_token:
                return

    async def streamed(
        self, method: str, request: Message, read: Callable[[Any], Any], timeout_s: float | None
    ) -> AsyncGenerator[Any, None]:
        """Yields the answers of a call whose response is a stream: early ones, if any, and the final one.

        `is_final` of an answer distinguishes them. A call that fails after an early answer is retried like any other,
        and then only the final answer is yielded, since earlier ones could be worse than those yielded already. The
        stream is cancelled when the caller stops reading.
        """
        retries, had_early, is_repeated = Retries(self, method, timeout_s), False, False
        while True:
            final = None
            try:
                async with aclosing(self._responses(method, request, retries.left_s())) as responses:
                    async for response in responses:
                        with _reading(method, response):
                            answer = read(response)
                        if answer.is_final:
                            final = answer
                        elif not is_repeated:
                            had_early = True
                            yield answer
                if final is None:
                    message = f"the stream of {method} ended before the answer"
                    raise Internal("INTERNAL", message, reason=MALFORMED_ANSWER)
            except MaplessError as error:
                if final is None:
                    await retries.pause_after(error)
                    is_repeated = had_early
                    continue
            yield final
            return

    async def _response(self, method: str, request: Message, timeout_s: float) -> Any:
        """Makes one attempt of a call."""
        server = self._servers.next(self._now_s())
        try:
            if isinstance(server.methods[method], grpc.UnaryUnaryMultiCallable):  # blocking
                response, started = self._start(server, method, request, timeout_s, "with_call")
            else:
                started = self._start(server, method, request, timeout_s)
                response = await started
        except grpc.RpcError as error:
            raise self._failed(server, error) from error
        self._answered(server)
        await self._check_masks(server, request, started)
        return response

    async def _responses(self, method: str, request: Message, timeout_s: float) -> AsyncGenerator[Any, None]:
        """Makes one attempt of a call that is answered by a stream."""
        server, started = self._servers.next(self._now_s()), None
        try:
            started = self._start(server, method, request, timeout_s)
            if isinstance(started, AsyncIterable):
                async for response in started:
                    self._answered(server)
                    yield response
            else:
                for response in started:
                    self._answered(server)
                    yield response
            await self._check_masks(server, request, started)
        except grpc.RpcError as error:
            raise self._failed(server, error) from error
        finally:
            if started is not None:
                started.cancel()

    def _start(self, server: Server, method: str, request: Message, timeout_s: float, how: str = "__call__") -> Any:
        metadata = self.options.metadata() + scene_metadata(request)
        return getattr(server.methods[method], how)(request, timeout=timeout_s, metadata=metadata)

    async def _check_masks(self, server: Server, request: Message, call: Any) -> None:
        """Warns once if a server has ignored masks because it is too old to know them; it did not say its version."""
        if server.has_warned or not carries_mask(request):
            return
        trailers = call.trailing_metadata()
        trailers = await trailers if isawaitable(trailers) else trailers
        if VERSION_KEY not in dict(trailers or ()):
            server.has_warned = True
            warnings.warn(IgnoredMask(server.address), stacklevel=2)

    def _answered(self, server: Server) -> None:
        self._servers.were_reached = True
        server.lost_until_s = -math.inf

    def _failed(self, server: Server, error: grpc.RpcError) -> MaplessError:
        failure = from_rpc_error(error)
        failure.address = server.address
        self._servers.were_reached |= not is_unconnected(failure) and failure.code != "DEADLINE_EXCEEDED"
        if failure.code in _LOST:
            server.lost_until_s = self._now_s() + self.options.max_reconnect_s
        return failure

    async def _explained(self, error: MaplessError) -> MaplessError:
        """An error that says more about why no server is reached; the error itself where nothing more is known."""
        if not is_unconnected(error) or not error.address:
            return error
        better: MaplessError = await self.unblocked(explained, error, error.address, self.options)
        if better is not error:
            better.address, better.__cause__ = error.address, error.__cause__
        return better

    async def unblocked(self, function: Callable[..., T], *arguments: Any) -> T:
        """Calls a function that may wait for a file or the network: asyncio's client in another thread."""
        return function(*arguments)

    def pipelined(
        self, call: Callable[[ItemT], Coroutine[Any, Any, T]], items: Iterator[ItemT]
    ) -> AsyncGenerator[T, None]:
        """Yields the result of a call for each item, in order; `IN_FLIGHT` calls run at a time.

        Items are read while calls run. The error of a call is raised in its turn, after those that run have ended.
        """
        raise NotImplementedError

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


class Retries:
    """The attempts of one call: the time left to each, and the pauses between them.

    `may_be_done` says whether an attempt whose answer was lost may have succeeded.
    """

    def __init__(
        self,
        connection: Connection,
        method: str,
        timeout_s: float | None,
        is_upload: bool = False,
        most: int | None = None,
    ) -> None:
        options, now_s = connection.options, connection._now_s()
        if timeout_s is None:
            timeout_s = options.upload_timeout_s if is_upload else options.timeout_s
        if not timeout_s > 0:
            raise ValueError(f"timeout_s must be above 0, is {timeout_s:g}")
        self._connection = connection
        self.deadline_s = min(now_s + timeout_s, connection._deadline_s)
        if not self.left_s():
            raise DeadlineExceeded("DEADLINE_EXCEEDED", f"no time left for {method}")
        self.may_be_done = False
        self._most = math.inf if options.max_attempts is None else options.max_attempts
        self._most_of_lost = min(self._most, math.inf if most is None else most)
        self._connect_until_s = min(self.deadline_s, now_s + options.connect_timeout_s)
        self._count = 0
        self._last: MaplessError | None = None

    def left_s(self) -> float:
        """Seconds left to the next attempt."""
        return max(self.deadline_s - self._connection._now_s(), 0.0)

    async def pause_after(self, error: MaplessError) -> None:
        """Pauses before the next attempt; raises the error of the last one if a retry would not help or is too late."""
        self._count += 1
        if error.code == "DEADLINE_EXCEEDED" and self._last is not None and not error.request_id:
            error.message += f"; before that: {self._last.message}"
            error.args = (f"{error.reason}: {error.message}",)
        self._last = error
        if self._count == _FEW_ATTEMPTS:
            error = await self._connection._explained(error)
        pause_s = self._pause_s(error)
        if pause_s is None or self._is_last(error) or pause_s >= self.left_s():
            raise await self._connection._explained(error)
        self.may_be_done |= error.code in _LOST and not is_unconnected(error)  # what was never sent is not done
        await self._connection._pause(pause_s, error)

    def _is_last(self, error: MaplessError) -> bool:
        """Whether no further attempt is made, whatever the time."""
        if self._count >= _FEW_ATTEMPTS and is_misconfigured(error):
            return True
        if error.retry_after_s is not None:  # the server has asked for another
            return self._most == 1
        return self._count >= self._most_of_lost

    def _pause_s(self, error: MaplessError) -> float | None:
        """Seconds to wait after this many attempts; None if a retry would not help."""
        connection, requested_s = self._connection, error.retry_after_s
        options, uniform = connection.options, connection._uniform
        if error.code in _LOST and (requested_s is None or self._count == 1):
            # With RetryInfo, too, the first retry is early: another server of the same name may be available.
            backoff_s = min(options.initial_backoff_s * 2.0 ** min(self._count - 1, 30), options.max_backoff_s)
            is_new = is_unconnected(error) and not connection._servers.were_reached
            left_s = (self._connect_until_s if is_new else self.deadline_s) - connection._now_s()
            # A server that returns shortly before the deadline is found, too.
            backoff_s = max(min(backoff_s, left_s / 2), options.initial_backoff_s) * uniform(1 - _JITTER, 1 + _JITTER)
            return backoff_s if backoff_s < left_s else None
        if error.code in {"UNAVAILABLE", "RESOURCE_EXHAUSTED"} and requested_s is not None:
            return max(options.initial_backoff_s, requested_s * uniform(1, 1 + _LATENESS))
        return None
