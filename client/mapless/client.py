"""The blocking client: the calls of `mapless.calls` as methods, executed in the caller's thread."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Coroutine, Generator, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import wraps
from types import TracebackType
from typing import Any, Concatenate, ParamSpec, TypeVar

from .calls import adoption, groups, health, localization, references, reports, scenes
from .connection import IN_FLIGHT, Connection, ItemT
from .errors import MaplessError
from .options import ConnectOptions

P = ParamSpec("P")
T = TypeVar("T")


def _finished(coroutine: Any) -> Any:
    """The result of a coroutine that never waits, since a blocking connection blocks instead."""
    try:
        coroutine.send(None)
    except StopIteration as end:
        return end.value
    raise AssertionError("a coroutine of a blocking connection waits")


def _blocking(call: Callable[Concatenate[Any, P], Coroutine[Any, Any, T]]) -> Callable[Concatenate[Client, P], T]:
    """The method that executes a call, with the call's parameters, result and docstring."""

    @wraps(call)
    def method(self: Client, /, *arguments: P.args, **named: P.kwargs) -> T:
        result: T = _finished(call(self, *arguments, **named))
        return result

    return method


def _iterated(call: Callable[Concatenate[Any, P], AsyncIterator[T]]) -> Callable[Concatenate[Client, P], Iterator[T]]:
    """The method that iterates over the results of a call."""

    @wraps(call)
    def method(self: Client, /, *arguments: P.args, **named: P.kwargs) -> Generator[T, None, None]:
        results: Any = call(self, *arguments, **named)
        try:
            while True:
                yield _finished(anext(results))
        except StopAsyncIteration:
            return
        finally:
            _finished(results.aclose())

    return method


class Client(Connection):
    """A connection to a mapless server; use it from any thread, close it or use it as a context manager.

    Scenes and references are given by id or by name ("scenes/{scene}"). Every method raises `MaplessError` and takes
    `timeout_s`, the deadline of a call with all its attempts, which replaces the options' default. `mapless.aio.Client`
    has the same methods for asyncio.
    """

    def __init__(self, address: str, options: ConnectOptions | None = None) -> None:
        """Makes a client; the first call connects.

        A call outlives a restart of the server: it is repeated until its deadline, 30 s unless the options or
        `timeout_s` say otherwise, while the server is away or stops, and if it is lost during the answer.

        Args:
            address: "host:port"; or "host1:port,host2:port" of servers that share a store, which take turns, and of
                which one that is away is passed over.
            options: how to connect.
        """
        options = options or ConnectOptions()
        super().__init__(address, options, options.channel)
        self._closed = threading.Event()

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Ends the connection; calls still running fail."""
        self._closed.set()
        for server in self._servers.all:
            server.channel.close()

    is_serving = _blocking(health.is_serving)

    localize = _blocking(localization.localize)
    localize_progressively = _iterated(localization.localize_progressively)
    localize_rig = _blocking(groups.localize_rig)
    localize_sequence = _blocking(groups.localize_sequence)

    create_scene = _blocking(scenes.create_scene)
    get_scene = _blocking(scenes.get_scene)
    update_scene = _blocking(scenes.update_scene)
    list_scenes = _iterated(scenes.list_scenes)
    delete_scene = _blocking(scenes.delete_scene)

    add_reference = _blocking(references.add_reference)
    add_references = _blocking(references.add_references)
    get_reference = _blocking(references.get_reference)
    list_references = _iterated(references.list_references)
    delete_reference = _blocking(references.delete_reference)
    retire_reference = _blocking(adoption.retire_reference)
    restore_reference = _blocking(adoption.restore_reference)
    restore_references = _blocking(adoption.restore_references)
    undo_adoption = _blocking(adoption.undo_adoption)

    retrieve_references = _blocking(references.retrieve_references)
    audit_scene = _iterated(references.audit_scene)
    check_coverage = _blocking(references.check_coverage)
    get_scene_report = _blocking(reports.get_scene_report)

    async def pipelined(
        self, call: Callable[[ItemT], Coroutine[Any, Any, T]], items: Iterator[ItemT]
    ) -> AsyncGenerator[T, None]:
        """Implements Connection.pipelined with threads. One that is interrupted leaves the calls that run to end."""
        running, threads = deque[Future[T]](), ThreadPoolExecutor(IN_FLIGHT, "upload")

        def finished(item: ItemT) -> T:
            result: T = _finished(call(item))
            return result

        try:
            for item in items:
                if len(running) == IN_FLIGHT:
                    yield running.popleft().result()
                running.append(threads.submit(finished, item))
            while running:
                yield running.popleft().result()
        except Exception:
            threads.shutdown(cancel_futures=True)
            raise
        finally:
            threads.shutdown(wait=False, cancel_futures=True)

    async def _pause(self, duration_s: float, error: MaplessError) -> None:
        if self._closed.wait(duration_s):
            raise error
