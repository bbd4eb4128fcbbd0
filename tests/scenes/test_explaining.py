"""Why a stored scene contradicts itself: planted mistakes of its poses are named, and its depth is measured."""

import re
from collections.abc import Callable, Iterator
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from support.posed_views import planted
from support.servers import StandInDescriptor, StandInExtractor

from mapless.geometry import RigidTransform, Similarity, rotation_from_vector
from mapless_server.method.pairs.correspond import Matcher
from mapless_server.scenes.agreement import Agreement
from mapless_server.scenes.explaining import SceneExplainer
from mapless_server.scenes.indexes import SceneIndexes
from mapless_server.scenes.library import ReferenceLibrary
from mapless_server.security import SceneKey
from mapless_server.store import NewReference, Store
from mapless_server.store.pairs import Pair

SCENE = SceneKey("s")
EXTRACTOR, DESCRIPTOR = StandInExtractor(), StandInDescriptor()
VIEWS = planted()
OTHER_WORLD = Similarity(0.5, rotation_from_vector([0.3, 0.8, -0.2]), np.array([3.0, -1.0, 2.0]))
"""The other session's world from the first one's."""

Pose = Callable[[int, RigidTransform], RigidTransform]


class Scene:
    """The planted views as references, with the poses given to them, and their keys in order."""

    def __init__(self, store: Store, pose: Pose) -> None:
        store.create_scene(SCENE)
        added = [
            NewReference(
                f"r{i}",
                b"photograph",
                it.view.camera,
                pose(i, it.world_from_camera),
                {EXTRACTOR.name: it.view},
                {DESCRIPTOR.name: np.eye(16, dtype=np.float32)[i]},
            )
            for i, it in enumerate(VIEWS)
        ]
        self.keys = [it.key for it in store.add_references(SCENE, added)]
        self.pairs: list[Pair] = [self.pair(i, j) for i, j in combinations(range(len(VIEWS)), 2) if j - i <= 3]
        library = ReferenceLibrary(store)
        indexes = SceneIndexes(store, library, DESCRIPTOR, EXTRACTOR, 2**30)
        self.explainer = SceneExplainer(indexes, library, EXTRACTOR, Matcher(), lambda: None)

    def pair(self, i: int, j: int) -> Pair:
        first, second = sorted((self.keys[i], self.keys[j]))
        return first, second


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store.open(tmp_path) as store:
        yield store


def test_a_mistake_of_all_poses_is_named(store: Store) -> None:
    axes = np.diag([1.0, -1.0, -1.0])
    scene = Scene(store, lambda _, it: RigidTransform(it.rotation @ axes, it.translation))
    assert "OpenGL" in scene.explainer.explanation(SCENE, Agreement(), scene.pairs)


def test_a_second_session_is_named_with_its_similarity(store: Store) -> None:
    """The session that was added later is named, though its group is given first."""
    scene = Scene(store, lambda i, it: OTHER_WORLD.transform_pose(it) if i >= 4 else it)
    groups = tuple(scene.keys[4:]), tuple(scene.keys[:4])
    text = scene.explainer.explanation(SCENE, Agreement(groups=groups), scene.pairs)
    assert text.startswith("two sessions, each in a world of its own: that of r4, r5, r6 would fit")
    scale = re.search(r"with scale ([\d.]+)", text)
    assert scale is not None
    assert float(scale.group(1)) == pytest.approx(2.0, rel=0.01)


def test_the_depth_of_what_agreeing_pairs_show_is_measured(store: Store) -> None:
    """The planted box is about 4 m away; references deleted meanwhile are left out."""
    scene = Scene(store, lambda _, it: it)
    assert scene.explainer.median_depth(SCENE, scene.pairs) == pytest.approx(4.0, rel=0.1)
    store.delete_reference(SCENE, "r0")
    assert scene.explainer.median_depth(SCENE, scene.pairs) == pytest.approx(4.0, rel=0.1)
    assert scene.explainer.median_depth(SCENE, []) is None


def test_references_of_one_pose_that_differ_are_named(store: Store) -> None:
    """Four references have one pose; it is wrong if most of their pairs do not agree with it."""
    start, bad, good = VIEWS[0].world_from_camera, 30.0, 0.5
    scene = Scene(store, lambda i, it: start if i < 4 else it)
    together = [scene.pair(i, j) for i, j in combinations(range(4), 2)]
    errors_px = dict.fromkeys(scene.pairs, good) | dict.fromkeys(together, bad)
    (found,) = scene.explainer.same_poses(SCENE, errors_px)
    assert found.keys == frozenset(scene.keys[:4])
    assert "r0" in found.text
    few = {scene.pair(0, 1): bad, scene.pair(2, 3): bad, scene.pair(5, 6): bad}
    assert scene.explainer.same_poses(SCENE, errors_px | dict.fromkeys(together, good) | few) == []
