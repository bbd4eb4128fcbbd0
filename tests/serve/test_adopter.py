"""Photographs of the demo's room become references of a scene with half of its survey, by a server of its own."""

import asyncio
from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone
from functools import partial

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from support.servers import listening

from mapless import AdoptionPolicy, Client, IntrinsicsUncertainty, NewReference, Rejected, RigImage, SequenceFrame
from mapless.geometry import Camera
from mapless.lenses import RadialTangential
from mapless_server.engine.query import Photo
from mapless_server.engine.queue_engine import QueueEngine
from mapless_server.errors import DataLoss
from mapless_server.method.bundle.priors import IntrinsicsSigma
from mapless_server.scenes.adoption.policy import AdoptionOptions, Refusal
from mapless_server.security import SceneKey
from mapless_server.serve.adoption import adopter as module
from mapless_server.serve.adoption import waiting
from mapless_server.serve.adoption.adopter import Adopter
from mapless_server.serve.adoption.waiting import Candidate
from mapless_server.serve.opening import make_engine
from mapless_server.settings import Settings
from mapless_server.store import NewReference as Described
from mapless_server.store import RetirementReason, Store, adoption
from mapless_tools.demo.photographs import Photograph, Place
from mapless_tools.demo.photographs import room as demo_room
from mapless_tools.evaluate.metrics import pose_error

POLICY = AdoptionPolicy(most_per_place=1, min_trust=0.3, max_radius_m=0.05)
ROOM = SceneKey("room")


@dataclass
class Held:
    """A server whose adopter considers nothing by itself."""

    client: Client
    store: Store
    place: Place
    engine: QueueEngine
    adopter: Adopter
    loop: asyncio.AbstractEventLoop

    def candidate(self, photograph: Photograph) -> Candidate:
        """A photograph that was answered, as it waits to be considered."""
        answer = self.client.localize(photograph.data, photograph.camera, "room", allow_adoption=True)
        assert not isinstance(answer, Rejected)
        return self.taken()

    def taken(self) -> Candidate:
        """The photograph that has waited longest to be considered."""
        candidate = self.adopter.take()
        assert candidate is not None
        return candidate

    def consider(self, candidate: Candidate) -> Refusal | None:
        return asyncio.run_coroutine_threadsafe(self.adopter.consider(candidate), self.loop).result(120)

    def maintain(self) -> None:
        asyncio.run_coroutine_threadsafe(self.adopter.maintain(), self.loop).result(60)

    def outdated(self) -> dict[str, str]:
        with self.store.database.read() as connection:
            return adoption.list_outdated(connection, ROOM)

    @property
    def adopted(self) -> list[str]:
        return [it.reference_id for it in self.client.list_references("room", only_adopted=True)]


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Held]:
    data_dir, started = tmp_path_factory.mktemp("data"), Future[tuple[Adopter, asyncio.AbstractEventLoop]]()

    async def run(self: Adopter) -> None:
        started.set_result((self, asyncio.get_running_loop()))

    settings = Settings(host="127.0.0.1", port=0, data_dir=data_dir, metrics=False, warm_up=False, features="sift")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module.Adopter, "run", run)
        store = Store.open(data_dir)
        with listening(settings, store, make_engine) as (running, _), Client(running.address) as client:
            yield Held(client, store, demo_room(), running.engine, *started.result(60))


@pytest.fixture(scope="module")
def survey(server: Held) -> list[Described]:
    """Every second reference of the room, with its features."""
    photographs = server.place.references[::2]
    describe = server.engine.references.describe
    both = ((it, describe(Photo(it.data, it.camera, "image"), lambda: None)) for it in photographs)
    return [Described(it.name, it.data, it.camera, it.world_from_camera, of.views, of.descriptors) for it, of in both]


@pytest.fixture
def held(server: Held, survey: list[Described]) -> Iterator[Held]:
    """The server with the survey."""
    server.client.create_scene("room", adoption=POLICY)
    server.store.add_references(ROOM, survey)
    yield server
    server.client.delete_scene("room")


def test_a_certain_photograph_with_something_new_is_adopted(held: Held) -> None:
    query = held.place.queries[0]
    candidate = held.candidate(query)
    assert held.consider(candidate) is None
    (found,) = held.client.list_references("room", only_adopted=True)
    kept = held.client.get_reference("room", found.reference_id, include_image=True)
    assert kept.image == query.data
    assert kept.camera == query.camera
    error_m, _ = pose_error(query.world_from_camera, kept.world_from_camera)
    assert kept.provenance.accuracy is not None
    assert error_m <= kept.provenance.accuracy.position_95_m
    surveyed = {it.name for it in held.place.references[::2]}
    assert {it.reference_id for it in kept.provenance.vouchers} <= surveyed
    assert held.consider(candidate) in (Refusal.CHANGED, Refusal.NOTHING_NEW)  # as of another server
    assert len(held.adopted) == 1


def test_its_pose_never_rests_on_adopted_references(held: Held) -> None:
    first, second = held.place.queries[4], held.place.queries[5]
    assert held.consider(held.candidate(first)) is None
    held.consider(held.candidate(second))
    adopted = set(held.adopted)
    for it in held.client.list_references("room", only_adopted=True):
        assert not adopted & {voucher.reference_id for voucher in it.provenance.vouchers}


def test_adoption_switched_off_in_the_middle_keeps_nothing(held: Held, monkeypatch: pytest.MonkeyPatch) -> None:
    candidate = held.candidate(held.place.queries[0])
    adopt = adoption.adopt

    def late(store: Store, *asked: object) -> object:
        store.update_scene(ROOM, adoption=None)
        return adopt(store, *asked)  # type: ignore[arg-type]

    monkeypatch.setattr(adoption, "adopt", late)
    assert held.consider(candidate) is Refusal.CHANGED
    assert held.consider(candidate) is Refusal.CHANGED  # it is off before, too
    assert held.adopted == []


def test_a_moved_thing_takes_no_other_place_along(held: Held) -> None:
    """Most of the photograph is of one place, and the rest of another, as with a poster that was carried there."""
    here, there = held.place.queries[1], held.place.queries[6]
    both = [_pixels(it) for it in (here, there)]
    width = both[0].shape[1]
    forged = np.concatenate([both[0][:, : width * 6 // 10], both[1][:, width * 6 // 10 :]], axis=1)
    _, jpeg = cv2.imencode(".jpg", forged, [cv2.IMWRITE_JPEG_QUALITY, 95])
    candidate = held.candidate(replace(here, data=jpeg.tobytes()))
    assert held.consider(candidate) is Refusal.ELSEWHERE
    assert held.adopted == []


def test_half_of_a_photograph_moved_a_little_is_seen(held: Held) -> None:
    """By 24 pixels, as where a printed wall hangs beside itself: what does not fit localizes nothing by itself."""
    here = held.place.queries[1]
    pixels = _pixels(here)
    pixels[:, pixels.shape[1] // 2 :] = np.roll(pixels, 24, axis=1)[:, pixels.shape[1] // 2 :]
    _, jpeg = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 95])
    candidate = held.candidate(replace(here, data=jpeg.tobytes()))
    held.adopter._options = AdoptionOptions(min_novelty=0.0)
    try:
        assert held.consider(candidate) is Refusal.ELSEWHERE
    finally:
        held.adopter._options = None


def test_the_least_useful_of_a_full_place_goes_first(held: Held) -> None:
    candidate = held.candidate(held.place.queries[0])
    assert held.consider(candidate) is None
    (first,) = held.adopted
    noisy = _noisy(held.place.queries[0])
    again = held.candidate(noisy)
    options = replace(AdoptionOptions(), min_novelty=0.0)
    held.adopter._options = options
    try:
        assert held.consider(again) is Refusal.PLACE_FULL
        (only,) = adoption.list_adopted(held.store.database, ROOM)
        adoption.set_usefulness(held.store.database, {only.key: 0.0})
        held.adopter._options = replace(options, remembered=10**6)
        assert held.consider(again) is None
    finally:
        held.adopter._options = None
    assert len(held.adopted) == 1
    assert held.adopted != [first]


def _noise() -> bytes:
    """A photograph of nothing."""
    image = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (720, 960, 3), np.uint8), (0, 0), 3)
    _, jpeg = cv2.imencode(".jpg", cv2.normalize(image, np.empty_like(image), 0, 255, cv2.NORM_MINMAX))
    return jpeg.tobytes()


def test_a_flood_by_one_token_makes_nothing_useless(held: Held) -> None:
    """Photographs of the place that show nothing of the adopted one, on one day."""
    query = held.place.queries[0]
    candidate = held.candidate(query)
    assert held.consider(candidate) is None
    (only,) = adoption.list_adopted(held.store.database, ROOM)
    adoption.set_usefulness(held.store.database, {only.key: 0.8})
    without = {name: it for name, it in candidate.answered.inliers_of.items() if name != only.reference_id}
    foreign = replace(candidate, answered=replace(candidate.answered, inliers_of=without), holder="robot")
    for _ in range(3):
        held.consider(foreign)
    (only,) = adoption.list_adopted(held.store.database, ROOM)
    assert only.usefulness == pytest.approx(0.8 * 0.9)


def _learned(held: Held, candidate: Candidate, share: float, day: int) -> None:
    """Counts what a photograph says of its place on a day, where the survey alone explains so much of it."""
    options, now = AdoptionOptions(), datetime.now(timezone.utc) + timedelta(days=day)
    pose, distance_m = candidate.answered.world_from_camera, candidate.distance_m
    place = held.adopter._localizer.place(ROOM, pose, distance_m, options)
    assert place is not None
    learning = held.adopter._keeper.learn(candidate, place, share, POLICY, now, options)
    asyncio.run_coroutine_threadsafe(learning, held.loop).result(60)


def test_ones_own_photographs_keep_no_place_full(held: Held) -> None:
    """Only photographs of others prove what one token put there useful; a new one is worth 0.2."""
    robot = replace(held.candidate(held.place.queries[0]), holder="robot")
    assert held.consider(robot) is None
    (only,) = adoption.list_adopted(held.store.database, ROOM)
    found = replace(robot.answered, inliers_of={only.reference_id: robot.answered.inlier_count})
    for day, holder in enumerate(["robot"] * 4 + ["other"] * 4, 1):
        _learned(held, replace(robot, holder=holder, answered=found), 1.0, day)
        (only,) = adoption.list_adopted(held.store.database, ROOM)
        assert (only.usefulness > 0.2) is (holder == "other")


def test_an_answer_from_the_survey_alone_shows_that_it_is_there(held: Held) -> None:
    """Also where it needs the call's priors, without which the survey does not suffice."""
    answered = held.candidate(held.place.queries[0])
    assert answered.by_survey
    for its, share in ((replace(_without_survey(answered), by_survey=True), 1.0), (_without_survey(answered), 0.5)):
        assert held.consider(replace(its, holder=str(share))) is Refusal.UNSUPPORTED
        (first, *_) = [it.place for it in held.client.list_references("room") if it.place is not None]
        assert first.surveyed_share == share  # the median


def _without_survey(answered: Candidate) -> Candidate:
    """An answer by adopted references to a photograph that the survey does not localize."""
    camera = answered.query.photo.camera
    noise = np.random.default_rng(0).integers(0, 255, (camera.height_px, camera.width_px, 3), np.uint8)
    query = replace(answered.query, photo=replace(answered.query.photo, image=cv2.imencode(".png", noise)[1].tobytes()))
    return replace(answered, query=query, as_stated=query, by_survey=False)


def test_a_robot_that_stands_still_outdates_nothing(held: Held) -> None:
    """A reference adopted where it stands gives its photographs most of their matches, and nothing has changed."""
    query = held.place.queries[2]
    assert held.consider(held.candidate(query)) is None
    candidate = held.candidate(_noisy(query))
    assert not candidate.by_survey
    assert held.consider(candidate) is not None
    shares = [it.place.surveyed_share for it in held.client.list_references("room") if it.place is not None]
    assert min(shares) > 0.6


def _pixels(photograph: Photograph) -> NDArray[np.uint8]:
    return np.asarray(cv2.imdecode(np.frombuffer(photograph.data, np.uint8), cv2.IMREAD_COLOR), np.uint8)


def _noisy(photograph: Photograph) -> Photograph:
    image = _pixels(photograph).astype(float)
    image += np.random.default_rng(0).normal(0, 2, image.shape)
    _, jpeg = cv2.imencode(".jpg", image.clip(0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 95])
    return replace(photograph, data=jpeg.tobytes())


def test_without_its_vouchers_an_adopted_reference_retires(held: Held) -> None:
    assert held.consider(held.candidate(held.place.queries[0])) is None
    (found,) = held.client.list_references("room", only_adopted=True)
    held.maintain()
    assert list(held.client.list_references("room", only_retired=True)) == []
    for it in found.provenance.vouchers:
        held.client.delete_reference("room", it.reference_id)
    held.maintain()
    (retired,) = held.client.list_references("room", only_retired=True)
    assert retired.reference_id == found.reference_id
    assert "were deleted or retired" in retired.retirement


def test_a_photograph_of_a_deleted_scene_is_forgotten(held: Held) -> None:
    held.client.create_scene("short", adoption=POLICY)
    held.client.add_references("short", [it.reference() for it in held.place.references[::2]])
    query = held.place.queries[0]
    held.client.localize(query.data, query.camera, "short", allow_adoption=True)
    held.client.delete_scene("short")
    assert held.consider(held.taken()) is Refusal.CHANGED


def test_a_place_without_its_surveyed_reference_is_another(held: Held) -> None:
    assert held.consider(held.candidate(held.place.queries[0])) is None
    (name,) = held.adopted
    place = held.client.get_reference("room", name).place_reference
    assert place in {it.name for it in held.place.references[::2]}
    held.client.delete_reference("room", place)
    assert held.client.get_reference("room", name).place_reference == ""
    held.maintain()
    assert held.client.get_reference("room", name).place_reference not in ("", place)


def test_one_that_comes_to_an_outdated_place_retires(held: Held) -> None:
    assert held.consider(held.candidate(held.place.queries[0])) is None
    (name,) = held.adopted
    held.client.delete_reference("room", held.client.get_reference("room", name).place_reference)
    surveyed = {it.reference_id for it in held.client.list_references("room")} - {name}
    keys = held.store.find_keys(ROOM, sorted(surveyed)).values()
    adoption.change_standings(held.store.database, keys, lambda _, it: adoption.outdated(it))
    held.maintain()
    retired = held.store.list_retirements(ROOM, [name])
    assert [it.reason for it in retired.values()] == [RetirementReason.SURVEY_OUTDATED]
    assert held.client.get_reference("room", name).place_reference in surveyed


def test_what_was_adopted_is_deleted_by_its_age(held: Held) -> None:
    assert held.consider(held.candidate(held.place.queries[0])) is None
    held.maintain()
    assert len(held.adopted) == 1
    held.client.update_scene("room", adoption=None)  # which prolongs nothing
    held.adopter._now = lambda: datetime.now(timezone.utc) + timedelta(hours=25)
    try:
        held.maintain()
    finally:
        held.adopter._now = lambda: datetime.now(timezone.utc)
    assert held.adopted == []
    assert len(list(held.client.list_references("room"))) == 8


def test_one_that_cannot_be_deleted_keeps_no_others(held: Held, monkeypatch: pytest.MonkeyPatch) -> None:
    for number in (0, 4):
        assert held.consider(held.candidate(held.place.queries[number])) is None
    first, *_ = held.adopted
    delete = held.store.delete_reference

    def damaged(scene_key: SceneKey, reference_id: str) -> str:
        if reference_id == first:
            raise DataLoss("the store is damaged")
        return delete(scene_key, reference_id)

    monkeypatch.setattr(held.store, "delete_reference", damaged)
    monkeypatch.setattr(held.adopter, "_now", lambda: datetime.now(timezone.utc) + timedelta(hours=25))
    for it in held.client.get_reference("room", first).provenance.vouchers:
        delete(ROOM, it.reference_id)
    held.maintain()
    assert held.adopted == [first]
    assert list(held.store.list_retirements(ROOM, [first])) == [first]  # for its vouchers


def test_a_damaged_index_ends_no_other_scenes_places(held: Held, monkeypatch: pytest.MonkeyPatch) -> None:
    other, place = SceneKey("other"), held.place
    held.client.create_scene("other")
    held.client.add_references("other", [it.reference() for it in place.references[::2]])
    try:
        for it in (other, ROOM):
            keys = held.store.find_keys(it, [place.references[0].name])
            adoption.change_standings(held.store.database, keys.values(), lambda _, known: adoption.outdated(known))
            held.client.add_references(it, [it.reference() for it in place.references[1::2]])
        localizer = held.adopter._keeper._localizer
        again = localizer.surveyed_again

        def surveyed_again(scene_key: SceneKey, *asked: object) -> set[str]:
            if scene_key == other:
                raise DataLoss("its index is damaged")
            return again(scene_key, *asked)  # type: ignore[arg-type]

        monkeypatch.setattr(localizer, "surveyed_again", surveyed_again)
        held.maintain()
        assert list(adoption.list_outdated_scenes(held.store.database)) == [other]
    finally:
        held.client.delete_scene("other")


def test_a_place_with_too_little_survey_left_is_named(held: Held) -> None:
    assert held.consider(held.candidate(held.place.queries[0])) is None
    now, unsupported = datetime.now(timezone.utc), _without_survey(held.candidate(held.place.queries[0]))
    held.adopter._options = AdoptionOptions(least_photographs=2, contradicting_days=2, remembered=2)
    try:
        for day in (1, 2):
            assert held.store.list_retirements(ROOM, held.adopted) == {}
            held.adopter._now = partial(now.__add__, timedelta(days=day))
            assert held.consider(unsupported) is Refusal.UNSUPPORTED
    finally:
        held.adopter._now, held.adopter._options = lambda: datetime.now(timezone.utc), None
    (retired,) = held.store.list_retirements(ROOM, held.adopted).values()
    assert retired.reason is RetirementReason.SURVEY_OUTDATED
    assert any("survey these places again" in it for it in held.client.get_scene("room").warnings)
    rejected = held.client.localize(_noise(), held.place.queries[0].camera, "room")
    assert isinstance(rejected, Rejected)
    outdated = held.outdated().values()
    assert rejected.outdated_place.rpartition("/")[2] in outdated
    assert rejected.hint is not None
    assert rejected.outdated_place.rpartition("/")[2] in rejected.hint.message
    held.maintain()
    assert list(held.outdated().values()) == list(outdated)
    here = held.place.references[1::2]
    held.client.add_references("room", [it.reference() for it in here])
    held.maintain()
    assert held.outdated() == {}
    assert not any("survey" in it for it in held.client.get_scene("room").warnings)


def test_an_uncertain_photograph_says_how_much_survey_is_left(held: Held) -> None:
    held.client.update_scene("room", adoption=replace(POLICY, max_radius_m=1e-4))
    answer = held.client.localize(held.place.queries[0].data, held.place.queries[0].camera, "room", allow_adoption=True)
    assert not isinstance(answer, Rejected)
    assert answer.diagnostics.adoption == "UNCERTAIN"
    candidate = held.adopter.take()
    assert candidate is not None
    assert held.consider(candidate) is Refusal.UNCERTAIN
    (place, *_) = [it.place for it in held.client.list_references("room") if it.place is not None]
    assert place.surveyed_share == pytest.approx(1.0, abs=0.1)
    assert place.photograph_count == 1


def test_a_contradicted_reference_is_retired_and_restored(held: Held) -> None:
    """It stands where a photograph was taken, and shows something else than the photograph."""
    query, now = held.place.queries[0], datetime.now(timezone.utc)
    other = held.place.queries[6]
    changed = NewReference("changed", other.data, query.camera, query.world_from_camera)
    held.client.add_reference("room", changed)
    candidate = held.candidate(query)
    held.adopter._options = AdoptionOptions(contradictions=2, contradicting_days=2)
    try:
        for day in range(2):
            assert list(held.client.list_references("room", only_retired=True)) == []
            held.adopter._now = partial(now.__add__, timedelta(days=day))
            held.consider(candidate)
    finally:
        held.adopter._now, held.adopter._options = lambda: datetime.now(timezone.utc), None
    (retired,) = held.client.list_references("room", only_retired=True)
    assert retired.reference_id == "changed"
    assert "do not show what it shows" in retired.retirement
    held.client.restore_reference("room", "changed")
    assert list(held.client.list_references("room", only_retired=True)) == []


def test_only_what_was_compared_is_contradicted(held: Held) -> None:
    """More references show what a photograph shows than are chosen for it, as at a robot's dock; one has changed."""
    query, other = held.place.queries[2], held.place.queries[6]
    held.client.add_references("room", [it.reference() for it in held.place.references[1::2]])
    held.client.add_reference("room", NewReference("changed", other.data, query.camera, query.world_from_camera))
    candidate = held.candidate(query)
    few = replace(candidate, query=replace(candidate.query, reference_count=3))
    held.adopter._options = AdoptionOptions(
        contradictions=1, contradicting_days=1, same_viewpoint_deg=30, same_viewpoint_share=0.3
    )
    try:
        held.consider(few)
    finally:
        held.adopter._options = None
    assert [it.reference_id for it in held.client.list_references("room", only_retired=True)] == ["changed"]


def test_among_several_scenes_the_one_of_the_answer_adopts(held: Held) -> None:
    query = held.place.queries[0]
    held.client.create_scene("elsewhere", adoption=POLICY)
    held.client.add_references("elsewhere", [NewReference("other", _noise(), query.camera, query.world_from_camera)])
    try:
        answer = held.client.localize(
            query.data, query.camera, scenes=["elsewhere", "room"], allow_adoption=True, axes="opencv"
        )
        assert (answer.scene, answer.diagnostics.adoption) == ("scenes/room", "WAITING")
        assert held.consider(held.taken()) is None
        assert len(held.adopted) == 1
        assert list(held.client.list_references("elsewhere", only_adopted=True)) == []
    finally:
        held.client.delete_scene("elsewhere")


@pytest.mark.parametrize("is_rig", [True, False], ids=["rig", "sequence"])
def test_each_photograph_of_a_group_may_be_adopted(held: Held, is_rig: bool) -> None:
    queries = held.place.queries[0], held.place.queries[4]
    first = queries[0].world_from_camera.inverse()
    poses = [first.compose(it.world_from_camera) for it in queries]
    both = list(zip(queries, poses, strict=True))
    rig = [RigImage(it.data, it.camera, pose) for it, pose in both]
    frames = [SequenceFrame(it.data, it.camera, pose) for it, pose in both]
    client = held.client
    answer = (
        client.localize_rig(rig, "room", allow_adoption=True)
        if is_rig
        else client.localize_sequence(frames, "room", allow_adoption=True)
    )
    assert [it.diagnostics.adoption for it in answer.images] == ["WAITING", "WAITING"]
    assert [held.consider(held.taken()) for _ in both] == [None, None]
    kept = [held.client.get_reference("room", it, include_image=True) for it in held.adopted]
    assert {it.image for it in kept} == {it.data for it in queries}
    for query in queries:
        (own,) = (it for it in kept if it.image == query.data)
        error_m, _ = pose_error(query.world_from_camera, own.world_from_camera)
        assert own.provenance.accuracy is not None
        assert error_m <= own.provenance.accuracy.position_95_m


def test_an_estimated_camera_is_kept_with_its_reference(held: Held) -> None:
    query = held.place.queries[0]
    given, found = (held.client.localize(query.data, it, "room", allow_adoption=True) for it in (query.camera, None))
    assert not isinstance(found, Rejected)
    assert found.diagnostics.adoption == "WAITING"
    candidates = held.taken(), held.taken()
    assert found.used_intrinsics is not None
    assert held.consider(candidates[1]) is None
    (adopted,) = held.client.list_references("room", only_adopted=True)
    assert adopted.camera == found.used_intrinsics.camera
    error_m, _ = pose_error(query.world_from_camera, adopted.world_from_camera)
    assert adopted.provenance.accuracy is not None
    assert error_m <= adopted.provenance.accuracy.position_95_m
    assert not isinstance(given, Rejected)


def test_a_camera_that_is_known_too_little_keeps_nothing(held: Held) -> None:
    query = held.place.queries[0]
    held.client.update_scene("room", adoption=replace(POLICY, max_radius_m=0.002))
    answer = held.client.localize(query.data, None, "room", allow_adoption=True)
    assert answer.diagnostics.adoption == "UNCERTAIN"


def _asked(held: Held, data: bytes, camera: Camera, said: IntrinsicsUncertainty) -> Candidate:
    answer = held.client.localize(data, camera, "room", allow_adoption=True, intrinsics_uncertainty=said)
    assert answer.diagnostics.adoption == "WAITING"
    return held.taken()


def _with_focal(camera: Camera, factor: float) -> Camera:
    return replace(camera, focal_x_px=factor * camera.focal_x_px, focal_y_px=factor * camera.focal_y_px)


def test_a_focal_length_that_matches_doubt_is_not_kept(held: Held) -> None:
    """It is 1 % wrong: the answer is as certain as the policy asks for, and the reference would move others."""
    query = held.place.queries[1]
    candidate = _asked(held, query.data, _with_focal(query.camera, 1.01), IntrinsicsUncertainty())
    assert held.consider(candidate) is Refusal.UNSUPPORTED


def test_a_caller_cannot_make_a_kept_pose_more_certain(held: Held) -> None:
    """The focal length is 0.5 % wrong, and said to be right to 0.01 %."""
    query = held.place.queries[0]
    camera = _with_focal(query.camera, 1.005)
    said = IntrinsicsUncertainty(focal_sigma_px=1e-4 * camera.focal_x_px)
    candidate = _asked(held, query.data, camera, said)
    assert held.consider(candidate) is None
    (kept,) = held.client.list_references("room", only_adopted=True)
    error_m, _ = pose_error(query.world_from_camera, kept.world_from_camera)
    assert kept.provenance.accuracy is not None
    assert candidate.answered.position_95_m < error_m < kept.provenance.accuracy.position_95_m


def test_a_wrong_lens_that_matches_correct_is_not_kept(held: Held) -> None:
    """Its pose is right, and is that of another camera than the reference would have."""
    query = held.place.queries[0]
    camera = replace(query.camera, distortion=RadialTangential(k1=0.1))
    candidate = _asked(held, query.data, camera, IntrinsicsUncertainty(k1_sigma=0.1))
    error_m, _ = pose_error(query.world_from_camera, candidate.answered.world_from_camera)
    assert error_m < candidate.answered.position_95_m
    assert held.consider(replace(candidate, by_survey=False)) is Refusal.UNSUPPORTED
    (place, *_) = [it.place for it in held.client.list_references("room") if it.place is not None]
    assert place.surveyed_share > 0.9  # of the place it says nothing
    estimated = replace(candidate.query.options, intrinsics=IntrinsicsSigma(k1=0.1))
    assert held.consider(replace(candidate, query=replace(candidate.query, options=estimated))) is Refusal.UNSUPPORTED


def test_a_stated_shutter_hides_no_warp(held: Held) -> None:
    """References have global shutters: what moves by 24 px from top to bottom is none, whatever explains it."""
    query = held.place.queries[0]
    pixels = _pixels(query)
    height, width = pixels.shape[:2]
    shear = np.array([[1, 24 / height, -12], [0, 1, 0]])
    warped = cv2.warpAffine(pixels, shear, (width, height), borderMode=cv2.BORDER_REFLECT)
    _, jpeg = cv2.imencode(".jpg", warped, [cv2.IMWRITE_JPEG_QUALITY, 95])
    candidate = _asked(held, jpeg.tobytes(), query.camera, IntrinsicsUncertainty(readout_s=0.1))
    assert held.consider(candidate) is not None
    assert held.adopted == []


def test_an_answer_says_why_nothing_is_kept(held: Held, monkeypatch: pytest.MonkeyPatch) -> None:
    query, client = held.place.queries[0], held.client
    ask = partial(client.localize, query.data, query.camera, "room", allow_adoption=True)

    def said(**flags: object) -> str:
        return ask(**flags).diagnostics.adoption  # type: ignore[arg-type]

    assert client.localize(query.data, query.camera, "room").diagnostics.adoption == ""
    assert said(confidential=True) == "CONFIDENTIAL"
    assert said(references=[it.name for it in held.place.references[::2]]) == "REFERENCES_NAMED"
    rejected = client.localize(_noise(), query.camera, "room", allow_adoption=True)
    assert rejected.diagnostics.adoption == "NOT_LOCALIZED"
    assert str(rejected).endswith("\n  adoption: not kept: it is not localized")
    client.update_scene("room", adoption=replace(POLICY, max_radius_m=1e-5))
    assert said() == "UNCERTAIN"
    held.taken()  # what it says of its place counts
    client.update_scene("room", adoption=None)
    assert said() == "SCENE_ADOPTS_NOTHING"
    client.update_scene("room", adoption=POLICY)
    monkeypatch.setattr(waiting, "MAX_WAITING_BYTES", 0)
    assert said() == "QUEUE_FULL"
    assert held.adopter.take() is None
