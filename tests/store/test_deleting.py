"""A large scene is deleted in portions, and no reader ever sees a part of it, not even after a crash in the middle."""

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import Connection
from support.stores import EXTRACTOR, Folder, Place, Shared, assert_same_view, faults_of, make_reference, view_of
from support.waiting import wait_until

from mapless import Accuracy, DepthImage, Provenance, Voucher
from mapless_server import errors
from mapless_server.method.features.matching import StoredPair
from mapless_server.method.features.views import KeptDepth
from mapless_server.security import DEFAULT_TENANT, SceneKey
from mapless_server.store import RetirementReason, Store, deletion, postgresql, reader
from mapless_server.store.adoption import retire
from mapless_server.store.backup import back_up, restore
from mapless_server.store.calibrations import claim_scene
from mapless_server.store.counts import LOCALIZED, CountKey, Sums, add_counts
from mapless_server.store.deletion import PendingDeletions
from mapless_server.store.depths import keep_depths
from mapless_server.store.pairs import PairStore, Progress
from mapless_server.store.reserve import RESERVE_FILE, Reserve
from mapless_server.store.sqlite import DATABASE_FILE, SqliteDatabase
from mapless_server.store.tables import metadata

OFFICE, HALL = SceneKey("office"), SceneKey("hall")
TABLES = ("reference", "image", "features", "global_descriptor", "removed_reference")
EMPTY = dict.fromkeys((*TABLES, "scene"), 0)
COUNT = 10


@pytest.fixture(autouse=True)
def few_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(deletion, "REFERENCES_AT_A_TIME", 3)


def fill(store: Store, key: SceneKey, count: int = COUNT) -> list[str]:
    """A scene with so many references and one that was deleted; their keys."""
    store.create_scene(key)
    records = store.add_references(key, [make_reference(f"r{it}", it, dimension=8) for it in range(count + 1)])
    store.delete_reference(key, f"r{count}")
    return [it.key for it in records[:count]]


def row_counts(place: Place) -> dict[str, int]:
    return {table: place.fetch(f"SELECT count(*) FROM {table}")[0][0] for table in (*TABLES, "scene")}


def before_each_portion(monkeypatch: pytest.MonkeyPatch, do: Callable[[], None]) -> None:
    real = deletion.next_portion

    def next_portion(connection: Connection, at_most: int) -> Sequence[str]:
        do()
        return real(connection, at_most)

    monkeypatch.setattr(deletion, "next_portion", next_portion)


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


def test_all_that_refers_to_a_scene_goes_with_it(place: Place) -> None:
    outlast = {"alembic_version", "matching_use", "scene_generation", "store_version"}
    tables = set(metadata.tables) - outlast

    def filled() -> set[str]:
        return {it for it in tables if place.fetch(f"SELECT 1 FROM {it} LIMIT 1")}

    with place.open() as store:
        keys = fill(store, OFFICE)
        store.add_references(OFFICE, [replace(make_reference("masked"), mask=b"mask", depth=DepthImage(b"", 1.0))])
        store.update_scene(OFFICE, labels={"site": "a"})
        provenance = Provenance("ADOPTED", Accuracy(0.01, 0.02, 0.1, 0.2), 0.5, (Voucher("masked", 40),))
        store.add_references(OFFICE, [replace(make_reference("adopted"), provenance=provenance)])
        retire(store, OFFICE, keys[1:2], RetirementReason.CONTRADICTED)
        pairs, progress = PairStore(store.database), Progress()
        while claim := pairs.claim("nearest", progress):
            made = {(keys[0], claim.key): StoredPair(np.zeros((1, 2), np.int32))} if claim.key != keys[0] else {}
            pairs.add("nearest", claim, made, is_complete=True)
        camera = make_reference("a").camera
        keep_depths(store.database, "kind", {keys[0]: KeptDepth(camera, np.ones((480, 640), np.float32), 0.02)})
        assert claim_scene(store.database, "kind") is not None
        add_counts(store.database, {OFFICE: {CountKey(0, keys[0], LOCALIZED): Sums(1)}})
        assert filled() == tables
        store.delete_reference(OFFICE, "r0")
        assert filled() == tables - {"reference_pair", "reference_depth"}
        store.delete_scene(OFFICE)
        assert filled() == set()
    assert faults_of(place) == ()


def test_during_the_deletion_the_scene_is_not_found(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
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
    assert seen == [10, 7, 4, 1]


def leave_some(place: Place, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """A store whose scene is gone, but not what it had; their keys."""
    with place.open() as store, monkeypatch.context() as patch:
        keys = fill(store, OFFICE)
        before_each_portion(patch, fail)
        with pytest.raises(errors.Unavailable):
            store.delete_scene(OFFICE)
    assert row_counts(place)["reference"] == COUNT
    return keys


def leave_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """The rows left when a store is opened."""
    monkeypatch.setattr(PendingDeletions, "resume", lambda _: None)


def wait_for_thread(store: Store) -> None:
    assert store._pending_deletions._thread is not None
    store._pending_deletions._thread.join(30)


def test_a_crash_midway_leaves_what_the_next_delete_removes(
    place: Place, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    keys = leave_some(place, monkeypatch)
    leave_alone(monkeypatch)
    with place.open() as store:
        assert row_counts(place)["reference"] == COUNT
        with pytest.raises(errors.NotFound):
            store.add_features(keys[0], "other", view_of(make_reference("a")))
        store.create_scene(OFFICE)
        store.add_references(OFFICE, [make_reference(f"r{it}", 100 + it, dimension=8) for it in range(COUNT)])
        assert store.get_scene(OFFICE).reference_count == COUNT
        assert not {it.key for it in store.list_references(OFFICE, 100)} & set(keys)
        assert faults_of(place) == ()
        with closing(place.open_as_is()) as source:
            assert back_up(source, tmp_path / "backup").faults == ()
        store.create_scene(HALL)
        store.delete_scene(HALL)
        assert row_counts(place)["reference"] == COUNT
        loaded = store.load_references(OFFICE, ["r4"], EXTRACTOR).references[0]
        assert_same_view(loaded.view, view_of(make_reference("r4", 104)))
    other = Folder(tmp_path / "other")
    with other.open() as store:
        restore(tmp_path / "backup", store.database)
        assert store.get_scene(OFFICE).reference_count == COUNT
        assert row_counts(other)["reference"] == COUNT
        assert row_counts(other)["scene"] == 1


def test_deleting_again_removes_the_remainder(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    leave_some(place, monkeypatch)
    leave_alone(monkeypatch)
    with place.open() as store, pytest.raises(errors.NotFound):
        store.delete_scene(OFFICE)
    assert row_counts(place) == EMPTY


def test_remains_are_deleted_in_the_background_after_opening(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    leave_some(place, monkeypatch)
    opened = threading.Event()
    with monkeypatch.context() as patch:
        before_each_portion(patch, lambda: assert_true(opened.wait(30)))
        with place.open() as store:
            assert store.list_scenes(DEFAULT_TENANT, 10) == []
            opened.set()
            wait_for_thread(store)
    assert row_counts(place) == EMPTY
    with place.open() as store:
        assert store._pending_deletions._thread is None


def assert_true(it: bool) -> None:
    assert it


def test_closing_ends_it_after_a_portion_and_a_start_goes_on(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    leave_some(place, monkeypatch)
    monkeypatch.setattr(deletion, "PAUSE_S", 30.0)
    with place.open():
        pass
    assert 0 < row_counts(place)["reference"] <= COUNT
    monkeypatch.setattr(deletion, "PAUSE_S", 0.0)
    with place.open() as store:
        wait_for_thread(store)
    assert row_counts(place) == EMPTY


@pytest.mark.parametrize("broken", ["is_pending", "next_portion"])
def test_where_that_fails_the_store_opens_and_logs_it(
    place: Place, broken: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    leave_some(place, monkeypatch)
    with monkeypatch.context() as patch:
        patch.setattr(deletion, broken, lambda *_: fail())
        with place.open() as store:
            assert store.list_scenes(DEFAULT_TENANT, 10) == []
    assert "stays until the next start or deletion of a scene: the store is not there" in caplog.text
    assert row_counts(place)["reference"] == COUNT


def test_a_store_that_can_only_be_read_leaves_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    place = Folder(tmp_path)
    leave_some(place, monkeypatch)
    monkeypatch.setattr(SqliteDatabase, "open", lambda it: SqliteDatabase._open_read_only(it / DATABASE_FILE))
    with place.open() as store:
        assert store._pending_deletions._thread is None
    assert "interrupted" not in caplog.text


@pytest.mark.parametrize(("portion_bytes", "expected"), [(0, range(COUNT, 0, -1)), (40_000, range(COUNT, 0, -2))])
def test_a_portion_is_bounded_by_its_bytes_and_has_one_at_least(
    place: Place, monkeypatch: pytest.MonkeyPatch, portion_bytes: int, expected: range
) -> None:
    """Each has 5000 bytes of a photograph and more than 10 000 of features."""
    monkeypatch.setattr(deletion, "REFERENCES_AT_A_TIME", 100)
    monkeypatch.setattr(deletion, "PORTION_BYTES", portion_bytes)
    seen: list[int] = []
    with place.open() as store:
        fill(store, OFFICE)
        before_each_portion(monkeypatch, lambda: seen.append(row_counts(place)["reference"]))
        store.delete_scene(OFFICE)
    assert seen == list(expected)
    assert row_counts(place) == EMPTY


def test_between_portions_others_may_write(place: Place) -> None:
    class Pause(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            assert timeout
            with ThreadPoolExecutor(1) as pool:
                pool.submit(store.create_scene, SceneKey(f"scene{len(written)}")).result(10)
            written.append(timeout)
            return False

    written: list[float] = []
    with place.open() as store:
        fill(store, OFFICE)
        store._pending_deletions._closing = Pause()
        store.delete_scene(OFFICE)
        assert len(store.list_scenes(DEFAULT_TENANT, 10)) == len(written) == 3


def test_the_journal_stays_as_small_as_a_portion(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Though what is deleted is overwritten, for which it goes through the journal."""
    place, journal = Folder(tmp_path), tmp_path / f"{DATABASE_FILE}-wal"
    monkeypatch.setattr(deletion, "PORTION_BYTES", 2**18)
    with place.open() as store:
        store.create_scene(OFFICE)
        large = [replace(make_reference(f"r{it}", it), image=bytes(200_000)) for it in range(15)]
        store.add_references(OFFICE, large)
    with place.open() as store:
        store.delete_scene(OFFICE)
        assert journal.stat().st_size < 2**19


class TestFullDisk:
    """Where there is room in the journal for one reference, but not for two."""

    def fill_up(self, monkeypatch: pytest.MonkeyPatch, room: int) -> list[int]:
        real, tried = deletion.delete_references, []

        def remove(connection: Connection, *keys: str) -> None:
            tried.append(len(keys))
            if len(keys) > room:
                raise errors.Overloaded("the store's disk is full", reason="STORE_FULL")
            real(connection, *keys)

        monkeypatch.setattr(deletion, "delete_references", remove)
        return tried

    def test_references_are_deleted_one_by_one(self, place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
        with place.open() as store:
            fill(store, OFFICE)
            tried = self.fill_up(monkeypatch, 1)
            store.delete_scene(OFFICE)
        assert tried == [3] + [1] * COUNT
        assert row_counts(place) == EMPTY

    def test_without_disk_space_the_deletion_reports_an_error(
        self, place: Place, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        with place.open() as store:
            fill(store, OFFICE)
            with monkeypatch.context() as patch:
                tried = self.fill_up(patch, 0)
                for _ in range(2):
                    with pytest.raises(errors.Overloaded):
                        store.delete_scene(OFFICE)
            assert tried == [3, 1, 3, 1] * 2  # each again with the space that is kept for deleting
            with pytest.raises(errors.NotFound):
                store.delete_scene(OFFICE)
        assert row_counts(place) == EMPTY

    def test_what_is_left_is_deleted_as_soon_as_there_is_room(
        self, place: Place, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(deletion, "AGAIN_S", 0.01)
        with place.open() as store:
            fill(store, OFFICE)
            with monkeypatch.context() as patch:
                tried = self.fill_up(patch, 0)
                with pytest.raises(errors.Overloaded):
                    store.delete_scene(OFFICE)
                begun = len(tried)
                wait_until(lambda: len(tried) > 3 * begun)  # the thread goes on where there is still none
            wait_until(lambda: row_counts(place) == EMPTY)

    def test_what_is_left_is_tried_again_by_one_thread_until_it_is_closed(self, tmp_path: Path) -> None:
        with Store.open(tmp_path) as store:
            pending = PendingDeletions(store.database)
            for _ in range(3):
                pending.try_again()
            assert [it.name for it in threading.enumerate()].count("deletions") == 1
            pending.close()
            assert "deletions" not in [it.name for it in threading.enumerate()]


class TestMemory:
    """Nothing is held of deleted scenes, all of others."""

    def used_bytes(self, store: Store) -> tuple[int, ...]:
        return tuple(it.used for it in (store.reference_cache, store._resolved, store._scenes))

    @pytest.mark.parametrize("what", ["scene", "reference"])
    def test_what_is_being_read_meanwhile_is_not_remembered(
        self, place: Place, what: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        real = reader._read_features

        def delete_meanwhile(*arguments: Any) -> Any:
            found = real(*arguments)
            with ThreadPoolExecutor(1) as pool:
                pool.submit(store.delete_reference, OFFICE, "r0").result(30)
                if what == "scene":
                    pool.submit(store.delete_scene, OFFICE).result(30)
            return found

        with place.open() as store:
            fill(store, OFFICE)
            with monkeypatch.context() as patch:
                patch.setattr(reader, "_read_features", delete_meanwhile)
                assert len(store.load_references(OFFICE, ["r1", "r0"], EXTRACTOR).references) == 2
            assert self.used_bytes(store)[:2] == (0, 0)


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
        assert row_counts(place) == EMPTY


def test_a_statement_s_limit_does_not_keep_a_scene_alive(shared: Shared, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(postgresql._SESSION_OPTIONS, "statement_timeout", "300ms")
    with shared.open() as store:
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
        assert row_counts(shared) == EMPTY


def test_the_space_for_deleting_is_used_by_one_at_a_time(tmp_path: Path) -> None:
    """The end of one use would otherwise keep the space again within another."""
    reserve, file, was_kept = Reserve(tmp_path), tmp_path / RESERVE_FILE, []
    reserve.keep()
    size_bytes = file.stat().st_size

    def use() -> None:
        with reserve.used():
            was_kept.append(file.exists())

    thread = threading.Thread(target=use)
    with reserve.used():
        thread.start()
        thread.join(0.05)
        assert thread.is_alive()
    thread.join()
    assert was_kept == [False]
    assert file.stat().st_size == size_bytes > 0
