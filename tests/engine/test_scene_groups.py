"""A query among several scenes: its answer is the one with the scene named, or that two scenes fit."""

import asyncio
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from support.corner import CAMERA, PAPERS, photograph, pose, wallpaper

from mapless.geometry import RigidTransform, rotation_from_vector
from mapless_server.engine.options import EngineOptions
from mapless_server.engine.query import Caller, Photo, Query, Result, SceneQuestion, Tier
from mapless_server.engine.queue_engine import QueueEngine
from mapless_server.method.bundle.priors import NO_PRIORS
from mapless_server.method.features.extractors import SiftExtractor
from mapless_server.method.judge.answer import Localization
from mapless_server.method.options import LocalizeOptions
from mapless_server.method.pipeline import Pipeline
from mapless_server.method.rejection import Rejection
from mapless_server.scenes import Narrowing
from mapless_server.scheduling import Flow
from mapless_server.security import SceneKey
from mapless_server.serve.assembly import engine_over
from mapless_server.store import NewReference, SceneAttributes, Store

TRUE, IDENTITY = pose(2.0, -1.5), RigidTransform(np.eye(3), np.zeros(3))
POSES = [pose(angle, height) for angle in (-15, -5, 5, 15) for height in (-1.8, -1.2)]
ELSEWHERE = RigidTransform(rotation_from_vector([0.1, 0.4, -0.2]), np.array([20.0, -3.0, 7.0]))
"""The pose of a corner in the world of another scene."""
NAMES = HERE, THERE, FURTHER, EMPTY = [SceneKey(it) for it in ("here", "there", "further", "empty")]
PAPERS_OF = {
    HERE: PAPERS,
    THERE: tuple(wallpaper(seed) for seed in range(10, 13)),
    FURTHER: (PAPERS[0], *(wallpaper(seed) for seed in (20, 21))),
}
"""The walls of each scene: one of those of the last is one of the first's."""


@dataclass
class Rooms:
    """An engine, its store, and how it is asked."""

    store: Store
    engine: QueueEngine
    loop: asyncio.AbstractEventLoop

    def add(
        self,
        scene: SceneKey,
        papers: Sequence[np.ndarray] = PAPERS,
        place: RigidTransform = IDENTITY,
        attributes: SceneAttributes = SceneAttributes(),  # noqa: B008  frozen
        poses: Sequence[RigidTransform] = POSES,
    ) -> None:
        """A scene with photographs of a corner that is at this pose in its world."""
        photos = [Photo(photograph(it, papers=papers), CAMERA, "image") for it in poses]
        described = self.loop.run_until_complete(self.engine.describe(photos, caller()))
        self.store.create_scene(scene, attributes)
        shown = zip(photos, poses, described, strict=True)
        references = [
            NewReference(f"r{i}", photo.image, CAMERA, place.compose(at), found.views, found.descriptors)
            for i, (photo, at, found) in enumerate(shown)
        ]
        self.store.add_references(scene, references)

    def remove(self, *scenes: SceneKey) -> None:
        for it in scenes:
            self.store.delete_scene(it)
            self.engine.forget_scene(it)

    def ask(self, image: bytes, *scenes: SceneKey, **named: object) -> Result:
        """Localizes a photograph in one scene, or among several; `priors` and `narrowing` are of the first one."""
        priors = named.pop("priors", {})
        assert isinstance(priors, dict)
        photo = Photo(image, CAMERA, "image")
        questions = [
            SceneQuestion(it, Narrowing.of(priors.get(it, NO_PRIORS)), priors.get(it, NO_PRIORS)) for it in scenes
        ]
        query = Query(scenes[0], (), photo, Narrowing(), 10, LocalizeOptions(), **named)  # type: ignore[arg-type]
        query = query.in_scene(questions[0]) if len(scenes) == 1 else replace(query, scenes=questions)
        return self.loop.run_until_complete(self.engine.run(self.engine.query_job(query, caller())))


def caller() -> Caller:
    return Caller(Flow("tenant", "client"), time.monotonic() + 600)


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rooms]:
    folder: Path = tmp_path_factory.mktemp("store")
    loop = asyncio.new_event_loop()
    with Store.open(folder) as store:
        engine = engine_over(store, [Tier(SiftExtractor(), Pipeline())], EngineOptions())
        found = Rooms(store, engine, loop)
        for i, (name, papers) in enumerate(PAPERS_OF.items()):
            found.add(name, papers, RigidTransform(np.eye(3), np.array([10.0 * i, 0.0, 0.0])))
        store.create_scene(EMPTY)
        yield found
        loop.run_until_complete(engine.close())
    loop.close()


def content(result: Result) -> tuple[object, ...]:
    """All of an answer but its times, and what is said of scenes."""
    outcome = result.answer.outcome
    numbers: list[bytes] = []
    if isinstance(outcome, Localization):
        assert outcome.covariance is not None
        numbers = [outcome.world_from_camera.matrix().tobytes(), outcome.covariance.tobytes()]
        outcome = replace(outcome, world_from_camera=IDENTITY, covariance=None)
    else:
        outcome = replace(outcome, hypotheses=(), imprecise=None)
    counts = result.answer.reference_match_counts, result.answer.reference_inlier_counts
    choice = result.choice
    assert choice is not None
    chosen = [(it.reference_id, it.similarity) for it in choice.references]
    names = [it.name for it in result.references]
    return result.scene_key, str(outcome), numbers, counts, chosen, names, result.generation, result.tier


def rejection(result: Result) -> Rejection:
    assert isinstance(result.answer.outcome, Rejection)
    return result.answer.outcome


@pytest.mark.parametrize("scene", PAPERS_OF)
@pytest.mark.parametrize("order", [1, -1])
def test_the_answer_among_scenes_is_the_one_with_it_named(rooms: Rooms, scene: SceneKey, order: int) -> None:
    image = photograph(TRUE, papers=PAPERS_OF[scene])
    among = rooms.ask(image, *NAMES[::order])
    assert isinstance(among.answer.outcome, Localization)
    assert content(among) == content(rooms.ask(image, scene))
    assert among.searched_scene_count == len(NAMES)
    assert (among.scenes[0].scene_key, among.scenes[0].attempted) == (scene, True)


def test_a_photograph_of_no_scene_gets_no_pose(rooms: Rooms) -> None:
    image = photograph(TRUE, papers=[wallpaper(seed) for seed in range(30, 33)])
    found = rooms.ask(image, *NAMES)
    assert isinstance(found.answer.outcome, Rejection)
    assert found.scene_key == found.scenes[0].scene_key
