"""Cost of the search for equal references in a large scene: `python -m research.equal_references [COUNT]`.

All of the scene's poses differ, or all are the same, as of a tracker that had not begun.
"""

import sys
import tempfile
import time
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path
from statistics import median

import numpy as np

from mapless.geometry import Camera, RigidTransform
from mapless_server.method.features.views import Features, View
from mapless_server.security import SceneKey
from mapless_server.store import NewReference, Store

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
BLANK = View(CAMERA, Features(np.empty((0, 2), np.float32), np.empty((0, 8), np.float32), np.empty(0, np.float32)))
SCENE = SceneKey("large")
REPEATS = 30


def reference(number: int, is_same: bool) -> NewReference:
    """A reference without features, a centimetre beside the one before it, or at the same pose."""
    pose = RigidTransform(np.eye(3), np.array([0.0 if is_same else 0.01 * number, 0.0, 0.0]))
    return NewReference(f"r{number:06d}", b"photograph %d" % number, CAMERA, pose, {"none": BLANK}, {})


def searched(store: Store, added: Sequence[NewReference]) -> str:
    """The processor time of a search for those equal to some that are to be added, and how many are found."""
    images = {sha256(it.image).hexdigest() for it in added}
    posed = [(it.camera, it.world_from_camera) for it in added]
    seconds, found = [], 0
    for _ in range(REPEATS):
        begin_s = time.process_time()
        found = len(store.list_alike(SCENE, images, posed))
        seconds.append(time.process_time() - begin_s)
    return f"{1e3 * median(seconds):.2f} ms, {1e3 * median(seconds) / len(added):.2f} each ({found} found)"


def main(count: int = 10_000) -> None:
    """Prints the table."""
    print("| poses | 1 added | 100 added | the first again |\n|---|---|---|---|")
    for is_same in (False, True):
        with tempfile.TemporaryDirectory() as folder, Store.open(Path(folder)) as store:
            store.create_scene(SCENE)
            for begin in range(0, count, 500):
                store.add_references(SCENE, [reference(begin + i, is_same) for i in range(500)])
            new = [reference(count + i, is_same) for i in range(100)]
            row = searched(store, new[:1]), searched(store, new), searched(store, [reference(0, is_same)])
            print(f"| {'the same' if is_same else 'different'} | {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
