"""A gateway in front of a server, without a socket, and what callers ask of it."""

import json
import struct
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any

import pytest

from mapless import Client, ConnectOptions, Datum
from mapless.geometry import Quaternion
from support.servers import RunningServer, make_scene, serving

pytest.importorskip("starlette", reason="needs the extra gateway")
pytest.importorskip("connectrpc", reason="needs connectrpc, which needs Python 3.11")

from mapless_tools.gateway.app import GatewayOptions, gateway
from mapless_tools.gateway.client import ServerClient
from mapless_tools.gateway.rpc import rpc_application
from support.asgi import Answer, requested

DATUM = Datum(47.0, 8.0, 450.0, Quaternion(0.0, 0.0, 0.6, 0.8))
JSON = {"content-type": "application/json"}
GPP = JSON | {"accept": "application/vnd.oscp+json;version=2.0;"}
GRPC_WEB = {"content-type": "application/grpc-web+proto", "x-grpc-web": "1", "x-request-id": "page-1"}
LOCALIZE = "/mapless.v1.LocalizationService/Localize"
INTRINSICS = json.dumps(
    {"width_px": 96, "height_px": 64, "focal_x_px": 80, "focal_y_px": 81}
    | {"principal_x_px": 47.5, "principal_y_px": 31.5}
)


@contextmanager
def behind_the_gateway(folder: Path) -> Iterator[RunningServer]:
    """A server with the scenes hall, nowhere (without a datum) and empty, which captures."""
    with serving(folder / "data", capture_dir=folder / "captured", allow_watching=True) as running:
        with Client(running.address) as client:
            for scene, count in (("hall", 2), ("nowhere", 1), ("empty", 0)):
                make_scene(client, scene, count)
            for scene in ("hall", "empty"):
                client.update_scene(scene, datum=DATUM)
        yield running


def frame(message: bytes) -> bytes:
    """As gRPC-Web has a message."""
    return struct.pack(">BI", 0, len(message)) + message


def form(**parts: bytes | str) -> tuple[bytes, dict[str, str]]:
    """A form's body and headers, as curl sends them."""
    lines = []
    for name, value in parts.items():
        file = '; filename="a"' if isinstance(value, bytes) else ""
        content = value if isinstance(value, bytes) else value.encode()
        head = f'--b0\r\nContent-Disposition: form-data; name="{name}"{file}\r\n\r\n'
        lines.append(head.encode() + content + b"\r\n")
    return b"".join(lines) + b"--b0--\r\n", {"content-type": "multipart/form-data; boundary=b0"}


class Asked:
    """A gateway's answer."""

    def __init__(self, app: Any) -> None:
        self.app = app

    async def get(self, path: str) -> Answer:
        return await requested(self.app, "GET", path)

    async def post(self, path: str, body: Any, headers: dict[str, str], **more: Any) -> Answer:
        """To a body as it is, or to JSON."""
        sent = body if isinstance(body, bytes) else json.dumps(body).encode()
        return await requested(self.app, "POST", path, sent, headers, **more)

    async def geopose(self, request: Any, path: str = "/geopose", **headers: str) -> Answer:
        return await self.post(path, request, GPP | headers)

    async def form(self, **parts: bytes | str) -> Answer:
        return await self.post("/v1/localize", *form(**parts))

    async def web(self, message: bytes, path: str = LOCALIZE, **more: Any) -> Answer:
        """To a call by gRPC-Web."""
        return await self.post(path, frame(message), GRPC_WEB, **more)


@asynccontextmanager
async def gateway_of(address: str, connect: ConnectOptions | None = None, **options: Any) -> AsyncIterator[Asked]:
    client, chosen = ServerClient(address, connect), GatewayOptions(**{"scene": "hall"} | options)
    yield Asked(gateway(lambda: client, chosen, rpc_application(lambda: client, chosen.guard.max_body_bytes)))
    await client.close()
