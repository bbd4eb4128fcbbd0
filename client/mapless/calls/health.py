"""The health check: whether the server takes calls."""

from typing import Any

from google.protobuf import wrappers_pb2

from ..exchange import Call, Exchange

# grpc.health.v1 in protobuf's own messages, which saves a dependency: the request has the service's name in field 1,
# empty for the whole server, and the answer an enum in field 1.
_WRAPPERS: Any = wrappers_pb2  # the module is not annotated
_METHOD = "grpc.health.v1.Health/Check"
_SERVING = 1

SERVICES = ("mapless.v1.LocalizationService", "mapless.v1.ReferenceService")
"""Services with a state of their own: a server whose store cannot be written still answers queries."""


def is_serving(service: str = "", *, timeout_s: float | None = None) -> Exchange[bool]:
    """Returns whether the server takes calls: False while it starts or drains. Raises an error if it cannot be reached.

    Args:
        service: one of `SERVICES`; empty for the whole server.
        timeout_s: deadline of the call.
    """
    response = yield Call(_METHOD, _WRAPPERS.StringValue(value=service), _WRAPPERS.UInt32Value, timeout_s)
    return bool(response.value == _SERVING)
