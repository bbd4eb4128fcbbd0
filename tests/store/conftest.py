"""Stores on either database."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from support.stores import DATABASES, Place, Shared, place_on

from mapless_server.store import Store


@pytest.fixture(scope="session", params=DATABASES)
def database(request: pytest.FixtureRequest) -> str:
    """The name of a database: tests that use it run on both."""
    return str(request.param)


@pytest.fixture
def place(database: str, tmp_path: Path) -> Place:
    """An empty place for a store, on either database."""
    return place_on(database, lambda: tmp_path)


@pytest.fixture
def store(place: Place) -> Iterator[Store]:
    """An empty store, on either database."""
    with place.open() as store:
        yield store


@pytest.fixture
def shared() -> Shared:
    """An empty place on PostgreSQL."""
    place = place_on("postgresql", Path)
    assert isinstance(place, Shared)
    return place
