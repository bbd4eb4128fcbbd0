"""Matching in the background: its results equal those of a query, each pair is made once, failures are tried again."""

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.planted import AnyRatio
from support.scenes import SceneOptions, SyntheticScene, make_scene, random_for
from support.servers import StandInDescriptor, StandInExtractor
from support.stores import DATABASES, Folder, Place, damage, let_pass, place_on
from support.waiting import wait_until

from mapless_server.errors import Unavailable
from mapless_server.method.features import matching
from mapless_server.method.features.matching import CorrespondOptions, PairMatching, StoredPair
from mapless_server.method.features.views import Features, Matches, PosedView, View
from mapless_server.method.options import StageContext
from mapless_server.method.pairs import pair as reference_pairs
from mapless_server.method.pairs.correspond import Matcher
from mapless_server.method.pairs.pair import Matching, in_order
from mapless_server.scenes import background
from mapless_server.scenes.background import BackgroundMatching, BackgroundOptions, SceneWork
from mapless_server.scenes.indexes import SceneIndexes
from mapless_server.scenes.library import ReferenceLibrary
from mapless_server.scenes.observer import BackgroundObserver
from mapless_server.scenes.stored import PairFinder, TierMatching
from mapless_server.security import SceneKey
from mapless_server.store import NewReference, Store, pairs
from mapless_server.store.pairs import PairStore

SCENE = SceneKey("s")
EXTRACTOR, DESCRIPTOR = StandInExtractor(), StandInDescriptor()
PLANTED = make_scene(random_for("background"), SceneOptions(reference_count=5, point_count=60, outlier_share=0.3))
TWO = (Matching.STRICT, Matching.WIDE)


@dataclass
class Counts(BackgroundObserver):
    """The notifications of an observer."""

    found: Counter[str] = field(default_factory=Counter)
    made: int = 0
    failures: int = 0
    lookup_failures: int = 0
    waits: int | None = None

    def count(self, name: str, amount: float = 1.0, result: str = "") -> None:
        assert amount >= 0
        if name == "stored_pairs":
            self.found[result] += round(amount)
        self.made += round(amount) if name == "background_pairs" else 0
        self.failures += name == "background_failures"
        self.lookup_failures += name == "stored_pairs_failures"

    def waiting(self, name: str, count: int) -> None:
        self.waits = count


def new(i: int, planted: SyntheticScene = PLANTED) -> NewReference:
    """A reference of the planted scene, whose photograph is never read."""
    view, pose = planted.references[i].view, planted.references[i].world_from_camera
    vector = np.zeros(16, np.float32)
    vector[:2] = np.cos(i / 5), np.sin(i / 5)  # the nearer, the more similar
    return NewReference(f"r{i}", b"photograph", view.camera, pose, {EXTRACTOR.name: view}, {DESCRIPTOR.name: vector})


class Server:
    """One server's part of matching, without its queue."""

    def __init__(
        self,
        store: Store,
        options: BackgroundOptions | None = None,
        is_idle: Callable[[], bool] = lambda: True,
        kinds: Sequence[Matching] = TWO,
        strong_matching: PairMatching | None = None,
        enough_matches: int = 500,
        work: SceneWork | None = None,
    ) -> None:
        self.store, self.counts = store, Counts()
        self.matcher = Matcher(
            CorrespondOptions(enough_matches=enough_matches),
            pair_matching=strong_matching or AnyRatio() if any(it.is_strong for it in kinds) else None,
        )
        self.pairs = PairStore(store.database)
        self.finder = self.matcher.pairs.stored = PairFinder(self.pairs, EXTRACTOR.name, self.counts)
        self.library = ReferenceLibrary(store)
        indexes = SceneIndexes(store, self.library, DESCRIPTOR, EXTRACTOR, 2**30)
        matchings = {TierMatching(EXTRACTOR, self.matcher, kind): self.finder for kind in kinds}
        self.background = BackgroundMatching(store, indexes, matchings, is_idle, self.counts, work, options)

    def references(self) -> tuple[PosedView, ...]:
        ids = self.store.list_reference_ids(SCENE, 100)
        return self.library.load(SCENE, ids, EXTRACTOR, StageContext())[1]

    def name(self, matching: Matching = Matching.STRICT) -> str:
        return TierMatching(EXTRACTOR, self.matcher, matching).name

    def stored(self, matching: Matching = Matching.STRICT) -> dict[tuple[str, str], Matches | None]:
        """By the references' names, of all pairs that are stored."""
        name_of = {it.key: it.name.rpartition("/")[2] for it in self.references()}
        found = self.pairs.load(self.name(matching), [(a, b) for a in name_of for b in name_of])
        return {(name_of[a], name_of[b]): None if it is None else it.matches for (a, b), it in found.items()}


@pytest.fixture
def place(tmp_path: Path) -> Folder:
    return Folder(tmp_path / "data")


@pytest.fixture
def store(place: Folder) -> Iterator[Store]:
    with place.open() as store:
        store.create_scene(SCENE)
        store.add_references(SCENE, [new(i) for i in range(3)])
        store.add_references(SCENE, [new(i) for i in range(3, 5)])
        yield store


@pytest.fixture
def compared(monkeypatch: pytest.MonkeyPatch) -> Counter[int]:
    """How often two sets of features were compared, by the sum of their first coordinates."""
    counts: Counter[int] = Counter()

    def counting(usual: Callable[..., Any]) -> Callable[..., Any]:
        def compare(first: Features, second: Features, *options: Any, **named: Any) -> Any:
            counts[round(1e3 * float(first.keypoints[0, 0] + second.keypoints[0, 0]))] += 1
            return usual(first, second, *options, **named)

        return compare

    for module, name in (reference_pairs, "mutual_matches_of_ratios"), (matching, "row_maxima"):
        monkeypatch.setattr(module, name, counting(getattr(matching, name)))
    return counts


class TestResults:
    @pytest.mark.parametrize("matching", TWO)
    def test_a_query_finds_all_pairs_and_gets_the_same(
        self, store: Store, matching: Matching, compared: Counter[int]
    ) -> None:
        server, query = Server(store), PLANTED.query
        expected = Matcher().correspond(query, server.references(), matching)
        server.background.match_waiting()
        compared.clear()
        found = server.matcher.correspond(query, server.references(), matching)
        assert compared.total() == 5  # with the query
        assert server.counts.found == {"stored": 10, "absent": 0, "damaged": 0}
        for pair, matches in expected.reference_pairs.items():
            np.testing.assert_array_equal(found.reference_pairs[pair], matches)
            assert found.reference_pairs[pair].dtype == matches.dtype
        assert (server.counts.made, server.counts.waits, server.counts.failures) == (20, 0, 0)

    def test_each_reference_is_matched_with_the_nearest_before_it(self, place: Folder) -> None:
        with place.open() as store:
            store.create_scene(SCENE)
            for i in (0, 4, 1, 3):
                store.add_references(SCENE, [new(i)])
            server = Server(store, BackgroundOptions(pairs=1), kinds=[Matching.STRICT])
            server.background.match_waiting()
            assert set(server.stored()) == {("r0", "r1"), ("r3", "r4")}

    def test_one_that_is_added_later_is_matched_with_those_before(self, store: Store, compared: Counter[int]) -> None:
        server = Server(store, kinds=[Matching.STRICT])
        server.background.match_waiting()
        compared.clear()
        store.delete_reference(SCENE, "r1")
        store.add_references(SCENE, [new(1)])
        server.background.match_waiting()
        assert compared.total() == 4
        assert len(server.stored()) == 10
        for (a, b), matches in server.stored().items():
            first, second = (next(it for it in server.references() if it.name.endswith(name)) for name in (a, b))
            np.testing.assert_array_equal(matches, Matcher().pairs.make(*in_order(first, second)))


class NeverCalled(AnyRatio):
    def match_one(self, first: View, second: View, pause: Callable[[], None] = lambda: None) -> Matches:
        raise AssertionError


class Halfway(AnyRatio):
    """Pauses once in each pair; a caller comes before that."""

    def __init__(self) -> None:
        super().__init__()
        self.is_busy, self.is_resumed = threading.Event(), threading.Event()

    def match_one(self, first: View, second: View, pause: Callable[[], None] = lambda: None) -> Matches:
        self.is_busy.set()
        time.sleep(0.05)  # a step
        pause()
        self.is_resumed.set()
        return super().match_one(first, second)


class TestStrongPairs:
    def test_a_query_finds_them_and_their_wide_ones(self, store: Store) -> None:
        server = Server(store, kinds=list(Matching))
        server.background.match_waiting()
        assert server.counts.made == 40
        for kind, strong in ((Matching.STRICT, Matching.STRONG), (Matching.WIDE, Matching.STRONG_WIDE)):
            found = server.matcher.correspond(PLANTED.query, server.references(), kind).reference_pairs
            twin = Matcher(pair_matching=AnyRatio())
            for (i, j), matches in found.items():
                first, second = server.references()[i], server.references()[j]
                pair = in_order(first, second)
                expected = twin.pairs.make(*pair, strong)
                np.testing.assert_array_equal(matches if pair[0] is first else matches[:, ::-1], expected)

    def test_nearest_neighbours_that_find_enough_suffice(self, store: Store) -> None:
        server = Server(store, kinds=list(Matching), strong_matching=NeverCalled(), enough_matches=1)
        server.background.match_waiting()
        assert (server.counts.made, server.counts.waits, server.counts.failures) == (20, 0, 0)
        assert min(len(it) for it in server.stored().values() if it is not None) >= 1


class TestDamage:
    def test_a_damaged_pair_is_deleted_and_made_again(
        self, store: Store, place: Folder, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        server = Server(store, kinds=[Matching.STRICT])
        server.background.match_waiting()
        usual = server.stored()
        place.execute(
            "UPDATE reference_pair SET data = zeroblob(8) WHERE first_key = (SELECT min(first_key) FROM reference_pair)"
        )
        quick = BackgroundOptions(poll_s=0.01, longest_poll_s=0.02)
        found = Server(store, quick, kinds=[Matching.STRICT])
        correspondences = found.matcher.correspond(PLANTED.query, found.references())
        assert found.counts.found["damaged"] > 0
        for pair, matches in Matcher().correspond(PLANTED.query, found.references()).reference_pairs.items():
            np.testing.assert_array_equal(correspondences.reference_pairs[pair], matches)
        left = len(usual) - found.counts.found["damaged"]
        claims: list[str] = []
        monkeypatch.setattr(found.background._pairs, "claim", lambda name, _: claims.append(name))
        found.background.start(makes_pairs=False)
        wait_until(lambda: place.fetch("SELECT count(*) FROM reference_pair") == [(left,)])
        found.background.close()
        assert claims == []
        maker = Server(store, kinds=[Matching.STRICT])
        maker.background.match_waiting()
        assert maker.counts.made == found.counts.found["damaged"]
        again = maker.stored()
        assert again.keys() == usual.keys()
        for names, stored in usual.items():
            np.testing.assert_array_equal(again[names], stored)

    def test_matches_of_keypoints_that_are_not_there_are_damage(self, store: Store) -> None:
        server = Server(store, kinds=[Matching.STRICT])
        first, second = server.references()[:2]
        claim = server.pairs.claim(server.name(), pairs.Progress())
        assert claim is not None
        for wrong in ([len(first.view.features), 0], [0, len(second.view.features)], [-1, 0]):
            server.pairs.add(
                server.name(), claim, {(first.key, second.key): StoredPair(np.array([wrong], np.int32))}, False
            )
            assert server.finder.find(server.matcher.pairs.name(), [(first, second)]) == [None]
            server.pairs.discard(server.name(), server.finder.take_damaged(server.name()))
        assert server.counts.found == {"damaged": 3, "stored": 0, "absent": 0}

    def test_a_damaged_reference_keeps_no_other_from_being_matched(
        self, store: Store, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        damage(store, SCENE, "r3", "features")
        server = Server(store, kinds=[Matching.STRICT])
        with caplog.at_level(logging.WARNING):
            server.background.match_waiting()
        assert server.counts.failures == 1
        assert server.counts.made == 6
        assert server.counts.waits == 1
        assert "reference r3 of scene s could not be described or matched, next time in 30 s" in caplog.text
        server.background.match_waiting()
        assert server.counts.failures == 1
        let_pass(monkeypatch, 31)
        server.background.match_waiting()
        assert server.counts.failures == 2
        store.delete_reference(SCENE, "r3")
        store.add_references(SCENE, [new(3)])
        server.background.match_waiting()
        assert (server.counts.made, server.counts.waits) == (10, 0)

    def test_a_query_does_without_a_store_that_fails(self, store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
        server = Server(store)

        def away(*_: object) -> None:
            raise Unavailable("the store is not there")

        references = server.references()
        monkeypatch.setattr(server.pairs, "load", away)
        found = server.matcher.correspond(PLANTED.query, references)
        assert server.counts.lookup_failures == 1
        for pair, matches in Matcher().correspond(PLANTED.query, references).reference_pairs.items():
            np.testing.assert_array_equal(found.reference_pairs[pair], matches)


class TestUnused:
    @pytest.fixture(autouse=True)
    def hours(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(background, "_USE_IS_RECORDED_S", 0.0)

    def test_servers_with_other_settings_keep_one_anothers_pairs(
        self, store: Store, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        servers = [Server(store, kinds=[Matching.STRICT]), Server(store, kinds=[Matching.WIDE])]
        for _ in range(4):
            for server in servers:
                server.background.match_waiting()
            let_pass(monkeypatch, 0.6 * pairs.KEPT_S)
        assert [len(servers[0].stored(it)) for it in TWO] == [10, 10]
        for _ in range(2):
            servers[0].background.match_waiting()
            let_pass(monkeypatch, 0.6 * pairs.KEPT_S)
        assert [len(servers[0].stored(it)) for it in TWO] == [10, 0]

    def test_a_server_that_makes_none_keeps_what_it_uses(self, store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
        Server(store, kinds=[Matching.STRICT]).background.match_waiting()
        let_pass(monkeypatch, 1.1 * pairs.KEPT_S)
        reader, other = Server(store, kinds=[Matching.STRICT]), Server(store, kinds=[Matching.WIDE])
        reader.background.maintain()
        other.background.match_waiting()
        assert [len(reader.stored(it)) for it in TWO] == [10, 10]


class TestFailures:
    def test_a_failure_is_counted_and_tried_again_with_back_off(
        self, store: Store, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        server = Server(store, kinds=[Matching.STRICT])

        def fail(*_: object) -> Matches:
            raise ArithmeticError("planted")

        with monkeypatch.context() as patch:
            patch.setattr(server.matcher.pairs, "make", fail)
            server.background.match_waiting()
            # The first reference has none before it.
            assert (server.counts.failures, server.counts.made, server.counts.waits) == (4, 0, 4)
        server.background.match_waiting()
        assert server.counts.made == 0
        let_pass(monkeypatch, pairs.FIRST_RETRY_S + 1)
        server.background.match_waiting()
        assert (server.counts.failures, server.counts.made, server.counts.waits) == (4, 10, 0)

    def test_the_thread_outlives_a_store_that_is_away(self, store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
        server = Server(store, BackgroundOptions(poll_s=0.01, longest_poll_s=0.02))
        away, claim = threading.Event(), server.background._pairs.claim
        away.set()

        def flaky(matching: str, progress: pairs.Progress) -> pairs.Claim | None:
            if away.is_set():
                raise Unavailable("the store is not there")
            return claim(matching, progress)

        monkeypatch.setattr(server.background._pairs, "claim", flaky)
        server.background.start()
        try:
            wait_until(lambda: server.counts.failures >= 3)
            away.clear()
            wait_until(lambda: server.counts.made == 20)
        finally:
            server.background.close()


class TestSharing:
    @pytest.mark.parametrize("database", DATABASES)
    def test_servers_share_the_work_and_do_no_pair_twice(
        self, database: str, tmp_path: Path, compared: Counter[int]
    ) -> None:
        place: Place = place_on(database, lambda: tmp_path)
        with place.open() as first, place.open() if database == "postgresql" else first.uncached() as second:
            first.create_scene(SCENE)
            first.add_references(SCENE, [new(i) for i in range(5)])
            servers = [Server(it, kinds=[Matching.STRICT]) for it in (first, second, first)]
            with ThreadPoolExecutor(3) as threads:
                list(threads.map(lambda it: it.background.match_waiting(), servers))
            assert len(compared) == compared.total() == sum(it.counts.made for it in servers) == 10
            assert len(servers[0].stored()) == 10

    def test_what_a_killed_server_began_is_finished(self, store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
        killed, server = Server(store, kinds=[Matching.STRICT]), Server(store, kinds=[Matching.STRICT])

        class Killed(BaseException):
            pass

        def die(*_: object) -> None:
            raise Killed

        monkeypatch.setattr(killed.background._pairs, "add", die)
        with pytest.raises(Killed):
            killed.background.match_waiting()
        server.background.match_waiting()
        assert server.counts.waits == 1
        let_pass(monkeypatch, pairs.CLAIM_S + 1)
        server.background.match_waiting()
        assert server.counts.waits == 0
        assert len(server.stored()) == 10


class TestPriority:
    @pytest.mark.parametrize(("owner", "step", "most"), [("pairs", "make", 2), ("library", "load", 0)])
    def test_a_busy_server_matches_little(
        self, store: Store, monkeypatch: pytest.MonkeyPatch, owner: str, step: str, most: int
    ) -> None:
        """Time to load features counts, too: those of another kind are extracted then."""
        is_busy = threading.Event()
        options = BackgroundOptions(poll_s=0.01, busy_share=1e-6, quiet_s=0.01)
        server = Server(store, options, lambda: not is_busy.is_set())
        place: Any = ReferenceLibrary if owner == "library" else server.matcher.pairs
        usual = getattr(place, step)

        def then_busy(*arguments: Any) -> Any:
            is_busy.set()
            return usual(*arguments)

        monkeypatch.setattr(place, step, then_busy)
        server.background.start()
        try:
            wait_until(is_busy.is_set)
            made = server.counts.made
            assert not threading.Event().wait(0.3)
            assert server.counts.made <= made + 1
        finally:
            server.background.close()  # at once, though it waits
        assert len(server.stored()) <= most

    @pytest.mark.parametrize("ends", ["the caller", "the server"])
    def test_a_slow_pair_waits_in_its_middle(self, store: Store, ends: str) -> None:
        slow = Halfway()
        options = BackgroundOptions(poll_s=0.01, busy_share=1e-6, quiet_s=0.01)
        server = Server(store, options, lambda: not slow.is_busy.is_set(), [Matching.STRICT, Matching.STRONG], slow)
        server.background.start()
        try:
            wait_until(slow.is_busy.is_set)
            assert not slow.is_resumed.wait(0.3)
            if ends == "the caller":
                slow.is_busy.clear()
                wait_until(slow.is_resumed.is_set)
        finally:
            server.background.close()  # at once, though it waits
        assert server.counts.failures == 0

    def test_a_gap_between_calls_is_not_idleness(self, store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
        """The server is idle whenever a step could begin, except for once."""
        monkeypatch.setattr("mapless_server.scenes.background.CLAIM_S", 6.0)  # steps wait for 0.2 s and more
        looks = iter([False])
        options = BackgroundOptions(poll_s=0.01, busy_share=1e-9, quiet_s=60.0)
        server = Server(store, options, lambda: next(looks, True))
        server.background.start()
        try:
            wait_until(lambda: server.counts.waits is not None)
            assert not threading.Event().wait(0.2)
        finally:
            server.background.close()
        assert (server.counts.made, len(server.stored())) == (0, 0)

    def test_a_first_calibration_precedes_matches_and_yields_to_callers(
        self, store: Store, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """It waits for no idle time: the server must only compute for no caller at that moment."""
        is_busy, done = threading.Event(), list[str]()

        class Stages:
            def calibrate_next(self, pause: Callable[[], None], is_first: bool = False) -> bool:
                if not is_first or done:
                    return False
                pause()
                done.append(f"calibrated with {server.counts.made} pairs")
                return True

            def maintain(self) -> None:
                pass

            kind = "a kind"

        options = BackgroundOptions(poll_s=0.01, busy_share=1e-6, quiet_s=60.0)
        calibrations: Any = Stages()
        server = Server(store, options, lambda: not is_busy.is_set(), work=SceneWork(calibrations))
        is_busy.set()
        server.background.start()
        try:
            assert not threading.Event().wait(0.3)
            assert not done
            is_busy.clear()
            wait_until(lambda: bool(done))
        finally:
            server.background.close()
        assert done == ["calibrated with 0 pairs"]

    def test_many_first_calibrations_leave_references_their_turn(self, store: Store) -> None:
        class Stages:
            def __init__(self) -> None:
                self.count = 0

            def calibrate_next(self, pause: Callable[[], None], is_first: bool = False) -> bool:
                self.count += is_first
                assert self.count <= 100, "references are not matched"
                return True

            def maintain(self) -> None:
                pass

            kind = "a kind"

        calibrations: Any = Stages()
        server = Server(store, kinds=[Matching.STRICT], work=SceneWork(calibrations))
        server.background.match_waiting()
        assert (server.counts.waits, calibrations.count) == (0, 6)

    def test_a_busy_server_with_slow_pairs_ends_too(self, store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
        """The wait for its share would be longer than a claim holds."""
        monkeypatch.setattr("mapless_server.scenes.background.CLAIM_S", 0.02)
        server = Server(store, BackgroundOptions(busy_share=1e-3, quiet_s=0.01), lambda: False)
        server.background.match_waiting()
        assert server.counts.made == 20

    def test_a_reference_deleted_after_its_claim_is_no_failure(self, store: Store) -> None:
        server = Server(store)
        found = server.background._claim(server.background._all)
        assert found is not None
        store.delete_reference(SCENE, found[1].reference_id)
        with closing(ReferenceLibrary(store)) as library:
            server.background._work_on_claimed(library, *found)
        assert server.counts.failures == 0

    def test_what_is_made_before_the_claim_ends_is_stored(
        self, store: Store, monkeypatch: pytest.MonkeyPatch, compared: Counter[int]
    ) -> None:
        monkeypatch.setattr("mapless_server.scenes.background.CLAIM_S", 0.0)
        server = Server(store, kinds=[Matching.STRICT])
        usual = server.background._let_callers_first
        steps = iter(range(1000))

        def sometimes(_: float = 0.25) -> None:
            usual()
            in_time = next(steps) % 3
            monkeypatch.setattr("mapless_server.scenes.background.CLAIM_S", 60.0 if in_time else 0.0)

        monkeypatch.setattr(server.background, "_let_callers_first", sometimes)
        server.background.match_waiting()
        assert len(compared) == compared.total() == 10

    def test_a_store_that_can_only_be_read_is_left_alone(self, store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
        server = Server(store, BackgroundOptions(poll_s=0.01))
        monkeypatch.setattr(store.database, "only_reads", True)
        server.background.start()
        server.background.close()
        assert not server.stored()
