"""Limits which requests reach the gateway (allowed origins, number and size), and the form of all its errors."""

import asyncio
import codecs
import logging
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field

from starlette.datastructures import Headers
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from mapless import MaplessError

log = logging.getLogger(__name__)

_STATUS = {
    "INVALID_ARGUMENT": 400,
    "UNAUTHENTICATED": 401,
    "PERMISSION_DENIED": 403,
    "NOT_FOUND": 404,
    "ALREADY_EXISTS": 409,
    "FAILED_PRECONDITION": 409,
    "RESOURCE_EXHAUSTED": 429,
    "UNAVAILABLE": 503,
    "DEADLINE_EXCEEDED": 504,
}
"""By the name of a gRPC status; all others are 502, faults of the server behind the gateway."""


_AWAY = "the server behind this gateway is away"
_OF_CONNECTION = {
    "UNAVAILABLE": _AWAY,
    "CANCELLED": _AWAY,
    "DEADLINE_EXCEEDED": "no answer of the server behind this gateway in time",
    "INTERNAL": "the server behind this gateway gave no answer that can be read",
    "UNKNOWN": "the server behind this gateway gave no answer that can be read",
}
"""By the name of a gRPC status that no server has sent."""


class Failure(Exception):
    """A request that is not answered: an HTTP status, and the members of `error` in the JSON.

    Members without a value are left out; the message begins with the field. `retry_after_s` is None if another attempt
    would not help.
    """

    def __init__(
        self,
        message: str,
        status: int = 400,
        *,
        reason: str = "INVALID_ARGUMENT",
        field: str | None = None,
        retry_after_s: float | None = None,
        **more: str | None,
    ) -> None:
        message = f"{field}: {message}" if field and field not in message else message
        super().__init__(message)
        self.status = status
        self.content = {"reason": reason, "message": message, "field": field or None} | more
        self.retry_after_s = retry_after_s

    def response(self) -> JSONResponse:
        """The HTTP response."""
        after = {} if self.retry_after_s is None else {"retry-after": str(math.ceil(self.retry_after_s))}
        content = {name: value for name, value in self.content.items() if value is not None}
        return JSONResponse({"error": content}, self.status, after)


def public_message(code: str, message: str, request_id: str) -> str:
    """The message of a call's error for callers of the gateway.

    It is the server's own if the error has a request id. Otherwise the connection failed, whose text names the server's
    address, or a proxy: it goes to the log.
    """
    if request_id or code not in _OF_CONNECTION:
        return message
    log.warning("a call of the server failed, %s: %s", code, message)
    return _OF_CONNECTION[code]


def of_server(error: MaplessError, field: str | None = None) -> Failure:
    """Makes the failure of a call; `field` replaces the error's own."""
    return Failure(
        public_message(error.code, error.message, error.request_id),
        _STATUS.get(error.code, 502),
        reason=error.reason,
        field=field or error.field,
        retry_after_s=error.retry_after_s,
        request_id=error.request_id or None,
    )


MAX_VALUES = 100_000
"""Most values of a JSON text, whose objects take ten times its memory and seconds to make; requests of devices have
hundreds."""
_LOOPBACK_NAMES = ("127.0.0.1", "localhost", "[::1]")


@dataclass(frozen=True)
class GuardOptions:
    """Limits of accepted requests.

    Attributes:
        origins: origins of pages that may call, besides the gateway's own, "https://app.example"; ("*",) for all.
        is_loopback: whether it listens on this machine only. Then host names other than its own and those of `origins`
            are rejected: a page whose name resolves to this machine would count as the gateway's own.
        max_body_bytes: largest body of a request. A photograph of 16 MiB, the largest that servers accept, has 22.4 MB
            in base64.
        max_requests: largest number of concurrent requests; further ones are rejected.
        max_held_bytes: largest size of all concurrent requests. It limits the memory, which is four times as much:
            text, photograph, call, and the bytes being sent.
        body_s: time in which a request has to arrive.
    """

    origins: Sequence[str] = ()
    is_loopback: bool = True
    max_body_bytes: int = 32 * 2**20
    max_requests: int = 32
    max_held_bytes: int = 96 * 2**20
    body_s: float = 60.0

    def __post_init__(self) -> None:
        for name in ("max_body_bytes", "max_requests", "max_held_bytes", "body_s"):
            if not (value := getattr(self, name)) > 0:
                raise ValueError(f"{name} must be above 0, is {value:g}")
        for origin in self.origins:
            scheme, separator, host = origin.partition("://")
            if origin != "*" and (scheme not in ("http", "https") or not separator or not host or "/" in host):
                raise ValueError(f"an origin is https://host or https://host:port, without a path, is {origin!a}")


@dataclass
class Guard:
    """Rejects what must not reach the application `app`."""

    app: ASGIApp
    options: GuardOptions = field(default_factory=GuardOptions)
    _running: int = 0
    _held_bytes: int = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handles a request; anything else is passed on."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        has_begun = False

        async def noting(message: Message) -> None:
            nonlocal has_begun
            has_begun = True
            await send(message)

        body = _Body(self, receive)
        self._running += 1
        try:
            self._check(scope)
            await self.app(scope, body.receive, noting)
        except Failure as failure:
            if not has_begun:
                await failure.response()(scope, receive, send)
        finally:
            self._running -= 1
            self._held_bytes -= body.size

    def _check(self, scope: Scope) -> None:
        headers, origins = Headers(scope=scope), self.options.origins
        host, origin = headers.get("host", ""), headers.get("origin")
        own = {f"http://{host}", f"https://{host}"}
        is_local = host in _LOOPBACK_NAMES or host.rpartition(":")[0] in _LOOPBACK_NAMES
        if "*" not in origins and self.options.is_loopback and not is_local and not own & {*origins}:
            raise Failure(
                f"this gateway listens on the loopback interface, and is not {host!a}; behind a proxy, its operator "
                "gives the proxy's address by --allow-origin",
                403,
                reason="FOREIGN_HOST",
            )
        if origin is not None and origin not in own | {*origins} and "*" not in origins:
            raise Failure(
                f"pages of the origin {origin!a} may not call; the gateway's operator allows them by --allow-origin",
                403,
                reason="FOREIGN_ORIGIN",
            )
        length = headers.get("content-length", "")
        self.check_size(int(length[:20]) if length.isdecimal() else 0)
        if self._running > self.options.max_requests:
            raise _busy("too many requests at a time")

    def check_size(self, size: int) -> None:
        """Rejects a body of this size if it is too large."""
        if size > self.options.max_body_bytes:
            large = f"the request is larger than {self.options.max_body_bytes} bytes"
            raise Failure(large, 413, reason="REQUEST_TOO_LARGE")

    def hold(self, size: int) -> None:
        """Counts bytes that have arrived; rejects them if there are too many."""
        self._held_bytes += size
        if self._held_bytes > self.options.max_held_bytes:
            raise _busy("too large requests at a time")


def checked_json(text: bytes | bytearray, field: str | None = None) -> bytes | bytearray:
    """A JSON text without a byte order mark; Failure if it has too many values, before it is parsed."""
    if sum(map(text.count, (b",", b"[", b"{"))) > MAX_VALUES:
        raise Failure(f"the JSON has more than {MAX_VALUES} values", field=field)
    return text.removeprefix(codecs.BOM_UTF8)


def _busy(message: str) -> Failure:
    return Failure(message, 503, reason="GATEWAY_BUSY", retry_after_s=1.0)


class _Body:
    """The body of a request, with limits on its size and time; `size` is that of the bytes that have arrived."""

    def __init__(self, guard: Guard, receive: Receive) -> None:
        self._guard = guard
        self._receive = receive
        self._deadline_s = time.monotonic() + guard.options.body_s
        self._is_complete = False
        self.size = 0

    async def receive(self) -> Message:
        """The next part; after the last one, waits for the end of the connection."""
        if self._is_complete:
            return await self._receive()
        try:
            message = await asyncio.wait_for(self._receive(), self._deadline_s - time.monotonic())
        except asyncio.TimeoutError:
            late = f"the request did not arrive within {self._guard.options.body_s:g} s"
            raise Failure(late, 408, reason="REQUEST_LATE") from None
        size = len(message.get("body", b""))
        self.size += size
        self._is_complete = not message.get("more_body", False)
        self._guard.check_size(self.size)
        self._guard.hold(size)
        return message
