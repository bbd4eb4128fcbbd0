"""Every schema that was ever released becomes the present one, and loses nothing; on either database."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext
from sqlalchemy import Connection, insert, text
from support.stores import EXTRACTOR, Folder, Place, Shared, assert_same_view, make_reference, view_of

from mapless_server.security import SceneKey
from mapless_server.store import SceneAttributes, Store, StoreError, rows
from mapless_server.store.backup import back_up, restore
from mapless_server.store.migrations import migrate, run_steps
from mapless_server.store.sqlite import DATABASE_FILE
from mapless_server.store.tables import SCHEMA_VERSION, features, image, metadata, reference, scene_generation

OFFICE = SceneKey("office")


class Raw:
    """A database as it is before any of ours has opened it."""

    def __init__(self, place: Place) -> None:
        from mapless_server.store.postgresql import _create_engine, parse_url
        from mapless_server.store.sqlite import create_sqlite_engine

        if isinstance(place, Shared):
            # As text: reflection does not read what is sent in binary.
            self.engine = _create_engine(parse_url(place.url), cursors_are_binary=False)
        else:
            assert isinstance(place, Folder)
            place.data_dir.mkdir(exist_ok=True)
            self.engine = create_sqlite_engine(place.data_dir / DATABASE_FILE)

    def __enter__(self) -> Connection:
        self.transaction = self.engine.begin()
        return self.transaction.__enter__()

    def __exit__(self, *exception: object) -> None:
        self.transaction.__exit__(*exception)  # type: ignore[arg-type]
        self.engine.dispose()


def make_version_1(place: Place) -> None:
    """A store with rows as the first release wrote them, which knew nothing of alembic."""
    made = [make_reference(it, seed) for seed, it in enumerate("abc")]
    with Raw(place) as connection:
        run_steps(connection, None, 1)
        connection.execute(text("DROP TABLE alembic_version"))
        connection.execute(text("INSERT INTO scene (scene_id, create_time_us) VALUES ('office', 5), ('empty', 6)"))
        for scene_id, generation in (("office", 7), ("empty", 1), ("deleted", 9)):
            connection.execute(insert(scene_generation).values(scene_id=scene_id, generation=generation))
        for new in made:
            record = rows.new_record(OFFICE, new, rows.time_of(8))
            row = rows.reference_row(record)
            del row["mask_sha256"]  # of a later schema
            connection.execute(insert(reference).values(row))
            connection.execute(insert(image).values(reference_key=record.key, data=new.image))
            connection.execute(insert(features).values(rows.features_row(record.key, EXTRACTOR, view_of(new))))


def test_a_store_of_the_first_release_keeps_every_byte(place: Place) -> None:
    make_version_1(place)
    tables = ("reference", "image", "features", "scene_generation")
    columns = {"reference": "key, scene_id, reference_id, geometry, geometry_sha256, image_sha256, feature_count"}
    before = {it: place.fetch(f"SELECT {columns.get(it, '*')} FROM {it} ORDER BY 1") for it in tables}
    with place.open() as store:
        assert {it: place.fetch(f"SELECT {columns.get(it, '*')} FROM {it} ORDER BY 1") for it in tables} == before
        office, empty = store.get_scene(OFFICE), store.get_scene(SceneKey("empty"))
        assert (office.generation, office.reference_count) == (7, 3)
        assert (empty.generation, empty.reference_count) == (1, 0)
        snapshot = store.load_references(OFFICE, None, EXTRACTOR)
        for seed, loaded in enumerate(snapshot.references):
            assert_same_view(loaded.view, view_of(make_reference("", seed)))
        changes = store.list_changes(OFFICE, 6, "vlad")
        assert (changes.is_whole, len(changes.added)) == (True, 3)
        store.delete_reference(OFFICE, "b")
        store.add_references(OFFICE, [make_reference("d")])
        changes = store.list_changes(OFFICE, 7, "vlad")
        assert ([it.reference_id for it in changes.added], len(changes.removed)) == (["d"], 1)
        assert store.create_scene(SceneKey("deleted")).generation == 10
    with place.open() as store:
        assert store.get_scene(OFFICE).reference_count == 3
        assert place.fetch("SELECT version_num FROM alembic_version") == [(str(SCHEMA_VERSION),)]
        assert place.fetch("SELECT schema_version FROM store_version") == [(SCHEMA_VERSION,)]


def test_a_store_of_the_second_release_has_no_attributes(place: Place, tmp_path: Path) -> None:
    """Its servers may still be there, too, and go on creating scenes."""
    create = "INSERT INTO scene (scene_id, create_time_us, first_generation) VALUES (?, 5, 1)"
    with Raw(place) as connection:
        run_steps(connection, None, 2)
        connection.execute(insert(scene_generation).values(scene_id="office", generation=1))
        connection.execute(insert(scene_generation).values(scene_id="hall", generation=1))
    place.execute(create, "office")
    if isinstance(place, Folder):
        with closing(place.open_as_is()) as database:
            assert back_up(database, tmp_path / "backup").faults == ()
        with Store.open(tmp_path / "other") as store:
            assert restore(tmp_path / "backup", store.database).faults == ()
            assert store.get_scene(OFFICE).attributes == SceneAttributes()
    with place.open() as store:
        assert store.get_attributes(OFFICE) == SceneAttributes()
        known = store.update_scene(OFFICE, down_in_world=(0.0, 0.0, -1.0))
        place.execute(create, "hall")
        assert store.get_scene(SceneKey("hall")).attributes == SceneAttributes()
    with place.open() as store:
        assert store.get_scene(OFFICE) == known


@pytest.mark.parametrize("start", ["nothing", "first release", "steps"])
def test_all_ways_lead_to_the_same_schema(place: Place, start: str) -> None:
    if start == "first release":
        make_version_1(place)
    if start == "steps":
        with Raw(place) as connection:
            run_steps(connection, None, SCHEMA_VERSION)
    place.open().close()
    with Raw(place) as connection:
        options = {"compare_type": True, "compare_server_default": True}
        # Alembic leaves its own table out of the comparison.
        context = MigrationContext.configure(connection, opts=options)
        others = [it for it in compare_metadata(context, metadata) if "alembic_version" not in str(it)]
        assert others == []
        assert migrate(connection) == SCHEMA_VERSION


def test_a_newer_schema_is_refused(place: Place) -> None:
    place.open().close()
    place.execute("UPDATE store_version SET schema_version = ?", SCHEMA_VERSION + 1)
    for _ in range(2):
        with pytest.raises(StoreError, match=f"has version {SCHEMA_VERSION + 1}.*up to {SCHEMA_VERSION}"):
            place.open()
    assert place.fetch("SELECT schema_version FROM store_version") == [(SCHEMA_VERSION + 1,)]


def test_the_database_of_another_program_is_refused(place: Place) -> None:
    with Raw(place) as connection:
        connection.execute(text("CREATE TABLE scene (name TEXT)"))
    with pytest.raises(StoreError, match="another program"):
        place.open()
    assert place.fetch("SELECT * FROM scene") == []


def test_a_step_that_fails_changes_nothing(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    from mapless_server.store import migrations

    make_version_1(place)

    def fail(*_: object) -> None:
        raise ValueError("the last step failed")

    with monkeypatch.context() as patch:
        patch.setattr(migrations, "write_version", fail)
        with pytest.raises(StoreError, match="the last step failed"):
            place.open()
    assert place.fetch("SELECT schema_version FROM store_version") == [(1,)]
    with pytest.raises(Exception, match="reference_count"):
        place.fetch("SELECT reference_count FROM scene")
    with place.open() as store:
        assert store.get_scene(OFFICE).reference_count == 3


@pytest.mark.parametrize("is_empty", [True, False])
def test_of_servers_that_start_at_once_one_migrates(shared: Shared, is_empty: bool) -> None:
    if not is_empty:
        make_version_1(shared)
    with ThreadPoolExecutor(6) as pool:
        stores: list[Store] = list(pool.map(lambda _: shared.open(), range(6)))
    try:
        if is_empty:
            stores[0].create_scene(OFFICE)
        assert {store.get_scene(OFFICE).reference_count for store in stores} == {0 if is_empty else 3}
    finally:
        for store in stores:
            store.close()
    assert shared.fetch("SELECT schema_version FROM store_version") == [(SCHEMA_VERSION,)]
