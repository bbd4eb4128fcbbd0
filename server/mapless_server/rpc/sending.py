"""Sends a stream's messages, and the errors of all calls, in limited time.

Refusals beyond a rate are delayed, so that callers that call again at once leave the processor to the answers.

A message waits in grpc until flow control lets it through, which it does not while the caller reads nothing. A handler
that ends by CancelledError, without a status, does not end its call: the caller would wait for the status for ever. So
a status is always sent, behind the earlier messages, and waits for its reader without the handler.
"""

import asyncio
import time
from collections import Counter
from collections.abc import Coroutine
from typing import Any

import grpc
from google.protobuf.message import Message
from google.rpc import error_details_pb2, status_pb2
from grpc_status import rpc_status

from mapless_server.errors import AlreadyExists, DeadlineExceeded, NotFound, Overloaded, RequestError

from .receiving import Context, Tasks, has_ended

REQUEST_ID_KEY = "x-request-id"

SEND_LIMIT_S = 10.0
"""For the caller of a finite stream to read a message that is ready. Answers of unary calls wait in grpc and cost only
their memory, see `Unread`; a stream without a reader keeps its call open."""
ENDLESS_SEND_LIMIT_S = 60.0
"""For the caller of an endless stream, whose messages hold photographs: 4.5 Mbit/s for the largest default message. A
caller that reads nothing for so long is gone, and its place is freed."""
_STATUS_LIMIT_S = 1.0
"""For a status to be sent, which takes no time unless unread messages are before it."""


class Sender:
    """Sends messages and statuses; runs on the event loop."""

    def __init__(self) -> None:
        self._sending = Tasks()

    async def headers(self, context: Context) -> None:
        """Sends the headers of a stream; raises the same exceptions as `message`.

        Otherwise the headers would be sent with the first message, and no status could be sent while that message
        waits: it would contain the headers, too, and grpc rejects headers that it already has.
        """
        await self._in_time(context.send_initial_metadata(()), SEND_LIMIT_S)

    async def message(self, context: Context, data: bytes, limit_s: float) -> None:
        """Sends a message; returns when grpc has accepted it.

        Raises:
            DeadlineExceeded: the caller does not read in time.
            asyncio.CancelledError: the caller has disconnected.
        """
        await self._in_time(context.write(data), limit_s)

    async def error(self, context: Context, request_id: str, error: RequestError, is_stream: bool) -> None:
        """Ends a call with an error: always raises, and the handler must not catch that exception.

        It does not wait for a caller that does not read a stream, which gets the status after the earlier messages.
        """
        status = rpc_status.to_status(to_status(error, request_id))
        metadata = (*status.trailing_metadata, (REQUEST_ID_KEY, request_id))
        abort = context.abort(status.code, status.details, metadata)
        if not is_stream:  # nothing is before it
            try:
                await abort
            except grpc.aio.BaseError as failure:
                if has_ended(failure):
                    raise asyncio.CancelledError("the call has ended") from None
                raise
        aborting = self._sending.begin(abort)
        await asyncio.wait({aborting}, timeout=_STATUS_LIMIT_S)
        if not aborting.done():
            raise asyncio.CancelledError("the caller does not read")
        if has_ended(aborting.exception()):
            raise asyncio.CancelledError("the call has ended")
        aborting.result()

    async def _in_time(self, sending: Coroutine[Any, Any, None], limit_s: float) -> None:
        task = self._sending.begin(sending)
        await asyncio.wait({task}, timeout=limit_s)
        if not task.done():
            raise DeadlineExceeded("the caller did not read a message in time", reason="READ_LATE")
        if isinstance(task.exception(), grpc.aio.BaseError):
            raise asyncio.CancelledError("the caller does not read")
        task.result()


UNREAD_BYTES = 256 * 2**20
"""Answers that a tenant's callers have not read yet; grpc keeps them in memory as long as the connection lasts, though
their handlers have ended. As many as sixteen of the largest photographs."""
UNREAD_SHARE = 0.75
"""Share that one token may have of what the tenant's other tokens leave."""
SMALL_ANSWER_BYTES = 256 * 1024
"""Such an answer is sent all the same: callers that read nothing must not keep others from being localized."""


class Unread:
    """Limits the answers in memory that callers are slow to read; runs on the event loop."""

    def __init__(self) -> None:
        self._of_tenants: Counter[str] = Counter()
        self._of_callers: Counter[tuple[str, str]] = Counter()

    def add(self, tenant: str, caller: str, size_bytes: int, context: Context) -> None:
        """Counts an answer until it is sent; Overloaded for a large one beside too many of the tenant or caller.

        A caller without a token or certificate has no name, and shares what the tenant may have with the others.
        """
        unread_bytes, by_caller = self._of_tenants[tenant], self._of_callers[tenant, caller]
        share = UNREAD_SHARE if caller else 1.0
        most_bytes = share * (UNREAD_BYTES - (unread_bytes - by_caller))
        if size_bytes > SMALL_ANSWER_BYTES and unread_bytes and by_caller + size_bytes > most_bytes:
            message = f"answers of {unread_bytes // 2**20} MiB wait to be read by their callers"
            raise Overloaded(message, reason="UNREAD_ANSWERS", retry_after_s=1.0)
        self._of_tenants[tenant] += size_bytes
        self._of_callers[tenant, caller] += size_bytes

        def sent(_: object) -> None:
            self._of_tenants[tenant] -= size_bytes
            self._of_callers[tenant, caller] -= size_bytes
            self._of_tenants, self._of_callers = +self._of_tenants, +self._of_callers

        context.add_done_callback(sent)


_DOMAIN = "mapless"
_MAX_MESSAGE_CHARACTERS = 1000  # trailers hold about 8 KB, and they hold the text twice


def to_status(error: RequestError, request_id: str = "") -> status_pb2.Status:
    """Converts an error to google.rpc.Status: one ErrorInfo, the details of its kind, and the request id if given."""
    message = str(error)[:_MAX_MESSAGE_CHARACTERS]
    field = {} if error.field is None else {"field": error.field}
    details: list[Message] = [error_details_pb2.ErrorInfo(reason=error.reason, domain=_DOMAIN, metadata=field)]
    if isinstance(error, NotFound | AlreadyExists):
        kind = "Reference" if "/references/" in error.resource else "Scene"
        resource = {"resource_type": f"mapless.v1.{kind}", "resource_name": error.resource} if error.resource else {}
        details.append(error_details_pb2.ResourceInfo(**resource, description=message))
    elif error.field is not None:
        violation = error_details_pb2.BadRequest.FieldViolation(field=error.field, description=message)
        details.append(error_details_pb2.BadRequest(field_violations=[violation]))
    if error.retry_after_s is not None:
        retry = error_details_pb2.RetryInfo()
        retry.retry_delay.FromMilliseconds(round(1000 * error.retry_after_s))
        details.append(retry)
    if request_id:
        details.append(error_details_pb2.RequestInfo(request_id=request_id))
    status = status_pb2.Status(code=grpc.StatusCode[error.code].value[0], message=message)
    for detail in details:
        status.details.add().Pack(detail)
    return status


PACED_CODES = frozenset({"RESOURCE_EXHAUSTED", "UNAUTHENTICATED", "PERMISSION_DENIED"})
"""Codes of calls that a caller may repeat as fast as they are answered; after UNAVAILABLE it tries another server."""

PER_S = 50
"""Refusals a second, of all callers together, that are not delayed: 2 % of a core. A server of twenty answers a second
refuses fewer at three times what it can do."""

BURST = 50
"""So many are not delayed although they come at once."""

LONGEST_S = 1.0
"""The longest delay."""

MOST_DELAYED = 256
"""Calls that are delayed at a time, a small part of those that may be open; a further one is refused at once."""


class Pace:
    """Gives refusals their turns, and callers that are refused equal parts of them; runs on the event loop."""

    def __init__(self) -> None:
        self._free_s: dict[tuple[str, str], float] = {}
        self._delayed = 0

    async def turn(self, deadline_s: float, caller: tuple[str, str] = ("", "")) -> None:
        """Returns when the next refusal of a caller may be sent, before the call's deadline, by `time.monotonic`.

        The caller is the tenant and the name of its token or certificate; all that have none are one.
        """
        now_s = time.monotonic()
        begin_s = now_s - BURST / PER_S
        self._free_s = {other: free_s for other, free_s in self._free_s.items() if free_s > begin_s}
        earliest_s = self._free_s.pop(caller, begin_s)
        interval_s = (len(self._free_s) + 1) / PER_S
        free_s = self._free_s[caller] = min(earliest_s + interval_s, now_s + LONGEST_S)
        wait_s = min(free_s, deadline_s) - now_s
        if wait_s > 0 and self._delayed < MOST_DELAYED:
            self._delayed += 1
            try:
                await asyncio.sleep(wait_s)
            finally:
                self._delayed -= 1
