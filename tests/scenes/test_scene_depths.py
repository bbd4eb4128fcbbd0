"""Making depths ahead of queries: each reference once, failures later again, nothing after the end; finding them."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import select
from support.stores import EXTRACTOR, let_pass, make_reference

from mapless.geometry import Camera
from mapless_server.errors import DataLoss, NotFound, Unavailable
from mapless_server.method.views import KeptDepth, PosedView
from mapless_server.scenes.depth.finder import DepthFinder
from mapless_server.scenes.depth.scene_depths import SceneDepths
from mapless_server.scenes.library import Closed, ReferenceLibrary
from mapless_server.scenes.observer import BackgroundObserver
from mapless_server.security import SceneKey
from mapless_server.store import Store, rows
from mapless_server.store.depths import depth_kind, load_depths
from mapless_server.store.pairs import FIRST_RETRY_S
from mapless_server.store.tables import reference_matching

SCENE = SceneKey("office")
CAMERA = Camera(8, 6, 8.0, 8.0, 3.5, 2.5)
DEPTH = KeptDepth(CAMERA, np.full((6, 8), 2.0, np.float32), 0.02)


@dataclass
class Counting(BackgroundObserver):
    events: list[tuple[object, ...]] = field(default_factory=list)

    def count(self, name: str, amount: float = 1.0, result: str = "") -> None:
        if name != "depth_seconds":
            self.events.append((name, round(amount), result))

    def looked_up(self, name: str, stored: int, absent: int, damaged: int) -> None:
        self.events.append(("looked up", stored, absent, damaged))


class StubMaker:
    """Keeps depth with the references of its answers, by name; raises those that are errors."""

    kind = depth_kind("stub", "1")

    def __init__(self, store: Store, answers: dict[str, object]) -> None:
        self._store, self._answers = store, answers
        self.asked: list[str] = []

    def make(
        self, scene_key: SceneKey, library: ReferenceLibrary, reference_id: str, check: Callable[[], None]
    ) -> dict[str, KeptDepth | None]:
        self.asked.append(reference_id)
        check()
        answer = self._answers.get(reference_id, {reference_id: DEPTH})
        if isinstance(answer, Exception):
            raise answer
        assert isinstance(answer, dict)
        return {self._store.find_keys(scene_key, [name])[name]: depth for name, depth in answer.items()}


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store.open(tmp_path / "data") as opened:
        opened.create_scene(SCENE)
        for seed, name in enumerate("abc"):
            opened.add_references(SCENE, [make_reference(name, seed)])
        yield opened


@dataclass
class Work:
    store: Store
    maker: StubMaker
    finder: DepthFinder
    depths: SceneDepths
    events: list[tuple[object, ...]]

    def run(self) -> None:
        while self.depths.make_next(lambda: None):
            pass

    def kept(self) -> set[str]:
        keys = self.store.find_keys(SCENE, list("abc"))
        found = load_depths(self.store.database, list(keys.values()), StubMaker.kind).depths
        return {name for name, key in keys.items() if key in found}


def work(store: Store, answers: dict[str, object] | None = None) -> Work:
    observer, maker = Counting(), StubMaker(store, answers or {})
    finder = DepthFinder(store.database, observer, maker.kind)
    return Work(store, maker, finder, SceneDepths(store, finder, maker, observer), observer.events)  # type: ignore[arg-type]


def views(store: Store) -> tuple[PosedView, ...]:
    snapshot = store.load_references(SCENE, list("abc"), EXTRACTOR)
    return tuple(
        PosedView(it.record.key, it.record.reference_id, it.view, it.record.world_from_camera)
        for it in snapshot.references
    )


def due_times_us(store: Store) -> list[int]:
    with store.database.read() as connection:
        return list(connection.scalars(select(reference_matching.c.due_time_us)))


def test_each_reference_is_made_once(store: Store) -> None:
    it = work(store)
    it.run()
    it.run()
    assert sorted(it.maker.asked) == ["a", "b", "c"]
    assert it.kept() == {"a", "b", "c"}
    assert it.events == [("depths", 1, "kept"), ("depths", 0, "dropped")] * 3


def test_what_a_neighbours_run_has_made_is_not_made_again(store: Store) -> None:
    everything = dict.fromkeys("abc", DEPTH)
    it = work(store, dict.fromkeys("abc", everything))
    it.run()
    assert len(it.maker.asked) == 1
    assert it.kept() == {"a", "b", "c"}


def test_a_dropped_depth_is_kept_only_by_a_neighbours_run(store: Store) -> None:
    it = work(store, {"a": {"a": None, "b": None}, "b": {"b": DEPTH, "a": DEPTH}, "c": {}})
    it.run()
    it.run()
    assert sorted(set(it.maker.asked)) == sorted(it.maker.asked)
    assert it.kept() == {"a", "b"}


@pytest.mark.parametrize("error", [RuntimeError("no memory"), DataLoss("damaged"), Unavailable("away")])
def test_a_failure_is_tried_again_later(store: Store, error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    it = work(store, {"b": error})
    it.run()
    assert it.kept() == {"a", "c"}
    assert it.maker.asked.count("b") == 1
    assert it.events.count(("depth_failures", 1, "")) == 1
    it.maker._answers.clear()
    let_pass(monkeypatch, FIRST_RETRY_S + 1)
    it.run()
    assert it.kept() == {"a", "b", "c"}


def test_a_deleted_reference_is_no_failure(store: Store) -> None:
    it = work(store, {"b": NotFound("gone")})
    it.run()
    assert ("depth_failures", 1, "") not in it.events


@pytest.mark.parametrize("is_abandoned", [False, True])
def test_the_end_of_the_server_stores_nothing_more(store: Store, is_abandoned: bool) -> None:
    """Where there is time, others may claim the reference at once."""
    it = work(store)

    def close() -> None:
        if is_abandoned:
            it.depths.abandon()
        raise Closed

    with pytest.raises(Closed):
        it.depths.make_next(close)
    assert it.kept() == set()
    (due_us,) = due_times_us(store)
    assert (due_us <= rows.now_us()) != is_abandoned
    it.run()
    assert len(it.kept()) == (2 if is_abandoned else 3)


def test_a_server_without_a_maker_uses_depths_of_others(store: Store) -> None:
    it = work(store)
    it.run()
    user = SceneDepths(store, it.finder, None, BackgroundObserver())
    assert not user.make_next(lambda: None)
    assert user.kinds == [StubMaker.kind]


class TestFinder:
    def test_depths_come_at_the_keypoints_and_are_read_once(self, store: Store) -> None:
        it = work(store, {"b": {}})
        it.run()
        it.events.clear()
        for _ in range(2):
            first, second, _ = it.finder.with_depths(views(store), EXTRACTOR)
            assert second.depths is None
            assert first.depths is not None
            assert len(first.depths.depth) == len(first.view.features)
        assert it.events == [("looked up", 2, 1, 0), ("looked up", 0, 1, 0)]

    def test_damaged_ones_are_not_used_and_made_again(self, store: Store) -> None:
        it = work(store)
        it.run()
        with store.database.write() as connection:
            connection.exec_driver_sql("UPDATE reference_depth SET sha256 = 'no'")
        assert all(view.depths is None for view in it.finder.with_depths(views(store), EXTRACTOR))
        assert it.events[-1] == ("looked up", 0, 0, 3)
        it.depths.maintain()
        it.run()
        assert it.kept() == {"a", "b", "c"}
        assert len(it.maker.asked) == 6

    def test_a_store_that_fails_costs_the_depths_alone(self, store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
        it = work(store)
        it.run()
        references = views(store)

        def fail() -> None:
            raise Unavailable("away")

        monkeypatch.setattr(store.database, "read", fail)
        found = it.finder.with_depths(references, EXTRACTOR)
        assert [view.key for view in found] == [view.key for view in references]
        assert all(view.depths is None for view in found)
        assert it.events[-1] == ("depth_failures", 1, "")
