"""A server killed at any moment loses nothing it acknowledged and leaves nothing half-written.

Run as a program, this file is the victim: it changes a store as fast as it can and prints a line for each change before
(``try``) and after (``done``) it is made.
"""

from __future__ import annotations

import random
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from mapless.geometry import Camera, RigidTransform
from mapless_server.method.views import Features, View
from mapless_server.store import NewReference, Store
from mapless_server.store.sqlite import DATABASE_FILE, choose_library
from mapless_server.tenancy import SceneKey

ROUNDS = 15
LIMIT_S = 30.0
SCENE = SceneKey("office")
EXTRACTOR = "sift"
CAMERA = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)


def make_reference(reference_id: str) -> NewReference:
    """A reference of about 200 kB, all of it determined by its id."""
    generator = np.random.default_rng(list(reference_id.encode()))
    features = Features(
        generator.random((200, 2), np.float32),
        generator.random((200, 128), np.float32),
        generator.random(200, np.float32),
    )
    pose = RigidTransform(np.eye(3), generator.normal(size=3))
    return NewReference(reference_id, generator.bytes(100_000), CAMERA, pose, {EXTRACTOR: View(CAMERA, features)})


def change_until_killed(data_dir: Path, prefix: str) -> None:
    """Adds one to three references at a time; every fourth change deletes the first of those just added."""
    with Store.open(data_dir) as store:
        added: list[str] = []
        for index in range(100_000):
            if index % 4 == 3:
                verb, ids = "delete", added[:1]
            else:
                verb, ids = "add", [f"{prefix}-{index}-{item}" for item in range(index % 3 + 1)]
            change = " ".join([verb, *ids])
            print("try", change, flush=True)
            if verb == "add":
                store.add_references(SCENE, [make_reference(it) for it in ids])
                added = ids
            else:
                store.delete_reference(SCENE, ids[0])
            print("done", change, flush=True)


def kill_at(data_dir: Path, prefix: str, change_count: int, delay_s: float) -> list[str]:
    """Lines of a victim that was killed some time after its n-th acknowledged change."""
    command = [sys.executable, __file__, str(data_dir), prefix]
    lines: list[str] = []
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as victim:
        assert victim.stdout is not None
        try:
            for line in victim.stdout:
                lines.append(line)
                if sum(it.startswith("done") for it in lines) >= change_count:
                    break
            time.sleep(delay_s)
        finally:
            victim.kill()
        lines += victim.stdout.readlines()
    assert victim.returncode == -9, "the victim ended by itself"
    return [line.strip() for line in lines if line.endswith("\n")]


def apply(stored: set[str], change: str) -> set[str]:
    verb, *ids = change.split()
    return stored | set(ids) if verb == "add" else stored - set(ids)


def assert_whole(store: Store, data_dir: Path, expected: set[str]) -> None:
    """Every reference is there with all its parts, and no part is there without its reference."""
    snapshot = store.load_references(SCENE, None, EXTRACTOR)
    assert {it.record.reference_id for it in snapshot.references} == expected
    assert not snapshot.undescribed
    for loaded in snapshot.references:
        reference_id = loaded.record.reference_id
        made = make_reference(reference_id)
        features, expected_features = loaded.view.features, made.views[EXTRACTOR].features
        assert store.read_image(SCENE, reference_id) == made.image
        assert features.keypoints.tobytes() == expected_features.keypoints.tobytes()
        assert features.descriptors.tobytes() == expected_features.descriptors.tobytes()
        assert loaded.record.world_from_camera.translation.tobytes() == made.world_from_camera.translation.tobytes()
    connection = choose_library().connect(data_dir / DATABASE_FILE)
    try:
        for table in ("reference", "image", "features"):
            assert connection.execute(f"SELECT count(*) FROM {table}").fetchone() == (len(expected),), table
        assert connection.execute("PRAGMA foreign_key_check").fetchall() == []
        assert connection.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
    finally:
        connection.close()


def test_killed_at_random_moments(tmp_path: Path) -> None:
    moments = random.Random(20)
    stored: set[str] = set()
    acknowledged_count = 0
    started = time.monotonic()
    with Store.open(tmp_path) as store:
        store.create_scene(SCENE)
    for number in range(ROUNDS):
        if time.monotonic() - started > LIMIT_S and number >= 5:
            break
        lines = kill_at(tmp_path, f"round{number}", moments.randint(0, 8), moments.uniform(0, 0.02))
        changes = [line.removeprefix("done ") for line in lines if line.startswith("done ")]
        acknowledged_count += len(changes)
        for change in changes:
            stored = apply(stored, change)
        with Store.open(tmp_path) as store:
            found = {it.reference_id for it in store.list_references(SCENE, 10_000)}
            # The change that was under way is there as a whole or not at all.
            if found != stored and lines and lines[-1].startswith("try "):
                stored = apply(stored, lines[-1].removeprefix("try "))
            assert_whole(store, tmp_path, stored)
            assert store.get_scene(SCENE).generation >= 1 + acknowledged_count
    assert acknowledged_count > 0


if __name__ == "__main__":
    change_until_killed(Path(sys.argv[1]), sys.argv[2])
