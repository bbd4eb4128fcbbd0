"""The client for asyncio: the calls of `mapless.calls` as its methods.

>>> async with mapless.aio.Client("localhost:50051") as client:
...     answer = await client.localize("photo.jpg", camera, scene="kitchen")
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncGenerator, Callable, Coroutine, Iterator
from contextlib import suppress
from types import TracebackType
from typing import Any, TypeVar

from .calls import adoption, groups, health, localization, references, reports, scenes
from .connection import IN_FLIGHT, Connection, ItemT
from .errors import MaplessError
from .options import ConnectOptions

T = TypeVar("T")


class Client(Connection):
    """A connection to a mapless server within the running event loop; close it or use it as a context manager.

    It has the methods of `mapless.Client`, but lists are read with `async for`. Cancelling a task also cancels its call
    on the server.
    """

    def __init__(self, address: str, options: ConnectOptions | None = None) -> None:
        """Makes a client; the first call connects, and is repeated until its deadline while the server is away.

        Args:
            address: "host:port", or "host1:port,host2:port": see `mapless.Client`.
            options: how to connect.

        Raises:
            RuntimeError: no event loop is running.
        """
        asyncio.get_running_loop()
        options = options or ConnectOptions()
        super().__init__(address, options, options.aio_channel)
        self._closed = asyncio.Event()

    async def __aenter__(self) -> Client:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Ends the connection; calls still running are cancelled."""
        self._closed.set()
        for server in self._servers.all:
            await server.channel.close()

    is_serving = health.is_serving

    localize = localization.localize
    localize_progressively = localization.localize_progressively
    localize_rig = groups.localize_rig
    localize_sequence = groups.localize_sequence

    create_scene = scenes.create_scene
    get_scene = scenes.get_scene
    update_scene = scenes.update_scene
    list_scenes = scenes.list_scenes
    delete_scene = scenes.delete_scene

    add_reference = references.add_reference
    add_references = references.add_references
    get_reference = references.get_reference
    list_references = references.list_references
    delete_reference = references.delete_reference
    retire_reference = adoption.retire_reference
    restore_reference = adoption.restore_reference
    restore_references = adoption.restore_references
    undo_adoption = adoption.undo_adoption

    retrieve_references = references.retrieve_references
    audit_scene = references.audit_scene
    check_coverage = references.check_coverage
    get_scene_report = reports.get_scene_report

    async def unblocked(self, function: Callable[..., T], *arguments: Any) -> T:
        """Calls a function in another thread."""
        return await asyncio.to_thread(function, *arguments)

    async def pipelined(
        self, call: Callable[[ItemT], Coroutine[Any, Any, T]], items: Iterator[ItemT]
    ) -> AsyncGenerator[T, None]:
        """Implements Connection.pipelined with tasks. One that is cancelled cancels the calls that run."""
        running = deque[asyncio.Task[T]]()
        try:
            while (item := await self.unblocked(next, items, None)) is not None:
                if len(running) == IN_FLIGHT:
                    yield await running.popleft()
                running.append(asyncio.create_task(call(item)))
            while running:
                yield await running.popleft()
        except MaplessError:
            await asyncio.gather(*running, return_exceptions=True)
            raise
        finally:
            for task in running:
                task.cancel()
            await asyncio.gather(*running, return_exceptions=True)

    async def _pause(self, duration_s: float, error: MaplessError) -> None:
        with suppress(asyncio.TimeoutError):
            await asyncio.wait_for(self._closed.wait(), duration_s)
            raise error
