"""The server that a command talks to: one that runs, or one of its own on the settings' store."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from mapless import Client, ConnectOptions
from mapless_server.settings import CLIENT_TOKEN_VARIABLE, Settings
from mapless_tools.child import child_server


@dataclass(frozen=True)
class Connection:
    """Where a server is and how to connect.

    Attributes:
        address: "host:port"; empty for a server of one's own.
        tls: whether to encrypt.
        ca, certificate, key, token_file: files, or none.
        client_id: which of the token's users this is.
    """

    address: str = ""
    tls: bool = False
    ca: Path | None = None
    certificate: Path | None = None
    key: Path | None = None
    token_file: Path | None = None
    client_id: str = ""

    def options(self) -> ConnectOptions:
        """As the client takes them; ValueError if they do not fit together or a file cannot be read."""
        token = _read(self.token_file).decode("utf-8") if self.token_file else os.environ.get(CLIENT_TOKEN_VARIABLE)
        return ConnectOptions(
            timeout_s=60.0,
            upload_timeout_s=600.0,
            tls=self.tls or self.ca is not None or self.certificate is not None,
            root_certificates=_read(self.ca) if self.ca else None,
            client_certificate=_read(self.certificate) if self.certificate else None,
            client_key=_read(self.key) if self.key else None,
            token=token.strip() if token else None,
            client_id=self.client_id,
        )


@contextmanager
def connected(connection: Connection, settings: Settings) -> Iterator[Client]:
    """A client until the block is left; without an address, of a server that is started on the settings' store.

    Raises:
        ValueError: the connection's options do not fit together, or the settings' server would not take us.
        ServerFailed: our own server did not start.
    """
    with reachable(connection, settings) as (address, options), Client(address, options) as client:
        yield client


@contextmanager
def reachable(
    connection: Connection, settings: Settings, environment: Mapping[str, str] | None = None
) -> Iterator[tuple[str, ConnectOptions]]:
    """The address of a server until the block is left, and how to connect to it; see `connected`.

    `environment` has settings for a server that is started, besides those of our own environment.
    """
    options = connection.options()
    if connection.address:
        yield connection.address, options
        return
    if settings.tls_certificate is not None or settings.tokens_file is not None:
        raise ValueError(
            "the settings ask for TLS or tokens, so a server cannot be started just for this; start it, and give its "
            "--address"
        )
    if options.tls or options.token is not None:
        options = ConnectOptions(timeout_s=options.timeout_s, upload_timeout_s=options.upload_timeout_s)
    with child_server(settings.database_url or settings.data_dir, environment=environment) as server:
        yield server.address, options


def _read(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        raise ValueError(f"{file} cannot be read: {error.strerror}") from error
