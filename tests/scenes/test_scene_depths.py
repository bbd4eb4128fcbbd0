"""Making depths ahead of queries: each reference once, failures later again, nothing after the end; finding them."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from sqlalchemy import select
from support.scenes import SceneOptions, make_scene, random_for
from support.stores import EXTRACTOR, let_pass, make_reference

from mapless.geometry import Array, Camera, RigidTransform, Similarity, rotation_from_vector
from mapless_server.errors import DataLoss, NotFound, Unavailable
from mapless_server.method.features.views import KeptDepth, PosedView, ReconstructedView, Reconstruction
from mapless_server.method.pairs.correspond import Correspondences, Matcher
from mapless_server.method.structure.model import MetricScale, ScaleStage
from mapless_server.scenes.depth import check
from mapless_server.scenes.depth.check import MIN_SIGMA, checked_depths
from mapless_server.scenes.depth.scene_depths import SceneDepths
from mapless_server.scenes.library import Closed, ReferenceLibrary
from mapless_server.scenes.observer import BackgroundObserver
from mapless_server.scenes.stored import DepthFinder
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


# What is kept


WALL = make_scene(random_for("depth check"), SceneOptions(reference_count=4, box_m=(4.0, 2.4, 0.0)))
"""A wall at z = 0."""
MAP = 96, 72
IDENTITY = RigidTransform(np.eye(3), np.zeros(3))
Change = Callable[[int, Array], Array]


@cache
def correspondences() -> Correspondences:
    return Matcher().correspond(WALL.query, WALL.references)


def wall_depth(index: int) -> NDArray[np.float64]:
    """The true depth map of a reference."""
    pose = WALL.references[index].world_from_camera
    camera = WALL.references[index].view.camera.resized(*MAP)
    rays = camera.rays(np.indices(MAP[::-1])[::-1].reshape(2, -1).T.astype(float)) @ pose.rotation.T
    ahead = pose.rotation[:, 2]
    return np.asarray((-pose.translation[2] / rays[:, 2] * (rays @ ahead)).reshape(MAP[::-1]))


def predicted(index: int, depth: Array) -> ReconstructedView:
    camera = WALL.references[index].view.camera.resized(*MAP)
    rays = camera.rays(np.indices(MAP[::-1])[::-1].reshape(2, -1).T.astype(float)).reshape(*MAP[::-1], 3)
    points = (rays / rays[..., 2:] * depth[..., None]).astype(np.float32)
    confidence = np.isfinite(depth).astype(np.float32)
    return ReconstructedView(camera, points, confidence, WALL.references[index].world_from_camera)


def checked(
    change: Change = lambda _, depth: depth,
    found: RigidTransform = WALL.world_from_query,
    unit: float = 2.0,
    **limits: float,
) -> list[KeptDepth | None]:
    """The kept depths: the true ones, changed, in a unit of their own, with other limits."""
    views = tuple(predicted(i, change(i, wall_depth(i)) / unit) for i in range(len(WALL.references)))
    nothing = ReconstructedView(views[0].camera, views[0].point_map, views[0].confidence, IDENTITY)
    scale = MetricScale(unit, ScaleStage.TRIANGULATION, 0.0, 0, Similarity(unit, np.eye(3), np.zeros(3)), found)
    reconstruction = Reconstruction(nothing, views)
    with pytest.MonkeyPatch.context() as patch:
        for name, value in limits.items():
            patch.setattr(check, name, value)
        return checked_depths(reconstruction, scale, WALL.references, WALL.world_from_query, correspondences())


def off(kept: KeptDepth | None, index: int) -> Array:
    """Relative errors of what is kept."""
    assert kept is not None
    error = np.log(kept.depth / wall_depth(index))
    return np.asarray(error[np.isfinite(error)])


def only(wanted: int, change: Callable[[Array], Array]) -> Change:
    return lambda index, depth: change(depth) if index == wanted else depth


def test_right_depths_are_kept_in_metres() -> None:
    for index, kept in enumerate(checked()):
        assert kept is not None
        assert np.isfinite(kept.depth).mean() > 0.95
        assert np.abs(off(kept, index)).max() < 0.01
        assert kept.relative_sigma == MIN_SIGMA


@pytest.mark.parametrize("factor", [0.85, 1.15])
def test_a_references_scale_follows_its_triangulated_points(factor: float) -> None:
    kept = checked(only(1, lambda depth: factor * depth))
    assert np.abs(off(kept[1], 1)).max() < 0.01


@pytest.mark.parametrize("sigma", [0.02, 0.05])
def test_the_standard_deviation_is_that_of_the_errors(sigma: float) -> None:
    random = np.random.default_rng(0)
    kept = checked(lambda _, depth: depth * np.exp(random.normal(0, sigma, depth.shape)), MAX_STEP=2.0)
    for it in kept:
        assert it is not None
        assert it.relative_sigma == pytest.approx(sigma, rel=0.25)


@pytest.mark.parametrize(
    "change",
    [
        lambda depth: 1.5 * depth,
        lambda depth: depth * np.exp(np.random.default_rng(0).normal(0, 0.2, depth.shape)),
        lambda depth: np.full_like(depth, np.nan),
        lambda depth: -depth,
        lambda depth: np.zeros_like(depth),
        lambda depth: np.linspace(1.5, 9.0, depth.shape[1])[None].repeat(depth.shape[0], 0),
    ],
    ids=["another scale", "noise", "nothing", "behind", "zero", "another shape"],
)
def test_a_reference_with_wrong_depths_is_dropped_alone(change: Callable[[Array], Array]) -> None:
    kept = checked(only(2, change), MAX_STEP=3.0)
    assert kept[2] is None
    assert all(kept[i] is not None for i in (0, 1, 3))


def test_what_others_look_through_is_dropped_by_pixel() -> None:
    patch = np.s_[20:40, 40:60]

    def nearer(depth: Array) -> Array:
        depth = depth.copy()
        depth[patch] *= 0.6
        return depth

    kept = checked(only(1, nearer))[1]
    assert kept is not None
    assert np.isnan(kept.depth[patch]).mean() > 0.95
    outside = np.ones(kept.depth.shape, bool)
    outside[18:42, 38:62] = False
    assert np.isfinite(kept.depth[outside]).mean() > 0.95


def test_edges_of_depth_are_dropped() -> None:
    def stepped(depth: Array) -> Array:
        depth = depth.copy()
        depth[:, 48:] *= 1.4
        return depth

    kept = checked(only(3, stepped), MAX_SIGMA=0.5, MAX_SCALE=2.0, MAX_WRONG=1.0)[3]
    assert kept is not None
    assert np.isnan(kept.depth[:, 47:49]).all()


@pytest.mark.parametrize(
    "found",
    [
        RigidTransform(WALL.world_from_query.rotation, WALL.world_from_query.translation + [0.5, 0, 0]),
        RigidTransform(
            WALL.world_from_query.rotation @ rotation_from_vector([0, np.deg2rad(6), 0]),
            WALL.world_from_query.translation,
        ),
        RigidTransform(np.full((3, 3), np.nan), np.full(3, np.nan)),
    ],
    ids=["position", "rotation", "not finite"],
)
def test_nothing_is_kept_if_the_known_pose_is_not_found(found: RigidTransform) -> None:
    assert checked(found=found) == [None] * 4


def test_without_confidence_nothing_is_kept() -> None:
    views = [predicted(i, wall_depth(i)) for i in range(4)]
    doubted = tuple(replace(it, confidence=0.05 * it.confidence) for it in views)
    scale = MetricScale(
        1.0, ScaleStage.TRIANGULATION, 0.0, 0, Similarity(1.0, np.eye(3), np.zeros(3)), WALL.world_from_query
    )
    given = WALL.references, WALL.world_from_query, correspondences()
    assert checked_depths(Reconstruction(views[0], doubted), scale, *given) == [None] * 4
