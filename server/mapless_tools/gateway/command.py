"""`mapless-server gateway`: the GeoPose Protocol, plain HTTP and calls of browsers."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from mapless_tools.connection import Connection, with_flags


@with_flags
def gateway_command(
    scene: Annotated[str, typer.Option(help="Id of the scene of requests that name none.")] = "",
    group: Annotated[
        list[str] | None,
        typer.Option(
            help="Label of the scenes among which that of requests that name none is found, NAME=VALUE; may be "
            "repeated. Without it and without --scene: all scenes."
        ),
    ] = None,
    host: Annotated[str, typer.Option(help="Address that it listens on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; 0 takes any free one.")] = 8080,
    allow_origin: Annotated[
        list[str] | None,
        typer.Option(help="Origin whose pages may call, https://app.example; may be repeated; * for all."),
    ] = None,
    pages: Annotated[Path | None, typer.Option(help="Folder of pages to serve, such as client/web/dist.")] = None,
    max_body_mib: Annotated[float, typer.Option(help="Largest request.")] = 32.0,
    max_requests: Annotated[int, typer.Option(help="Requests at a time; further ones are refused.")] = 32,
    tls_certificate: Annotated[Path | None, typer.Option(help="Of the gateway, PEM; headsets need it.")] = None,
    tls_key: Annotated[Path | None, typer.Option(help="Its key, PEM.")] = None,
    insecure: Annotated[
        bool, typer.Option("--insecure", help="Listen beyond this machine without TLS, or to a server without tokens.")
    ] = False,
    *,
    connection: Connection,
) -> None:
    """Serve HTTP in front of a server: GeoPose Protocol 2, a form for curl, gRPC-Web and Connect for browsers.

    A token given here is used for requests of the GeoPose Protocol and of the form that have none of their own, never
    for the calls of browsers.
    """
    from mapless.labels import parse_labels
    from mapless_server.serve.libraries import configure_libraries
    from mapless_server.serve.signals import terminable
    from mapless_server.settings import load_settings
    from mapless_tools.connection import reachable
    from mapless_tools.usage import failures_end_command

    with failures_end_command(ValueError):
        settings = load_settings({}).settings
        configure_libraries(settings)
        from .app import GatewayOptions
        from .guard import GuardOptions
        from .serving import Binding, run

        binding = Binding(host, port, tls_certificate, tls_key, insecure)
        guard = GuardOptions(tuple(allow_origin or ()), binding.is_loopback, round(max_body_mib * 2**20), max_requests)
        if pages is not None and not (pages / "index.html").is_file():
            raise ValueError(
                f"--pages {pages} holds no index.html; in client/web, build it by npm install && npm run build"
            )
        if scene and group:
            raise ValueError("--scene and --group exclude each other")
        labels = parse_labels(group or (), "--group")
        options = GatewayOptions(scene, labels, pages, guard)
        with terminable(), reachable(connection, settings) as (server, connect):
            if not connection.address:
                print(f"a server was started at {server}", file=sys.stderr)
            run(server, connect, options, binding)
