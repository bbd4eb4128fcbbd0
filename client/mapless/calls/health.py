"""The health check: whether the server takes calls."""

from ..connection import Connection
from ..servers import HealthRequest

SERVICES = ("mapless.v1.LocalizationService", "mapless.v1.ReferenceService")
"""Services with a state of their own: a server whose store cannot be written still answers queries."""
_SERVING = 1


async def is_serving(connection: Connection, service: str = "", *, timeout_s: float | None = None) -> bool:
    """Returns whether the server takes calls: False while it starts or drains.

    Raises an error if it cannot be reached, after four attempts in about 1.4 s, not at the deadline.

    Args:
        service: one of `SERVICES`; empty for the whole server.
        timeout_s: deadline of the call.
    """
    request = HealthRequest(value=service)
    return await connection.call("Check", request, lambda it: bool(it.value == _SERVING), timeout_s, is_check=True)
