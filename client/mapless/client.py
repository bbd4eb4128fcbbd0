"""The blocking client: the calls of `mapless.calls`, each made and waited for in the caller's thread."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator
from functools import wraps
from types import TracebackType
from typing import Concatenate, ParamSpec, TypeVar

import grpc
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


def _blocking(call: Callable[P, Exchange[T]]) -> Callable[Concatenate[Client, P], T]:
    """The method that makes a call and waits for it: its parameters, what it returns, its docstring."""

    @wraps(call)
    def method(self: Client, /, *arguments: P.args, **named: P.kwargs) -> T:
        return self.run(call(*arguments, **named))

    return method


def _paged(call: Callable[P, Pages[T]]) -> Callable[Concatenate[Client, P], Iterator[T]]:
    """The method that fetches a list as it is read."""

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
    """The method that yields what a call tells early, and its answer."""

    @wraps(call)
    def method(self: Client, /, *arguments: P.args, **named: P.kwargs) -> Iterator[T]:
        return self._follow(call(*arguments, **named))

    return method


class Client:
    """A connection to a mapless server; use it from any thread, close it or use it as a context manager.

    Scenes and references are given by id or by name ("scenes/{scene}"). Every method raises `MaplessError`, and takes
    `timeout_s`, which stands for the options' own: a deadline for a call with all its attempts. `mapless.aio.Client`
    has the same methods for asyncio.
    """

    def __init__(self, address: str, options: ConnectOptions | None = None) -> None:
        """Does not connect yet: a server that cannot be reached is noticed by the first call.

        Args:
            address: "host:port".
            options: how to connect.
        """
        self.options = options or ConnectOptions()
        self._channel = self.options.channel(address)
        self._metadata = self.options.metadata()
        self._methods = Methods(self._channel)
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
        self._channel.close()

    is_serving = _blocking(health.is_serving)

    localize = _blocking(localization.localize)
    localize_progressively = _followed(localization.localize_progressively)
    localize_rig = _blocking(groups.localize_rig)
    localize_sequence = _blocking(groups.localize_sequence)

    create_scene = _blocking(reference_calls.create_scene)
    get_scene = _blocking(reference_calls.get_scene)
    update_scene = _blocking(reference_calls.update_scene)
    list_scenes = _paged(reference_calls.list_scenes)
    delete_scene = _blocking(reference_calls.delete_scene)

    add_reference = _blocking(reference_calls.add_reference)
    get_reference = _blocking(reference_calls.get_reference)
    list_references = _paged(reference_calls.list_references)
    delete_reference = _blocking(reference_calls.delete_reference)

    retrieve_references = _blocking(asking.retrieve_references)
    audit_scene = _paged(asking.audit_scene)
    check_coverage = _blocking(asking.check_coverage)

    def add_references(
        self,
        scene: str,
        references: Iterable[NewReference],
        *,
        on_progress: Callable[[int], None] | None = None,
        timeout_s: float | None = None,
    ) -> list[Reference]:
        """Stores many references, in as many messages as needed.

        A message is stored whole or not at all. When one fails, those before it stay: list the scene to see how far
        it came.

        Args:
            scene: where to.
            references: what to store; files are read as they are sent.
            on_progress: told the number stored so far, after each message.
            timeout_s: deadline of each message; None for `upload_timeout_s`.
        """
        stored: list[Reference] = []
        for batch in reference_calls.batches(scene, references, self.options):
            stored += self.run(reference_calls.add_batch(scene, batch, timeout_s))
            if on_progress is not None:
                on_progress(len(stored))
        return stored

    def run(self, exchange: Exchange[T]) -> T:
        """Makes the calls of an exchange, and waits; what all methods do."""
        steps = attempts(exchange, self.options)
        try:
            step = next(steps)
            while True:
                if isinstance(step, Pause):
                    self._pause(step)
                    step = next(steps)
                else:
                    step = steps.send(self._attempt(step))
        except StopIteration as end:
            value: T = end.value
            return value

    def _follow(self, exchange: Exchange[T]) -> Iterator[T]:
        """The same for calls that are answered by streams; what they tell early comes first."""
        steps, heard = attempts(exchange, self.options), Heard()
        try:
            step = next(steps)
            while True:
                if isinstance(step, Pause):
                    self._pause(step)
                    step = next(steps)
                else:
                    for message in self._messages(step, heard):
                        early: T | None = heard.hear(message)
                        if early is not None:
                            yield early
                    step = steps.send(heard.outcome)
        except StopIteration as end:
            yield end.value

    def _pause(self, pause: Pause) -> None:
        if self._closed.wait(pause.duration_s):
            raise pause.error

    def _attempt(self, attempt: Attempt) -> Message | MaplessError:
        method = self._methods.of(attempt.call)
        metadata = self._metadata + attempt.call.metadata
        try:
            response: Message = method(attempt.call.request, timeout=attempt.timeout_s, metadata=metadata)
        except grpc.RpcError as error:
            failure = from_rpc_error(error)
            failure.__cause__ = error
            return failure
        return response

    def _messages(self, attempt: Attempt, heard: Heard) -> Iterator[Message]:
        """What a stream says; whoever reads no further ends the call."""
        method = self._methods.of(attempt.call)
        heard.begin(attempt.call)
        metadata = self._metadata + attempt.call.metadata
        stream = method(attempt.call.request, timeout=attempt.timeout_s, metadata=metadata)
        try:
            yield from stream
        except grpc.RpcError as error:
            failure = from_rpc_error(error)
            failure.__cause__ = error
            heard.fail(failure)
        finally:
            stream.cancel()
