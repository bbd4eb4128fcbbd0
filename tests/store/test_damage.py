"""Damage: the reference that it is in is named, and nothing else is; pages that a disk has lost, and changed bytes.

Features and descriptors here are large enough to lie on pages of their own. A page is found by what was stored in it.
"""

import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from support.stores import (
    EXTRACTOR,
    Folder,
    Place,
    assert_same_view,
    faults_of,
    lose_page_with,
    make_reference,
    read_image,
    view_of,
)

from mapless_server import errors
from mapless_server.errors import AlreadyExists, DataLoss, NotFound
from mapless_server.security import SceneKey
from mapless_server.store import Store, codec, deletion
from mapless_server.store.sqlite import DATABASE_FILE

SCENE = SceneKey("office")
IDS = ["a", "b", "c"]
MADE = {it: make_reference(it, seed, count=100, dimension=6000) for seed, it in enumerate(IDS)}


@pytest.fixture
def folder(tmp_path: Path) -> Folder:
    folder = Folder(tmp_path)
    with folder.open() as store:
        store.create_scene(SCENE)
        store.add_references(SCENE, list(MADE.values()))
    return folder


def lose(folder: Folder, what: str, reference_id: str) -> None:
    made = MADE[reference_id]
    stored = {
        "image": made.image[4000:4016],
        "features": view_of(made).features.descriptors.tobytes()[20_000:20_016],
        "descriptor": made.descriptors["vlad"].astype("float16").tobytes()[6000:6016],
    }
    lose_page_with(folder.data_dir / DATABASE_FILE, stored[what])


def test_lost_features_name_their_reference_and_others_load(folder: Folder) -> None:
    lose(folder, "features", "b")
    with folder.open() as store:
        for asked in (IDS, ["b"], ["c", "b"], None):
            with pytest.raises(DataLoss, match="'b' is damaged"):
                store.load_references(SCENE, asked, EXTRACTOR)
        loaded = store.load_references(SCENE, ["c", "a"], EXTRACTOR).references
        assert [it.record.reference_id for it in loaded] == ["c", "a"]


@pytest.mark.parametrize("what", ["image", "features", "descriptor"])
def test_any_loss_is_reported_and_the_reference_can_be_replaced(folder: Folder, what: str) -> None:
    lose(folder, what, "b")
    named = [fault for fault in faults_of(folder) if "reference" in fault]
    assert named
    assert all("'b'" in fault for fault in named)
    with folder.open() as store:
        if what == "image":
            with pytest.raises(DataLoss, match="'b' is damaged"):
                read_image(store, SCENE, "b")
            assert read_image(store, SCENE, "a") == MADE["a"].image
        if what == "descriptor":
            changes = store.list_changes(SCENE, None, "vlad")
            assert ([it.reference_id for it in changes.added], changes.damaged) == (["a", "c"], ("b",))
        with pytest.raises(AlreadyExists):
            store.add_references(SCENE, [MADE["b"]])
        store.delete_reference(SCENE, "b")
        with pytest.raises(NotFound):
            store.get_reference(SCENE, "b")
        assert store.get_scene(SCENE).reference_count == 2
        store.add_references(SCENE, [MADE["b"]])
        assert read_image(store, SCENE, "b") == MADE["b"].image
        assert len(store.load_references(SCENE, IDS, EXTRACTOR).references) == 3
        assert len(store.list_changes(SCENE, None, "vlad").added) == 3
    assert not [fault for fault in faults_of(folder) if "reference" in fault]


@pytest.mark.parametrize("at_a_time", [1, 2, 100])
def test_a_scene_with_lost_pages_can_be_deleted(
    folder: Folder, at_a_time: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(deletion, "REFERENCES_AT_A_TIME", at_a_time)
    lose(folder, "features", "b")
    lose(folder, "features", "c")
    with folder.open() as store:
        store.delete_scene(SCENE)
        with pytest.raises(NotFound):
            store.get_scene(SCENE)
        store.create_scene(SCENE)
        store.add_references(SCENE, list(MADE.values()))
        assert store.get_scene(SCENE).reference_count == 3
        store.delete_scene(SCENE)
        assert store.list_scenes("default", 10) == []
    assert folder.fetch("SELECT count(*) FROM reference") == [(2,)], "of those that cannot be deleted"


def test_a_lost_table_of_references_names_no_reference(folder: Folder) -> None:
    with folder.open() as store:
        key = store.get_reference(SCENE, "a").key
    lose_page_with(folder.data_dir / DATABASE_FILE, f"{key}office".encode())
    with folder.open() as store, pytest.raises(DataLoss, match="the store is damaged"):
        store.load_references(SCENE, IDS, EXTRACTOR)
    assert any(fault.startswith("database: ") for fault in faults_of(folder))


# Changed bytes


OFFICE = SceneKey("office")


OF_FEATURES, OF_REFERENCE = "WHERE reference_key = ?", "WHERE key = ?"
DAMAGES: dict[str, tuple[str, Callable[[str, str, bytes], tuple[object, ...]]]] = {
    "zeros": (f"features SET data = ? {OF_FEATURES}", lambda key, *_: (bytes(100), key)),
    "nothing": (f"features SET data = ? {OF_FEATURES}", lambda key, *_: (b"", key)),
    "features of another": (
        f"features SET data = (SELECT data FROM features {OF_FEATURES}) {OF_FEATURES}",
        lambda key, other, _: (other, key),
    ),
    "features and checksum of another": (
        f"features SET (data, sha256) = (SELECT data, sha256 FROM features {OF_FEATURES}) {OF_FEATURES}",
        lambda key, other, _: (other, key),
    ),
    "another width": (
        f"reference SET geometry = ? {OF_REFERENCE}",
        lambda key, _, geometry: (geometry.replace(b"640", b"641"), key),
    ),
    "no geometry": (f"reference SET geometry = ? {OF_REFERENCE}", lambda key, *_: (b"\xff", key)),
    "text for bytes": (f"reference SET geometry = CAST(geometry AS TEXT) {OF_REFERENCE}", lambda key, *_: (key,)),
}
"""Statements after UPDATE, and their parameters by a reference's key, another's, and its geometry."""


class TestDamage:
    @pytest.mark.parametrize("damage", DAMAGES)
    def test_one_damaged_reference_is_named_and_the_other_served(self, store: Store, place: Place, damage: str) -> None:
        store.create_scene(OFFICE)
        bad, good_record = store.add_references(OFFICE, [make_reference("bad", 1), make_reference("good", 2)])
        if damage == "text for bytes" and not isinstance(place, Folder):
            pytest.skip("to PostgreSQL, text is not bytes")
        statement, parameters = DAMAGES[damage]
        ((geometry,),) = place.fetch("SELECT geometry FROM reference WHERE key = ?", bad.key)
        place.execute(f"UPDATE {statement}", *parameters(bad.key, good_record.key, geometry))
        for ids in (["bad"], ["good", "bad"], None):
            with pytest.raises(errors.DataLoss, match="'bad'"):
                store.load_references(OFFICE, ids, EXTRACTOR)
        (good,) = store.load_references(OFFICE, ["good"], EXTRACTOR).references
        assert_same_view(good.view, view_of(make_reference("good", 2)))
        assert read_image(store, OFFICE, "bad") == make_reference("bad", 1).image
        store.delete_reference(OFFICE, "bad")
        assert len(store.load_references(OFFICE, None, EXTRACTOR).references) == 1

    def test_damaged_image_is_not_handed_out(self, store: Store, place: Place) -> None:
        store.create_scene(OFFICE)
        bad, _ = store.add_references(OFFICE, [make_reference("bad"), make_reference("good")])
        place.execute("UPDATE image SET data = ? WHERE reference_key = ?", bytes(5000), bad.key)
        with pytest.raises(errors.DataLoss, match="'bad'"):
            store.read_image_of(bad.key)
        assert read_image(store, OFFICE, "good") == make_reference("good").image

    def test_every_single_bit_flip_is_noticed(self) -> None:
        blob = codec.encode_view(view_of(make_reference("a", count=1)))
        sha256 = codec.sha256_for("owner", blob)
        codec.decode_view("owner", blob, sha256)
        for position in range(0, len(blob), 7):
            flipped = bytearray(blob)
            flipped[position] ^= 1 << position % 8
            with pytest.raises(codec.Damaged):
                codec.decode_view("owner", bytes(flipped), sha256)

    def test_a_later_format_is_not_misread(self) -> None:
        blob = bytearray(codec.encode_view(view_of(make_reference("a", count=1))))
        struct.pack_into("<B", blob, 0, codec.SMALL_VIEW_FORMAT_VERSION + 1)
        with pytest.raises(codec.Damaged, match="format 3"):
            codec.decode_view("owner", bytes(blob), codec.sha256_for("owner", bytes(blob)))
