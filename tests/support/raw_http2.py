"""HTTP/2 by hand (RFC 9113, 7541), for clients that no library allows: they never read, or never finish sending."""

import asyncio
import socket
import struct
from collections.abc import Mapping

PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
_DATA, _HEADERS, _SETTINGS, _PING = 0x0, 0x1, 0x4, 0x6
_ACK = 0x1
_END_STREAM, _END_HEADERS = 0x1, 0x4
_INITIAL_WINDOW_SIZE = 0x4


def hello(window_bytes: int = 65_535) -> bytes:
    """The client's first bytes; the server may send so much of each answer."""
    return PREFACE + _frame(_SETTINGS, 0, 0, struct.pack(">HI", _INITIAL_WINDOW_SIZE, window_bytes))


def ping(is_answer: bool = False) -> bytes:
    """A ping, or the answer to it."""
    return _frame(_PING, _ACK if is_answer else 0, 0, b"mapless!")


def call(stream: int, method: str, message: bytes) -> bytes:
    """A unary gRPC call on a stream, an odd number that was not used before."""
    body = struct.pack(">?I", False, len(message)) + message
    return begin(stream, method) + _frame(_DATA, _END_STREAM, stream, body)


def begin(stream: int, method: str, headers: Mapping[str, str] | None = None) -> bytes:
    """The headers of a gRPC call and nothing else, some of them the caller's own."""
    every = {
        ":method": "POST",
        ":scheme": "http",
        ":path": method,
        ":authority": "localhost",
        "content-type": "application/grpc",
        "te": "trailers",
    }
    return _frame(_HEADERS, _END_HEADERS, stream, _pack(every | dict(headers or {})))


async def until_ended(reader: asyncio.StreamReader, stream: int) -> None:
    """Returns when the server has ended a stream by its trailers."""
    while True:
        head = await reader.readexactly(9)
        kind, flags, of = struct.unpack(">BBI", head[3:])
        await reader.readexactly(int.from_bytes(head[:3], "big"))
        if (kind, of) == (_HEADERS, stream) and flags & _END_STREAM:
            return


def connect(address: str) -> socket.socket:
    """A connection to "host:port"."""
    host, _, port = address.rpartition(":")
    return socket.create_connection((host, int(port)), timeout=20)


def _frame(kind: int, flags: int, stream: int, body: bytes) -> bytes:
    return struct.pack(">I", len(body))[1:] + struct.pack(">BBI", kind, flags, stream) + body


def _pack(headers: Mapping[str, str]) -> bytes:
    """Literals that are not indexed, none of them Huffman coded; shorter than 127 bytes each."""
    parts = [part.encode() for pair in headers.items() for part in pair]
    strings = [bytes([len(part)]) + part for part in parts]
    return b"".join(b"\0" + name + value for name, value in zip(strings[::2], strings[1::2], strict=True))
