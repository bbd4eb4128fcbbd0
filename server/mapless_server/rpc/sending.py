"""Sending a stream's messages, and the errors of all calls, in limited time.

What is sent waits in grpc until there is room for it on the way, and there is none while its caller reads nothing. A
handler that ends without a status, by CancelledError, does not end its call: the caller would wait for one for ever. So
a status is always sent, behind what was sent before, and waits for its reader on its own.
"""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any

import grpc
from grpc_status import rpc_status

from mapless_server.errors import DeadlineExceeded, RequestError

from .call import REQUEST_ID_KEY, Call
from .receiving import Context, retrieve
from .status import to_status

SEND_LIMIT_S = 10.0
"""For the caller of a stream that comes to an end to read a message that was made in time. Answers of unary calls wait
in grpc, and cost nothing but themselves; a stream that nobody reads is a call that goes on."""
ENDLESS_SEND_LIMIT_S = 60.0
"""For that of a stream without end, whose messages carry photographs: 4.5 Mbit/s for the largest there are by default.
Who reads nothing for so long does not look any more, and others may want the place."""
_STATUS_LIMIT_S = 1.0
"""For a status to get on its way, which takes no time unless something stands before it."""


class Sender:
    """Writes messages and statuses; lives on the event loop."""

    def __init__(self) -> None:
        self._sending: set[asyncio.Task[None]] = set()  # the loop itself would forget them

    async def headers(self, context: Context) -> None:
        """Begins a stream; raises what `message` does.

        Its first message would take them along, but then no status could be sent while that waits: the status would
        have to take them, too, and grpc refuses what it has been given twice.
        """
        await self._in_time(context.send_initial_metadata(()), SEND_LIMIT_S)

    async def message(self, context: Context, data: bytes, limit_s: float) -> None:
        """Returns when there is room for a message on the way.

        Raises:
            DeadlineExceeded: the caller does not read in time.
            asyncio.CancelledError: it has left.
        """
        await self._in_time(context.write(data), limit_s)

    async def error(self, context: Context, call: Call, error: RequestError) -> None:
        """Ends a call; always raises what grpc is to be told by its handler.

        A caller that does not read is not waited for: it gets the status when it has read what was sent before.
        """
        status = rpc_status.to_status(to_status(error))
        metadata = (*status.trailing_metadata, (REQUEST_ID_KEY, call.request_id))
        telling = self._begin(context.abort(status.code, status.details, metadata))
        await asyncio.wait({telling}, timeout=_STATUS_LIMIT_S)
        if not telling.done():
            raise asyncio.CancelledError("nobody reads any more")
        telling.result()

    async def _in_time(self, sending: Coroutine[Any, Any, None], limit_s: float) -> None:
        task = self._begin(sending)
        await asyncio.wait({task}, timeout=limit_s)
        if not task.done():
            raise DeadlineExceeded("what was sent was not read in time", reason="READ_LATE")
        if isinstance(task.exception(), grpc.aio.BaseError):
            raise asyncio.CancelledError("nobody reads any more")
        task.result()

    def _begin(self, sending: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Never cancelled: grpc still reads from where it was told to. It ends with the call at the latest."""
        task = asyncio.ensure_future(sending)
        self._sending.add(task)
        task.add_done_callback(self._forget)
        return task

    def _forget(self, task: asyncio.Task[None]) -> None:
        self._sending.discard(task)
        retrieve(task)
