"""The port of metrics and probes: HTTP in its own threads, so that it answers while the event loop is busy.

"/metrics" is the registry. "/ready", for probes without gRPC, is 200 while the server serves, and 503 before, after,
and when the heartbeat of event loop and queue is older than `READY_LIMIT_S`. "/ready?store" is 503 also while the store
is away, for load balancers that have servers with another store. "/live" is 503 when the heartbeat is older than
`LIVE_LIMIT_S`: the server hangs, and its supervisor should restart it.

The server of prometheus_client starts a thread for every connection and waits for its request without a limit, so that
a thousand idle connections need a thousand threads and file descriptors. This one accepts a few connections, closes the
oldest for a new one, and limits the time of each.
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
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

from prometheus_client import CollectorRegistry, make_wsgi_app

from .metrics import Metrics
from .store_probe import StoreProbe

if TYPE_CHECKING:
    from wsgiref.types import StartResponse, WSGIApplication, WSGIEnvironment

log = logging.getLogger(__name__)

MAX_CONNECTIONS = 8
"""Two instances of Prometheus and a few probes or people."""
IDLE_LIMIT_S = 5.0
"""A connection that is idle for longer is closed."""
READY_LIMIT_S = 5.0
"""Largest age of the heartbeat of a ready server, which beats a hundred times a second."""
LIVE_LIMIT_S = 60.0
"""Longer than any load delays the heartbeat, and than closing takes, during which there is none."""
_POLL_S = 0.2


class MetricsServer:
    """Serves a registry and the probes until it is closed."""

    def __init__(
        self, registry: CollectorRegistry, host: str, port: int, state: Metrics, store_probe: StoreProbe | None = None
    ) -> None:
        """Begins to listen and to serve; port 0 for any free one. OSError if the address cannot be listened on.

        Without a probe of the store, "/ready?store" is as "/ready".
        """
        self._server = _HttpServer(host, port)
        self._server.set_app(_application(registry, state, store_probe))
        self.port: int = self._server.server_port
        self._thread = threading.Thread(target=self._server.serve_forever, args=(_POLL_S,), name="metrics", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Frees the port and ends all threads."""
        self._server.shutdown()
        self._thread.join()
        self._server.close_connections()
        self._server.server_close()


def _application(registry: CollectorRegistry, state: Metrics, store_probe: StoreProbe | None) -> WSGIApplication:
    metrics: WSGIApplication = make_wsgi_app(registry)

    def beats_within(limit_s: float) -> bool:
        beaten_s = state.beaten_s
        return beaten_s is None or time.monotonic() - beaten_s < limit_s

    def why_not_ready(asks_for_store: bool) -> str:
        if not beats_within(READY_LIMIT_S):
            return "hanging"
        if not state.is_serving:
            return "not serving" + (state.not_serving_because and f": {state.not_serving_because}")
        return store_probe.fault() if asks_for_store and store_probe is not None else ""

    def answer(environ: WSGIEnvironment, start_response: StartResponse) -> Iterable[bytes]:
        path = environ["PATH_INFO"]
        if path == "/metrics":
            return metrics(environ, start_response)
        if path == "/ready":
            fault = why_not_ready("store" in parse_qs(environ.get("QUERY_STRING", ""), keep_blank_values=True))
            status = HTTPStatus.SERVICE_UNAVAILABLE if fault else HTTPStatus.OK
            return _text(start_response, status, fault or "serving")
        if path == "/live":
            if beats_within(LIVE_LIMIT_S):
                return _text(start_response, HTTPStatus.OK, "alive")
            return _text(start_response, HTTPStatus.SERVICE_UNAVAILABLE, "hanging")
        return _text(start_response, HTTPStatus.NOT_FOUND, "there are /metrics, /ready and /live")

    return answer


def _text(start_response: StartResponse, status: HTTPStatus, text: str) -> list[bytes]:
    start_response(f"{status.value} {status.phrase}", [("Content-Type", "text/plain; charset=utf-8")])
    return [f"{text}\n".encode()]


class _Handler(WSGIRequestHandler):
    timeout = IDLE_LIMIT_S

    def log_message(self, *_: Any) -> None:
        pass


class _HttpServer(socketserver.ThreadingMixIn, WSGIServer):
    """Serves at most MAX_CONNECTIONS concurrent connections, a thread each, which `server_close` waits for."""

    daemon_threads = False
    request_queue_size = 64  # with 5, the default, a few that connect at once make the next wait for seconds

    def __init__(self, host: str, port: int) -> None:
        self._open: OrderedDict[socket.socket, None] = OrderedDict()
        self._lock = threading.Lock()
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        self.address_family = family
        super().__init__((str(address[0]), port), _Handler)

    def server_bind(self) -> None:
        """Does the same as WSGIServer without looking up the host's name, which can take seconds."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = self.server_address[:2]  # type: ignore[assignment]
        self.setup_environ()

    def process_request(self, request: Any, client_address: Any) -> None:
        """Overrides ThreadingMixIn: limits the number of connections."""
        with self._lock:
            if len(self._open) >= MAX_CONNECTIONS:
                oldest, _ = self._open.popitem(last=False)
                _disconnect(oldest)
            self._open[request] = None
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Overrides TCPServer: also forgets the connection."""
        with self._lock:
            self._open.pop(request, None)
        super().shutdown_request(request)

    def close_connections(self) -> None:
        """Ends the open connections."""
        with self._lock:
            for connection in self._open:
                _disconnect(connection)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Overrides BaseServer's: logs the error, unless the client broke the connection."""
        if not isinstance(error := sys.exception(), OSError):
            log.warning("a request for metrics failed", exc_info=error)


def _disconnect(connection: socket.socket) -> None:
    with suppress(OSError):  # it may have ended meanwhile
        connection.shutdown(socket.SHUT_RDWR)  # wakes the thread that reads from it, which then closes it
