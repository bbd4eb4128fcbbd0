"""What every call has in common: an id, a caller, a deadline, one line in the log, and errors as google.rpc.Status."""

from __future__ import annotations

import asyncio
import inspect
import logging
import time
from collections.abc import AsyncGenerator, Callable, Coroutine, Iterable, Iterator, Mapping
from contextlib import aclosing, contextmanager, suppress
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeVar

import grpc
from google.protobuf.message import DecodeError

from mapless.wire import FieldError
from mapless_server.errors import DeadlineExceeded, InvalidArgument, RequestError, Unavailable
from mapless_server.observability.logs import as_extra
from mapless_server.observability.tracing import CallSpan, Metadata, NoTracer, Tracer
from mapless_server.security.access import ENDLESS_METHODS, OPEN_METHODS
from mapless_server.security.principal import Principal

from .call import REQUEST_ID_KEY, Call, Deadlines, begin_call, metadata_of
from .receiving import Context, OpenMethods, Receiver
from .sending import ENDLESS_SEND_LIMIT_S, SEND_LIMIT_S, Sender

log = logging.getLogger(__name__)

T = TypeVar("T")

Authenticate = Callable[[Metadata, str, Mapping[str, Iterable[bytes]]], Principal]
"""Who calls a method ("/package.Service/Method"), from the call's metadata and the connection's auth_context.

Raises Unauthenticated or PermissionDenied; called on the event loop.
"""


Making = Coroutine[Any, Any, AsyncGenerator[Any, None]]
"""A servicer's method of a stream: gives an iterator of messages."""


class CallObserver(Protocol):
    """Counts calls; called on the event loop, so it must return at once and never raise."""

    def call_started(self, method: str) -> None:
        """A call arrived; `method` is "/package.Service/Method"."""

    def call_handled(self, method: str, code: str, seconds: float, trace_id: str) -> None:
        """It ended with a gRPC status; told once, whatever happened. The id is empty if it is not traced."""


@dataclass
class _Account:
    """What is to be said of a call at its end.

    Attributes:
        span: of its trace.
        code: its gRPC status.
    """

    span: CallSpan
    code: str = "UNKNOWN"


class CallGuard:
    """Wraps the handlers of all methods but the open ones (health, reflection): servicers get a `Call`, not a context.

    No interceptor: a server that somebody else made, and that takes none, can be given handlers.
    """

    def __init__(
        self,
        default_deadline_s: float = 30.0,
        max_deadline_s: float = 600.0,
        *,
        authenticate: Authenticate | None = None,
        check_door: Callable[[str], None] = lambda method: None,
        observer: CallObserver | None = None,
        tracer: Tracer | None = None,
    ) -> None:
        """Without `authenticate`, everybody is admitted.

        Args:
            default_deadline_s: for calls without one.
            max_deadline_s: for calls with a later one.
            authenticate: who calls.
            check_door: raises RequestError if nobody can be let in to this method now; called on the event loop.
            observer: counts calls.
            tracer: traces them; closed by whoever made it.
        """
        self._deadlines = Deadlines(default_deadline_s, max_deadline_s)
        self._authenticate = authenticate
        self._check_door = check_door
        self._observer = observer
        self._tracer = tracer or NoTracer()
        self._active = 0
        self._idle = asyncio.Event()
        self._idle.set()
        self._abandoned: set[asyncio.Task[Any]] = set()  # the loop itself would forget them
        self._receiver = Receiver()
        self._sender = Sender()
        self._open = OpenMethods(self._receiver)

    def guarded(self, method: str, handler: Any) -> Any:
        """The handler of "/package.Service/Method" as it is to be served."""
        if method in OPEN_METHODS:
            return self._open.guarded(handler)
        streams = handler.response_streaming
        reply = self._stream if streams else self._answer

        async def answer(_: object, context: Context) -> bytes | None:
            call = begin_call(context, self._deadlines, method in ENDLESS_METHODS)
            with self._accounted(method, call, context) as account:
                try:
                    self._who_calls(method, context)
                    self._check_door(method)
                    response = await reply(handler, method, call, context)
                    context.set_trailing_metadata(((REQUEST_ID_KEY, call.request_id),))
                    account.code = "OK"
                    return response
                except RequestError as error:
                    account.code = error.code
                    call.note(reason=error.reason, error=str(error))
                    await self._sender.error(context, call, error)
                    raise  # not reached: sending it raises
                except asyncio.CancelledError:
                    # Where the caller's deadline passes, it may be grpc that notices first.
                    account.code = "CANCELLED" if time.monotonic() < call.deadline_s else "DEADLINE_EXCEEDED"
                    raise
                except Exception as error:
                    account.code = "INTERNAL"
                    call.note(reason=type(error).__name__)
                    ids = {"request_id": call.request_id, "trace_id": account.span.trace_id}
                    log.exception("%s failed", method, extra=ids)
                    await self._sender.error(context, call, RequestError(f"internal error, id={call.request_id}"))
                    raise

        # Not as a unary method, whose message grpc receives first: what is refused shall cost nothing, and who sends no
        # message shall not hold a place. Without a deserializer a malformed message is answered here, too.
        if streams:
            return grpc.stream_stream_rpc_method_handler(answer, None, None)
        return grpc.stream_unary_rpc_method_handler(answer, None, None)

    @contextmanager
    def _accounted(self, method: str, call: Call, context: Context) -> Iterator[_Account]:
        """Counts a call, traces it, and writes its line when it has ended, with the status that the account says."""
        is_awaited = method not in ENDLESS_METHODS
        self._active += is_awaited
        if self._active:
            self._idle.clear()
        account = _Account(self._tracer.begin(method, metadata_of(context), call.arrived_s))
        if self._observer is not None:
            self._observer.call_started(method)
        log.debug("%s begins", method, extra={"request_id": call.request_id})
        try:
            yield account
        finally:
            self._active -= is_awaited
            if not self._active:
                self._idle.set()
            self._end(method, account.code, call, account.span)

    async def wait_until_idle(self, limit_s: float) -> None:
        """Returns when no call is being answered, or the time is over."""
        with suppress(asyncio.TimeoutError):
            await asyncio.wait_for(self._idle.wait(), limit_s)

    def _who_calls(self, method: str, context: Context) -> Principal:
        if self._authenticate is None:
            return Principal()
        return self._authenticate(metadata_of(context), method, context.auth_context())

    async def _answer(self, handler: Any, method: str, call: Call, context: Context) -> bytes:
        """The servicer's answer; whatever is wrong with the request is a RequestError."""
        request, call = await self._request(handler, method, call, context)
        try:
            response = await self._in_time(lambda: handler.unary_unary(request, call), call.deadline_s)
        except FieldError as error:
            raise InvalidArgument(str(error), field=error.field) from None
        data = bytes(handler.response_serializer(response))
        call.note(bytes_out=len(data))
        return data

    async def _stream(self, handler: Any, method: str, call: Call, context: Context) -> None:
        """Sends the servicer's messages as they come, until it or the caller ends, or the time is over.

        The servicer's method is a coroutine that gives an iterator of messages, with `aclose`.
        """
        is_endless = method in ENDLESS_METHODS
        request, call = await self._request(handler, method, call, context)
        making = handler.unary_stream(request, call)
        del request  # a photograph, which shall not wait for who reads slowly
        limit_s, sent_bytes = ENDLESS_SEND_LIMIT_S if is_endless else SEND_LIMIT_S, 0
        messages = (
            self._endless(making, method, handler, context)
            if is_endless
            else self._finite(making, handler, call, context)
        )
        try:
            async with aclosing(messages) as coming:
                async for data in coming:
                    await self._sender.message(context, data, limit_s)
                    sent_bytes += len(data)
        except FieldError as error:
            raise InvalidArgument(str(error), field=error.field) from None
        finally:
            call.note(bytes_out=sent_bytes)

    async def _endless(
        self, making: Making, method: str, handler: Any, context: Context
    ) -> AsyncGenerator[bytes, None]:
        """A servicer's messages, each when the one before is sent; the caller learns when they can come."""
        async with aclosing(await making) as responses:
            await self._sender.headers(context)
            async for response in responses:
                # The token may have been revoked, or have expired, since.
                self._who_calls(method, context)
                yield bytes(handler.response_serializer(response))

    async def _finite(self, making: Making, handler: Any, call: Call, context: Context) -> AsyncGenerator[bytes, None]:
        """A servicer's messages, a few, made in time and as fast as it can, however slowly the caller reads."""
        made: asyncio.Queue[bytes | None] = asyncio.Queue()

        async def make() -> None:
            async with aclosing(await making) as responses:
                async for response in responses:
                    made.put_nowait(bytes(handler.response_serializer(response)))

        task = asyncio.ensure_future(self._in_time(make, call.deadline_s))
        task.add_done_callback(lambda _: made.put_nowait(None))
        try:
            data = await made.get()
            if data is not None:
                await self._sender.headers(context)
            while data is not None:
                yield data
                data = await made.get()
            await task
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
            if inspect.getcoroutinestate(making) == inspect.CORO_CREATED:  # the time was over before it began
                making.close()

    async def _request(self, handler: Any, method: str, call: Call, context: Context) -> tuple[Any, Call]:
        """The call's message, and the call with who makes it."""
        limit_s = call.deadline_s - time.monotonic()
        if method in ENDLESS_METHODS:  # which may have no deadline
            limit_s = min(limit_s, self._deadlines.default_deadline_s)
        data = await self._receiver.message(context, limit_s)
        call.note(bytes_in=len(data))
        call = replace(call, principal=self._who_calls(method, context))
        call.note(tenant=call.principal.tenant, **({"principal": call.principal.name} if call.principal.name else {}))
        try:
            # Reading holds the interpreter, about 1 ms for a MiB, in whatever thread: in another one it would hold up
            # the event loop no less. Clients send uploads in pieces (`batch_mib`).
            request = handler.request_deserializer(data)
        except (DecodeError, ValueError):
            raise InvalidArgument("the request is not a well-formed message", reason="MALFORMED_MESSAGE") from None
        return request, call

    async def _in_time(self, answer: Callable[[], Coroutine[Any, Any, T]], deadline_s: float) -> T:
        """The answer, or DeadlineExceeded as soon as the time is over, however long it takes the servicer to stop.

        Neither asyncio.wait_for nor asyncio.timeout will do: before Python 3.12 the first forgets that the caller has
        gone where the answer comes in the same moment, Python 3.10 lacks the second, and both wait for the servicer.
        """
        remaining_s = deadline_s - time.monotonic()
        if remaining_s > 0:
            task = asyncio.ensure_future(answer())
            try:
                await asyncio.wait({task}, timeout=remaining_s)
            except asyncio.CancelledError:
                self._abandon(task)
                raise
            if task.cancelled():  # by what it waited for, since nobody else knows it
                raise Unavailable("the server gave the call up", reason="GIVEN_UP")
            if task.done():
                return task.result()
            self._abandon(task)
        raise DeadlineExceeded("the deadline passed before the answer was ready")

    def _abandon(self, task: asyncio.Task[Any]) -> None:
        self._abandoned.add(task)
        task.add_done_callback(self._bury)
        task.cancel()

    def _bury(self, task: asyncio.Task[Any]) -> None:
        self._abandoned.discard(task)
        error = None if task.cancelled() else task.exception()
        if error is not None and not isinstance(error, RequestError | FieldError):
            log.error("a call failed after it was given up", exc_info=error)

    def _end(self, method: str, code: str, call: Call, span: CallSpan) -> None:
        seconds = time.monotonic() - call.arrived_s
        if self._observer is not None:
            self._observer.call_handled(method, code, seconds, span.trace_id)
        trail = call.trail
        fields: dict[str, object] = {**trail.notes, "request_id": call.request_id, "client": call.client}
        span.end(code, trail.steps, fields)
        if span.trace_id:
            fields["trace_id"] = span.trace_id
        if trail.queue_s is not None:
            fields["queue_ms"] = _ms(trail.queue_s)
        if trail.stage_seconds:
            fields["stages_ms"] = {name: _ms(spent_s) for name, spent_s in trail.stage_seconds.items()}
        fields |= {"method": method, "code": code, "duration_ms": _ms(seconds)}
        log.info("%s %s", method.rpartition("/")[2], code, extra=as_extra(fields))


def _ms(seconds: float) -> float:
    return round(1000 * seconds, 1)
