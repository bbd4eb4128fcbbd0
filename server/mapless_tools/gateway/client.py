"""The gateway's client of the server, which outlives the server's restarts within its callers' time."""

from collections.abc import Awaitable, Callable
from typing import Any, TypeVar

import grpc

from mapless import MaplessError, ResourceExhausted, aio
from mapless.connection import Retries
from mapless.errors import is_unconnected

T = TypeVar("T")


class ServerClient(aio.Client):
    """A client that leaves it to the callers to wait for a server at its limit: their photographs are not held."""

    def channel(self) -> Any:
        """The channel of the server whose turn it is."""
        return self._servers.next(self._now_s()).channel

    async def passed(
        self,
        method: str,
        begin: Callable[[Any, float | None], Awaitable[T]],
        timeout_s: float | None,
        *,
        can_repeat: bool,
    ) -> T:
        """Makes a caller's own call with retries; raises gRPC's error of the last attempt.

        Args:
            method: its name.
            begin: begins an attempt on a channel, with so many seconds left, None for the server's default.
            timeout_s: the caller's deadline; None for the server's default, and retries until the options' timeout.
            can_repeat: whether it is repeated if its answer was lost, and not only if it reached no server.
        """
        retries = Retries(self, method, timeout_s)
        while True:
            server = self._servers.next(self._now_s())
            try:
                response = await begin(server.channel, None if timeout_s is None else retries.left_s())
                self._answered(server)
                return response
            except grpc.RpcError as error:
                failure = self._failed(server, error)
                if not can_repeat and not is_unconnected(failure):
                    raise
                try:
                    await retries.pause_after(failure)
                except MaplessError:
                    raise error from None

    async def _pause(self, duration_s: float, error: MaplessError) -> None:
        if isinstance(error, ResourceExhausted):
            raise error
        await super()._pause(duration_s, error)
