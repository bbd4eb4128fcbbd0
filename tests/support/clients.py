"""The asynchronous client with a blocking interface, servers with planted failures, exchanges without a server."""

from __future__ import annotations

import asyncio
import inspect
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent import futures
from contextlib import contextmanager
from dataclasses import replace
from types import TracebackType
from typing import Any, TypeAlias, cast

import grpc
import pytest
from google.protobuf.message import Message
from google.rpc import error_details_pb2, status_pb2

from mapless import Client, ConnectOptions, InvalidArgument, MaplessError, NotFound, aio
from mapless.client import _finished
from mapless.connection import Connection
from support.servers import CAMERA, PHOTO

Connect: TypeAlias = Callable[..., Client]


class Awaiting:
    """An `aio.Client` in an event loop of its own; its methods wait for their answers."""

    def __init__(self, address: str, options: ConnectOptions | None = None) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever)
        self._thread.start()
        self.client = self.wait(self._made(address, options))

    async def _made(self, address: str, options: ConnectOptions | None) -> aio.Client:
        return aio.Client(address, options)

    def wait(self, coroutine: Any) -> Any:
        return asyncio.run_coroutine_threadsafe(coroutine, self._loop).result(60)

    def __getattr__(self, name: str) -> Callable[..., Any]:
        method = getattr(self.client, name)

        async def listed(items: Any) -> list[Any]:
            return [item async for item in items]

        def call(*arguments: Any, **named: Any) -> Any:
            given = method(*arguments, **named)
            return self.wait(given) if inspect.isawaitable(given) else iter(self.wait(listed(given)))

        return call

    def __enter__(self) -> Awaiting:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.wait(self.client.close())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(30)
        self._loop.close()


def awaiting(address: str, options: ConnectOptions | None = None) -> Client:
    """The asynchronous client, to be used like the blocking one."""
    return cast(Client, Awaiting(address, options))


class Failing(grpc.GenericRpcHandler):
    """Ends each call with the next of its statuses; when there are none left, as `answers` does.

    Attributes:
        tries: (method, seconds left to its deadline) of every call that came.
        answers: the response to a method's request; may raise grpc.RpcError.
        does_it: whether failed calls are carried out all the same.
    """

    def __init__(self, statuses: Sequence[grpc.Status], answers: Callable[[str, bytes], bytes], does_it: bool) -> None:
        self.statuses = list(statuses)
        self.tries: list[tuple[str, float]] = []
        self.answers = answers
        self.does_it = does_it
        self._lock = threading.Lock()

    def service(self, handler_call_details: Any) -> Any:
        method = handler_call_details.method

        def answer(data: bytes, context: grpc.ServicerContext) -> bytes:
            with self._lock:
                self.tries.append((method.rpartition("/")[2], context.time_remaining()))
                status = self.statuses.pop(0) if self.statuses else None
            try:
                response = self.answers(method, data) if status is None or self.does_it else b""
            except grpc.RpcError as failure:
                error: Any = failure
                context.set_trailing_metadata(error.trailing_metadata())
                context.abort(error.code(), error.details())
            if status is not None:
                context.abort_with_status(status)
            return response

        return grpc.unary_unary_rpc_method_handler(answer)

    @property
    def methods(self) -> list[str]:
        """Methods of the calls that came."""
        return [method for method, _ in self.tries]


class _Status(grpc.Status):
    def __init__(self, code: grpc.StatusCode, details: Sequence[Message]) -> None:
        self.code, self.details = code, "planted"
        rich = status_pb2.Status(code=code.value[0], message=self.details)
        for detail in details:
            rich.details.add().Pack(detail)
        self.trailing_metadata = (("grpc-status-details-bin", rich.SerializeToString()),)


def status(code: str, retry_after_s: float | None = None) -> grpc.Status:
    """A failure, with RetryInfo if a time is given."""
    retry = error_details_pb2.RetryInfo()
    if retry_after_s is not None:
        retry.retry_delay.FromNanoseconds(round(1e9 * retry_after_s))
    return _Status(grpc.StatusCode[code], [retry] if retry_after_s is not None else [])


class Recording(grpc.GenericRpcHandler):
    """Answers the interface's calls with nothing, or refuses them, and keeps their metadata."""

    def __init__(self, refuses: bool = False) -> None:
        self.refuses = refuses
        self.metadata: list[dict[str, str]] = []
        self.remaining_s: list[float] = []

    def service(self, handler_call_details: Any) -> Any:
        if not handler_call_details.method.startswith("/mapless.v1."):
            return None
        self.metadata.append(dict(handler_call_details.invocation_metadata))

        def answer(_: bytes, context: grpc.ServicerContext) -> bytes:
            self.remaining_s.append(context.time_remaining())
            if self.refuses:
                context.abort(grpc.StatusCode.NOT_FOUND, "nothing here")
            return b""

        return grpc.unary_unary_rpc_method_handler(answer)


def _serves_nothing_else(_: Any) -> None:
    pass


@contextmanager
def hosted(
    *handlers: grpc.GenericRpcHandler, add: Callable[[Any], object] = _serves_nothing_else, threads: int = 4
) -> Iterator[str]:
    """The address of a server with these handlers, and with the servicers that `add` adds to it."""
    with futures.ThreadPoolExecutor(threads) as pool:
        server = grpc.server(pool, handlers, options=[("grpc.max_receive_message_length", -1)])
        add(server)
        port = server.add_insecure_port("127.0.0.1:0")
        server.start()
        try:
            yield f"127.0.0.1:{port}"
        finally:
            server.stop(None).wait()


@contextmanager
def failing(
    statuses: Sequence[grpc.Status],
    answers: Callable[[str, bytes], bytes] = lambda method, data: b"",
    does_it: bool = True,
) -> Iterator[tuple[str, Failing]]:
    """Such a server and its address."""
    handler = Failing(statuses, answers, does_it)
    with hosted(handler) as address:
        yield address, handler


@contextmanager
def losing(address: str, does_it: bool = True) -> Iterator[tuple[str, Failing]]:
    """A way to a server on which the first answer is lost, after the call was done or before."""
    with grpc.insecure_channel(address, [("grpc.max_send_message_length", -1)]) as channel:

        def forward(method: str, data: bytes) -> bytes:
            return bytes(channel.unary_unary(method)(data, timeout=30))

        with failing([status("UNAVAILABLE")], forward, does_it) as made:
            yield made


FAILING_CALLS: dict[str, tuple[type[MaplessError], Callable[[Client, str], Any]]] = {
    "unknown scene": (NotFound, lambda client, _: client.localize(PHOTO, CAMERA, "nowhere")),
    "unknown reference": (NotFound, lambda client, scene: client.localize(PHOTO, CAMERA, scene, ("r", "lost"))),
    "bad image": (InvalidArgument, lambda client, scene: client.localize(b"no image", CAMERA, scene)),
    "bad camera": (InvalidArgument, lambda client, it: client.localize(PHOTO, replace(CAMERA, width_px=97), it)),
    "bad name": (InvalidArgument, lambda client, _: client.get_scene("no name")),
}
"""On a scene that is there."""


def assert_fails_alike(what: str, scene: str, direct: Client, through: Client) -> MaplessError:
    """With the same details by both ways; the error of the second."""
    expected, call = FAILING_CALLS[what]
    with pytest.raises(expected) as here:
        call(direct, scene)
    with pytest.raises(expected) as there:
        call(through, scene)
    for name in ("code", "reason", "message", "field", "retry_after_s"):
        assert getattr(there.value, name) == getattr(here.value, name), what
    assert there.value.request_id
    return there.value


_CHANNEL = grpc.insecure_channel("localhost:1")  # never used


class Played(Connection):
    """A connection with scripted outcomes, of which the last is repeated; makes what it is asked to.

    Attributes:
        tries: the time left to each attempt, seconds.
        calls: method and request of each attempt.
        pauses: seconds.
        result: what the calls returned, or their error.
    """

    def __init__(
        self, ask: Callable[[Connection], Any], outcomes: list[Any], options: ConnectOptions, dice: float = 0.5
    ) -> None:
        super().__init__("localhost:1", options, lambda _: _CHANNEL)
        self.tries: list[float] = []
        self.calls: list[tuple[str, Any]] = []
        self.pauses: list[float] = []
        self._outcomes, self._dice = list(outcomes), dice
        try:
            self.result: Any = _finished(ask(self))
        except MaplessError as error:
            self.result = error

    @property
    def methods(self) -> list[str]:
        return [method for method, _ in self.calls]

    @property
    def took_s(self) -> float:
        """All of it; an attempt takes a second."""
        return len(self.tries) + sum(self.pauses)

    async def _response(self, method: str, request: Message, timeout_s: float) -> Any:
        self.tries.append(timeout_s)
        self.calls.append((method, request))
        outcome = self._outcomes.pop(0) if len(self._outcomes) > 1 else self._outcomes[0]
        if isinstance(outcome, MaplessError):
            raise outcome
        return outcome

    async def _pause(self, duration_s: float, error: MaplessError) -> None:
        self.pauses.append(duration_s)

    def _now_s(self) -> float:
        return self.took_s

    def _uniform(self, low: float, high: float) -> float:
        return low + self._dice * (high - low)
