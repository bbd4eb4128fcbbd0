"""Whether the server takes calls."""

from __future__ import annotations

from typing import Any

from google.protobuf import empty_pb2, wrappers_pb2

from ..exchange import Call, Exchange

# grpc.health.v1 in messages that every protobuf has, which spares robots a package: the request for the whole server is
# empty, and the answer is an enum in field 1.
_EMPTY: Any = empty_pb2  # neither module is annotated
_WRAPPERS: Any = wrappers_pb2
_METHOD = "grpc.health.v1.Health/Check"
_SERVING = 1


def is_serving(*, timeout_s: float | None = None) -> Exchange[bool]:
    """Whether the server takes calls; False while it starts or drains, an error if it cannot be reached."""
    response = yield Call(_METHOD, _EMPTY.Empty(), _WRAPPERS.UInt32Value, timeout_s)
    return bool(response.value == _SERVING)
