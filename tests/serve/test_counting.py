"""Photographs of answers as they are counted: rigs, several scenes, priors; planted answers."""

import asyncio
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.plain_reports import stored_counts
from support.servers import COVARIANCE, pose
from support.stores import make_reference

from mapless.geometry import RigidTransform
from mapless_server.engine.query import SceneQuestion
from mapless_server.errors import Unavailable
from mapless_server.method.bundle.estimate import PoseStage
from mapless_server.method.bundle.priors import HeadingPrior, PosePrior, PositionPrior, Priors
from mapless_server.method.judge.answer import Answer, Localization
from mapless_server.method.rejection import PoseHypothesis, Rejection, RejectionReason
from mapless_server.observability.metrics import Metrics
from mapless_server.scenes import ANYWHERE, Cone, Narrowing, Sphere
from mapless_server.scenes.retrieval.index import SceneIndex
from mapless_server.security import SceneKey
from mapless_server.serve import counting
from mapless_server.serve.counting import Counting, Noted
from mapless_server.store import Store, counts
from mapless_server.store.counts import DAY_US, LOCALIZED
from mapless_server.store.reporting import Days, read_report
from mapless_server.store.rows import now_us

HALL, YARD = SceneKey("hall"), SceneKey("yard")
LOW = Rejection(RejectionReason.LOW_OVERLAP, "another place")
GATE = Rejection(RejectionReason.GATE, "the rig's mounting")
FOUND = Localization(pose(3.0), COVARIANCE, PoseStage.REFINED, 50, 80, 0.5)
NOWHERE_FOUND: Any = SimpleNamespace(accuracy=SimpleNamespace(position_68_m=0.04))


def photograph(
    outcome: Localization | Rejection,
    *,
    matches: Sequence[int] = (3, 9),
    scenes: Sequence[SceneQuestion] = (),
    scene_key: SceneKey | None = HALL,
    priors: Priors = Priors(),  # noqa: B008
    narrowing: Narrowing = ANYWHERE,
) -> tuple[Any, Any]:
    references = [SimpleNamespace(name=f"scenes/hall/references/r{i}") for i in range(len(matches))]
    answer = Answer(outcome, reference_match_counts=tuple(matches), reference_inlier_counts=(0, 7)[: len(matches)])
    query = SimpleNamespace(scene_key=HALL, scenes=scenes, priors=priors, narrowing=narrowing)
    return query, SimpleNamespace(answer=answer, references=references, choice=None, scene_key=scene_key)


def noted(parts: list[tuple[Any, Any]], outcome: object, days: int = 400) -> list[Noted]:
    nothing: Any = None
    it = Counting(nothing, nothing, Metrics(), days)
    it.note(parts, outcome, NOWHERE_FOUND)
    return list(it._waiting)


def test_all_photographs_of_a_localized_rig_are_localized() -> None:
    first, second = (it.sighting for it in noted([photograph(FOUND), photograph(LOW)], object()))
    assert (first.outcome, second.outcome) == (LOCALIZED, LOCALIZED)
    assert (first.inlier_count, first.radius_m, dict(first.inliers_of)) == (50, 0.04, {"r1": 7})
    assert first.position is not None
    np.testing.assert_array_equal(first.position, FOUND.world_from_camera.translation)
    assert (second.position, second.reference_id) == (None, "r1")


def test_photographs_of_a_rejected_rig_have_their_own_reasons() -> None:
    first, second = (it.sighting for it in noted([photograph(FOUND), photograph(LOW)], GATE))
    assert (first.outcome, second.outcome) == ("gate", "low_overlap")
    assert first.position is not None


def look(x: float, y: float, z: float) -> HeadingPrior:
    return HeadingPrior.looking(np.array([x, y, z]), 5.0)


AT = PosePrior(RigidTransform(np.eye(3), np.array([1.0, 2.0, 3.0])), np.eye(6))


@pytest.mark.parametrize(
    ("priors", "narrowing", "position", "variance", "forward"),
    [
        (Priors(), ANYWHERE, None, None, None),
        (Priors(pose=AT), ANYWHERE, [1, 2, 3], 1, [0, 0, 1]),
        (Priors(position=PositionPrior(np.ones(3), 4 * np.eye(3))), ANYWHERE, [1, 1, 1], 4, None),
        (Priors(pose=AT, heading=look(1, 0, 0)), ANYWHERE, [1, 2, 3], 1, [1, 0, 0]),
        (Priors(), Narrowing(Sphere(np.ones(3), 5.0), Cone(np.array([0.0, 1.0, 0.0]), 30.0)), [1, 1, 1], 5, [0, 1, 0]),
    ],
)
def test_a_rejected_photograph_is_where_its_priors_say(
    priors: Priors,
    narrowing: Narrowing,
    position: list[int] | None,
    variance: int | None,
    forward: list[int] | None,
) -> None:
    (it,) = noted([photograph(LOW, priors=priors, narrowing=narrowing)], LOW)
    found = (it.sighting.position, it.sighting.forward)
    assert [None if each is None else each.tolist() for each in found] == [position, forward]
    covariance = it.sighting.covariance
    assert (None if covariance is None else covariance.tolist()) == (variance and (variance * np.eye(3)).tolist())


def test_a_pose_that_was_too_uncertain_says_where_it_was() -> None:
    imprecise = Rejection(RejectionReason.GATE, "radius", imprecise=PoseHypothesis(pose(6.0), 20, ()))
    (it,) = noted([photograph(imprecise, priors=Priors(pose=AT))], imprecise)
    assert it.sighting.position is not None
    np.testing.assert_array_equal(it.sighting.position, pose(6.0).translation)


def test_of_several_scenes_the_priors_of_the_found_one_count() -> None:
    asked = [SceneQuestion(it, ANYWHERE, Priors(position=PositionPrior(np.full(3, x), np.eye(3)))) for it, x in
             ((HALL, 1.0), (YARD, 2.0))]  # fmt: skip
    (it,) = noted([photograph(LOW, scenes=asked, scene_key=YARD)], LOW)
    assert it.scene_key == YARD
    position = counting._with_priors(it).position
    assert position is not None
    assert position.tolist() == [2.0, 2.0, 2.0]


def test_without_a_scene_or_with_no_days_nothing_is_counted() -> None:
    question = SceneQuestion(HALL, ANYWHERE)
    assert noted([photograph(LOW, scenes=[question], scene_key=None)], LOW) == []
    assert noted([photograph(LOW)], LOW, days=0) == []


def test_what_waits_is_bounded_and_dropped_ones_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(counting, "MOST_WAITING", 2)
    nothing: Any = None
    metrics = Metrics()
    it = Counting(nothing, nothing, metrics, 400)
    for _ in range(2):
        it.note([photograph(LOW)] * 3, GATE, nothing)
    assert len(it._waiting) == 2
    assert metrics.registry.get_sample_value("mapless_scene_counts_dropped_total") == 4
    for _ in range(3):
        it.count_in_scene(HALL, "adoptions", 1, "adopted")
    assert metrics.registry.get_sample_value("mapless_scene_counts_dropped_total") == 5


def test_photographs_wait_while_the_store_is_away(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nothing: Any = None
    with Store.open(tmp_path) as store:
        store.create_scene(HALL)
        store.add_references(HALL, [make_reference("r1")])
        it = Counting(nothing, store, Metrics(), 400)
        it.note([photograph(LOW)], LOW, nothing)

        def away(*_: object) -> None:
            raise Unavailable("the store is away", reason="STORE_UNAVAILABLE", retry_after_s=1.0)

        monkeypatch.setattr("mapless_server.store.counts.scenes_created", away)
        with pytest.raises(Unavailable):
            asyncio.run(it.write())
        assert len(it._waiting) == 1
        asyncio.run(it.close())


def test_what_is_adopted_or_retired_is_counted_in_its_scene(tmp_path: Path) -> None:
    nothing: Any = None
    metrics = Metrics()
    with Store.open(tmp_path) as store:
        store.create_scene(HALL)
        it = Counting(nothing, store, metrics, 400)
        for result in ("adopted", "adopted", "nothing_new"):
            it.count_in_scene(HALL, "adoptions", 1, result)
        it.count_in_scene(HALL, "retirements", 2, "contradicted")
        it.count_in_scene(YARD, "adoptions", 1, "adopted")  # it was deleted
        asyncio.run(it.write())
        with read_report(store.database, HALL, Days(0, now_us() // DAY_US, 1), 14) as found:
            (by_name,), places = found.happened().values(), found.places()
    assert by_name == {"adoptions:adopted": 2, "adoptions:nothing_new": 1, "retirements:contradicted": 2}
    assert places == []
    assert metrics.registry.get_sample_value("mapless_adoptions_total", {"result": "adopted"}) == 3


@pytest.fixture
def counted_scenes(tmp_path: Path) -> Iterator[tuple[Store, Counting, Metrics]]:
    """Two scenes with a reference each, their store, and what counts."""
    with Store.open(tmp_path) as store:
        for key in (HALL, YARD):
            store.create_scene(key)
            store.add_references(key, [make_reference("r1")])
        indexes = SimpleNamespace(entries=lambda *_, **__: SceneIndex(4).entries())
        engine: Any = SimpleNamespace(
            references=SimpleNamespace(retrievals=[SimpleNamespace(indexes=indexes)]),
            queue=SimpleNamespace(prompt_count=0),
        )
        metrics = Metrics()
        yield store, Counting(engine, store, metrics, 400), metrics


def photographs_in(store: Store, scene_key: SceneKey) -> int:
    return sum(it.photograph_count for it in stored_counts(store, scene_key, 0, now_us() // DAY_US).values())


def test_photographs_are_counted_once_when_the_server_stops(
    counted_scenes: tuple[Store, Counting, Metrics], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It stops while they are written."""
    store, it, _ = counted_scenes
    begins, ends, add = threading.Event(), threading.Event(), counts.add_counts

    def slowly(*its: Any) -> None:
        begins.set()
        ends.wait(9)
        add(*its)

    async def stopped() -> None:
        running = asyncio.ensure_future(it.run())
        await asyncio.to_thread(begins.wait, 9)
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        it.note([photograph(LOW)], LOW, None)
        asyncio.get_running_loop().call_later(0.05, ends.set)
        await it.close()

    monkeypatch.setattr(counting, "WRITE_S", 0.001)
    monkeypatch.setattr("mapless_server.store.counts.add_counts", slowly)
    it.note([photograph(LOW)] * 3, LOW, None)
    asyncio.run(stopped())
    assert photographs_in(store, HALL) == 4


def test_a_scene_that_cannot_be_counted_costs_no_other(
    counted_scenes: tuple[Store, Counting, Metrics], monkeypatch: pytest.MonkeyPatch
) -> None:
    store, it, metrics = counted_scenes
    indexes: Any = it._engine.references.retrievals[0].indexes

    def damaged(scene_key: SceneKey, *_: Any, **__: Any) -> Any:
        if scene_key == HALL:
            raise ZeroDivisionError
        return SceneIndex(4).entries()

    monkeypatch.setattr(indexes, "entries", damaged)
    it.note([photograph(LOW)] * 2, LOW, None)
    it.note([photograph(LOW, scene_key=YARD)], LOW, None)
    asyncio.run(it.write())
    assert (photographs_in(store, HALL), photographs_in(store, YARD), len(it._waiting)) == (0, 1, 0)
    assert metrics.registry.get_sample_value("mapless_scene_counts_dropped_total") == 2
