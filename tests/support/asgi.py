"""Requests to an ASGI application without a socket."""

import asyncio
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from starlette.types import ASGIApp


@dataclass(frozen=True)
class Answer:
    """Status, headers by name in small letters, and body."""

    status: int
    headers: Mapping[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body)


async def requested(
    app: ASGIApp,
    method: str,
    path: str,
    body: bytes = b"",
    headers: Mapping[str, str] | None = None,
    parts: int = 1,
    stays_s: float | None = None,
) -> Answer:
    """The answer to a request whose body comes in parts; the client stays for a time, or until it is answered."""
    named = {"host": "127.0.0.1:8080", "content-length": str(len(body)), **(headers or {})}
    scope: Any = {
        "type": "http",
        "asgi": {"version": "3.0"},
        "http_version": "1.1",
        "method": method,
        "scheme": "http",
        "path": path,
        "raw_path": path.encode(),
        "query_string": b"",
        "root_path": "",
        "headers": [(name.encode(), value.encode()) for name, value in named.items()],
        "client": ("127.0.0.1", 1),
        "server": ("127.0.0.1", 8080),
    }
    size = -(-len(body) // parts) or 1
    waiting = [body[at : at + size] for at in range(0, len(body), size)] or [b""]
    status, got, sent = 0, {}, bytearray()

    async def receive() -> Any:
        if not waiting:
            await (asyncio.Event().wait() if stays_s is None else asyncio.sleep(stays_s))
            return {"type": "http.disconnect"}
        part = waiting.pop(0)
        return {"type": "http.request", "body": part, "more_body": bool(waiting)}

    async def send(message: Any) -> None:
        nonlocal status
        if message["type"] == "http.response.start":
            status = message["status"]
            got.update({name.decode(): value.decode() for name, value in message["headers"]})
        elif message["type"] == "http.response.body":
            sent.extend(message.get("body", b""))

    await app(scope, receive, send)
    return Answer(status, got, bytes(sent))
