"""The port that Prometheus and probes ask: plain HTTP in threads of its own, which answer while the event loop is busy.

"/metrics" is the registry. "/ready", for probes that do not speak gRPC, is 200 while the server serves and 503 before
and after, and when its event loop or its queue have not been heard of for a moment. "/live" is 503 when they have not
been for long: that server answers nobody any more, and whoever supervises it should start it anew.

The library's own server starts a thread for every connection and waits for its request without end, so that a thousand
idle connections take a thousand threads and file descriptors from the server beside it. This one holds a few, lets go
of the oldest for a new one, and gives each a time.
"""

from __future__ import annotations

import logging
import socket
import socketserver
import sys
import threading
import time
from collections import OrderedDict
from collections.abc import Iterable
from contextlib import suppress
from http import HTTPStatus
from typing import TYPE_CHECKING, Any, Protocol
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

from prometheus_client import CollectorRegistry, make_wsgi_app

if TYPE_CHECKING:
    from wsgiref.types import StartResponse, WSGIApplication, WSGIEnvironment

log = logging.getLogger(__name__)

MAX_CONNECTIONS = 8
"""Prometheus needs one, its twin another; a person looks as well."""
SILENCE_S = 5.0
"""A connection on which nothing comes or goes for so long is closed."""
READY_LIMIT_S = 5.0
"""A heartbeat may be so old; the loop beats a hundred times a second."""
LIVE_LIMIT_S = 60.0
"""As old as no machine, however busy, makes it; longer than closing takes, during which it does not beat."""
_POLL_S = 0.2


class State(Protocol):
    """How the server does; read in threads of its own.

    Attributes:
        is_serving: whether health says SERVING.
        beaten_s: when its heart beat last, `time.monotonic`; None while it starts.
    """

    is_serving: bool
    beaten_s: float | None


class MetricsServer:
    """Serves a registry, and whether the server is ready and alive, until it is closed."""

    def __init__(self, registry: CollectorRegistry, host: str, port: int, state: State) -> None:
        """Listens and serves.

        Args:
            registry: the metrics.
            host: address to listen on.
            port: 0 takes any free one.
            state: of the server.

        Raises:
            OSError: the address cannot be listened on.
        """
        self._server = _HttpServer(host, port)
        self._server.set_app(_application(registry, state))
        self.port: int = self._server.server_port
        self._thread = threading.Thread(target=self._server.serve_forever, args=(_POLL_S,), name="metrics", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Frees the port and ends all threads."""
        self._server.shutdown()
        self._thread.join()
        self._server.close_connections()
        self._server.server_close()


def _application(registry: CollectorRegistry, state: State) -> WSGIApplication:
    metrics: WSGIApplication = make_wsgi_app(registry)

    def beats_within(limit_s: float) -> bool:
        beaten_s = state.beaten_s
        return beaten_s is None or time.monotonic() - beaten_s < limit_s

    def answer(environ: WSGIEnvironment, start_response: StartResponse) -> Iterable[bytes]:
        path = environ["PATH_INFO"]
        if path == "/metrics":
            return metrics(environ, start_response)
        if path == "/ready":
            if not beats_within(READY_LIMIT_S):
                return _say(start_response, HTTPStatus.SERVICE_UNAVAILABLE, "hanging")
            if state.is_serving:
                return _say(start_response, HTTPStatus.OK, "serving")
            return _say(start_response, HTTPStatus.SERVICE_UNAVAILABLE, "not serving")
        if path == "/live":
            if beats_within(LIVE_LIMIT_S):
                return _say(start_response, HTTPStatus.OK, "alive")
            return _say(start_response, HTTPStatus.SERVICE_UNAVAILABLE, "hanging")
        return _say(start_response, HTTPStatus.NOT_FOUND, "there are /metrics, /ready and /live")

    return answer


def _say(start_response: StartResponse, status: HTTPStatus, text: str) -> list[bytes]:
    start_response(f"{status.value} {status.phrase}", [("Content-Type", "text/plain; charset=utf-8")])
    return [f"{text}\n".encode()]


class _Handler(WSGIRequestHandler):
    timeout = SILENCE_S

    def log_message(self, *_: Any) -> None:
        pass


class _HttpServer(socketserver.ThreadingMixIn, WSGIServer):
    """At most MAX_CONNECTIONS at a time, a thread each, which `server_close` waits for."""

    daemon_threads = False
    request_queue_size = 64  # with 5, the default, a few that connect at once make the next wait for seconds

    def __init__(self, host: str, port: int) -> None:
        self._open: OrderedDict[socket.socket, None] = OrderedDict()
        self._changing = threading.Lock()
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        self.address_family = family
        super().__init__((str(address[0]), port), _Handler)

    def server_bind(self) -> None:
        """As WSGIServer's, but nobody is asked for the host's name, which can take seconds."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = self.server_address[:2]  # type: ignore[assignment]
        self.setup_environ()

    def process_request(self, request: Any, client_address: Any) -> None:
        """Overrides ThreadingMixIn's."""
        with self._changing:
            if len(self._open) >= MAX_CONNECTIONS:
                oldest, _ = self._open.popitem(last=False)
                _hang_up(oldest)
            self._open[request] = None
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Overrides TCPServer's."""
        with self._changing:
            self._open.pop(request, None)
        super().shutdown_request(request)

    def close_connections(self) -> None:
        """Ends what is still being answered."""
        with self._changing:
            for connection in self._open:
                _hang_up(connection)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Overrides BaseServer's: into the log, and what a client does to its connection is no error of ours."""
        error = sys.exception() if sys.version_info >= (3, 11) else sys.exc_info()[1]
        if not isinstance(error, OSError):
            log.warning("a request for metrics failed", exc_info=error)


def _hang_up(connection: socket.socket) -> None:
    with suppress(OSError):  # it may have ended meanwhile
        connection.shutdown(socket.SHUT_RDWR)  # wakes the thread that reads from it, which then closes it
