"""Receives the one message of a call in limited time.

For methods with one request message, grpc receives it before it calls the handler, however long that takes: a call
whose caller sends only the headers would count as a concurrent call as long as its connection exists. So all
methods are served as if their callers sent streams, of which the first message is read here.
"""

import asyncio
import logging
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from typing import Any

import grpc

from mapless_server.errors import DeadlineExceeded, InvalidArgument, Overloaded, RequestError

OPEN_MESSAGE_LIMIT_S = 5.0
"""For the messages of methods without authentication, a few bytes that are sent together with the headers."""
MAX_OPEN_WAITING = 256
"""Calls of such methods whose message has not arrived; a further one ends the oldest. Messages are rarely late."""
MAX_OPEN_STREAMS = 256
"""Open streams of such methods (health watches, reflection), which have no deadline."""

Context = Any
"""A grpc.aio.ServicerContext; its annotations are wrong in places."""


class Tasks:
    """Tasks of calls that are never cancelled, since grpc reads or writes their buffers; they end with their calls."""

    def __init__(self) -> None:
        self._running: set[asyncio.Future[Any]] = set()  # the loop holds only weak references

    def begin(self, work: Awaitable[Any]) -> asyncio.Future[Any]:
        """Starts a task, whose exception need not be retrieved."""
        task = asyncio.ensure_future(work)
        self._running.add(task)
        task.add_done_callback(self._end)
        return task

    def _end(self, task: asyncio.Future[Any]) -> None:
        self._running.discard(task)
        if not task.cancelled():
            task.exception()  # which asyncio would otherwise log


class Receiver:
    """Reads messages; runs on the event loop."""

    def __init__(self) -> None:
        self._reading = Tasks()

    async def message(self, context: Context, limit_s: float, evicted: asyncio.Future[None] | None = None) -> bytes:
        """Receives the bytes of a call's first message.

        Args:
            context: context of the call, which has no deserializer.
            limit_s: longest wait, seconds.
            evicted: a future that is done when the call has to end in favour of another one.

        Raises:
            DeadlineExceeded: no message arrived in time.
            Overloaded: the call was evicted.
            InvalidArgument: the caller sent no message, or a too large one (which grpc itself reports to the caller).
        """
        if limit_s <= 0:
            raise DeadlineExceeded("the message did not arrive in time", reason="MESSAGE_LATE")
        reading = self._reading.begin(context.read())
        awaited: set[asyncio.Future[Any]] = {reading} if evicted is None else {reading, evicted}
        await asyncio.wait(awaited, timeout=limit_s, return_when=asyncio.FIRST_COMPLETED)
        if not reading.done():
            if evicted is not None and evicted.done():
                raise Overloaded("too many calls whose message has not arrived")
            raise DeadlineExceeded("the message did not arrive in time", reason="MESSAGE_LATE")
        message = reading.result()
        if message is grpc.aio.EOF:
            raise InvalidArgument("the call has no message, or one that is too large", reason="MALFORMED_MESSAGE")
        return bytes(message)


MAX_CALLS_OF_CALLER = 512
"""Calls of one token or certificate at a time, a quarter of those of all: calls of which only the headers have come
need no room in the queue, and would otherwise leave no place for others."""


class Places:
    """Limits the calls in progress of each token or certificate; runs on the event loop."""

    def __init__(self) -> None:
        self._taken: Counter[tuple[str, str]] = Counter()

    @contextmanager
    def taken(self, holder: tuple[str, str]) -> Iterator[None]:
        """Takes a place for a call of a tenant's caller; Overloaded if it has too many. Without a name none counts."""
        if self._taken[holder] >= MAX_CALLS_OF_CALLER and holder[1]:
            raise Overloaded(
                f"{MAX_CALLS_OF_CALLER} calls of this caller are in progress",
                reason="TOO_MANY_CALLS",
                retry_after_s=1.0,
            )
        self._taken[holder] += 1
        try:
            yield
        finally:
            self._taken[holder] -= 1
            if not self._taken[holder]:
                del self._taken[holder]


class OpenMethods:
    """Serves methods without authentication, limited in number, so that they cannot use up all concurrent calls."""

    def __init__(self, receiver: Receiver) -> None:
        self._receiver = receiver
        self._waiting: dict[asyncio.Future[None], None] = {}  # the oldest first
        self._streams = 0

    def guarded(self, handler: Any) -> Any:
        """Wraps a method's handler, with a limit on concurrent calls and on the time for the message."""
        if not handler.response_streaming:
            return grpc.stream_unary_rpc_method_handler(self._unary(handler), None, handler.response_serializer)
        if handler.request_streaming:
            serve, deserializer = self._stream(handler), handler.request_deserializer
        else:
            serve, deserializer = self._watch(handler), None
        return grpc.stream_stream_rpc_method_handler(serve, deserializer, handler.response_serializer)

    def _unary(self, handler: Any) -> Callable[..., Any]:
        async def answer(_: object, context: Context) -> Any:
            return await handler.unary_unary(await self._request(handler, context), context)

        return answer

    def _watch(self, handler: Any) -> Callable[..., Any]:
        async def answer(_: object, context: Context) -> None:
            await self._enter(context)
            try:
                await handler.unary_stream(await self._request(handler, context), _Latest(context))
            finally:
                self._streams -= 1

        return answer

    def _stream(self, handler: Any) -> Callable[..., Any]:
        async def answer(requests: Any, context: Context) -> Any:
            await self._enter(context)
            try:
                async for response in handler.stream_stream(requests, context):
                    yield response
            finally:
                self._streams -= 1

        return answer

    async def _enter(self, context: Context) -> None:
        if self._streams >= MAX_OPEN_STREAMS:
            await context.abort(grpc.StatusCode.RESOURCE_EXHAUSTED, f"{MAX_OPEN_STREAMS} streams are open already")
        self._streams += 1

    async def _request(self, handler: Any, context: Context) -> Any:
        """Receives and parses the call's message; aborts the call if there is none."""
        if len(self._waiting) >= MAX_OPEN_WAITING:
            oldest = next(iter(self._waiting))
            del self._waiting[oldest]
            oldest.set_result(None)
        evicted: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting[evicted] = None
        try:
            return handler.request_deserializer(await self._receiver.message(context, OPEN_MESSAGE_LIMIT_S, evicted))
        except RequestError as error:
            try:
                await context.abort(getattr(grpc.StatusCode, error.code), str(error))
            except grpc.aio.BaseError as failure:
                if has_ended(failure):
                    raise asyncio.CancelledError("the call has ended") from None
                raise
        finally:
            self._waiting.pop(evicted, None)


class _Latest:
    """The context of a health watch, whose `write` never waits: only the latest unread message is kept.

    The servicer writes while it has the lock for changes of the health, which a stopping server needs.
    """

    def __init__(self, context: Context) -> None:
        self._context = context
        self._message: Any = None
        self._writing: asyncio.Future[Any] | None = None
        self._tasks = Tasks()

    async def write(self, message: Any) -> None:
        """Returns at once."""
        self._message = message
        if self._writing is None or self._writing.done():
            self._writing = self._tasks.begin(self._write())

    async def _write(self) -> None:
        while self._message is not None:
            message, self._message = self._message, None
            await self._context.write(message)


def has_ended(failure: BaseException | None) -> bool:
    """Whether a status could not be sent because the call has ended: grpc rejected its message, or the caller left.

    If such an error reached grpc, it would log its stack trace.
    """
    return isinstance(failure, grpc.aio.BaseError) and not isinstance(failure, grpc.aio.AbortError)


def quiet_ended_calls() -> None:
    """Keeps stack traces of calls that ended before their status was sent out of the log; grpc writes them itself.

    They come from methods whose messages grpc reads itself, such as reflection, after a message that is too large.
    """
    logging.getLogger("grpc._cython.cygrpc").addFilter(_is_no_ended_call)


def _is_no_ended_call(record: logging.LogRecord) -> bool:
    return not has_ended(record.exc_info[1] if record.exc_info else None)
