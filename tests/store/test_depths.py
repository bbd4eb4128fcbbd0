"""Kept depths: what is read is what was kept, to half a per cent; damaged ones and other versions are never used."""

from collections.abc import Iterator

import numpy as np
import pytest
from support.stores import Place, faults_of, let_pass, make_reference

from mapless.geometry import Camera
from mapless_server.method.features.views import KeptDepth
from mapless_server.security import SceneKey
from mapless_server.store import Store, codec, depths, pairs
from mapless_server.store.depths import (
    depth_kind,
    discard_depths,
    keep_depths,
    list_kinds,
    list_without,
    load_depths,
)
from mapless_server.store.pairs import PairStore, Progress, delete_unused, record_use

SCENE = SceneKey("office")
KIND = depth_kind("mapanything", "a" * 64)
OTHER = depth_kind("pi3x", "b" * 64)
CAMERA = Camera(64, 48, 50.0, 51.0, 31.5, 23.5)


@pytest.fixture
def store(place: Place) -> Iterator[Store]:
    with place.open() as opened:
        opened.create_scene(SCENE)
        for seed, name in enumerate("abc"):
            opened.add_references(SCENE, [make_reference(name, seed)])
        yield opened


def key_of(store: Store, name: str) -> str:
    return store.find_keys(SCENE, [name])[name]


def kept(seed: int = 0, near_m: float = 0.5, far_m: float = 40.0) -> KeptDepth:
    """A slanted wall with a step and holes."""
    random = np.random.default_rng(seed)
    depth = np.geomspace(near_m, far_m, CAMERA.width_px)[None].repeat(CAMERA.height_px, 0)
    depth = depth * np.where(random.random(depth.shape) < 0.3, 1.5, 1.0)
    depth[random.random(depth.shape) < 0.2] = np.nan
    return KeptDepth(CAMERA, depth.astype(np.float32), 0.02)


@pytest.mark.parametrize(("near_m", "far_m"), [(0.5, 40.0), (1e-3, 1e-3), (1e-4, 1e6)])
def test_depths_are_read_to_half_a_per_cent(store: Store, near_m: float, far_m: float) -> None:
    key, depth = key_of(store, "a"), kept(0, near_m, far_m)
    keep_depths(store.database, KIND, {key: depth})
    found = load_depths(store.database, [key, key_of(store, "b")], KIND)
    assert list(found.depths) == [key]
    read = found.depths[key]
    assert (read.camera, read.relative_sigma) == (CAMERA, 0.02)
    assert np.array_equal(np.isnan(read.depth), np.isnan(depth.depth))
    assert np.nanmax(np.abs(np.log(read.depth / depth.depth))) <= 0.0051
    assert not read.depth.flags.writeable


@pytest.mark.parametrize("value", [0.0, -1.0])
def test_depths_that_are_not_above_0_are_refused(value: float) -> None:
    depth = np.full((48, 64), value, np.float32)
    with pytest.raises(ValueError, match="above 0"):
        codec.encode_depth(KeptDepth(CAMERA, depth, 0.02))


def test_a_smooth_map_takes_a_seventh_of_a_byte_a_pixel() -> None:
    """A network's map at 518x392 takes 34 KB with noise of 1 %."""
    camera = CAMERA.resized(512, 384)
    row, column = np.indices((384, 512))
    depth = (2.0 + 0.002 * column + 0.001 * row).astype(np.float32)
    assert len(codec.encode_depth(KeptDepth(camera, depth, 0.02))) < 384 * 512 / 7


def test_what_is_kept_first_stays(store: Store) -> None:
    key = key_of(store, "a")
    keep_depths(store.database, KIND, {key: kept(0)})
    keep_depths(store.database, KIND, {key: kept(1), "no such reference": kept(2)})
    expected = codec.decode_depth("", *_encoded(kept(0))).depth
    assert np.array_equal(load_depths(store.database, [key]).depths[key].depth, expected, equal_nan=True)


def _encoded(depth: KeptDepth) -> tuple[bytes, str]:
    data = codec.encode_depth(depth)
    return data, codec.sha256_for("", data)


@pytest.mark.parametrize(
    "damage",
    ["data = ?", "sha256 = 'no'", "data = substr(data, 1, length(data) - 3)"],
)
def test_damaged_ones_are_not_used_and_claimed_again(store: Store, place: Place, damage: str) -> None:
    key, claims, progress = key_of(store, "a"), PairStore(store.database), Progress()
    while claim := claims.claim(KIND, progress):
        claims.add(KIND, claim, {}, is_complete=True)
    keep_depths(store.database, KIND, {key: kept()})
    parameters = [b"\1\2\3"] if "?" in damage else []
    place.execute(f"UPDATE reference_depth SET {damage}", *parameters)
    found = load_depths(store.database, [key], KIND)
    assert found.depths == {}
    assert found.damaged == {(KIND, key)}
    discard_depths(store.database, found.damaged)
    assert list_without(store.database, KIND, [key]) == [key]
    claim = claims.claim(KIND, progress)
    assert claim is not None
    assert claim.key == key
    assert faults_of(place) == ()


def test_bytes_of_another_reference_or_kind_do_not_pass(store: Store, place: Place) -> None:
    first, second = key_of(store, "a"), key_of(store, "b")
    keep_depths(store.database, KIND, {first: kept()})
    place.execute("UPDATE reference_depth SET reference_key = ?", second)
    assert load_depths(store.database, [first, second], KIND).damaged == {(KIND, second)}


def test_depths_of_another_version_are_not_found(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    key = key_of(store, "a")
    keep_depths(store.database, KIND, {key: kept()})
    monkeypatch.setattr(depths, "_OF_VERSION", "depth-2/")
    later = depth_kind("mapanything", "a" * 64)
    assert load_depths(store.database, [key]).depths == {}
    assert load_depths(store.database, [key], later).depths == {}
    assert list_kinds(store.database) == []
    assert list_without(store.database, later, [key]) == [key]


def test_a_server_that_makes_none_uses_any_kind_of_its_version(store: Store, place: Place) -> None:
    key = key_of(store, "a")
    keep_depths(store.database, OTHER, {key: kept(1)})
    keep_depths(store.database, KIND, {key: kept(0)})
    assert list_kinds(store.database) == [KIND, OTHER]
    first = load_depths(store.database, [key]).depths[key].depth
    assert np.array_equal(first, load_depths(store.database, [key], KIND).depths[key].depth, equal_nan=True)
    place.execute("UPDATE reference_depth SET sha256 = 'no' WHERE kind = ?", KIND)
    found = load_depths(store.database, [key])
    assert found.damaged == {(KIND, key)}
    second = load_depths(store.database, [key], OTHER).depths[key].depth
    assert np.array_equal(found.depths[key].depth, second, equal_nan=True)


def test_those_without_use_are_deleted(store: Store, place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also of a reference that no server has claimed."""
    keep_depths(store.database, OTHER, {key_of(store, name): kept() for name in "ab"})
    claims = PairStore(store.database)
    claim = claims.claim(OTHER, Progress())
    assert claim is not None
    claims.add(OTHER, claim, {}, is_complete=True)
    record_use(store.database, [OTHER])
    let_pass(monkeypatch, pairs.KEPT_S + 1)
    keep_depths(store.database, KIND, {key_of(store, "c"): kept()})
    record_use(store.database, [KIND])
    delete_unused(store.database, lambda: None)
    assert place.fetch("SELECT kind FROM reference_depth") == [(KIND,)]
