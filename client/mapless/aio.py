"""The client for asyncio: the methods of `mapless.Client` as coroutines.

>>> async with mapless.aio.Client("localhost:50051") as client:
...     answer = await client.localize("photo.jpg", camera, scene="kitchen")
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Coroutine, Iterable
from contextlib import aclosing
from copy import copy
from dataclasses import replace
from functools import wraps
from types import TracebackType
from typing import Any, Concatenate, ParamSpec, TypeVar

import grpc
import grpc.aio

from .calls import health, localization
from .calls import references as reference_calls
from .errors import from_rpc_error
from .exchange import Attempt, Exchange, Methods, Pages, Pause, Reader, attempts
from .options import ConnectOptions, explained, is_unreached
from .requests import NewReference
from .results import Reference
from .v1 import reference_service_pb2 as pb

P = ParamSpec("P")
T = TypeVar("T")


def _awaited(call: Callable[P, Exchange[T]]) -> Callable[Concatenate[Client, P], Coroutine[Any, Any, T]]:
    """Makes the coroutine method that executes a call, with the call's parameters, result and docstring."""

    @wraps(call)
    async def method(self: Client, /, *arguments: P.args, **named: P.kwargs) -> T:
        return await self.run(call(*arguments, **named))

    return method


def _paged(call: Callable[P, Pages[T]]) -> Callable[Concatenate[Client, P], AsyncIterator[T]]:
    """Makes the method that iterates over a list and fetches its pages when needed."""

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
    """Makes the method that yields a call's early answers and its final answer."""

    @wraps(call)
    def method(self: Client, /, *arguments: P.args, **named: P.kwargs) -> AsyncIterator[T]:
        return self._follow(call(*arguments, **named))

    return method


class Client:
    """A connection to a mapless server within the running event loop; close it or use it as a context manager.

    It has the methods of `mapless.Client`, but lists are read with `async for`. Cancelling a task also cancels its call
    on the server.
    """

    def __init__(self, address: str, options: ConnectOptions | None = None) -> None:
        """Makes a client; the first call connects, and fails if the server cannot be reached.

        Args:
            address: "host:port".
            options: how to connect.

        Raises:
            RuntimeError: no event loop is running.
        """
        asyncio.get_running_loop()
        self.options = options or ConnectOptions()
        self._address = address
        self._channel = self.options.aio_channel(address)
        self._methods = Methods(self._channel, self.options.metadata())

    async def __aenter__(self) -> Client:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        await self.close()

    def acting_for(self, token: str | None, client_id: str = "") -> Client:
        """A client on the same connection with another token and client id, for programs that serve several users.

        Closing this client also ends the returned one. ValueError as of `ConnectOptions`.
        """
        other = copy(self)
        other.options = replace(self.options, token=token, client_id=client_id)
        other._methods = Methods(self._channel, other.options.metadata())
        return other

    async def close(self) -> None:
        """Ends the connection; calls still running are cancelled."""
        await self._channel.close()

    is_serving = _awaited(health.is_serving)

    localize = _awaited(localization.localize)
    localize_progressively = _followed(localization.localize_progressively)
    localize_rig = _awaited(localization.localize_rig)
    localize_sequence = _awaited(localization.localize_sequence)

    create_scene = _awaited(reference_calls.create_scene)
    get_scene = _awaited(reference_calls.get_scene)
    update_scene = _awaited(reference_calls.update_scene)
    list_scenes = _paged(reference_calls.list_scenes)
    delete_scene = _awaited(reference_calls.delete_scene)

    add_reference = _awaited(reference_calls.add_reference)
    get_reference = _awaited(reference_calls.get_reference)
    list_references = _paged(reference_calls.list_references)
    delete_reference = _awaited(reference_calls.delete_reference)

    retrieve_references = _awaited(reference_calls.retrieve_references)
    audit_scene = _paged(reference_calls.audit_scene)
    check_coverage = _awaited(reference_calls.check_coverage)

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
        there: dict[str, pb.Reference] = {}
        batches = reference_calls.batches(scene, references, self.options)
        while batch := await asyncio.to_thread(next, batches, None):
            stored += await self.run(reference_calls.add_batch(scene, batch, timeout_s, there))
            if on_progress is not None:
                on_progress(len(stored))
        return stored

    async def run(self, exchange: Exchange[T]) -> T:
        """Executes the calls of an exchange; used by all methods."""
        return [answer async for answer in self._follow(exchange)][-1]

    async def _follow(self, exchange: Exchange[T]) -> AsyncIterator[T]:
        """Executes the calls of an exchange: yields a stream's early answers and the final answer."""
        steps, reader = attempts(exchange, self.options), Reader()
        # The first step builds the request, which may read a file: not in the event loop.
        step = await asyncio.to_thread(next, steps)
        try:
            while True:
                if isinstance(step, Pause):
                    await asyncio.sleep(step.duration_s)
                    step = next(steps)
                else:
                    async with aclosing(self._early_answers(step, reader)) as answers:
                        async for early in answers:
                            yield early
                    step = steps.send(reader.outcome)
        except StopIteration as end:
            yield end.value

    async def _early_answers(self, attempt: Attempt, reader: Reader) -> AsyncGenerator[Any, None]:
        """Makes an attempt; a stream is cancelled when the caller stops reading."""
        reader.begin(attempt.call)
        try:
            response = self._methods.start(attempt)
            if attempt.call.early is None:
                reader.read(await response)
                return
            try:
                async for message in response:
                    early = reader.read(message)
                    if early is not None:
                        yield early
            finally:
                response.cancel()
        except grpc.RpcError as error:
            failure = from_rpc_error(error)
            if is_unreached(failure):
                failure = await asyncio.to_thread(explained, failure, self._address, self.options)
            reader.fail(failure)
