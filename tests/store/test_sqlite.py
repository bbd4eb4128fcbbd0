"""Particular to SQLite: which library, how connections are set, whose a data folder is, faults of its disk."""

import logging
import os
import sqlite3
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from support.stores import EXTRACTOR, CountingStoreObserver, Folder, make_reference

from mapless_server import errors
from mapless_server.security import DEFAULT_TENANT, SceneKey
from mapless_server.store import Store, StoreError, sqlite

OFFICE = SceneKey("office")


@pytest.fixture
def data_dir(tmp_path: Path) -> Path:
    return tmp_path / "data"


@pytest.fixture
def store(data_dir: Path) -> Iterator[Store]:
    with Store.open(data_dir) as store:
        yield store


class TestFaults:
    def test_a_full_disk_is_reported_and_harms_nothing(self, store: Store) -> None:
        store.create_scene(OFFICE)
        store.add_references(OFFICE, [make_reference("a")])
        before = store.get_scene(OFFICE)
        store.observer = observer = CountingStoreObserver()
        with store.database.read() as connection:
            pages = connection.exec_driver_sql("PRAGMA page_count").scalar()
            unlimited = connection.exec_driver_sql("PRAGMA max_page_count").scalar()
            connection.exec_driver_sql(f"PRAGMA max_page_count={pages}")
        with pytest.raises(errors.Overloaded) as caught:
            store.add_references(OFFICE, [make_reference(it, count=200) for it in "bcd"])
        assert caught.value.reason == "STORE_FULL"
        assert (observer.operations, observer.failures) == (["add_references"], 1)
        assert store.get_scene(OFFICE) == before
        with store.database.read() as connection:
            connection.exec_driver_sql(f"PRAGMA max_page_count={unlimited}")
        store.add_references(OFFICE, [make_reference(it, count=200) for it in "bcd"])
        assert store.get_scene(OFFICE).reference_count == 4

    def test_a_lock_held_by_another_tool_asks_for_a_retry(
        self, data_dir: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(sqlite, "BUSY_TIMEOUT_MS", 10)
        with Store.open(data_dir) as store:
            store.observer = observer = CountingStoreObserver()
            other = Folder(data_dir).connect()
            other.execute("BEGIN IMMEDIATE")
            with pytest.raises(errors.Unavailable, match="busy") as caught:
                store.create_scene(OFFICE)
            assert (observer.operations, observer.failures) == (["create_scene"], 1)
            assert caught.value.retry_after_s is not None
            assert store.list_scenes(DEFAULT_TENANT, 10) == []
            other.rollback()
            other.close()
            assert store.create_scene(OFFICE).generation == 1


class TestOpening:
    def test_versions_with_the_wal_reset_bug(self) -> None:
        affected = [(3, 7, 0), (3, 40, 1), (3, 44, 5), (3, 45, 0), (3, 50, 6), (3, 51, 0), (3, 51, 2)]
        fixed = [(3, 6, 23), (3, 44, 6), (3, 50, 7), (3, 51, 3), (3, 53, 4)]
        assert [it for it in affected + fixed if sqlite.has_wal_reset_bug(it)] == affected

    def settings_in_use(self, store: Store) -> dict[str, object]:
        with store.database.read() as connection:
            return {it: connection.exec_driver_sql(f"PRAGMA {it}").scalar() for it in ("journal_mode", "synchronous")}

    @pytest.mark.parametrize("what", ["reference", "scene"])
    def test_what_is_deleted_is_not_left_in_the_file(self, store: Store, data_dir: Path, what: str) -> None:
        reference, kept = make_reference("a", seed=1), make_reference("b", seed=2)
        pieces = [reference.image[i : i + 16] for i in range(0, 4096, 64)]

        def found() -> int:
            data = b"".join(path.read_bytes() for path in data_dir.iterdir() if path.suffix != ".lock")
            return sum(piece in data for piece in pieces)

        store.create_scene(OFFICE)
        store.add_references(OFFICE, [reference, kept])
        assert found() > len(pieces) // 2  # one may lie across two pages
        store.delete_reference(OFFICE, "a") if what == "reference" else store.delete_scene(OFFICE)
        store.close()  # which empties the journal
        assert found() == 0

    def test_closing_waits_for_threads_that_read(self, data_dir: Path) -> None:
        store, reads = Store.open(data_dir), threading.Event()

        def read() -> None:
            with store.database.read():
                reads.set()
                time.sleep(0.2)

        with ThreadPoolExecutor(1) as thread:
            reading = thread.submit(read)
            assert reads.wait(10)
            store.close()
            assert not list(data_dir.glob("*.sqlite3-*"))  # else it is removed beneath whatever opens the folder next
            reading.result()

    def test_a_closed_store_is_neither_read_nor_written(self, data_dir: Path) -> None:
        store = Store.open(data_dir)
        store.close()
        database = store.database
        for use in (database.check, database.free_space, database.read().__enter__, database.write().__enter__):
            with pytest.raises(errors.Unavailable, match="closed"):
                use()
        assert not list(data_dir.glob("*.sqlite3-*"))

    def test_threads_that_read_on_close_their_connection(self, data_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(sqlite, "CLOSING_S", 0.01)
        store = Store.open(data_dir)
        with store.database.read() as connection:
            driver_connection = connection.connection.driver_connection
            store.close()
            assert connection.exec_driver_sql("SELECT 1").scalar() == 1
        assert driver_connection is not None
        with pytest.raises(sqlite.choose_library().ProgrammingError, match="closed"):
            driver_connection.execute("SELECT 1")

    def test_transactions_really_begin(self, store: Store, data_dir: Path) -> None:
        with store.database.write() as writer:
            assert writer.connection.driver_connection.in_transaction  # type: ignore[union-attr]
            # A second write transaction, past our own queue, must be refused by SQLite itself.
            other = Folder(data_dir).connect()
            with pytest.raises(sqlite.choose_library().OperationalError, match="locked"):
                other.execute("BEGIN IMMEDIATE")
            other.close()
        with store.database.read() as reader:
            assert reader.connection.driver_connection.in_transaction  # type: ignore[union-attr]

    def test_affected_library_runs_in_safe_mode(
        self, data_dir: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        with Store.open(data_dir) as store:
            store.create_scene(OFFICE)
            in_use = self.settings_in_use(store)
            assert (in_use["journal_mode"], in_use["synchronous"]) == ("wal", 2), "also after a power failure"
        with monkeypatch.context() as patch, caplog.at_level(logging.WARNING):
            for library in (sqlite3.dbapi2, pytest.importorskip("pysqlite3.dbapi2")):
                patch.setattr(library, "sqlite_version_info", (3, 51, 2))
            with Store.open(data_dir) as store:
                in_use = self.settings_in_use(store)
                assert (in_use["journal_mode"], in_use["synchronous"]) == ("delete", 3)
                with ThreadPoolExecutor(4) as pool:
                    list(pool.map(lambda it: store.add_references(OFFICE, [make_reference(it)]), "abcd"))
                    list(pool.map(lambda it: store.delete_reference(OFFICE, it), "bcd"))
        assert "WAL-reset" in caplog.text
        with Store.open(data_dir) as store:
            assert self.settings_in_use(store)["journal_mode"] == "wal"
            assert store.get_scene(OFFICE).reference_count == 1

    def test_works_without_the_packaged_library(self, data_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "pysqlite3", None)
        monkeypatch.setitem(sys.modules, "pysqlite3.dbapi2", None)
        with Store.open(data_dir) as store:
            store.create_scene(OFFICE)
            store.add_references(OFFICE, [make_reference("a")])
            assert store.load_references(OFFICE, None, EXTRACTOR).generation == 2

    def test_refused_opening_leaves_no_lock(self, data_dir: Path) -> None:
        data_dir.mkdir()
        database = data_dir / sqlite.DATABASE_FILE
        database.write_bytes(b"not a database " * 1000)
        for _ in range(2):
            with pytest.raises(StoreError, match="not a database"):
                Store.open(data_dir)
        database.unlink()
        Store.open(data_dir).close()

    def test_truncated_database_is_refused_or_reported(self, data_dir: Path) -> None:
        with Store.open(data_dir) as store:
            store.create_scene(OFFICE)
            store.add_references(OFFICE, [make_reference(str(index)) for index in range(20)])
        os.truncate(data_dir / sqlite.DATABASE_FILE, 8192)
        with pytest.raises((StoreError, errors.DataLoss)), Store.open(data_dir) as store:
            store.load_references(OFFICE, None, EXTRACTOR)

    def test_unusable_folders_are_one_sentence(self, tmp_path: Path) -> None:
        file = tmp_path / "file"
        file.touch()
        folder_for_file = tmp_path / "folder"
        (folder_for_file / sqlite.DATABASE_FILE).mkdir(parents=True)
        for data_dir in (file, file / "below", folder_for_file):
            with pytest.raises(StoreError) as caught:
                Store.open(data_dir)
            assert str(data_dir) in str(caught.value)
            assert "\n" not in str(caught.value)
            assert data_dir != file or "is a file, not a folder" in str(caught.value)

    @pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
    def test_unwritable_folder_is_refused(self, tmp_path: Path) -> None:
        tmp_path.chmod(0o500)
        with pytest.raises(StoreError, match="Permission denied"):
            Store.open(tmp_path)
