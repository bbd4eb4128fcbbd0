"""Migrations of the schema, one file per step, run by alembic when a store is opened.

Several servers share a database, and they are replaced one after the other. So a change of the schema is made in steps,
each in a release of its own, and at every moment the servers of the last two releases work side by side:

1. *Expand*: add tables, columns with a default, indices. Running servers ignore them.
2. *Migrate*: fill what was added, in the same step if it is quick; new servers write both, and read the new.
3. *Contract*: remove what no server of the last release uses.

A step's revision is the number of the schema, which is also in `store_version`, for programs without alembic. A
released step is never edited: a change is a new file. The steps begin at the schema of 0.2.0; an older store, or one of
a version between releases, is refused with the release that can bring it up to date. A newer one is refused, since a
server cannot know what it would have to keep up to date; a server that has it open already works on through an
expansion.
"""

import logging

from sqlalchemy import Connection, insert, inspect, select

from ..tables import SCHEMA_VERSION, alembic_version, metadata, store_version

log = logging.getLogger(__name__)

OLDEST_VERSION = 3
"""The schema of 0.2.0, at which the steps begin."""
FIRST_STEP = 9
"""The schema of 0.3.0, to which the first step leads; from there on each schema has a step."""


def read_version(connection: Connection) -> int | None:
    """Version of the schema; None for an empty database.

    ValueError if the database holds something else, a store of a newer program, or one at whose schema no step begins.
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
        raise ValueError(
            f"a newer release has written it: its schema has version {found}, this release knows versions up to "
            f"{SCHEMA_VERSION}; use that release, or restore a backup from before the upgrade"
        )
    if found < FIRST_STEP and found != OLDEST_VERSION:
        raise ValueError(
            f"its schema has version {found}, which lies before release 0.2.0 or between releases; run "
            "`mapless-server store migrate` of release 0.3.0 first; if it is a backup, restore it with release 0.3.0, "
            "and back it up there again"
        )
    return found


def migrate(connection: Connection) -> int | None:
    """Migrates a database in the connection's transaction, which must be the only one; returns its version before.

    An empty database, whose version is None, gets the current schema; a test checks that the steps lead to the same.
    ValueError as in `read_version`.
    """
    found = read_version(connection)
    if found is None:
        metadata.create_all(connection)
        connection.execute(insert(alembic_version).values(version_num=str(SCHEMA_VERSION)))
    elif found < SCHEMA_VERSION:
        _run_steps(connection, found)
        log.info("the store's schema was brought from version %d to %d", found, SCHEMA_VERSION)
    if found != SCHEMA_VERSION:
        connection.execute(store_version.delete())
        connection.execute(insert(store_version).values(schema_version=SCHEMA_VERSION))
    return found


def _run_steps(connection: Connection, found: int) -> None:
    from alembic import command
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", "mapless_server.store:migrations")
    config.attributes["connection"] = connection
    if found == OLDEST_VERSION:
        command.stamp(config, "base", purge=True)  # the step that led to it is no longer here
    command.upgrade(config, "head")
