"""The store that the settings name, as commands read it while servers use it."""

from mapless_server.settings import Settings
from mapless_server.store.database import Database
from mapless_server.store.postgresql import PostgresqlDatabase
from mapless_server.store.sqlite import DATABASE_FILE, SqliteDatabase


def open_database_as_is(settings: Settings) -> Database:
    """Opens the database for reading, without migrating it; StoreError if there is none, or it cannot be opened."""
    if settings.database_url is not None:
        return PostgresqlDatabase.open(settings.database_url.get_secret_value(), migrates=False)
    return SqliteDatabase.open_as_is(settings.data_dir / DATABASE_FILE)
