"""How the schema came to be what it is, one file a step, run by alembic when a store is opened.

Several servers share a database, and they are replaced one after the other. So a change of the schema is made in steps,
each in a release of its own, and at every moment the servers of the last two releases work side by side:

1. *Expand*: add tables, columns with a default, indices. Servers that run already neither see nor hurt them.
2. *Migrate*: fill what was added, in the same step if it is quick; new servers write both, and read the new.
3. *Contract*: take away what no server of the last release uses any more.

A step never edits what a released one did: it is a new file. A server refuses a schema newer than itself when it opens
it, since it cannot know what it would have to keep up to date; one that has it open already goes on working through an
expansion. A step has the number of the schema as its revision, and writes that number into `store_version`, too, by
which programs know it that have no alembic.

Revision 2 keeps counts that servers of revision 1 would not: revision 1 was on SQLite only, where no second server is.
"""

from __future__ import annotations

import logging

from sqlalchemy import Connection, insert, inspect, select

from ..tables import SCHEMA_VERSION, alembic_version, metadata, store_version

log = logging.getLogger(__name__)


def read_version(connection: Connection) -> int | None:
    """Version of the schema, or None in an empty database.

    Raises:
        ValueError: the database holds something else, or a store of a newer program.
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
    """Bring a database to this program's schema, in the connection's transaction, beside which nobody may run another.

    An empty one gets the schema as it is now, which is quicker; a test holds that the steps lead to the same. Only who
    copies an older database needs another version.

    Returns:
        The version found, None in an empty database.

    Raises:
        ValueError: as `read_version`.
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
    """Run the steps from one version (None: an empty database) to another, in the connection's transaction."""
    from alembic import command
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", "mapless_server.store:migrations")
    config.attributes["connection"] = connection
    if from_version is not None and not inspect(connection).has_table(alembic_version.name):
        command.stamp(config, str(from_version))  # made before there was alembic
    command.upgrade(config, str(to_version))


def write_version(connection: Connection, version: int) -> None:
    """The last thing that a step does."""
    connection.execute(store_version.delete())
    connection.execute(insert(store_version).values(schema_version=version))
