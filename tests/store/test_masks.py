"""Masks in the store: kept byte for byte, and their damage is named."""

from dataclasses import replace
from pathlib import Path

import pytest
from support.stores import Folder, Place, faults_of, make_reference

from mapless_server.errors import DataLoss
from mapless_server.security import SceneKey
from mapless_server.store import Store

SCENE = SceneKey("office")
MASK = bytes(range(256)) * 40


def filled(store: Store) -> dict[str, str]:
    """Keys by id of two references, the first of which has a mask."""
    store.create_scene(SCENE)
    masked, plain = replace(make_reference("masked", 1), mask=MASK), make_reference("plain", 2)
    return {it.reference_id: it.key for it in store.add_references(SCENE, [masked, plain])}


def test_a_mask_comes_back_and_goes_with_its_reference(place: Place) -> None:
    with place.open() as store:
        keys = filled(store)
        assert store.read_mask_of(keys["masked"]) == MASK
        assert store.read_mask_of(keys["plain"]) == b""
        assert [len(it.mask_sha256) for it in store.list_references(SCENE, 10)] == [64, 0]
        store.delete_reference(SCENE, "masked")
        assert place.fetch("SELECT count(*) FROM mask") == [(0,)]


@pytest.mark.parametrize("statement", ["UPDATE mask SET data = 'x'", "DELETE FROM mask"])
def test_a_damaged_or_lost_mask_is_named(tmp_path: Path, statement: str) -> None:
    folder = Folder(tmp_path)
    with folder.open() as store:
        key = filled(store)["masked"]
    folder.execute(statement)
    assert faults_of(folder) == ("tenant 'default', scene 'office', reference 'masked': mask",)
    with folder.open() as store, pytest.raises(DataLoss, match=r"'masked' is damaged in the store \(mask\)"):
        store.read_mask_of(key)
