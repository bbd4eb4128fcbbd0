"""Bodies of HTTP requests to the gateway: the GeoPose Protocol, the form, and calls of browsers.

An input is one byte that chooses the path, then the body. Laws: no answer is a fault of the gateway (500), errors are
JSON with a reason and a message, and what the server is asked is a photograph with a camera. The server is a stand-in
that answers at once: what real ones do with requests is the subject of `localization`.
"""

from __future__ import annotations

import asyncio
import base64
import json
import struct
from datetime import datetime, timezone
from functools import cache
from random import Random
from types import SimpleNamespace
from typing import Any

from support import gpp
from support.asgi import requested
from support.planted_answers import localized
from support.servers import PHOTO, localize_request

from mapless import Datum, LocalizationResult, Scene
from mapless.answers import Accuracy
from mapless.geodesy import geopose
from mapless.geometry import Camera, RigidTransform
from mapless.v1 import localization_service_pb2 as pb
from mapless_tools.gateway.app import GatewayOptions, gateway
from mapless_tools.gateway.rpc import rpc_application

from .target import MutateBytes, Target

_DATUM = Datum(47.0, 8.0, 450.0)
_LOCALIZE = "/mapless.v1.LocalizationService/Localize"
_PATHS = (
    ("/geopose", "application/json"),
    ("/v1/localize", "multipart/form-data; boundary=b0"),
    (_LOCALIZE, "application/json"),
    (_LOCALIZE, "application/proto"),
    (_LOCALIZE, "application/grpc-web+proto"),
    (f"{_LOCALIZE}Progressively", "application/connect+json"),
)
_VALUES: tuple[Any, ...] = (None, True, 0, -1, 1e308, -1e308, 2**70, "", "x", [], {}, [[]], 1e-320, "JPG", "RGBA32", 91)


class _Client:
    """Answers as a client does."""

    options = SimpleNamespace(token=None)

    def acting_for(self, *_: Any) -> _Client:
        return self

    async def get_scene(self, name: str) -> Scene:
        return Scene("hall", 1, 1, datetime(2026, 1, 1, tzinfo=timezone.utc), datum=_DATUM)

    async def localize(self, image: bytes, camera: Camera, scene: str, *, confidential: bool, **_: Any) -> Any:
        assert image
        assert isinstance(camera, Camera)
        assert isinstance(confidential, bool)
        answer: LocalizationResult = localized(
            geo_pose=geopose(RigidTransform.identity(), _DATUM), accuracy=Accuracy(0.1, 0.2, 0.3, 0.4, False)
        )
        return answer

    async def call(self, method: str, request: Any, read: Any) -> Any:
        assert request.image
        return pb.LocalizeResponse()


class _Channel:
    """A channel whose calls answer at once, and the client that has it."""

    def channel(self) -> _Channel:
        return self

    async def passed(self, method: str, begin: Any, timeout_s: float | None, *, can_repeat: bool) -> Any:
        return await begin(self, timeout_s)

    def unary_unary(self, path: str, *, request_serializer: Any, response_deserializer: Any) -> Any:
        async def call(request: Any, **_: Any) -> Any:
            request_serializer(request)
            return response_deserializer(b"")

        return call

    def unary_stream(self, path: str, *, request_serializer: Any, response_deserializer: Any) -> Any:
        class Call:
            def __init__(self, request: Any, **_: Any) -> None:
                request_serializer(request)

            async def __aiter__(self) -> Any:
                yield response_deserializer(b"")

            def cancel(self) -> None:
                """Nothing runs."""

        return Call


@cache
def _application() -> tuple[asyncio.AbstractEventLoop, Any]:
    client: Any = _Client()
    channel: Any = _Channel()
    app = gateway(lambda: client, GatewayOptions("hall"), rpc_application(lambda: channel, 2**20))
    return asyncio.new_event_loop(), app


def check(data: bytes) -> bool:
    """See Target."""
    path, kind = _PATHS[(data[0] if data else 0) % len(_PATHS)]
    loop, app = _application()
    answer = loop.run_until_complete(requested(app, "POST", path, data[1:], {"content-type": kind}))
    assert answer.status == 200 or 400 <= answer.status < 500, (answer.status, answer.body)
    if answer.status != 200 and not path.startswith(_LOCALIZE):
        error = answer.json["error"]
        assert error["reason"]
        assert error["message"]
    if kind == "application/grpc-web+proto":
        return b"grpc-status: 0" in answer.body
    return answer.status == 200 and b'"error"' not in answer.body


def _form(**parts: bytes) -> bytes:
    head = 'Content-Disposition: form-data; name="{}"; filename="a"'
    lines = (b"--b0\r\n" + head.format(name).encode() + b"\r\n\r\n" + it + b"\r\n" for name, it in parts.items())
    return b"".join(lines) + b"--b0--\r\n"


def seeds() -> list[bytes]:
    """Requests of each kind that are right."""
    request = localize_request("hall")
    message: bytes = request.SerializeToString()
    camera = {"width_px": 96, "height_px": 64, "focal_x_px": 80, "focal_y_px": 81}
    place = gpp.geolocation(47.0, 8.0, timestamp=5.0)
    earlier = {
        "id": "a",
        "timestamp": 5.0,
        "accuracy": {"position": 0.1, "orientation": 0.2},
        "type": "geopose",
        "geopose": geopose(RigidTransform.identity(), _DATUM).to_json(),
    }
    full = gpp.request(gpp.camera_reading(timestamp=5.0), geolocationReadings=[place]) | {"priorPoses": [earlier]}
    image = base64.b64encode(PHOTO).decode()
    as_json = json.dumps({"scene": "scenes/hall", "image": image, "intrinsics": camera}).encode()
    options = b'{"options": {"axes": "AXES_ARKIT"}}'
    bodies = (
        json.dumps(full).encode(),
        json.dumps(gpp.demo_request()).encode(),
        _form(image=PHOTO, intrinsics=json.dumps(camera).encode(), request=options),
        as_json,
        message,
        struct.pack(">BI", 0, len(message)) + message,
        struct.pack(">BI", 0, len(as_json)) + as_json,
    )
    paths = (0, 0, 1, 2, 3, 4, 5)
    return [bytes([path]) + body for path, body in zip(paths, bodies, strict=True)]


def mutate(data: bytes, random: Random, mutate_bytes: MutateBytes) -> bytes:
    """Changes members of what is JSON, or now and then bytes."""
    try:
        content = json.loads(data[1:])
    except (ValueError, RecursionError):
        content = None
    if not isinstance(content, dict) or random.random() < 0.2:
        return data[:1] + mutate_bytes(data[1:])
    for _ in range(random.randrange(1, 4)):
        _change(content, random)
    return data[:1] + json.dumps(content).encode(errors="replace")


def _change(content: Any, random: Random) -> None:
    """One member, at any depth."""
    while True:
        keys = list(content) if isinstance(content, dict) else list(range(len(content)))
        if not keys:
            return
        key = random.choice(keys)
        inner = content[key]
        if isinstance(inner, dict | list) and inner and random.random() < 0.8:
            content = inner
            continue
        break
    chance = random.random()
    if chance < 0.2:
        del content[key]
    elif chance < 0.3 and isinstance(content, list):
        content.append(inner)
    elif chance < 0.5 and isinstance(inner, int | float):
        content[key] = inner * random.choice((-1, 0.5, 1e3, 1e-3, 1e12))
    elif chance < 0.6 and isinstance(inner, str):
        content[key] = inner[: random.randrange(len(inner) + 1)]
    else:
        content[key] = random.choice(_VALUES)


TARGET = Target(
    seeds,
    check,
    mutate,
    max_bytes=65_536,
    words=(
        b'"cameraReadings"',
        b'"imageBytes"',
        b'"modelParams"',
        b"NaN",
        b"1e999",
        b"\r\n--b0",
        b'name="image"',
        b"null",
    ),
)
