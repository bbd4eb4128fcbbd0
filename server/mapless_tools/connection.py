"""The server of a command: a running one, or one of its own on the store of the settings.

Imports the client only when it connects, so that --help answers at once.
"""

from __future__ import annotations

import functools
import inspect
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from mapless_server.serve.command import fail
from mapless_server.settings import CLIENT_TOKEN_VARIABLE, Settings

if TYPE_CHECKING:
    from mapless import Client, ConnectOptions

CONNECT_S = 2.0
"""A command that finds no server ends soon; one that has begun outlives a restart of its server."""

Scene = Annotated[str, typer.Argument(help="Id of the scene.")]


@dataclass(frozen=True)
class Connection:
    """Where a server is and how to connect; each field is a flag of the commands that connect."""

    address: Annotated[
        str,
        typer.Option(
            help="host:port of the server, or host1:port,host2:port of several that share a store; default: one is "
            "started on the store of the settings."
        ),
    ] = ""
    tls: Annotated[bool, typer.Option("--tls", help="Encrypt; --ca and --cert imply it.")] = False
    ca: Annotated[Path | None, typer.Option(help="Certificate that signed the server's, PEM.")] = None
    cert: Annotated[Path | None, typer.Option(help="Our own certificate, PEM, if the server asks.")] = None
    key: Annotated[Path | None, typer.Option(help="Its key, PEM.")] = None
    token_file: Annotated[
        Path | None, typer.Option(help="Holds the token to show; default: that in MAPLESS_TOKEN.")
    ] = None
    client_id: Annotated[str, typer.Option(help="Which of the token's users this is.")] = ""

    def options(self) -> ConnectOptions:
        """The options in the client's form; ValueError if they do not fit together or a file cannot be read."""
        from mapless import ConnectOptions
        from mapless.text_files import decode_text

        token = (
            decode_text(_read(self.token_file), str(self.token_file))
            if self.token_file
            else os.environ.get(CLIENT_TOKEN_VARIABLE)
        )
        return ConnectOptions(
            timeout_s=60.0,
            upload_timeout_s=600.0,
            connect_timeout_s=CONNECT_S,
            tls=self.tls or self.ca is not None or self.cert is not None,
            root_certificates=_read(self.ca) if self.ca else None,
            client_certificate=_read(self.cert) if self.cert else None,
            client_key=_read(self.key) if self.key else None,
            token=token.strip() if token else None,
            client_id=self.client_id,
        )


def with_flags(command: Callable[..., None]) -> Callable[..., None]:
    """Gives a command the fields of its parameters that are dataclasses as flags, in place of these parameters."""
    own = inspect.signature(command, eval_str=True).parameters
    groups: dict[str, Any] = {it.name: it.annotation for it in own.values() if is_dataclass(it.annotation)}
    flags = []
    for group in groups.values():
        hints = get_type_hints(group, include_extras=True)
        flags += [
            inspect.Parameter(it.name, inspect.Parameter.KEYWORD_ONLY, default=it.default, annotation=hints[it.name])
            for it in fields(group)
        ]

    @functools.wraps(command)
    def grouped(**arguments: Any) -> None:
        try:
            for name, group in groups.items():
                arguments[name] = group(**{it.name: arguments.pop(it.name) for it in fields(group)})
        except ValueError as error:
            fail(str(error))
        command(**arguments)

    rest = [it for it in own.values() if it.name not in groups]
    vars(grouped)["__signature__"] = inspect.Signature([*rest, *flags])
    return grouped


@contextmanager
def connected(connection: Connection, settings: Settings) -> Iterator[Client]:
    """A client until the end of the block; without an address, of a server that is started on the settings' store.

    ValueError if the connection's options do not fit together, or the settings' server would reject the client.
    """
    from mapless.cli.output import suggesting
    from mapless.cli.waiting import WaitingClient

    with (
        reachable(connection, settings) as (address, options),
        WaitingClient(address, options, "mapless-server") as client,
        suggesting(client),
    ):
        yield client


@contextmanager
def reachable(
    connection: Connection, settings: Settings, environment: Mapping[str, str] | None = None
) -> Iterator[tuple[str, ConnectOptions]]:
    """The address of a server until the end of the block, and how to connect to it; see `connected`.

    `environment` has settings for a started server, besides those of this process's environment.
    """
    from mapless import ConnectOptions

    from .child import ATTEMPTS, child_server

    options = connection.options()
    if connection.address:
        yield connection.address, options
        return
    if settings.tls_certificate is not None or settings.tokens_file is not None:
        raise ValueError(
            "the settings ask for TLS or tokens, so a server cannot be started just for this; start it, and give its "
            "--address"
        )
    options = ConnectOptions(
        timeout_s=options.timeout_s, upload_timeout_s=options.upload_timeout_s, max_attempts=ATTEMPTS
    )
    with child_server(settings.database_url or settings.data_dir, environment=environment) as server:
        yield server.address, options


def _read(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        raise ValueError(f"{file} cannot be read: {error.strerror}") from error
