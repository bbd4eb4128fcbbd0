"""Whether a scene contradicts itself, from the errors of its pairs."""

import threading
import time
from collections.abc import Iterator
from itertools import combinations
from types import SimpleNamespace
from typing import Any, cast

import pytest
from support.waiting import wait_until

from mapless_server.method.features.extractors import SiftExtractor
from mapless_server.method.pairs.make import make_matcher
from mapless_server.scenes import scene_agreements
from mapless_server.scenes.agreement import Agreement, agreement_of
from mapless_server.scenes.explaining import SamePose
from mapless_server.scenes.scene_agreements import SceneAgreements
from mapless_server.security import SceneKey
from mapless_server.store import SceneAttributes, Store

GOOD, BAD = 0.4, 60.0


def session(prefix: str, count: int, error_px: float) -> dict[tuple[str, str], float]:
    return dict.fromkeys(combinations([f"{prefix}{i}" for i in range(count)], 2), error_px)


def between(first: str, second: str, count: int, error_px: float) -> dict[tuple[str, str], float]:
    return {(f"{first}{i}", f"{second}{j}"): error_px for i in range(count) for j in range(count)}


@pytest.mark.parametrize(
    ("errors_px", "contradicts"),
    [
        ({}, False),
        ({("a", "b"): BAD}, False),
        ({("a", "b"): BAD, ("b", "c"): BAD}, False),
        ({("a", "b"): BAD, ("b", "c"): BAD, ("c", "d"): BAD}, True),
        (session("a", 3, GOOD) | {(f"a{i}", "wrong"): BAD for i in range(3)} | {("a4", "wrong"): BAD}, False),
        ({("a", "b"): GOOD, ("b", "c"): BAD, ("a", "c"): BAD}, False),
        (session("a", 5, GOOD), False),
        (session("a", 3, BAD), True),
        (session("a", 5, GOOD) | {(f"a{i}", "wrong"): BAD for i in range(5)}, False),
        (session("a", 4, GOOD) | session("b", 4, BAD) | between("a", "b", 4, BAD), True),
    ],
)
def test_a_scene_contradicts_itself_if_most_pairs_do(
    errors_px: dict[tuple[str, str], float], contradicts: bool
) -> None:
    found = agreement_of(errors_px)
    assert found.contradicts_itself == contradicts
    assert bool(found.contradiction) == contradicts
    assert (found.pair_count, found.agreeing_count) == (len(errors_px), sum(it == GOOD for it in errors_px.values()))


def test_two_sessions_with_worlds_of_their_own_are_found() -> None:
    worlds = session("a", 9, GOOD) | session("b", 7, GOOD)
    found = agreement_of(worlds | between("a", "b", 3, BAD))
    assert 2 * found.agreeing_count > found.pair_count
    assert [len(it) for it in found.groups] == [9, 7]
    assert "9 and 7 references" in found.contradiction
    # A pair that agrees by chance joins no worlds; sessions that do agree, or share nothing, are no contradiction.
    assert agreement_of(worlds | between("a", "b", 3, BAD) | {("a0", "b0"): GOOD}).groups == found.groups
    assert agreement_of(worlds | between("a", "b", 3, GOOD)) == Agreement(66, 66, GOOD)
    assert agreement_of(worlds).groups == ()


def test_large_scenes_that_disagree_are_grouped_in_linear_time() -> None:
    pairs = {(f"{i:05}", f"{i + 1:05}"): BAD for i in range(20_000)}
    begin_s = time.thread_time()
    assert agreement_of(pairs).contradicts_itself
    assert time.thread_time() - begin_s < 3.0


def test_sessions_agree_within() -> None:
    worlds = session("a", 9, GOOD) | session("b", 7, GOOD) | between("a", "b", 3, BAD)
    some_bad = dict.fromkeys(list(session("b", 7, GOOD))[1::4], BAD)
    assert agreement_of(worlds).groups
    assert agreement_of(worlds | some_bad).groups == ()


class Counts(dict[str, int]):
    """The observer's last figures by name."""

    def waiting(self, what: str, count: int) -> None:
        self[what] = count


class Pairs:
    """Stored errors of a scene's pairs, which are read when they may be."""

    def __init__(self) -> None:
        self.errors_px = session("a", 8, BAD)
        self.may_read = threading.Event()
        self.may_read.set()
        self.reads = 0
        self.scenes = [SceneKey(f"scene-{i}") for i in range(5)]

    def list_scenes_with_errors(self, *_: object) -> list[SceneKey]:
        return self.scenes

    def list_errors(self, *_: object) -> dict[tuple[str, str], float]:
        self.reads += 1
        assert self.may_read.wait(10)
        return self.errors_px


class Explainer:
    """The depth and the mistake that a test plants."""

    def __init__(self) -> None:
        self.depth, self.fails = 3.0, False

    def explanation(self, *_: object) -> str:
        if self.fails:
            raise OSError
        return "inverse"

    def same_poses(self, *_: object) -> list[SamePose]:
        return []

    def median_depth(self, *_: object) -> float:
        return self.depth


HALL = SceneKey("hall")


class TestScenes:
    @pytest.fixture
    def counts(self) -> Counts:
        return Counts()

    @pytest.fixture
    def pairs(self) -> Pairs:
        return Pairs()

    @pytest.fixture
    def explainer(self) -> Explainer:
        return Explainer()

    @pytest.fixture
    def agreements(
        self, counts: Counts, pairs: Pairs, explainer: Explainer, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
    ) -> Iterator[SceneAgreements]:
        nothing: Any = None
        matcher = make_matcher("sift")
        with Store.open(tmp_path) as store:
            made = SceneAgreements(store, nothing, nothing, SiftExtractor(), matcher, cast(Any, counts))
            monkeypatch.setattr(made, "_pairs", pairs)
            monkeypatch.setattr(made, "_explainer", explainer)
            yield made
            made.close()
        matcher.close()

    def test_contradicting_scenes_are_counted_until_they_are_deleted(
        self, agreements: SceneAgreements, counts: Counts
    ) -> None:
        assert agreements.current(HALL).contradicts_itself
        assert counts == {"contradicting_scenes": 1}
        agreements.forget_scene(HALL)
        assert counts == {"contradicting_scenes": 0}

    def test_a_scene_that_is_deleted_meanwhile_is_not_counted(
        self, agreements: SceneAgreements, counts: Counts, pairs: Pairs
    ) -> None:
        pairs.may_read.clear()
        update = agreements.touch(HALL)
        assert update is not None
        agreements.forget_scene(HALL)
        pairs.may_read.set()
        update.result(10)
        assert counts == {"contradicting_scenes": 0}

    def test_pairs_that_take_long_to_read_are_read_seldom(self, agreements: SceneAgreements, pairs: Pairs) -> None:
        agreements.current(HALL)
        agreements.current(HALL)
        assert pairs.reads == 1
        agreements.changed(HALL)
        agreements.current(HALL)
        assert pairs.reads == 2

    def test_the_depth_is_measured_again_if_references_are_replaced(
        self, agreements: SceneAgreements, pairs: Pairs, explainer: Explainer
    ) -> None:
        pairs.errors_px, explainer.depth = session("a", 8, GOOD), 3000.0
        assert "millimetres" in str(agreements.current(HALL).warnings(arbitrary_unit=False))
        assert agreements.current(HALL).warnings(arbitrary_unit=True) == []
        explainer.depth = 3.0
        pairs.errors_px = session("b", 8, GOOD)
        agreements.changed(HALL)
        assert agreements.current(HALL).warnings(arbitrary_unit=False) == []

    @pytest.mark.parametrize("is_arbitrary", [False, True])
    def test_depths_are_compared_only_in_metres(
        self, agreements: SceneAgreements, pairs: Pairs, is_arbitrary: bool, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        compared = set[SceneKey]()

        def with_depth(scene_key: SceneKey) -> list[str]:
            compared.add(scene_key)
            return []

        monkeypatch.setattr(agreements, "_depths", SimpleNamespace(with_depth=with_depth))
        agreements._store.create_scene(HALL, SceneAttributes(arbitrary_unit=is_arbitrary))
        pairs.errors_px = session("a", 8, GOOD)
        agreements.current(HALL)
        assert bool(compared) is not is_arbitrary

    def test_a_change_while_pairs_are_read_is_seen(self, agreements: SceneAgreements, pairs: Pairs) -> None:
        pairs.may_read.clear()
        assert agreements.touch(HALL) is not None
        wait_until(lambda: pairs.reads == 1)
        agreements.changed(HALL)
        pairs.errors_px = session("a", 8, GOOD)
        pairs.may_read.set()
        assert not agreements.current(HALL).contradicts_itself
        assert pairs.reads == 2

    def test_a_scene_that_is_asked_for_does_not_wait_for_all(
        self, agreements: SceneAgreements, pairs: Pairs, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(scene_agreements, "LONGEST_WAIT_S", 30.0)
        pairs.may_read.clear()
        agreements.derive_all()
        asked = threading.Thread(target=agreements.current, args=[HALL])
        asked.start()
        wait_until(lambda: len(agreements._scenes) == 2)  # that of the list, which waits, and the one that is asked for
        pairs.may_read.set()
        asked.join(30)
        wait_until(lambda: pairs.reads == len(pairs.scenes) + 1)
        assert list(agreements._scenes).index(HALL) == 1

    def test_what_fails_is_tried_again_after_a_rest(
        self, agreements: SceneAgreements, explainer: Explainer, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(scene_agreements, "FAILED_S", 0.0)
        explainer.fails = True
        assert agreements.current(HALL).explanation == ""
        explainer.fails = False
        wait_until(lambda: agreements.current(HALL).explanation == "inverse")
