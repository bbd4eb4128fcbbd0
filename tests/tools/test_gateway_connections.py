"""Connections to the gateway that make no request end; those whose request is being answered do not."""

import asyncio
import socket
import ssl
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("uvicorn", reason="needs the extra gateway")

from support.certificates import authority, signed

from mapless_tools.gateway import serving
from mapless_tools.gateway.serving import Binding, http_server

LIMIT_S = 0.6
REQUEST = b"GET / HTTP/1.1\r\nhost: a\r\n"


async def slow(scope: Any, receive: Any, send: Any) -> None:
    """Answers each request after four limits, but one for /soon at once."""
    if scope["type"] != "http":
        return
    await asyncio.sleep(0 if scope["path"] == "/soon" else 4 * LIMIT_S)
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"4")]})
    await send({"type": "http.response.body", "body": b"done"})


@asynccontextmanager
async def listening(monkeypatch: pytest.MonkeyPatch, **tls: Any) -> AsyncIterator[int]:
    """The port of such a server."""
    monkeypatch.setattr(serving, "REQUEST_LIMIT_S", LIMIT_S)
    server = http_server(slow, Binding("127.0.0.1", 0, **tls))
    with socket.create_server(("127.0.0.1", 0)) as bound:
        task = asyncio.create_task(server.serve([bound]))
        try:
            yield bound.getsockname()[1]
        finally:
            server.should_exit = True
            await asyncio.wait_for(task, 30)


async def until_ended(port: int, *sent: bytes, context: ssl.SSLContext | None = None) -> tuple[float, bytes]:
    """Seconds until the server ends a connection on which this was sent, and what it answered."""
    begin_s = time.monotonic()
    reader, writer = await asyncio.open_connection("127.0.0.1", port, ssl=context)
    for data in sent:
        writer.write(data)
        await writer.drain()
    answer = await asyncio.wait_for(reader.read(), 30)
    writer.close()
    return time.monotonic() - begin_s, answer


async def test_a_connection_without_a_request_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    async with listening(monkeypatch) as port:
        for sent in (b"", REQUEST, b"GET /soon HTTP/1.1\r\nhost: a\r\n\r\n" + REQUEST):
            ended_s, _ = await until_ended(port, sent)
            assert LIMIT_S <= ended_s + 0.05 < 3.5 * LIMIT_S, sent


async def test_a_connection_whose_request_is_answered_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    async with listening(monkeypatch) as port:
        ended_s, answer = await until_ended(port, REQUEST + b"\r\n")
    assert answer.endswith(b"done")
    assert ended_s >= 4 * LIMIT_S


async def test_a_connection_without_a_tls_handshake_ends(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """And one with it that makes no request."""
    root = authority()
    files = {"certificate": tmp_path / "certificate.pem", "key": tmp_path / "key.pem"}
    signed(root, "gateway").write(*files.values())
    context = ssl.create_default_context(cadata=root.certificate_pem.decode())
    async with listening(monkeypatch, **files) as port:
        for sent in (b"", b"\x16\x03\x01\x02"):  # the second is the beginning of a ClientHello
            ended_s, _ = await until_ended(port, sent)
            assert ended_s < 3.5 * LIMIT_S, sent
        assert (await until_ended(port, context=context))[0] < 4.5 * LIMIT_S
        assert (await until_ended(port, REQUEST + b"\r\n", context=context))[1].endswith(b"done")
