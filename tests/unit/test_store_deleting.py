"""A large scene is deleted in portions, and nobody ever sees a part of it, not even after a crash in the middle."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import Connection
from stores import DATABASES, EXTRACTOR, Folder, Place, Shared, assert_same_view, make_reference, place_on, view_of

from mapless_server import errors
from mapless_server.principal import DEFAULT_TENANT
from mapless_server.store import Store, changing, postgresql, removing
from mapless_server.store.backup import back_up, restore
from mapless_server.store.postgresql import PostgresqlDatabase
from mapless_server.store.sqlite import DATABASE_FILE, SqliteDatabase
from mapless_server.store.verify import verify
from mapless_server.tenancy import SceneKey

OFFICE, HALL = SceneKey("office"), SceneKey("hall")
TABLES = ("reference", "image", "features", "global_descriptor", "removed_reference")
COUNT = 10


@pytest.fixture(params=DATABASES)
def place(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Place:
    monkeypatch.setattr(changing, "REFERENCES_DELETED_AT_A_TIME", 3)
    return place_on(request.param, lambda: tmp_path)


def fill(store: Store, key: SceneKey, count: int = COUNT) -> list[str]:
    """A scene with so many references and one that was deleted; their keys."""
    store.create_scene(key)
    records = store.add_references(key, [make_reference(f"r{it}", it, dimension=8) for it in range(count + 1)])
    store.delete_reference(key, f"r{count}")
    return [it.key for it in records[:count]]


def row_counts(place: Place) -> dict[str, int]:
    return {table: place.fetch(f"SELECT count(*) FROM {table}")[0][0] for table in (*TABLES, "scene")}


def before_each_portion(monkeypatch: pytest.MonkeyPatch, do: Callable[[], None]) -> None:
    real = removing.delete_portion

    def delete_portion(connection: Connection, count: int) -> bool:
        do()
        return real(connection, count)

    monkeypatch.setattr(removing, "delete_portion", delete_portion)


def fail() -> None:
    raise errors.Unavailable("the store is not there")


def test_nothing_is_left(place: Place) -> None:
    with place.open() as store:
        fill(store, OFFICE)
        store.create_scene(HALL)
        store.add_references(HALL, [make_reference("stays", 1, dimension=8)])
        store.delete_scene(OFFICE)
        assert [it.scene_id for it in store.list_scenes(DEFAULT_TENANT, 10)] == ["hall"]
        assert store.get_scene(HALL).reference_count == 1
        assert_same_view(
            store.load_references(HALL, ["stays"], EXTRACTOR).references[0].view, view_of(make_reference("stays", 1))
        )
        assert row_counts(place) == dict.fromkeys((*TABLES, "scene"), 1) | {"removed_reference": 0}


def test_in_the_middle_it_is_gone_for_everybody(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []

    def look() -> None:
        seen.append(row_counts(place)["reference"])
        # Without a cache, and read only: in SQLite, the writer's turn is not over.
        assert store.list_scenes(DEFAULT_TENANT, 10) == []
        for read in (
            lambda: store.get_scene(OFFICE),
            lambda: store.get_reference(OFFICE, "r9"),
            lambda: store.list_references(OFFICE, 10),
            lambda: store.load_references(OFFICE, ["r9"], EXTRACTOR),
            lambda: store.list_changes(OFFICE, generation, "vlad"),
            lambda: store.read_image_of(keys[9]),
            lambda: store.add_descriptor(keys[9], "other", make_reference("a", 1, dimension=8).descriptors["vlad"]),
        ):
            with pytest.raises(errors.NotFound):
                read()
        assert not store.has_features(keys[9], EXTRACTOR)

    with place.open(0) as store:
        keys = fill(store, OFFICE)
        generation = store.get_scene(OFFICE).generation
        before_each_portion(monkeypatch, look)
        store.delete_scene(OFFICE)
    assert seen == [10, 7, 4, 1, 0]


def test_a_crash_in_the_middle_leaves_what_nobody_sees_and_the_next_delete_removes(
    place: Place, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with place.open() as store:
        keys = fill(store, OFFICE)
        with monkeypatch.context() as patch:
            before_each_portion(patch, fail)
            with pytest.raises(errors.Unavailable):
                store.delete_scene(OFFICE)
    with place.open() as store:
        assert row_counts(place)["reference"] == COUNT
        with pytest.raises(errors.NotFound):
            store.delete_scene(OFFICE)
        with pytest.raises(errors.NotFound):
            store.add_features(keys[0], "other", view_of(make_reference("a")))
        store.create_scene(OFFICE)
        store.add_references(OFFICE, [make_reference(f"r{it}", 100 + it, dimension=8) for it in range(COUNT)])
        assert store.get_scene(OFFICE).reference_count == COUNT
        assert not {it.key for it in store.list_references(OFFICE, 100)} & set(keys)
        with store.database.read() as connection:
            assert verify(connection).faults == ()
        source: Any = (
            PostgresqlDatabase.look_at(place.url)
            if isinstance(place, Shared)
            else SqliteDatabase.look_at(tmp_path / "data" / DATABASE_FILE)
        )
        with closing(source):
            assert back_up(source, tmp_path / "backup").faults == ()
        store.create_scene(HALL)
        store.delete_scene(HALL)  # a small one
        assert row_counts(place)["reference"] == COUNT
        loaded = store.load_references(OFFICE, ["r4"], EXTRACTOR).references[0]
        assert_same_view(loaded.view, view_of(make_reference("r4", 104)))
    other = Folder(tmp_path / "other")
    with other.open() as store:
        restore(tmp_path / "backup", store.database)
        assert store.get_scene(OFFICE).reference_count == COUNT
        assert row_counts(other)["reference"] == COUNT
        assert row_counts(other)["scene"] == 1


def test_servers_that_delete_at_the_same_time_help_one_another(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    if not isinstance(place, Shared):
        pytest.skip("a folder has one server")
    with place.open() as one, place.open() as other:
        fill(one, OFFICE)
        fill(one, HALL)
        entered: list[None] = []

        def delete_the_other() -> None:
            entered.append(None)
            if len(entered) == 2:
                other.delete_scene(HALL)

        before_each_portion(monkeypatch, delete_the_other)
        one.delete_scene(OFFICE)
        assert row_counts(place) == dict.fromkeys((*TABLES, "scene"), 0)


def test_a_statement_s_limit_does_not_keep_a_scene_alive(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(changing, "REFERENCES_DELETED_AT_A_TIME", 3)
    place = place_on("postgresql", lambda: tmp_path)
    monkeypatch.setitem(postgresql._SESSION_OPTIONS, "statement_timeout", "300ms")
    with place.open() as store:
        fill(store, OFFICE, 20)
        with store.database.write() as connection:
            connection.exec_driver_sql(
                "CREATE FUNCTION slow() RETURNS trigger AS 'BEGIN PERFORM pg_sleep(0.03); "
                "IF TG_OP = ''DELETE'' THEN RETURN OLD; END IF; RETURN NEW; END' LANGUAGE plpgsql"
            )
            connection.exec_driver_sql(
                "CREATE TRIGGER slow BEFORE UPDATE OR DELETE ON reference FOR EACH ROW EXECUTE FUNCTION slow()"
            )
        store.delete_scene(OFFICE)
        assert row_counts(place) == dict.fromkeys((*TABLES, "scene"), 0)
