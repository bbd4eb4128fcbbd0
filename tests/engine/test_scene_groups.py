"""A query among several scenes: its answer is the one with the scene named, or that two scenes fit."""

import asyncio
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.compare import pose_error
from support.corner import CAMERA, PAPERS, photograph, picture, pose, wallpaper
from support.images import encode

from mapless.geodesy import Datum, geodetic_from_world
from mapless.geometry import Camera, RigidTransform, rotation_from_vector
from mapless_server.engine import choosing
from mapless_server.engine.failures import SceneMadeAnew
from mapless_server.engine.options import EngineOptions
from mapless_server.engine.query import Caller, Photo, Query, Result, SceneQuestion, Tier
from mapless_server.engine.queue_engine import QueueEngine
from mapless_server.engine.references import References
from mapless_server.engine.search import Search
from mapless_server.errors import DataLoss, NotFound
from mapless_server.method.bundle.priors import NO_PRIORS, GravityPrior, PosePrior, PositionPrior, Priors
from mapless_server.method.features.extractors import SiftExtractor
from mapless_server.method.judge.answer import Localization
from mapless_server.method.judge.hypothesis import AS_IT_IS, TRACKED
from mapless_server.method.options import LocalizeOptions
from mapless_server.method.pipeline import Pipeline
from mapless_server.method.rejection import Rejection, RejectionReason
from mapless_server.scenes import Choice, Narrowing
from mapless_server.scheduling import Flow
from mapless_server.security import SceneKey
from mapless_server.serve.assembly import engine_over
from mapless_server.store import NewReference, SceneAttributes, SceneState, Store

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
        priors, camera = named.pop("priors", {}), named.pop("camera", CAMERA)
        assert isinstance(priors, dict)
        assert isinstance(camera, Camera)
        photo = Photo(image, camera, "image")
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
            place = RigidTransform(np.eye(3), np.array([10.0 * i, 0.0, 0.0]))
            found.add(name, papers, place, SceneAttributes(arbitrary_unit=name == FURTHER))
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
    return result.scene_key, str(outcome), numbers, counts, chosen, names, result.generation, result.tier.kind


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


@pytest.fixture
def twin(rooms: Rooms) -> Iterator[Callable[..., SceneKey]]:
    """Makes a scene with the photographs of the first one, in another world."""
    made: list[SceneKey] = []

    def make(place: RigidTransform = ELSEWHERE, attributes: SceneAttributes = SceneAttributes()) -> SceneKey:  # noqa: B008  frozen
        made.append(SceneKey(f"twin-{len(made)}"))
        rooms.add(made[-1], place=place, attributes=attributes)
        return made[-1]

    yield make
    rooms.remove(*made)


@pytest.mark.parametrize("attributes", [SceneAttributes(), SceneAttributes(arbitrary_unit=True)])
def test_two_scenes_with_the_same_photographs_are_ambiguous(
    rooms: Rooms, twin: Callable[..., SceneKey], attributes: SceneAttributes
) -> None:
    other = twin(attributes=attributes)
    found = rooms.ask(photograph(TRUE), HERE, THERE, other)
    rejected = rejection(found)
    assert rejected.reason is RejectionReason.AMBIGUOUS
    assert all(f"{name!r}" in rejected.message for name in (HERE, other))
    at = {it.world: it.world_from_camera for it in rejected.hypotheses}
    assert at.keys() == {HERE, other}
    for world, true in ((HERE, TRUE), (other, ELSEWHERE.compose(TRUE))):
        metres, degrees = pose_error(at[world], true)
        assert (metres < 0.02, degrees < 0.3) == (True, True)
    assert [it.attempted for it in found.scenes] == [True, True, *[False] * (len(found.scenes) - 2)]


def test_priors_decide_between_two_scenes_with_the_same_photographs(
    rooms: Rooms, twin: Callable[..., SceneKey]
) -> None:
    other = twin()
    prior = Priors(position=PositionPrior(TRUE.translation, 0.01 * np.eye(3)))
    found = rooms.ask(photograph(TRUE), HERE, other, priors={HERE: prior, other: prior})
    assert found.scene_key == HERE
    assert isinstance(found.answer.outcome, Localization)


@pytest.mark.parametrize("apart_m", [0.0, 5.0])
def test_scenes_that_agree_on_the_earth_are_one_place(
    rooms: Rooms, twin: Callable[..., SceneKey], apart_m: float
) -> None:
    datum, away_m = Datum(47.0, 8.0, 400.0), np.array([20.0, -3.0, 7.0])
    origin = geodetic_from_world(np.array([apart_m, 0.0, 0.0]) - away_m, datum)
    first = twin(IDENTITY, SceneAttributes(datum))
    at = Datum(origin.latitude_deg, origin.longitude_deg, origin.height_m)
    second = twin(RigidTransform(np.eye(3), away_m), SceneAttributes(at))
    found = rooms.ask(photograph(TRUE), first, second)
    if apart_m:
        assert rejection(found).reason is RejectionReason.AMBIGUOUS
    else:
        assert found.scene_key in (first, second)
        assert content(found) == content(rooms.ask(photograph(TRUE), found.scene_key))


def test_scenes_without_references_are_a_rejection(rooms: Rooms) -> None:
    rooms.store.create_scene(also_empty := SceneKey("also-empty"))
    found = rooms.ask(photograph(TRUE), EMPTY, also_empty)
    assert rejection(found).reason is RejectionReason.NO_USABLE_REFERENCES
    assert (found.scene_key, found.scenes, found.searched_scene_count) == (None, (), 2)


def test_a_scene_that_is_gone_is_left_out(rooms: Rooms) -> None:
    gone = SceneKey("gone")
    found = rooms.ask(photograph(TRUE), gone, HERE, THERE)
    assert content(found) == content(rooms.ask(photograph(TRUE), HERE))
    assert found.searched_scene_count == 2
    with pytest.raises(SceneMadeAnew):
        rooms.ask(photograph(TRUE), gone, SceneKey("gone-too"))


def test_a_scene_deleted_after_it_was_chosen_costs_no_other_answer(
    rooms: Rooms, twin: Callable[..., SceneKey], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The scene that matches best is deleted when its own references are chosen: the other one is answered."""
    prior = Priors(position=PositionPrior(TRUE.translation, 0.01 * np.eye(3)))
    other, shortlisted = twin(IDENTITY), choosing._shortlisted
    first = rooms.ask(photograph(TRUE), HERE, other, priors={HERE: prior, other: prior}).scenes[0].scene_key

    def deleting(search: Search, *arguments: Any) -> Choice:
        if search.query.scene_key == first:
            raise NotFound("deleted", field="scene")
        return shortlisted(search, *arguments)

    monkeypatch.setattr(choosing, "_shortlisted", deleting)
    found = rooms.ask(photograph(TRUE), HERE, other, THERE)
    assert found.scene_key in {HERE, other} - {first}
    assert isinstance(found.answer.outcome, Localization)
    assert [it.outcome for it in found.attempts] == ["failed", "localized"]


@pytest.mark.parametrize("damaged", [HERE, THERE])
def test_damaged_attributes_of_a_scene_cost_no_other_answer(
    rooms: Rooms, damaged: SceneKey, monkeypatch: pytest.MonkeyPatch
) -> None:
    attributes_of = choosing.attributes_of

    def failing(search: Search, scene: SceneState) -> SceneAttributes:
        if search.query.scene_key == damaged:
            raise DataLoss("damaged attributes")
        return attributes_of(search, scene)

    monkeypatch.setattr(choosing, "attributes_of", failing)
    for scene, image in ((it, photograph(TRUE, papers=PAPERS_OF[it])) for it in (HERE, THERE)):
        found = rooms.ask(image, HERE, THERE)
        if scene == damaged:
            assert isinstance(found.answer.outcome, Rejection)
        else:
            assert content(found) == content(rooms.ask(image, scene))


def test_a_scene_that_contradicts_itself_costs_no_other_answer(rooms: Rooms, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(References, "contradiction", lambda _, key: "it does" if key == THERE else "")
    found = rooms.ask(photograph(TRUE), THERE, HERE)
    assert content(found) == content(rooms.ask(photograph(TRUE), HERE))
    assert not found.attributes.contradiction


def pose_prior(at: RigidTransform) -> Priors:
    return Priors(pose=PosePrior(at, np.diag(np.square([0.05] * 3 + [np.radians(1.5)] * 3))))


def test_a_prior_in_a_scene_tracks_in_it_alone(rooms: Rooms) -> None:
    priors = {HERE: pose_prior(TRUE)}
    found = rooms.ask(photograph(TRUE), THERE, HERE, priors=priors, prior_scene=HERE)
    assert found.is_tracked
    assert (found.scenes, found.searched_scene_count) == ((), 1)
    assert content(found) == content(rooms.ask(photograph(TRUE), HERE, priors=priors))


def test_a_prior_in_a_wrong_scene_gives_the_answer_without_it(rooms: Rooms) -> None:
    image = photograph(TRUE, papers=PAPERS_OF[THERE])
    found = rooms.ask(image, HERE, THERE, priors={HERE: pose_prior(TRUE)}, prior_scene=HERE)
    assert [it.rung for it in found.attempts] == [TRACKED, AS_IT_IS]
    assert content(found) == content(rooms.ask(image, THERE))


def test_a_prior_in_a_scene_that_is_gone_gives_the_answer_without_it(rooms: Rooms) -> None:
    gone, image = SceneKey("gone"), photograph(TRUE)
    found = rooms.ask(image, gone, HERE, THERE, priors={gone: pose_prior(TRUE)}, prior_scene=gone)
    assert [it.outcome for it in found.attempts] == ["failed", "localized"]
    assert content(found) == content(rooms.ask(image, HERE))


@pytest.mark.parametrize("scene", [HERE, THERE])
def test_gravity_turns_a_photograph_among_scenes_as_in_one(rooms: Rooms, scene: SceneKey) -> None:
    pixels = np.rot90(picture(TRUE, papers=PAPERS_OF[scene]))
    camera = replace(CAMERA, width_px=CAMERA.height_px, height_px=CAMERA.width_px)
    camera = replace(camera, principal_x_px=CAMERA.principal_y_px, principal_y_px=CAMERA.principal_x_px)
    turn = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    down = np.array([0.0, 1.0, 0.0])
    prior = Priors(gravity=GravityPrior(turn @ TRUE.rotation.T @ down, down, 2.0))
    priors, image = {HERE: prior, THERE: prior}, encode(".png", np.ascontiguousarray(pixels))
    found = rooms.ask(image, HERE, THERE, priors=priors, camera=camera)
    assert isinstance(found.answer.outcome, Localization)
    assert content(found) == content(rooms.ask(image, scene, priors=priors, camera=camera))


def test_scenes_are_chosen_in_a_stage_of_their_own(rooms: Rooms) -> None:
    seconds = rooms.ask(photograph(TRUE), HERE, THERE).stage_seconds
    assert {"decode", "features", "retrieval", "scenes", "shortlist"} <= seconds.keys()
