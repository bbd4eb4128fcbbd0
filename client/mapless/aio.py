"""The client for asyncio: the methods of `mapless.Client`, to be awaited.

>>> async with mapless.aio.Client("localhost:50051") as client:
...     answer = await client.localize("photo.jpg", camera, scene="kitchen")
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Coroutine, Iterable
from contextlib import aclosing
from functools import wraps
from types import TracebackType
from typing import Any, Concatenate, ParamSpec, TypeVar

import grpc
import grpc.aio
from google.protobuf.message import Message

from .calls import asking, groups, health, localization
from .calls import references as reference_calls
from .errors import MaplessError, from_rpc_error
from .exchange import Attempt, Exchange, Heard, Methods, Pages, Pause, attempts
from .options import ConnectOptions
from .requests import NewReference
from .results import Reference

P = ParamSpec("P")
T = TypeVar("T")


def _awaited(call: Callable[P, Exchange[T]]) -> Callable[Concatenate[Client, P], Coroutine[Any, Any, T]]:
    """The method that makes a call: its parameters, what it returns, its docstring."""

    @wraps(call)
    async def method(self: Client, /, *arguments: P.args, **named: P.kwargs) -> T:
        return await self.run(call(*arguments, **named))

    return method


def _paged(call: Callable[P, Pages[T]]) -> Callable[Concatenate[Client, P], AsyncIterator[T]]:
    """The method that fetches a list as it is read."""

    @wraps(call)
    async def method(self: Client, /, *arguments: P.args, **named: P.kwargs) -> AsyncIterator[T]:
        pages, token = call(*arguments, **named), ""
        while True:
            items, token = await self.run(pages.fetch(token))
            for item in items:
                yield item
            if not token:
                return

    return method


def _followed(call: Callable[P, Exchange[T]]) -> Callable[Concatenate[Client, P], AsyncIterator[T]]:
    """The method that yields what a call tells early, and its answer."""

    @wraps(call)
    def method(self: Client, /, *arguments: P.args, **named: P.kwargs) -> AsyncIterator[T]:
        return self._follow(call(*arguments, **named))

    return method


class Client:
    """A connection to a mapless server for the event loop it is made in; close it or use it as a context manager.

    What is said of `mapless.Client` holds here, but that lists are read with `async for`. A call whose task is
    cancelled is cancelled on the server, too.
    """

    def __init__(self, address: str, options: ConnectOptions | None = None) -> None:
        """Does not connect yet: a server that cannot be reached is noticed by the first call.

        Args:
            address: "host:port".
            options: how to connect.

        Raises:
            RuntimeError: no event loop is running.
        """
        asyncio.get_running_loop()
        self.options = options or ConnectOptions()
        self._channel = self.options.aio_channel(address)
        self._metadata = self.options.metadata()
        self._methods = Methods(self._channel)

    async def __aenter__(self) -> Client:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Ends the connection; calls still running are cancelled."""
        await self._channel.close()

    is_serving = _awaited(health.is_serving)

    localize = _awaited(localization.localize)
    localize_progressively = _followed(localization.localize_progressively)
    localize_rig = _awaited(groups.localize_rig)
    localize_sequence = _awaited(groups.localize_sequence)

    create_scene = _awaited(reference_calls.create_scene)
    get_scene = _awaited(reference_calls.get_scene)
    update_scene = _awaited(reference_calls.update_scene)
    list_scenes = _paged(reference_calls.list_scenes)
    delete_scene = _awaited(reference_calls.delete_scene)

    add_reference = _awaited(reference_calls.add_reference)
    get_reference = _awaited(reference_calls.get_reference)
    list_references = _paged(reference_calls.list_references)
    delete_reference = _awaited(reference_calls.delete_reference)

    retrieve_references = _awaited(asking.retrieve_references)
    audit_scene = _paged(asking.audit_scene)
    check_coverage = _awaited(asking.check_coverage)

    async def add_references(
        self,
        scene: str,
        references: Iterable[NewReference],
        *,
        on_progress: Callable[[int], None] | None = None,
        timeout_s: float | None = None,
    ) -> list[Reference]:
        """Stores many references, as `mapless.Client.add_references` does; `references` is read in another thread."""
        stored: list[Reference] = []
        batches = reference_calls.batches(scene, references, self.options)
        while batch := await asyncio.to_thread(next, batches, None):
            stored += await self.run(reference_calls.add_batch(scene, batch, timeout_s))
            if on_progress is not None:
                on_progress(len(stored))
        return stored

    async def run(self, exchange: Exchange[T]) -> T:
        """Makes the calls of an exchange; what all methods do."""
        steps = attempts(exchange, self.options)
        # The first step builds the request, which may read a file: not in the event loop.
        step = await asyncio.to_thread(next, steps)
        try:
            while True:
                if isinstance(step, Pause):
                    await asyncio.sleep(step.duration_s)
                    step = next(steps)
                else:
                    step = steps.send(await self._attempt(step))
        except StopIteration as end:
            value: T = end.value
            return value

    async def _follow(self, exchange: Exchange[T]) -> AsyncIterator[T]:
        """The same for calls that are answered by streams; what they tell early comes first."""
        steps, heard = attempts(exchange, self.options), Heard()
        step = await asyncio.to_thread(next, steps)
        try:
            while True:
                if isinstance(step, Pause):
                    await asyncio.sleep(step.duration_s)
                    step = next(steps)
                else:
                    async with aclosing(self._messages(step, heard)) as messages:
                        async for message in messages:
                            early: T | None = heard.hear(message)
                            if early is not None:
                                yield early
                    step = steps.send(heard.outcome)
        except StopIteration as end:
            yield end.value

    async def _attempt(self, attempt: Attempt) -> Message | MaplessError:
        method = self._methods.of(attempt.call)
        metadata = self._metadata + attempt.call.metadata
        try:
            response: Message = await method(attempt.call.request, timeout=attempt.timeout_s, metadata=metadata)
        except grpc.RpcError as error:
            failure = from_rpc_error(error)
            failure.__cause__ = error
            return failure
        return response

    async def _messages(self, attempt: Attempt, heard: Heard) -> AsyncGenerator[Message, None]:
        """What a stream says; whoever reads no further ends the call."""
        method = self._methods.of(attempt.call)
        heard.begin(attempt.call)
        metadata = self._metadata + attempt.call.metadata
        stream = method(attempt.call.request, timeout=attempt.timeout_s, metadata=metadata)
        try:
            async for message in stream:
                yield message
        except grpc.RpcError as error:
            failure = from_rpc_error(error)
            failure.__cause__ = error
            heard.fail(failure)
        finally:
            stream.cancel()
