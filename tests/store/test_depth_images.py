"""Measured depth in the store: kept bit by bit, compressed, and its damage is named."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.stores import Folder, Place, faults_of, make_reference

from mapless import Camera, DepthImage, DepthNoise, DepthSensor, RigidTransform
from mapless.geometry import rotation_from_vector
from mapless_server.errors import DataLoss
from mapless_server.security import SceneKey
from mapless_server.store import Store
from mapless_server.store.depth_images import encode_depth_image

SCENE = SceneKey("office")
PNG = DepthImage(
    bytes(range(256)),
    0.0002,
    None,
    DepthSensor.STEREO,
    Camera(640, 480, 585.0, 585.0, 320.0, 240.0),
    RigidTransform(rotation_from_vector([0.1, 0.2, 0.3]), np.array([0.01, 0.0, 0.002])),
    bytes(range(100)),
    3,
    DepthNoise(0.001, 0.002, 0.003, 0.004),
)
METRES = DepthImage.of_metres(np.linspace(1, 2, 640 * 480, dtype=np.float32).reshape(480, 640), DepthSensor.RENDERED)


def filled(store: Store) -> dict[str, str]:
    """Keys by id of references with depth of both kinds, and of one without."""
    store.create_scene(SCENE)
    made = {"png": PNG, "metres": METRES, "plain": None}
    new = [replace(make_reference(name, i), depth=depth) for i, (name, depth) in enumerate(made.items(), 1)]
    return {it.reference_id: it.key for it in store.add_references(SCENE, new)}


def test_a_depth_comes_back_and_goes_with_its_reference(place: Place) -> None:
    with place.open() as store:
        keys = filled(store)
        for name, depth in {"png": PNG, "metres": METRES}.items():
            found = store.read_depth_of(keys[name])
            assert vars(found) | {"camera_from_depth_camera": None} == vars(depth) | {"camera_from_depth_camera": None}
            assert found.sha256 == depth.sha256
        hashes = {it.reference_id: it.depth_sha256 for it in store.list_references(SCENE, 10)}
        assert hashes == {"metres": METRES.sha256, "plain": "", "png": PNG.sha256}
        for name in ("png", "metres"):
            store.delete_reference(SCENE, name)
        assert place.fetch("SELECT count(*) FROM depth") == [(0,)]


def test_float32_values_are_compressed() -> None:
    assert len(encode_depth_image(METRES)) < 0.6 * len(METRES.data)


@pytest.mark.parametrize("statement", ["UPDATE depth SET data = 'x'", "DELETE FROM depth"])
def test_a_damaged_or_lost_depth_is_named(tmp_path: Path, statement: str) -> None:
    folder = Folder(tmp_path)
    with folder.open() as store:
        key = filled(store)["png"]
    folder.execute(f"{statement} WHERE reference_key = '{key}'")
    assert faults_of(folder) == ("tenant 'default', scene 'office', reference 'png': depth",)
    with folder.open() as store, pytest.raises(DataLoss, match=r"'png' is damaged in the store \(depth\)"):
        store.read_depth_of(key)
