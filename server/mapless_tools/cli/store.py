"""`mapless-server store`: migrate, verify, back up and restore the store that the settings name."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mapless_server.serve.command import fail
from mapless_tools.progress import progress_bars

from .printing import AsJson, printed_as_json

if TYPE_CHECKING:
    from mapless_server.store.database import Database
    from mapless_server.store.verification import Verification

store_app = typer.Typer(help="The store: bring it up to date, check it, back it up, restore it.", no_args_is_help=True)

FAULTS_SHOWN = 50

Config = Annotated[Path | None, typer.Option(help="TOML file of settings; also MAPLESS_CONFIG.")]
DataDir = Annotated[Path | None, typer.Option(help="Folder of the store; default: the server's setting.")]


@store_app.command("migrate")
def migrate_command(config: Config = None, data_dir: DataDir = None) -> None:
    """Bring the store to this program's schema, as the server does when it starts; makes one where there is none."""
    with _store_errors(), closing(_open(config, data_dir)) as database:
        from mapless_server.store.tables import SCHEMA_VERSION

        print(f"database {database.name} has schema version {SCHEMA_VERSION}")


@store_app.command("verify")
def verify_command(
    file: Annotated[Path | None, typer.Argument(help="A backup; default: the store.")] = None,
    config: Config = None,
    data_dir: DataDir = None,
    as_json: AsJson = None,
) -> None:
    """Read every row of the store or of a backup and report damage; exit code 1 if there is any."""
    from mapless_server.store.sqlite import SqliteDatabase
    from mapless_server.store.verification import verify

    with (
        _store_errors(),
        progress_bars() as on_progress,
        closing(SqliteDatabase.open_as_is(file) if file else _open(config, data_dir, as_is=True)) as database,
        database.read() as connection,
    ):
        database.lift_limits(connection)
        found = verify(connection, on_progress)
    if printed_as_json(as_json, asdict(found)):
        raise typer.Exit(1 if found.faults else 0)
    _report(found, "whole")


@store_app.command("backup")
def backup_command(
    file: Annotated[Path, typer.Argument(help="File to write; it must not exist.")],
    config: Config = None,
    data_dir: DataDir = None,
) -> None:
    """Copy the store to one file, whether it is served or not; exit code 1 if something in the store is damaged."""
    from mapless_server.store.backup import back_up

    with _store_errors(), progress_bars() as on_progress, closing(_open(config, data_dir, as_is=True)) as database:
        found = back_up(database, file, on_progress)
    _report(found, f"written to {file}, read again and found whole")


@store_app.command("restore")
def restore_command(
    file: Annotated[Path, typer.Argument(help="A backup, of either database.")],
    config: Config = None,
    data_dir: DataDir = None,
) -> None:
    """Check a backup and copy it into the store, which must be empty: all of it or nothing."""
    from mapless_server.store.backup import restore
    from mapless_server.store.sqlite import SqliteDatabase

    with _store_errors(), progress_bars() as on_progress:
        SqliteDatabase.open_as_is(file).close()  # before a store is made for it
        with closing(_open(config, data_dir)) as database:
            found = restore(file, database, on_progress)
    _report(found, "restored, read again and found whole")


def _open(config: Path | None, data_dir: Path | None, as_is: bool = False) -> Database:
    from mapless_server.settings import load_settings
    from mapless_tools.stores import open_database

    return open_database(load_settings({"data_dir": data_dir}, config).settings, as_is)


@contextmanager
def _store_errors() -> Iterator[None]:
    from mapless_server.errors import RequestError
    from mapless_server.settings import ConfigError
    from mapless_server.store import StoreError

    try:
        yield
    except ConfigError as error:
        fail(str(error), code=2)
    except (StoreError, RequestError, ValueError) as error:
        fail(str(error), code=1)


def _report(found: Verification, verdict: str) -> None:
    contents = ", ".join(f"{name.replace('_', ' ')}: {count}" for name, count in found.counts.items())
    print(f"schema version {found.version}; {contents}")
    for fault in found.faults[:FAULTS_SHOWN]:
        print(f"damaged: {fault}")
    if found.faults:
        print(f"{len(found.faults)} faults; delete the references that are named and add them again")
        if not found.is_file_whole:
            print("the file itself is damaged: restore a backup, or export each scene and import it into a new store")
        raise typer.Exit(1)
    print(verdict)
