"""A backup is one moment of a store that is being changed, is verified, and moves a store between databases."""

import os
import shutil
import stat
import subprocess
import sys
import threading
from contextlib import closing, suppress
from pathlib import Path

import pytest
from support.disks import small_disk
from support.stores import (
    DATABASES,
    EXTRACTOR,
    Folder,
    Place,
    assert_same_view,
    faults_of,
    make_reference,
    place_on,
    read_image,
    view_of,
)
from typer.testing import CliRunner

from mapless.geodesy import Datum
from mapless_server.security import DEFAULT_TENANT, SceneKey, key_of
from mapless_server.store import SceneAttributes, Store, StoreError, codec, tables
from mapless_server.store.backup import GENERATIONS_SKIPPED, back_up, restore
from mapless_server.store.sqlite import SqliteDatabase, choose_library
from mapless_server.store.verification import verify
from mapless_tools.cli.store import store_app

OFFICE = SceneKey("office")
THEIRS = key_of("acme", "hall")
KNOWN = {OFFICE: SceneAttributes(), THEIRS: SceneAttributes(Datum(47.5, 8.25, 400.0), (0.0, 0.0, -1.0))}


@pytest.fixture(params=DATABASES)
def place(request: pytest.FixtureRequest, tmp_path: Path) -> Place:
    return place_on(request.param, lambda: tmp_path)


@pytest.fixture
def backup(tmp_path: Path) -> Path:
    return tmp_path / "backup.sqlite3"


def fill(store: Store) -> None:
    """Two tenants' scenes, a deleted reference, one without a descriptor."""
    for key in (OFFICE, THEIRS):
        store.create_scene(key, KNOWN[key])
        store.add_references(key, [make_reference(f"r{seed}", seed, dimension=32 * (seed % 2)) for seed in range(5)])
    store.delete_reference(OFFICE, "r3")


def assert_same_contents(store: Store, skipped: int = 0) -> None:
    """That `fill` was what filled it."""
    for key, ids in ((OFFICE, "0124"), (THEIRS, "01234")):
        scene = store.get_scene(key)
        assert scene.attributes == store.get_attributes(key) == KNOWN[key]
        assert (scene.reference_count, scene.generation) == (len(ids), skipped + (3 if key == OFFICE else 2))
        changes = store.list_changes(key, 2, "vlad")
        assert changes.is_whole is bool(skipped)
        changes = store.list_changes(key, None, "vlad")
        snapshot = store.load_references(key, None, EXTRACTOR)
        assert [it.reference_id for it in changes.added] == [f"r{it}" for it in ids]
        for number, loaded, indexed in zip(map(int, ids), snapshot.references, changes.added, strict=True):
            made = make_reference(f"r{number}", number, dimension=32 * (number % 2))
            assert_same_view(loaded.view, view_of(made))
            assert read_image(store, key, f"r{number}") == made.image
            assert (indexed.descriptor is not None) == bool(number % 2)
            if indexed.descriptor is not None:
                assert codec.encode_descriptor(indexed.descriptor) == codec.encode_descriptor(made.descriptors["vlad"])


@pytest.mark.parametrize("destination", DATABASES)
def test_either_database_comes_back_as_either(place: Place, destination: str, backup: Path, tmp_path: Path) -> None:
    with place.open() as store:
        fill(store)
        with closing(place.open_as_is()) as database:
            made = back_up(database, backup)
        assert_same_contents(store)
    assert (made.faults, made.counts["reference"]) == ((), 9)
    assert [it.name for it in tmp_path.iterdir() if it.name != "data"] == ["backup.sqlite3"]
    other = place_on(destination, lambda: tmp_path / "other")
    with other.open() as store:
        store.create_scene(OFFICE)  # a former life, which the restored one must not be taken for
        store.delete_scene(OFFICE)
        assert restore(backup, store.database).faults == ()
        assert_same_contents(store, GENERATIONS_SKIPPED)
        store.add_references(OFFICE, [make_reference("new")])
        with pytest.raises(StoreError, match="has scenes"):
            restore(backup, store.database)
        with pytest.raises(StoreError, match="exists already"):
            back_up(store.database, backup)


def test_a_backup_is_its_owners_alone(
    place: Place, backup: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From its first byte on: it holds the photographs of all tenants."""
    seen: list[int] = []

    def look(*_: object) -> None:
        seen.extend(stat.S_IMODE(it.stat().st_mode) for it in tmp_path.iterdir() if it.is_file())

    before = os.umask(0o022)
    try:
        with place.open() as store:
            fill(store)
            with closing(place.open_as_is()) as database:
                back_up(database, backup, look)
    finally:
        os.umask(before)
    assert set(seen) == {stat.S_IMODE(backup.stat().st_mode)} == {0o600}


def test_a_backup_beside_writers_shows_one_moment(place: Place, tmp_path: Path) -> None:
    """Pairs are added and deleted all the time: no backup has half a pair, and none is kept waiting."""
    done = threading.Event()
    with place.open() as store:
        store.create_scene(OFFICE)
        for index in range(100):
            store.add_references(OFFICE, [make_reference(f"{index:03}-{side}", index) for side in "ab"])

        def change() -> None:
            index = 100
            while not done.is_set():
                store.add_references(OFFICE, [make_reference(f"{index:03}-{side}", index) for side in "ab"])
                index += 1

        writer = threading.Thread(target=change)
        writer.start()
        try:
            for number in range(2):
                path = tmp_path / f"{number}.sqlite3"
                with closing(place.open_as_is()) as source:
                    back_up(source, path)
                with closing(SqliteDatabase.open_as_is(path)) as database, database.read() as connection:
                    found = verify(connection)
                assert found.faults == ()
                assert found.counts["reference"] >= 200
                assert found.counts["reference"] % 2 == 0
                assert found.counts["reference"] == found.counts["image"] == found.counts["features"]
        finally:
            done.set()
            writer.join(30)


@pytest.mark.parametrize(
    ("statement", "named"),
    [
        ("UPDATE features SET data = ? WHERE reference_key = (%s)", "r1"),
        ("UPDATE image SET data = ? WHERE reference_key = (%s)", "r2"),
        ("UPDATE global_descriptor SET data = ? WHERE reference_key = (%s)", "r1"),
        ("UPDATE reference SET geometry = ? WHERE key = (%s)", "r4"),
    ],
)
def test_damage_is_named_kept_and_not_restored(
    place: Place, backup: Path, tmp_path: Path, statement: str, named: str
) -> None:
    with place.open() as store:
        fill(store)
    key = "SELECT key FROM reference WHERE scene_id = 'office' AND reference_id = ?"
    place.execute(statement % key, b"wrong", named)
    with closing(place.open_as_is()) as database:
        with database.read() as connection:
            found = verify(connection)
        made = back_up(database, backup)
    assert len(found.faults) == 1
    assert f"'default', scene 'office', reference '{named}'" in found.faults[0]
    assert made == found
    with Store.open(tmp_path / "other") as store:
        with pytest.raises(StoreError, match=named):
            restore(backup, store.database)
        assert store.list_scenes(DEFAULT_TENANT, 1) == []


def test_a_wrong_count_is_found(place: Place) -> None:
    with place.open() as store:
        fill(store)
    place.execute("UPDATE scene SET reference_count = 7 WHERE scene_id = 'acme/hall'")
    assert faults_of(place) == ("tenant 'acme', scene 'hall': its count of references is wrong",)


def test_damage_of_what_is_known_of_a_scene_is_found(place: Place) -> None:
    with place.open() as store:
        fill(store)
    place.execute("UPDATE scene SET attributes_sha256 = ? WHERE scene_id = 'acme/hall'", "0" * 64)
    assert faults_of(place) == ("tenant 'acme', scene 'hall': its datum, down and calibration",)


def test_a_damaged_file_is_no_backup(backup: Path, tmp_path: Path) -> None:
    with Store.open(tmp_path / "data") as store:
        fill(store)
        back_up(store.database, backup)
    whole = backup.read_bytes()
    with Store.open(tmp_path / "other") as store:
        for content in (
            whole[: len(whole) // 2],
            b"",
            b"no database" * 1000,
            whole[:5000] + bytes(4096) + whole[9096:],
        ):
            backup.write_bytes(content)
            with pytest.raises(StoreError, match=r"backup\.sqlite3"):
                restore(backup, store.database)
            assert store.list_scenes(DEFAULT_TENANT, 1) == []
        backup.write_bytes(whole)
        restore(backup, store.database)
        assert_same_contents(store, GENERATIONS_SKIPPED)


def test_a_copy_that_differs_is_not_kept(backup: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As if the disk of the backup lost what was written to it."""
    from mapless_server.store import backup as module

    copy = module._copy_pages

    def copy_badly(*arguments: object) -> None:
        copy(*arguments)  # type: ignore[arg-type]
        Folder.execute(_File(backup.parent), "UPDATE image SET data = ?", b"lost")

    class _File(Folder):
        def connect(self) -> object:
            (unfinished,) = self.data_dir.glob("*.unfinished")
            return choose_library().connect(unfinished)

    monkeypatch.setattr(module, "_copy_pages", copy_badly)
    with Store.open(tmp_path / "data") as store:
        fill(store)
        with pytest.raises(StoreError, match="copy is damaged"):
            back_up(store.database, backup)
    assert not backup.exists()
    assert not list(tmp_path.glob("*.unfinished")) + list(tmp_path.glob(".*.unfinished"))


def test_without_room_for_a_backup_nothing_is_left(backup: Path, tmp_path: Path) -> None:
    """Neither for the copy, nor for reading it again."""
    with Store.open(tmp_path / "data") as store:
        fill(store)
        back_up(store.database, backup)
        size_bytes = backup.stat().st_size
        for room_bytes in (size_bytes // 3, *range(size_bytes, size_bytes + 2**16, 2**13)):
            with small_disk(tmp_path / f"disk-{room_bytes}", 1) as disk:
                (disk / "filler").write_bytes(bytes(2**20 - room_bytes))
                with suppress(StoreError):
                    back_up(store.database, disk / "backup.sqlite3")
                assert {it.name for it in disk.iterdir()} <= {"filler", "backup.sqlite3"}
                assert room_bytes >= size_bytes or not (disk / "backup.sqlite3").exists()


def test_commands_do_it_beside_a_server(tmp_path: Path, backup: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data_dir, other = tmp_path / "data", tmp_path / "other"
    runner = CliRunner()

    def run(*arguments: str) -> str:
        result = runner.invoke(store_app, [*arguments], catch_exceptions=False)
        return f"{result.exit_code} {result.output}"

    monkeypatch.delenv("MAPLESS_DATABASE_URL", raising=False)
    assert "there is no database" in run("backup", str(backup), "--data-dir", str(data_dir))
    with Store.open(data_dir) as store:
        fill(store)
        code = [sys.executable, "-m", "mapless_tools", "store", "backup", str(backup), "--data-dir", str(data_dir)]
        ended = subprocess.run(code, capture_output=True, text=True, timeout=60)
        assert ended.returncode == 0, ended.stderr
        assert "reference: 9" in ended.stdout
        assert run("migrate", "--data-dir", str(data_dir))[0] == "1"
    assert run("verify", str(backup)).startswith("0")
    assert "there is no database" in run("restore", str(tmp_path / "nothing"), "--data-dir", str(other))
    assert not other.exists()
    assert run("restore", str(backup), "--data-dir", str(other)).startswith("0")
    assert run("verify", "--data-dir", str(other)).startswith("0")
    with Store.open(other) as store:
        assert_same_contents(store, GENERATIONS_SKIPPED)
    Folder(other).execute("UPDATE image SET data = ?", b"wrong")
    said = run("verify", "--data-dir", str(other))
    assert said.startswith("1")
    assert "reference 'r0': image" in said
    shutil.rmtree(other)
    assert f"schema version {tables.SCHEMA_VERSION}" in run("migrate", "--data-dir", str(other))
