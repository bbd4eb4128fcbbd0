"""Migrations of the schema, one file per step, run by alembic when a store is opened.

Several servers share a database, and they are replaced one after the other. So a change of the schema is made in steps,
each in a release of its own, and at every moment the servers of the last two releases work side by side:

1. *Expand*: add tables, columns with a default, indices. Running servers ignore them.
2. *Migrate*: fill what was added, in the same step if it is quick; new servers write both, and read the new.
3. *Contract*: remove what no server of the last release uses.

A released step is never edited: a change is a new file. A server refuses to open a schema newer than its own, since it
cannot know what it would have to keep up to date; a server that has it open already works on through an expansion. A
step's revision is the number of the schema, which it also writes into `store_version`, for programs without alembic.

Revision 2 keeps counts that servers of revision 1 would not: revision 1 was on SQLite only, where no second server is.
"""

import logging

from sqlalchemy import Connection, insert, inspect, select

from ..tables import SCHEMA_VERSION, alembic_version, metadata, store_version

log = logging.getLogger(__name__)


def read_version(connection: Connection) -> int | None:
    """Version of the schema; None for an empty database.

    ValueError if the database holds something else, or a store of a newer program.
    """
    names = inspect(connection).get_table_names()
    if not names:
        return None
    found: int | None = None
    if store_version.name in names:
        found = connection.scalar(select(store_version.c.schema_version))
    if found is None:
        raise ValueError("it is a database of another program")
    if found > SCHEMA_VERSION:
        raise ValueError(f"its schema has version {found}, this program knows versions up to {SCHEMA_VERSION}")
    return found


def migrate(connection: Connection, to_version: int = SCHEMA_VERSION) -> int | None:
    """Migrates a database in the connection's transaction, which must be the only one; returns its version before.

    An empty database, whose version is None, gets the current schema at once, which is quicker; a test checks that the
    steps lead to the same schema. Only copies of older databases need another version. ValueError as in `read_version`.
    """
    found = read_version(connection)
    if found is None and to_version == SCHEMA_VERSION:
        metadata.create_all(connection)
        write_version(connection, SCHEMA_VERSION)
        connection.execute(insert(alembic_version).values(version_num=str(SCHEMA_VERSION)))
    elif found is None or found < to_version:
        run_steps(connection, found, to_version)
        log.info("the store's schema was brought from version %s to %d", found, to_version)
    return found


def run_steps(connection: Connection, from_version: int | None, to_version: int) -> None:
    """Runs the steps from one version (None: an empty database) to another, in the connection's transaction."""
    from alembic import command
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", "mapless_server.store:migrations")
    config.attributes["connection"] = connection
    if from_version is not None and not inspect(connection).has_table(alembic_version.name):
        command.stamp(config, str(from_version))  # from before alembic was used
    command.upgrade(config, str(to_version))


def write_version(connection: Connection, version: int) -> None:
    """Records the version; the last thing that a step does."""
    connection.execute(store_version.delete())
    connection.execute(insert(store_version).values(schema_version=version))
