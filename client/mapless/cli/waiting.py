"""A client that says on standard error what it waits for, where that takes longer than a moment."""

import math
import queue
import sys
import threading
from typing import Any

import grpc
from google.protobuf.message import Message

from ..client import Client
from ..errors import DeadlineExceeded, MaplessError, is_unconnected
from ..options import ConnectOptions

NOTICE_S = 2.0
"""A shorter wait is not worth a line."""
_STATE_S = 1.0


class WaitingClient(Client):
    """A client that says what it waits for, once until a call is answered: a server that is away, or a connection.

    What a server that is connected computes is not waited for in this sense, however long it takes.
    """

    def __init__(self, address: str, options: ConnectOptions, program: str = "mapless") -> None:
        """As `Client`; the name of the program begins each line."""
        super().__init__(address, options)
        self._program = program
        self._lock = threading.Lock()
        self._waits_since_s: float | None = None
        self._until_s = 0.0
        self._has_said = False

    async def _response(self, method: str, request: Message, timeout_s: float) -> Any:
        now_s = self._now_s()
        with self._lock:
            self._until_s = now_s + timeout_s
            if self._waits_since_s is None:
                self._waits_since_s = now_s
        timer = threading.Timer(NOTICE_S, self._say_if_unconnected)
        timer.daemon = True
        timer.start()
        try:
            response = await super()._response(method, request, timeout_s)
        except DeadlineExceeded as error:
            if not error.request_id and not self._is_connected():
                error.message = f"no connection to {self.address} in time"
                error.args = (f"{error.reason}: {error.message}",)
            raise
        finally:
            timer.cancel()
        with self._lock:
            self._waits_since_s, self._has_said = None, False
        return response

    async def _pause(self, duration_s: float, error: MaplessError) -> None:
        begin_s = self._waits_since_s
        if begin_s is not None and self._now_s() + duration_s - begin_s >= NOTICE_S:
            is_new = is_unconnected(error) and not self._servers.were_reached
            self._say(error.message, begin_s + self.options.connect_timeout_s if is_new else math.inf)
        await super()._pause(duration_s, error)

    def _say_if_unconnected(self) -> None:
        if not self._is_connected():
            self._say(f"no connection to {self.address} yet")

    def _is_connected(self) -> bool:
        """Whether there is a connection to one of the servers now."""
        return any(map(_is_connected, (it.channel for it in self._servers.all)))

    def _say(self, what: str, until_s: float = math.inf) -> None:
        with self._lock:
            if self._has_said:
                return
            self._has_said = True
            left_s = max(min(self._until_s, until_s) - self._now_s(), 0.0)
        clear = "\r\033[K" if sys.stderr.isatty() else ""  # a bar of progress may be there
        print(f"{clear}{self._program}: {what}; trying for up to {left_s:.0f} s more", file=sys.stderr, flush=True)


def _is_connected(channel: grpc.Channel) -> bool:
    states: queue.Queue[grpc.ChannelConnectivity] = queue.Queue()
    channel.subscribe(states.put)
    try:
        return states.get(timeout=_STATE_S) is grpc.ChannelConnectivity.READY
    except queue.Empty:
        return False
    finally:
        channel.unsubscribe(states.put)
