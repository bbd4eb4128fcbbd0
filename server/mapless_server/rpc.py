"""What every call has in common: a request id, a deadline, one line in the log, and errors as google.rpc.Status."""

from __future__ import annotations

import asyncio
import logging
import re
import time
import uuid
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any

import grpc
from google.protobuf.message import DecodeError, Message
from google.rpc import error_details_pb2, status_pb2
from grpc_status import rpc_status

from mapless.wire import FieldError

from .errors import AlreadyExists, DeadlineExceeded, InvalidArgument, NotFound, RequestError

log = logging.getLogger(__name__)

REQUEST_ID_KEY = "x-request-id"
_REQUEST_ID = re.compile(r"[A-Za-z0-9_.-]{1,64}", re.ASCII)  # it enters the log: no line breaks, no escapes
_DOMAIN = "mapless"
_MAX_MESSAGE_CHARACTERS = 1000  # trailers hold about 8 KB, and the text stands in them twice


Context = Any
"""grpc.aio.ServicerContext, whose annotations are wrong in places."""


@dataclass(frozen=True)
class Call:
    """What a servicer may know of the call it answers.

    Attributes:
        request_id: identifies it in the log; the caller's own if it sent a well-formed one.
        arrived_s: when it arrived, `time.monotonic`.
        deadline_s: when its answer is of no use any more, `time.monotonic`.
    """

    request_id: str
    arrived_s: float
    deadline_s: float


class CallInterceptor(grpc.aio.ServerInterceptor):
    """Wraps the methods of mapless (health and reflection pass); servicers get a `Call` in place of the context."""

    def __init__(self, default_deadline_s: float) -> None:
        self._default_deadline_s = default_deadline_s

    async def intercept_service(self, continuation: Callable[[Any], Awaitable[Any]], handler_call_details: Any) -> Any:
        """Implements grpc.aio.ServerInterceptor."""
        handler = await continuation(handler_call_details)
        method = handler_call_details.method
        if handler is None or not method.startswith("/mapless."):
            return handler

        async def answer(data: bytes, context: Context) -> Message:
            call = self._begin(context)
            outcome = "CANCELLED"
            log.debug("request_id=%s method=%s begins", call.request_id, method)
            try:
                response = await self._answer_in_time(handler, data, call)
                context.set_trailing_metadata(((REQUEST_ID_KEY, call.request_id),))
                outcome = "OK"
                return response
            except RequestError as error:
                outcome = f"{error.code} {error.reason}: {error}"
                await _abort(context, call, error)
                raise  # not reached: abort raises
            except Exception:
                outcome = "INTERNAL"
                log.exception("request_id=%s method=%s failed", call.request_id, method)
                await _abort(context, call, RequestError(f"internal error, id={call.request_id}"))
                raise
            finally:
                duration_ms = 1000 * (time.monotonic() - call.arrived_s)
                log.info(
                    "request_id=%s method=%s bytes=%d duration_ms=%.0f outcome=%s",
                    call.request_id,
                    method,
                    len(data),
                    duration_ms,
                    outcome.encode("unicode_escape").decode("ascii"),
                )

        # Without a deserializer the bytes arrive as they are, so that a malformed message is answered here too.
        return grpc.unary_unary_rpc_method_handler(answer, None, handler.response_serializer)

    def _begin(self, context: Context) -> Call:
        now_s = time.monotonic()
        remaining_s = context.time_remaining()
        if remaining_s is None:
            remaining_s = self._default_deadline_s
        given_id = next((str(value) for key, value in context.invocation_metadata() or () if key == REQUEST_ID_KEY), "")
        request_id = given_id if _REQUEST_ID.fullmatch(given_id) else uuid.uuid4().hex
        return Call(request_id, now_s, now_s + remaining_s)

    @staticmethod
    async def _answer_in_time(handler: Any, data: bytes, call: Call) -> Message:
        """The servicer's answer; whatever is wrong with the request is a RequestError."""
        try:
            request = handler.request_deserializer(data)
        except (DecodeError, ValueError):
            raise InvalidArgument("the request is not a well-formed message", reason="MALFORMED_MESSAGE") from None
        try:
            return await asyncio.wait_for(handler.unary_unary(request, call), call.deadline_s - time.monotonic())
        except FieldError as error:
            raise InvalidArgument(str(error), field=error.field) from None
        except asyncio.TimeoutError:
            raise DeadlineExceeded("the deadline passed before the answer was ready") from None


async def _abort(context: Context, call: Call, error: RequestError) -> None:
    status = rpc_status.to_status(to_status(error))
    await context.abort(status.code, status.details, (*status.trailing_metadata, (REQUEST_ID_KEY, call.request_id)))


def to_status(error: RequestError) -> status_pb2.Status:
    """The error as google.rpc.Status: one ErrorInfo, and what belongs to its kind."""
    message = str(error)[:_MAX_MESSAGE_CHARACTERS]
    field = {} if error.field is None else {"field": error.field}
    details: list[Message] = [error_details_pb2.ErrorInfo(reason=error.reason, domain=_DOMAIN, metadata=field)]
    if isinstance(error, NotFound | AlreadyExists):
        details.append(error_details_pb2.ResourceInfo(description=message))
    elif error.field is not None:
        violation = error_details_pb2.BadRequest.FieldViolation(field=error.field, description=message)
        details.append(error_details_pb2.BadRequest(field_violations=[violation]))
    if error.retry_after_s is not None:
        retry = error_details_pb2.RetryInfo()
        retry.retry_delay.FromMilliseconds(round(1000 * error.retry_after_s))
        details.append(retry)
    status = status_pb2.Status(code=grpc.StatusCode[error.code].value[0], message=message)
    for detail in details:
        status.details.add().Pack(detail)
    return status
