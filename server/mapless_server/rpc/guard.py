"""Wraps the handlers of all methods: id, authentication, deadline, log line, and errors as google.rpc.Status.

A servicer gets a `Call`: its id, caller and deadline, and a record of its steps.
"""

from __future__ import annotations

import asyncio
import inspect
import logging
import math
import random
import re
import time
from collections.abc import AsyncGenerator, Callable, Coroutine, Iterable, Iterator, Mapping, Sequence
from contextlib import aclosing, contextmanager, suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar
from urllib.parse import unquote

import grpc
from google.protobuf.message import DecodeError

from mapless.wire import FieldError
from mapless_server.errors import DeadlineExceeded, InvalidArgument, RequestError, Unavailable
from mapless_server.security import ENDLESS_METHODS, OPEN_METHODS, Principal

from .call import Call
from .receiving import Context, OpenMethods, Places, Receiver, quiet_ended_calls
from .sending import ENDLESS_SEND_LIMIT_S, PACED_CODES, REQUEST_ID_KEY, SEND_LIMIT_S, Pace, Sender, Unread

if TYPE_CHECKING:
    from mapless_server.observability.metrics import Metrics
    from mapless_server.observability.otlp import CallSpan, OtlpTracer

log = logging.getLogger(__name__)

T = TypeVar("T")

CLIENT_ID_KEY = "x-client-id"
ANSWER_MARGIN_SHARE = 0.02
"""Share of the time given by which the answer is early: gRPC rounds the time up when it sends it, by at most 1 %."""
ANSWER_MARGIN_S = 0.01
"""Least time by which it is early, because the answer has to be written and sent as well ..."""
_MAX_MARGIN_SHARE = 0.1
"""... and the largest share of the time that this may take."""
_ID = re.compile(r"[A-Za-z0-9_.-]{1,64}", re.ASCII)  # it is logged: no line breaks, no escapes

Metadata = Sequence[tuple[str, str | bytes]]
"""The keys and values that a caller sends beside its message."""

Authenticate = Callable[[Metadata, str, Mapping[str, Iterable[bytes]]], Principal]
"""The caller of a method ("/package.Service/Method"), from the call's metadata and the connection's auth_context.

Raises Unauthenticated or PermissionDenied; called on the event loop.
"""

Opening = Coroutine[Any, Any, AsyncGenerator[Any, None]]
"""A servicer's method of a stream: gives an iterator of messages."""


@dataclass
class _Result:
    """The gRPC status with which a call is logged at its end, and its span, if it is traced."""

    span: CallSpan | None
    code: str = "UNKNOWN"

    @property
    def trace_id(self) -> str:
        """32 hexadecimal digits; empty if the call is not traced."""
        return "" if self.span is None else self.span.trace_id


class CallGuard:
    """Wraps the handlers of all methods except open ones (health, reflection): servicers get a `Call`, not a context.

    It is not an interceptor, because Ray Serve's gRPC servers accept handlers, but no interceptors.
    """

    def __init__(
        self,
        default_deadline_s: float = 30.0,
        max_deadline_s: float = 600.0,
        *,
        authenticate: Authenticate | None = None,
        check_admission: Callable[[str, Call], None] = lambda method, call: None,
        observer: Metrics | None = None,
        tracer: OtlpTracer | None = None,
    ) -> None:
        """Without `authenticate`, every caller is admitted.

        Args:
            default_deadline_s: deadline of calls without one.
            max_deadline_s: largest deadline; later ones are reduced to it.
            authenticate: function that authenticates the caller of a method.
            check_admission: raises RequestError if no call of this method and caller can be served now; called on the
                event loop, before the message is read.
            observer: counts calls.
            tracer: traces calls; its owner closes it.
        """
        self._default_deadline_s = default_deadline_s
        self._max_deadline_s = max_deadline_s
        self._authenticate = authenticate
        self._check_admission = check_admission
        self._observer = observer
        self._tracer = tracer
        self._active = 0
        self._idle = asyncio.Event()
        self._idle.set()
        self._abandoned: set[asyncio.Task[Any]] = set()  # the loop holds only weak references
        self._receiver = Receiver()
        self._sender = Sender()
        self._unread = Unread()
        self._places = Places()
        self._pace = Pace()
        self._open = OpenMethods(self._receiver)
        quiet_ended_calls()

    def guarded(self, method: str, handler: Any) -> Any:
        """Wraps the handler of "/package.Service/Method"."""
        if method in OPEN_METHODS:
            return self._open.guarded(handler)
        streams = handler.response_streaming
        reply = self._stream if streams else self._answer

        async def answer(_: object, context: Context) -> bytes | None:
            call = self._begun(context, method in ENDLESS_METHODS)
            with self._recorded(method, call, context) as result:
                try:
                    call = replace(call, principal=self._principal(method, context))
                    self._check_admission(method, call)
                    with self._places.taken(call.principal.holder):
                        response = await reply(handler, method, call, context)
                    context.set_trailing_metadata(call.trailers)
                    result.code = "OK"
                    return response
                except RequestError as error:
                    result.code = error.code
                    call.note(reason=error.reason, error=str(error))
                    if error.code in PACED_CODES:
                        error.__traceback__ = error.__context__ = None  # they hold the message
                        await self._pace.turn(call.deadline_s, call.principal.holder)
                    await self._sender.error(context, call.request_id, error, streams)
                    raise  # not reached: sending it raises
                except asyncio.CancelledError:
                    # When the caller's deadline passes, grpc may notice it first.
                    result.code = "CANCELLED" if time.monotonic() < call.deadline_s else "DEADLINE_EXCEEDED"
                    raise
                except Exception as error:
                    result.code = "INTERNAL"
                    call.note(reason=type(error).__name__)
                    ids = {"request_id": call.request_id, "trace_id": result.trace_id}
                    log.exception("%s failed", method, extra=ids)
                    internal = RequestError(f"internal error, id={call.request_id}")
                    await self._sender.error(context, call.request_id, internal, streams)
                    raise

        # Not as a unary method, whose message grpc receives first: a rejected call must cost nothing, and one without a
        # message must not hold a place. Without a deserializer a malformed message is answered here, too.
        if streams:
            return grpc.stream_stream_rpc_method_handler(answer, None, None)
        return grpc.stream_unary_rpc_method_handler(answer, None, None)

    def _begun(self, context: Context, is_endless: bool) -> Call:
        """Makes the call whose headers have just arrived; it is not authenticated yet."""
        now_s, asked_s = time.monotonic(), context.time_remaining()
        usual_s = math.inf if is_endless else self._default_deadline_s
        given_s = usual_s if asked_s is None else asked_s
        if not is_endless:
            given_s = min(given_s, self._max_deadline_s)
        margin_s = 0.0
        if math.isfinite(given_s):
            margin_s = min(max(ANSWER_MARGIN_S, ANSWER_MARGIN_SHARE * given_s), _MAX_MARGIN_SHARE * given_s)
        metadata = metadata_of(context)
        request_id = _well_formed(metadata, REQUEST_ID_KEY) or f"{random.getrandbits(128):032x}"
        client = _well_formed(metadata, CLIENT_ID_KEY) or unquote(context.peer())
        call = Call(request_id, now_s, now_s + given_s - margin_s, client=client)
        if math.isfinite(given_s):
            call.note(deadline_ms=round(1000 * given_s))
        return call

    @contextmanager
    def _recorded(self, method: str, call: Call, context: Context) -> Iterator[_Result]:
        """Counts and traces a call, and logs it at its end with the status of the result."""
        is_awaited = method not in ENDLESS_METHODS
        self._active += is_awaited
        if self._active:
            self._idle.clear()
        tracer = self._tracer
        result = _Result(None if tracer is None else tracer.begin(method, metadata_of(context), call.arrived_s))
        if self._observer is not None:
            self._observer.call_started(method)
        log.debug("%s begins", method, extra={"request_id": call.request_id})
        try:
            yield result
        finally:
            self._active -= is_awaited
            if not self._active:
                self._idle.set()
            seconds = time.monotonic() - call.arrived_s
            if self._observer is not None:
                self._observer.call_handled(method, result.code, seconds, result.trace_id)
            # Behind the answer, which grpc sends when this handler returns.
            asyncio.get_running_loop().call_soon(self._log_end, method, call, result, seconds)

    async def wait_until_idle(self, limit_s: float) -> None:
        """Returns when no call is being answered, or after the limit."""
        with suppress(asyncio.TimeoutError):
            await asyncio.wait_for(self._idle.wait(), limit_s)

    def _principal(self, method: str, context: Context) -> Principal:
        if self._authenticate is None:
            return Principal()
        return self._authenticate(metadata_of(context), method, context.auth_context())

    async def _answer(self, handler: Any, method: str, call: Call, context: Context) -> bytes:
        """Returns the servicer's answer; raises faults of the request as RequestError."""
        request, call = await self._request(handler, method, call, context)
        try:
            response = await self._in_time(lambda: handler.unary_unary(request, call), call.deadline_s)
        except FieldError as error:
            raise InvalidArgument(str(error), field=error.field) from None
        data = bytes(handler.response_serializer(response))
        self._unread.add(*call.principal.holder, len(data), context)
        call.note(bytes_out=len(data))
        return data

    async def _stream(self, handler: Any, method: str, call: Call, context: Context) -> None:
        """Sends the servicer's messages until the servicer or the caller ends the call, or the deadline passes.

        The servicer's method is a coroutine that returns an iterator of messages, with `aclose`.
        """
        is_endless = method in ENDLESS_METHODS
        request, call = await self._request(handler, method, call, context)
        opening = handler.unary_stream(request, call)
        del request  # it has a photograph, which a slow reader must not keep in memory
        limit_s, sent_bytes = ENDLESS_SEND_LIMIT_S if is_endless else SEND_LIMIT_S, 0
        messages = (
            self._endless(opening, method, handler, call, context)
            if is_endless
            else self._finite(opening, handler, call, context)
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
        self, opening: Opening, method: str, handler: Any, call: Call, context: Context
    ) -> AsyncGenerator[bytes, None]:
        """Yields a servicer's messages, each after the previous one is sent; sends headers when messages can come."""
        async with aclosing(await opening) as responses:
            await self._sender.headers(context)
            async for response in responses:
                # The token may have been revoked, have expired or been changed since.
                if self._principal(method, context) != call.principal:
                    raise Unavailable("the rights of the token have changed: call again", reason="TOKEN_CHANGED")
                yield bytes(handler.response_serializer(response))

    async def _finite(
        self, opening: Opening, handler: Any, call: Call, context: Context
    ) -> AsyncGenerator[bytes, None]:
        """Yields a servicer's few messages, computed before the deadline however slowly the caller reads."""
        ready: asyncio.Queue[bytes | None] = asyncio.Queue()

        async def compute() -> None:
            async with aclosing(await opening) as responses:
                async for response in responses:
                    ready.put_nowait(bytes(handler.response_serializer(response)))

        task = asyncio.ensure_future(self._in_time(compute, call.deadline_s))
        task.add_done_callback(lambda _: ready.put_nowait(None))
        try:
            data = await ready.get()
            if data is not None:
                await self._sender.headers(context)
            while data is not None:
                yield data
                data = await ready.get()
            await task
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
            if inspect.getcoroutinestate(opening) == inspect.CORO_CREATED:  # the deadline passed before it began
                opening.close()

    async def _request(self, handler: Any, method: str, call: Call, context: Context) -> tuple[Any, Call]:
        """Receives the call's message; returns it, and the call with its principal."""
        limit_s = call.deadline_s - time.monotonic()
        if method in ENDLESS_METHODS:  # which may have no deadline
            limit_s = min(limit_s, self._default_deadline_s)
        data = await self._receiver.message(context, limit_s)
        call.note(bytes_in=len(data))
        call = replace(call, principal=self._principal(method, context))
        call.note(tenant=call.principal.tenant, **({"principal": call.principal.name} if call.principal.name else {}))
        try:
            # Parsing holds the interpreter lock, 1 to 6 ms for 24 MiB, so another thread would block the event loop as
            # much.
            request = handler.request_deserializer(data)
        except (DecodeError, ValueError):
            raise InvalidArgument("the request is not a well-formed message", reason="MALFORMED_MESSAGE") from None
        return request, call

    async def _in_time(self, answer: Callable[[], Coroutine[Any, Any, T]], deadline_s: float) -> T:
        """Returns the answer, or raises DeadlineExceeded at the deadline, however long the servicer takes to stop.

        asyncio.wait_for cannot be used: before Python 3.12 it loses a cancellation that comes together with the answer.
        Both it and asyncio.timeout would wait for the servicer.
        """
        remaining_s = deadline_s - time.monotonic()
        if remaining_s > 0:
            task = asyncio.ensure_future(answer())
            try:
                await asyncio.wait({task}, timeout=remaining_s)
            except asyncio.CancelledError:
                self._abandon(task)
                raise
            if task.cancelled():  # by the job that it waited for
                raise Unavailable("the server abandoned the call", reason="GIVEN_UP")
            if task.done():
                return task.result()
            self._abandon(task)
        raise DeadlineExceeded("the deadline passed before the answer was ready")

    def _abandon(self, task: asyncio.Task[Any]) -> None:
        self._abandoned.add(task)
        task.add_done_callback(self._log_abandoned)
        task.cancel()

    def _log_abandoned(self, task: asyncio.Task[Any]) -> None:
        self._abandoned.discard(task)
        error = None if task.cancelled() else task.exception()
        if error is not None and not isinstance(error, RequestError | FieldError):
            log.error("a call failed after it was abandoned", exc_info=error)

    def _log_end(self, method: str, call: Call, result: _Result, seconds: float) -> None:
        fields: dict[str, object] = {**call.notes, "request_id": call.request_id, "client": call.client}
        if result.span is not None:
            result.span.end(result.code, call.stages, fields)
        if result.trace_id:
            fields["trace_id"] = result.trace_id
        if call.stages:
            spent_s: dict[str, float] = {}
            for it in call.stages:
                if it.jobs:
                    spent_s[it.stage] = spent_s.get(it.stage, 0.0) + it.end_s - it.start_s
            fields["queue_ms"] = _ms(sum(it.waited_s for it in call.stages))
            fields["stages_ms"] = {name: _ms(seconds) for name, seconds in spent_s.items()}
        fields |= {"method": method, "code": result.code, "duration_ms": _ms(seconds)}
        log.info("%s %s", method.rpartition("/")[2], result.code, extra={"fields": fields})


def _ms(seconds: float) -> float:
    return round(1000 * seconds, 1)


def metadata_of(context: Context) -> Metadata:
    """The caller's metadata, in order."""
    return context.invocation_metadata() or ()


def _well_formed(metadata: Metadata, wanted: str) -> str:
    """The value of a key of the metadata; empty if it is missing or cannot be written to the log."""
    given = next((str(value) for key, value in metadata if key == wanted), "")
    return given if _ID.fullmatch(given) else ""
