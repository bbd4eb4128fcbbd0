"""viser's server, on this machine alone, and for its own web pages only.

A web page that is open in the same browser may connect to any WebSocket of the machine. Browsers do not prevent that,
but they send the page's `Origin`, and the name by which it reached the server (`Host`), which shows names that were
pointed at this machine. viser checks neither, and can publish itself through a tunnel; so it gets a check before each
request, and no tunnel.
"""

import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from http import HTTPStatus
from typing import Any
from unittest.mock import patch

import viser
import websockets.asyncio.server

_LOOPBACK_NAMES = ("127.0.0.1", "localhost", "[::1]")


class GuardedViser(viser.ViserServer):
    """A viser server that serves its own pages only."""

    def __init__(self, host: str, port: int, label: str) -> None:
        """Listens on a loopback address, port 0 for any; RuntimeError if it is taken, or viser cannot be guarded."""
        # It prints its address, which the command prints, too.
        with _guarded_connections() as guarded, redirect_stdout(io.StringIO()):
            super().__init__(host=host, port=port, label=label, verbose=False)
        if not guarded:
            self.stop()
            raise RuntimeError(
                f"viser {viser.__version__} listens in a way that cannot be guarded; take another version"
            )
        if port not in (0, self.get_port()):  # viser takes the next one
            self.stop()
            raise RuntimeError(f"port {port} of {host} is taken: give another, or 0 for any")

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Returns None: what the viewer shows is not public."""
        return None


def is_own(host: str | None, origin: str | None) -> bool:
    """Whether a request comes from a page of the server that it is made to, or from no page at all.

    The headers are `Host`, "127.0.0.1:8080", and `Origin`, "http://127.0.0.1:8080", None from other programs than
    browsers.
    """
    name = (host or "").rpartition(":")[0] or (host or "")
    return name in _LOOPBACK_NAMES and origin in (None, f"http://{host}")


@contextmanager
def _guarded_connections() -> Iterator[list[bool]]:
    """Servers that begin to listen meanwhile check their requests; the list is empty if none did."""
    serve, guarded = websockets.asyncio.server.serve, []

    def guarded_serve(*arguments: Any, process_request: Callable[..., Any] | None = None, **options: Any) -> Any:
        guarded.append(True)

        def check(connection: Any, request: Any) -> Any:
            if not is_own(request.headers.get("Host"), request.headers.get("Origin")):
                return connection.respond(HTTPStatus.FORBIDDEN, "Only the viewer's own page may connect.\n")
            return None if process_request is None else process_request(connection, request)

        return serve(*arguments, process_request=check, **options)

    with patch.object(websockets.asyncio.server, "serve", guarded_serve):
        yield guarded
