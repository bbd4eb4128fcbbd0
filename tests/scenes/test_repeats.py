"""References that repeat a pose or a photograph are named at once, by what is stored of them."""

from datetime import datetime, timezone

import numpy as np
from support.scenes import CAMERA

from mapless.geometry import RigidTransform
from mapless_server.method.pairs.readings.repeats import is_start
from mapless_server.scenes.repeats import PosedImage, repeats
from mapless_server.security import SceneKey
from mapless_server.store import ReferenceRecord
from mapless_server.store.reader import ALIKE_MOST


def moved(x: float) -> RigidTransform:
    return RigidTransform(np.eye(3), np.array([x, 0.0, 0.0]))


def stored(name: str, image: str, pose: RigidTransform) -> ReferenceRecord:
    time = datetime(2026, 1, 1, tzinfo=timezone.utc)
    return ReferenceRecord(
        scene_key=SceneKey("s"),
        reference_id=name,
        key=name,
        camera=CAMERA,
        world_from_camera=pose,
        image_sha256=image,
        feature_count=1,
        create_time=time,
    )


def test_one_photograph_with_two_poses_is_said_once() -> None:
    there = [stored("a", "1", moved(0)), stored("b", "2", moved(1))]
    (text,) = repeats([PosedImage("c", "1", moved(3)), PosedImage("d", "2", moved(1.0005))], there)
    assert text == "c is the same photograph as a, but its pose is 3 m and 0 degrees away: one of them is wrong"
    (text,) = repeats([PosedImage("c", "3", moved(3)), PosedImage("d", "3", moved(5))], [])
    assert text.startswith("d is the same photograph as c")


def test_exactly_the_same_pose_of_other_photographs_is_said() -> None:
    start = RigidTransform.identity()
    there = [stored("a", "1", start), stored("b", "2", start)]
    (text,) = repeats([PosedImage("c", "3", start)], there)
    assert text.startswith("3 references with different photographs have exactly the same pose (a, b, c): the identity")
    (text,) = repeats([PosedImage("c", "3", moved(2)), PosedImage("d", "4", moved(2))], there)
    assert "(c, d): unless the camera stood still" in text
    assert repeats([PosedImage("c", "1", start)], there[:1]) == []
    assert repeats([PosedImage("c", "3", moved(2))], there) == []
    assert is_start(RigidTransform(np.diag([1.0, -1.0, -1.0]), np.zeros(3)))


def test_many_sentences_are_cut() -> None:
    added = [PosedImage(f"c{i}", "1", moved(i)) for i in range(1, 9)]
    texts = repeats(added, [stored("a", "1", moved(0))])
    assert len(texts) == 6
    assert texts[-1] == "so are 3 more"


def test_the_number_of_many_equal_poses_is_a_least_one() -> None:
    """The store reads no more of them."""
    there = [stored(f"a{i}", f"{i}", moved(0)) for i in range(ALIKE_MOST)]
    (text,) = repeats([PosedImage("c", "c", moved(0))], there)
    assert text.startswith(f"at least {ALIKE_MOST + 1} references")
    (text,) = repeats([PosedImage("c", "c", moved(0))], there[1:])
    assert text.startswith(f"{ALIKE_MOST} references")
