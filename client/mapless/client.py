"""The blocking client: a method for each call of `mapless.calls`, executed in the caller's thread."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator
from copy import copy
from dataclasses import replace
from functools import wraps
from types import TracebackType
from typing import Any, Concatenate, ParamSpec, TypeVar

import grpc

from .calls import health, localization
from .calls import references as reference_calls
from .errors import from_rpc_error
from .exchange import Attempt, Exchange, Methods, Pages, Pause, Reader, attempts
from .options import ConnectOptions, explained
from .requests import NewReference
from .results import Reference
from .v1 import reference_service_pb2 as pb

P = ParamSpec("P")
T = TypeVar("T")


def _blocking(call: Callable[P, Exchange[T]]) -> Callable[Concatenate[Client, P], T]:
    """Makes the method that executes a call, with the call's parameters, result and docstring."""

    @wraps(call)
    def method(self: Client, /, *arguments: P.args, **named: P.kwargs) -> T:
        return self.run(call(*arguments, **named))

    return method


def _paged(call: Callable[P, Pages[T]]) -> Callable[Concatenate[Client, P], Iterator[T]]:
    """Makes the method that iterates over a list and fetches its pages when needed."""

    @wraps(call)
    def method(self: Client, /, *arguments: P.args, **named: P.kwargs) -> Iterator[T]:
        pages, token = call(*arguments, **named), ""
        while True:
            items, token = self.run(pages.fetch(token))
            yield from items
            if not token:
                return

    return method


def _followed(call: Callable[P, Exchange[T]]) -> Callable[Concatenate[Client, P], Iterator[T]]:
    """Makes the method that yields a call's early answers and its final answer."""

    @wraps(call)
    def method(self: Client, /, *arguments: P.args, **named: P.kwargs) -> Iterator[T]:
        return self._follow(call(*arguments, **named))

    return method


class Client:
    """A connection to a mapless server; use it from any thread, close it or use it as a context manager.

    Scenes and references are given by id or by name ("scenes/{scene}"). Every method raises `MaplessError` and takes
    `timeout_s`, the deadline of a call with all its attempts, which replaces the options' default. `mapless.aio.Client`
    has the same methods for asyncio.
    """

    def __init__(self, address: str, options: ConnectOptions | None = None) -> None:
        """Makes a client; the first call connects, and fails if the server cannot be reached.

        Args:
            address: "host:port".
            options: how to connect.
        """
        self.options = options or ConnectOptions()
        self._address = address
        self._channel = self.options.channel(address)
        self._methods = Methods(self._channel, self.options.metadata())
        self._closed = threading.Event()

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def acting_for(self, token: str | None, client_id: str = "") -> Client:
        """A client on the same connection with another token and client id, for programs that serve several users.

        Closing this client also ends the returned one. ValueError as of `ConnectOptions`.
        """
        other = copy(self)
        other.options = replace(self.options, token=token, client_id=client_id)
        other._methods = Methods(self._channel, other.options.metadata())
        return other

    def close(self) -> None:
        """Ends the connection; calls still running fail."""
        self._closed.set()
        self._channel.close()

    is_serving = _blocking(health.is_serving)

    localize = _blocking(localization.localize)
    localize_progressively = _followed(localization.localize_progressively)
    localize_rig = _blocking(localization.localize_rig)
    localize_sequence = _blocking(localization.localize_sequence)

    create_scene = _blocking(reference_calls.create_scene)
    get_scene = _blocking(reference_calls.get_scene)
    update_scene = _blocking(reference_calls.update_scene)
    list_scenes = _paged(reference_calls.list_scenes)
    delete_scene = _blocking(reference_calls.delete_scene)

    add_reference = _blocking(reference_calls.add_reference)
    get_reference = _blocking(reference_calls.get_reference)
    list_references = _paged(reference_calls.list_references)
    delete_reference = _blocking(reference_calls.delete_reference)

    retrieve_references = _blocking(reference_calls.retrieve_references)
    audit_scene = _paged(reference_calls.audit_scene)
    check_coverage = _blocking(reference_calls.check_coverage)

    def add_references(
        self,
        scene: str,
        references: Iterable[NewReference],
        *,
        on_progress: Callable[[int], None] | None = None,
        timeout_s: float | None = None,
    ) -> list[Reference]:
        """Stores many references, in as many messages as needed.

        A message is stored whole or not at all. When one fails, the references of earlier messages remain stored:
        call this again with all of them. Those that the scene has already, with the same photograph, intrinsics and
        pose, are not stored again, and are returned and counted like the others; AlreadyExists names one that the scene
        has with another photograph, intrinsics or pose.

        Args:
            scene: the scene.
            references: the references; files are read when they are sent.
            on_progress: called with the number stored so far, with those that were there, after each message.
            timeout_s: deadline of each message; None for `upload_timeout_s`.
        """
        stored: list[Reference] = []
        there: dict[str, pb.Reference] = {}
        for batch in reference_calls.batches(scene, references, self.options):
            stored += self.run(reference_calls.add_batch(scene, batch, timeout_s, there))
            if on_progress is not None:
                on_progress(len(stored))
        return stored

    def run(self, exchange: Exchange[T]) -> T:
        """Executes the calls of an exchange; used by all methods."""
        *_, answer = self._follow(exchange)
        return answer

    def _follow(self, exchange: Exchange[T]) -> Iterator[T]:
        """Executes the calls of an exchange: yields a stream's early answers and the final answer."""
        steps, reader = attempts(exchange, self.options), Reader()
        try:
            step = next(steps)
            while True:
                if isinstance(step, Pause):
                    self._pause(step)
                    step = next(steps)
                else:
                    yield from self._early_answers(step, reader)
                    step = steps.send(reader.outcome)
        except StopIteration as end:
            yield end.value

    def _pause(self, pause: Pause) -> None:
        if self._closed.wait(pause.duration_s):
            raise pause.error

    def _early_answers(self, attempt: Attempt, reader: Reader) -> Iterator[Any]:
        """Makes an attempt; a stream is cancelled when the caller stops reading."""
        reader.begin(attempt.call)
        try:
            response = self._methods.start(attempt)
            if attempt.call.early is None:
                reader.read(response)
                return
            try:
                for message in response:
                    early = reader.read(message)
                    if early is not None:
                        yield early
            finally:
                response.cancel()
        except grpc.RpcError as error:
            reader.fail(explained(from_rpc_error(error), self._address, self.options))
