"""The store that the settings name."""

from mapless_server.settings import Settings
from mapless_server.store.database import Database
from mapless_server.store.postgresql import PostgresqlDatabase
from mapless_server.store.sqlite import DATABASE_FILE, SqliteDatabase


def open_database(settings: Settings, as_is: bool) -> Database:
    """Opens the store: migrated, and created if missing; or `as_is`, to be read while servers use it.

    StoreError if there is none, or it cannot be opened.
    """
    if settings.database_url is not None:
        return PostgresqlDatabase.open(settings.database_url.get_secret_value(), migrates=not as_is)
    if as_is:
        return SqliteDatabase.open_as_is(settings.data_dir / DATABASE_FILE)
    return SqliteDatabase.open(settings.data_dir)
