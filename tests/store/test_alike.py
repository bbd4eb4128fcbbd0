"""References with a photograph, or a camera and pose, are found however many a scene has, and few are read."""

import hashlib
from collections.abc import Iterator
from dataclasses import replace
from unittest.mock import Mock

import pytest
from sqlalchemy import text
from support.stores import Folder, Place, make_reference

from mapless_server.security import SceneKey
from mapless_server.store import Store, codec
from mapless_server.store.alike import find_alike
from mapless_server.store.reader import ALIKE_MOST

SCENE = SceneKey("hall")
MANY = 40
FIRST, NEW = make_reference("first", 1), make_reference("new", 2)
ELSEWHERE = make_reference("elsewhere", 3)


def sha256(image: bytes) -> str:
    return hashlib.sha256(image).hexdigest()


@pytest.fixture
def store(place: Place) -> Iterator[Store]:
    """With a first reference, MANY others of which no two are alike, and MANY with one camera and pose."""
    with place.open() as store:
        for scene in (SCENE, SceneKey("other")):
            store.create_scene(scene)
        store.add_references(SCENE, [FIRST])
        store.add_references(SCENE, [make_reference(f"r{i}", 10 + i) for i in range(MANY)])
        still = [replace(ELSEWHERE, reference_id=f"s{i}", image=b"still %d" % i) for i in range(MANY)]
        store.add_references(SCENE, still)
        store.add_references(SceneKey("other"), [NEW])
        yield store


def test_alike_references_are_found_however_old(store: Store) -> None:
    place_of_new = (NEW.camera, NEW.world_from_camera)

    def found(image: bytes, *posed: tuple[object, object]) -> list[str]:
        return [it.reference_id for it in store.list_alike(SCENE, {sha256(image)}, posed)]  # type: ignore[arg-type]

    assert found(NEW.image, place_of_new) == []
    assert found(FIRST.image, place_of_new) == ["first"]
    assert found(NEW.image, (FIRST.camera, FIRST.world_from_camera)) == ["first"]
    assert found(b"still 3", (FIRST.camera, FIRST.world_from_camera)) == ["first", "s3"]
    assert found(NEW.image, (NEW.camera, FIRST.world_from_camera)) == []


def test_of_many_alike_references_few_are_read(store: Store) -> None:
    posed = [(ELSEWHERE.camera, ELSEWHERE.world_from_camera), (FIRST.camera, FIRST.world_from_camera)]
    found = [it.reference_id for it in store.list_alike(SCENE, (), posed)]
    assert len(found) == ALIKE_MOST + 1
    assert "first" in found


@pytest.mark.parametrize(("count", "statements"), [(0, 0), (1, 1), (9, 1), (64, 1), (100, 2)])
def test_many_values_are_searched_for_in_few_statements(store: Store, count: int, statements: int) -> None:
    """Each with a limit of its own, whichever way the last statement is filled."""
    posed = [make_reference("", 10 + i) for i in range(MANY)]
    values = [codec.encode_geometry(it.camera, it.world_from_camera) for it in posed]
    values += [b"unknown %d" % i for i in range(100 - MANY)]
    with store.database.read() as connection:
        counting = Mock(wraps=connection)
        found = {it.reference_id for it in find_alike(counting, SCENE, "geometry", values[:count], ALIKE_MOST)}
    assert found == {f"r{i}" for i in range(min(count, MANY))}
    assert counting.execute.call_count == statements


def test_alike_references_are_found_by_an_index(place: Place) -> None:
    if not isinstance(place, Folder):
        pytest.skip("PostgreSQL plans by what the table holds")
    with place.open() as store, store.database.read() as connection:
        for column in ("image_sha256", "geometry"):
            plan = text(f"EXPLAIN QUERY PLAN SELECT * FROM reference WHERE scene_id = 's' AND {column} = 'v' LIMIT 1")
            assert f"({column}=?)" in str(connection.execute(plan).all()).replace("scene_id=? AND ", "")
