"""`mapless-server view`: a scene in the browser."""

import sys
import threading
from typing import Annotated

import typer

from mapless_server.serve.command import fail
from mapless_tools.connection import Connection, Scene, with_flags

_ALLOW_WATCHING = {"MAPLESS_ALLOW_WATCHING": "true"}


@with_flags
def view_command(
    scene: Scene,
    host: Annotated[str, typer.Option(help="Loopback address that the page is served on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the page; 0 takes any free one.")] = 8080,
    no_open: Annotated[bool, typer.Option("--no-open", help="Do not open a browser.")] = False,
    max_pictured: Annotated[
        int, typer.Option(min=1, help="References drawn with their photographs; others are dots.")
    ] = 300,
    seeds: Annotated[
        int,
        typer.Option(min=0, help="References localized against their neighbours, to have points to show; 0.5 s each."),
    ] = 8,
    *,
    connection: Connection,
) -> None:
    """Show a scene in the browser: references, matched points, and queries as they are answered.

    Live queries take a server with the setting allow_watching, and a token of the role write.
    """
    from mapless_server.security import is_loopback
    from mapless_server.serve.signals import terminable
    from mapless_server.settings import load_settings
    from mapless_tools.connection import reachable
    from mapless_tools.usage import failures_end_command

    if not is_loopback(host):
        fail(
            f"--host {host} is not a loopback address: the page has no authentication, and shows the scene's "
            f"photographs; from another machine, use a tunnel: ssh -L {port}:127.0.0.1:{port} THIS-MACHINE"
        )
    with failures_end_command(ValueError, failure=RuntimeError):
        from .viewer import viewer

        settings = load_settings({}).settings
        with (
            terminable(),
            reachable(connection, settings, _ALLOW_WATCHING) as (server, connect),
            viewer(server, connect, scene, host=host, port=port, max_pictured=max_pictured, seeds=seeds) as page,
        ):
            _announce(page, "" if connection.address else server, no_open)
            threading.Event().wait()


def _announce(page: str, own_server: str, no_open: bool) -> None:
    if own_server:
        print(f"queries sent to {own_server} are shown", file=sys.stderr)
    # Read by programs that take any port: keep its form.
    print(f"mapless-server view is on {page}", flush=True)
    if not no_open:
        import webbrowser

        webbrowser.open(page)
