"""Stores of earlier releases become the present schema and lose nothing; on either database.

`released` has a store of each release as SQL: four references of which one was deleted, and a scene without references.
"""

import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext
from support.images import encode, textured, with_exif_orientation
from support.stores import EXTRACTOR, Place, Shared, faults_of, make_reference, read_image

from mapless.geometry import Camera
from mapless_server.security import SceneKey
from mapless_server.store import LruCache, Store, StoreError
from mapless_server.store.backup import back_up, reading_backup, restore
from mapless_server.store.tables import SCHEMA_VERSION, metadata

OFFICE, EMPTY = SceneKey("office"), SceneKey("empty")
RELEASES = {"0.2.0": 3, "0.3.0": 9}
"""Their schemas."""


def make_store_of(release: str, place: Place) -> None:
    """Makes the store that the release has written."""
    kind = "postgresql" if isinstance(place, Shared) else "sqlite"
    place.run_script((Path(__file__).parent / "released" / f"{release}.{kind}.sql").read_text())


@pytest.mark.parametrize("release", RELEASES)
def test_a_store_of_an_earlier_release_is_usable(place: Place, release: str) -> None:
    make_store_of(release, place)
    for _ in range(2):  # when it is upgraded, and afterwards
        with place.open() as store:
            assert_all_is_there(store, release)
    assert faults_of(place) == ()
    assert place.fetch("SELECT version_num FROM alembic_version") == [(str(SCHEMA_VERSION),)]
    assert place.fetch("SELECT schema_version FROM store_version") == [(SCHEMA_VERSION,)]
    with place.open() as store:
        store.delete_reference(OFFICE, "b")
        store.add_references(OFFICE, [make_reference("e", dimension=4)])
        changes = store.list_changes(OFFICE, 3, "vlad")
        assert ([it.reference_id for it in changes.added], len(changes.removed)) == (["e"], 1)


def assert_all_is_there(store: Store, release: str) -> None:
    """Asserts that scenes, photographs, features, descriptors and poses are those that were written."""
    office, empty = store.get_scene(OFFICE), store.get_scene(EMPTY)
    assert (office.generation, office.reference_count, office.attributes.down_in_world) == (3, 3, (0.0, 0.0, -1.0))
    assert (empty.generation, empty.reference_count) == (1, 0)
    changes = store.list_changes(OFFICE, 2, "vlad")
    assert (len(changes.added), len(changes.removed)) == (0, 1)
    indexed = store.list_changes(OFFICE, 0, "vlad").added
    for number, (reference_id, found) in enumerate(
        zip("abc", store.load_references(OFFICE, None, EXTRACTOR).references, strict=True)
    ):
        camera = Camera(64, 48, 50.25 + number, 51.0, 31.5, 23.5)
        assert (found.record.reference_id, found.record.camera, found.view.camera) == (reference_id, camera, camera)
        pose = found.record.world_from_camera
        np.testing.assert_array_equal(pose.rotation, np.roll(np.eye(3), number, axis=0))
        np.testing.assert_array_equal(pose.translation, [number, 2.5, -1])
        features = found.view.features
        np.testing.assert_array_equal(features.keypoints, np.arange(8).reshape(4, 2) + number / 4)
        np.testing.assert_array_equal(features.unit_descriptors(), np.roll(np.eye(4, 8), number, axis=1))
        np.testing.assert_array_equal(features.sizes_px, np.full(4, 2 + number))
        np.testing.assert_array_equal(indexed[number].descriptor, np.roll(np.eye(4)[0], number))
        assert read_image(store, OFFICE, reference_id) == bytes([number]) * 8
        has_mask = release != "0.2.0" and reference_id == "c"
        assert store.read_mask_of(found.record.key) == (b"mask" if has_mask else b"")


@pytest.mark.parametrize("release", RELEASES)
def test_photographs_that_exif_turns_are_described_again(place: Place, release: str) -> None:
    make_store_of(release, place)
    photograph = with_exif_orientation(encode(".jpg", textured(64, 48)), 6)
    (key,) = place.fetch("SELECT key FROM reference WHERE reference_id = 'b'")[0]
    place.execute("UPDATE image SET data = ? WHERE reference_key = ?", photograph, key)
    with place.open() as store:
        found = store.load_references(OFFICE, None, EXTRACTOR)
        assert [it.record.reference_id for it in found.references] == ["a", "c"]
        assert [it.reference_id for it in found.undescribed] == ["b"]
        assert [it.reference_id for it in store.list_changes(OFFICE, 0, "vlad").added if it.descriptor is None] == ["b"]


@pytest.mark.parametrize("start", ["nothing", *RELEASES])
def test_all_ways_lead_to_the_same_schema(place: Place, start: str) -> None:
    if start in RELEASES:
        make_store_of(start, place)
    place.open().close()
    with place.inspected() as connection:
        options = {"compare_type": True, "compare_server_default": True}
        # Alembic leaves its own table out of the comparison.
        context = MigrationContext.configure(connection, opts=options)
        assert [it for it in compare_metadata(context, metadata) if "alembic_version" not in str(it)] == []


@pytest.mark.parametrize("release", RELEASES)
def test_backups_of_earlier_releases_are_restored(place: Place, release: str, tmp_path: Path) -> None:
    make_store_of(release, place)
    with closing(place.open_as_is()) as database:
        if isinstance(place, Shared):
            with pytest.raises(StoreError, match=f"version {RELEASES[release]}.*with the release that uses"):
                back_up(database, tmp_path / "backup")
            return
        assert back_up(database, tmp_path / "backup").faults == ()
    with reading_backup(tmp_path / "backup") as current:
        read = Store(current, LruCache(0)).load_references(OFFICE, ["a"], EXTRACTOR)
        assert read.references[0].record.camera.width_px == 64
    with Store.open(tmp_path / "other") as store:
        assert restore(tmp_path / "backup", store.database).faults == ()
        assert store.load_references(OFFICE, ["a"], EXTRACTOR).references[0].record.camera.width_px == 64


@pytest.mark.parametrize(
    ("version", "advice"),
    [
        (SCHEMA_VERSION + 1, f"newer release.*version {SCHEMA_VERSION + 1}.*up to {SCHEMA_VERSION}; use that release"),
        (2, "version 2, .*before release 0.2.0.*`mapless-server store migrate` of release 0.3.0.*a backup, restore it"),
        (5, "version 5, .*between releases.*`mapless-server store migrate` of release 0.3.0"),
    ],
)
def test_other_schemas_are_refused_with_advice(place: Place, version: int, advice: str) -> None:
    make_store_of("0.2.0", place)
    place.execute("UPDATE store_version SET schema_version = ?", version)
    for _ in range(2):
        with pytest.raises(StoreError, match=advice):
            place.open()
    assert place.fetch("SELECT schema_version FROM store_version") == [(version,)]


def test_the_database_of_another_program_is_refused(place: Place) -> None:
    place.run_script("CREATE TABLE scene (name TEXT)")
    with pytest.raises(StoreError, match="another program"):
        place.open()
    assert place.fetch("SELECT * FROM scene") == []


@pytest.mark.parametrize("release", RELEASES)
def test_a_killed_upgrade_is_made_at_the_next_start(place: Place, release: str) -> None:
    make_store_of(release, place)
    program = """
import os, signal, sys
from pathlib import Path
from alembic.operations import Operations
from mapless_server.store import Store
create_index = Operations.create_index
def killed(operations, name, *arguments, **options):
    create_index(operations, name, *arguments, **options)
    if name == "reference_by_image":
        os.kill(os.getpid(), signal.SIGKILL)
Operations.create_index = killed
where = sys.argv[1]
Store.connect(where) if where.startswith("postgresql") else Store.open(Path(where))
"""
    where = place.url if isinstance(place, Shared) else str(place.data_dir)
    ended = subprocess.run([sys.executable, "-c", program, where], timeout=60)
    assert ended.returncode == -signal.SIGKILL
    assert place.fetch("SELECT schema_version FROM store_version") == [(RELEASES[release],)]
    with place.open() as store:
        assert_all_is_there(store, release)


@pytest.mark.parametrize("is_empty", [True, False])
def test_of_servers_that_start_at_once_one_migrates(shared: Shared, is_empty: bool) -> None:
    if not is_empty:
        make_store_of("0.2.0", shared)
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
