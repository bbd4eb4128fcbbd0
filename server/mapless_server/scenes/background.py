"""Makes what references need besides their first features when there is time, so that a query need not.

A thread takes one reference after another, of all scenes, finds its further features, and matches it with the
references that a query from its place would choose, one pair at a time; `later.in_order` has the order. What it makes
is stored where the queries of all servers find it, with which references are done, so that it goes on after a restart.
Between steps it waits while the server computes for a caller, except for a small share of one core, so that it ends on
a busy server, too.
"""

import logging
import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial

from mapless_server.bounds import check_bounds
from mapless_server.cache import LruCache
from mapless_server.errors import DataLoss, NetworkNotLoaded, NotFound
from mapless_server.method.features.matching import StoredPair
from mapless_server.method.features.views import PosedView
from mapless_server.method.options import StageContext
from mapless_server.method.pairs.pair import in_order as pair_in_order
from mapless_server.security import SceneKey
from mapless_server.store import Store
from mapless_server.store.pairs import CLAIM_S, Claim, Pair, PairStore, Progress, delete_unused, record_use

from .calibration.calibrator import SceneCalibrations
from .depth.scene_depths import SceneDepths
from .indexes import SceneIndexes
from .later import CALIBRATION, LaterFeatures, Pending, Work, in_order, name_of, what_of
from .library import Closed, ReferenceLibrary
from .observer import BackgroundObserver
from .pacing import Pace
from .retrieval.ranking import rank_beside
from .scene_agreements import SceneAgreements
from .stored import PairFinder, TierMatching

log = logging.getLogger(__name__)

_CACHE_BYTES = 64 * 2**20
"""Features that are kept from one reference to the next, of about 60; in addition to what queries have in memory."""

_WAITING_IS_COUNTED_S = 30.0
_USE_IS_RECORDED_S = 3600.0
_COMPLETE_SCENES = 10_000
"""Scenes of which is remembered in which generation nothing was left."""
_LONGEST_END_S = 10.0


@dataclass(frozen=True)
class BackgroundOptions:
    """Options of matching in the background.

    Attributes:
        pairs: largest number of earlier references that each reference is matched with. In the kitchen of 7-Scenes (75
            references, 25 queries, 10 references a query) a query finds 90 % of its pairs with 20, 96 % with 30, 99 %
            with 40, for which 17, 24 and 29 pairs are made for each reference.
        strong_pairs: the same number for pairs that a slow network matches, 0.6 to 0.7 s of processor time each. Those
            that nearest neighbours match well are left out: of 100 references of the kitchen 75 pairs remain of 490.
        busy_share: share of one core that is used while the server computes for callers.
        quiet_s: only after this time without work for a caller the server counts as idle, so that a device that sends a
            photograph every second is not slowed by steps that begin in its gaps. With 0.05 its photographs took
            1.15 times as long.
        poll_s: time between two looks into the store for new references, also those that other servers have added.
        longest_poll_s: the same time after repeated failures of the store.
    """

    pairs: int = 30
    strong_pairs: int = 5
    busy_share: float = 0.05
    quiet_s: float = 1.0
    poll_s: float = 2.0
    longest_poll_s: float = 60.0

    def __post_init__(self) -> None:
        check_bounds(self, "pairs strong_pairs", at_least=1)
        check_bounds(self, "busy_share", above=0, at_most=1)
        check_bounds(self, "quiet_s", at_least=0)
        check_bounds(self, "poll_s longest_poll_s", above=0)


@dataclass(frozen=True, eq=False)
class SceneWork:
    """The work on scenes besides matches; None for work that is not done.

    Attributes:
        calibrations: the first of a scene is made between references, others after all of them; they use depths.
        depths: made before scenes are calibrated.
        features: further features of references.
        agreements: brought up to date after a scene's references are matched.
    """

    calibrations: SceneCalibrations | None = None
    depths: SceneDepths | None = None
    agreements: SceneAgreements | None = None
    features: Sequence[LaterFeatures] = ()


class BackgroundMatching:
    """Matches the references of a store in a thread of its own."""

    def __init__(
        self,
        store: Store,
        indexes: SceneIndexes,
        matchings: Mapping[TierMatching, PairFinder],
        is_idle: Callable[[], bool],
        observer: BackgroundObserver,
        work: SceneWork | None = None,
        options: BackgroundOptions | None = None,
    ) -> None:
        """Makes the object; nothing is matched before `start` or `match_waiting`.

        The matchings are ordered, the most important first, each with the finder that queries use for it. `is_idle` is
        whether the server computes nothing for a caller.
        """
        work = work or SceneWork()
        self._store = store
        self._pairs = PairStore(store.database)
        self._indexes = indexes
        self._matchings = matchings
        self._observer = observer
        self._calibrations = work.calibrations
        self._depths = work.depths
        self._agreements = work.agreements
        self.options = options or BackgroundOptions()
        self._pace = Pace(is_idle, self.options.busy_share)
        self._urgent, others = in_order(list(matchings), work.features)
        self._all = [*self._urgent, *others]
        self._progress = {it.name: Progress() for it in self._all}
        self._thread: threading.Thread | None = None
        self._makes_pairs = False
        self._complete: LruCache[int] = LruCache(_COMPLETE_SCENES)
        self._rests_until_s: dict[Work, float] = {}
        self._use_is_due_s = -math.inf
        self._counted_s = 0.0
        self._waiting_count = 0

    def start(self, makes_pairs: bool = True) -> None:
        """Starts the thread, unless the store can only be read.

        Without `makes_pairs`, it still deletes damaged pairs that queries find, and unused ones.
        """
        if self._store.database.only_reads:
            log.warning("references are not matched in the background: the store can only be read")
            return
        self._makes_pairs = makes_pairs
        run = partial(self._run, self._match_and_calibrate if makes_pairs else self.maintain)
        self._thread = threading.Thread(target=run, name="background matching", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends the thread after its current pair; finished pairs are stored.

        A network that predicts depths on a CPU takes minutes, so the wait for it is limited, and its result is not
        stored.
        """
        self._pace.closing.set()
        if self._thread is None:
            return
        self._thread.join(None if self._depths is None else _LONGEST_END_S)
        if self._thread.is_alive() and self._depths is not None:
            self._depths.abandon()

    def _match_and_calibrate(self) -> None:
        """Does what waits: what is urgent of new references, then depths, then calibrations, then the rest."""
        has_more = True
        while has_more and not self._pace.closing.is_set():
            self._work_on(self._urgent)
            has_more = self._make_next_depth() or self._calibrate_next() or self._work_on(self._all, is_rest=True)

    def _make_next_depth(self) -> bool:
        self._pace.begin_step()
        return self._depths is not None and self._depths.make_next(self._wait_for_callers)

    def _calibrate_next(self, is_first: bool = False) -> bool:
        self._pace.begin_step()
        pause = partial(self._wait_for_callers, 0.0 if is_first else None)  # the first needs no idle time
        return self._calibrations is not None and self._calibrations.calibrate_next(pause, is_first)

    def match_waiting(self) -> None:
        """Does all work on references that may be claimed now, until none is left; raises if the store fails."""
        self._work_on(self._all)

    def _work_on(self, works: Sequence[Work], is_rest: bool = False) -> bool:
        """Does work on the references that may be claimed now, in order, until none is left.

        With `is_rest` it returns after work that is urgent, with True, so that what follows that comes first.
        """
        self._pace.begin_step()
        found = self._claim(works)
        if found is None:
            if self._waiting_count:  # another server may have done it
                self._count_waiting()
            return False
        self._count_waiting()
        # Of its own, so that references that queries use stay in memory.
        uncached = self._store.uncached(_CACHE_BYTES)
        with closing(ReferenceLibrary(uncached, locks=self._indexes.locks)) as library:
            while found is not None and not self._pace.closing.is_set():
                self._work_on_claimed(library, *found)
                if is_rest and found[0] in self._urgent:
                    return True
                if time.monotonic() - self._counted_s >= _WAITING_IS_COUNTED_S:
                    self._count_waiting()
                found = self._claim(works)
        self._count_waiting()
        return False

    def pending(self, scene_key: SceneKey) -> list[Pending]:
        """The work that is left in a scene, in order; empty if nothing is done in the background."""
        if self._thread is None or not self._makes_pairs:
            return []
        generation = self._store.get_generation(scene_key)
        if self._complete.get(scene_key) == generation:  # counting takes long in a large scene
            return []
        counts = self._pairs.count_complete(scene_key, self._progress)
        total = counts[""]
        left = [Pending(what_of(it), name_of(it), total - counts[it.name]) for it in self._all]
        if self._calibrations is not None and self._calibrations.is_waiting(scene_key):
            left.append(Pending(CALIBRATION, self._calibrations.kind, total))
        left = [it for it in left if it.reference_count > 0]
        if not left:
            self._complete.put(scene_key, generation, 1)
        return left

    def maintain(self) -> None:
        """Deletes damaged pairs and those of unused matchings, at most once an hour."""
        for matching, finder in self._matchings.items():
            damaged = finder.take_damaged(matching.name)
            if damaged:
                self._pairs.discard(matching.name, damaged)
        if self._depths is not None:
            self._depths.maintain()
        if time.monotonic() < self._use_is_due_s:
            return
        used = list(self._progress)
        if self._calibrations is not None:
            self._calibrations.maintain()
            used.append(self._calibrations.kind)
        if self._depths is not None:
            used += self._depths.kinds
        if self._agreements is not None:
            self._agreements.derive_all()
        record_use(self._store.database, used)
        delete_unused(self._store.database, self._pause)
        self._use_is_due_s = time.monotonic() + _USE_IS_RECORDED_S

    def _run(self, work: Callable[[], None]) -> None:
        poll_s = self.options.poll_s
        while not self._pace.closing.wait(poll_s):
            next_s, poll_s = min(2 * poll_s, self.options.longest_poll_s), self.options.poll_s
            try:
                work()
            except Closed:
                return
            except Exception as error:
                poll_s = next_s
                self._observer.count("background_failures")
                log.warning("matching references in the background failed, and is tried again: %s", error)

    def _claim(self, works: Sequence[Work]) -> tuple[Work, Claim] | None:
        """Claims the next reference; before it, a scene gets its first calibration: one, so that many delay nothing."""
        self.maintain()
        self._calibrate_next(is_first=True)
        for work in works:
            if time.monotonic() < self._rests_until_s.get(work, -math.inf):
                continue
            claim = self._pairs.claim(work.name, self._progress[work.name])
            if claim is not None:
                return work, claim
        return None

    def _count_waiting(self) -> None:
        self._waiting_count = max(map(self._pairs.count_waiting, self._progress))
        self._observer.waiting("background_waiting", self._waiting_count)
        self._counted_s = time.monotonic()

    def _work_on_claimed(self, library: ReferenceLibrary, work: Work, claim: Claim) -> None:
        """Does work on one reference, or postpones it if that fails.

        Where a network cannot be loaded all of this work rests: it would fail with every reference.
        """
        until_s = time.monotonic() + CLAIM_S / 3
        begin_s = time.thread_time()
        try:
            made, is_complete = self._make(library, work, claim, until_s)
        except Closed:
            made, is_complete = {}, False
        except NotFound:  # the reference was deleted
            self._pairs.postpone(work.name, claim)
            return
        except NetworkNotLoaded as error:
            self._rests_until_s[work] = time.monotonic() + error.retry_after_s
            self._observer.count("background_failures")
            log.warning("%s of %s rest for %.0f s: %s", what_of(work), name_of(work), error.retry_after_s, error)
            made, is_complete = {}, False
        except Exception as error:
            is_damaged = isinstance(error, DataLoss)
            wait_s = self._pairs.postpone(work.name, claim, is_damaged)
            self._observer.count("background_failures")
            message = "reference %s of scene %s could not be described or matched, next time in %.0f s: %s"
            log.warning(
                message, claim.reference_id, claim.scene_key, wait_s, error, exc_info=None if is_damaged else error
            )
            return
        self._pairs.add(work.name, claim, made, is_complete)
        if self._agreements is not None and any(it.error_px is not None for it in made.values()):
            self._agreements.touch(claim.scene_key)
        self._observer.count("background_pairs", len(made))
        self._observer.count("background_cpu_seconds", time.thread_time() - begin_s)

    def _make(
        self, library: ReferenceLibrary, work: Work, claim: Claim, until_s: float
    ) -> tuple[dict[Pair, StoredPair], bool]:
        """Finds a reference's features, or matches it, see `_match`."""
        if not isinstance(work, LaterFeatures):
            return self._match(library, work, claim, until_s)
        self._let_callers_first()
        work.make(library, claim, StageContext(self._check))
        return {}, True

    def _match(
        self, library: ReferenceLibrary, matching: TierMatching, claim: Claim, until_s: float
    ) -> tuple[dict[Pair, StoredPair], bool]:
        """Matches a reference's pairs until a time or until closed; returns the pairs, and whether these are all."""
        made: dict[Pair, StoredPair] = {}
        self._let_callers_first()
        self._check()
        wanted = self._nearest(matching, claim)
        if not wanted:
            return made, True
        self._let_callers_first()
        context = StageContext(self._check)
        _, (subject,) = library.load(claim.scene_key, [claim.reference_id], matching.extractor, context)
        if subject.key != claim.key:
            raise NotFound("the reference was replaced")
        for reference_id in wanted:
            self._let_callers_first()
            # One pair at least, so that a busy server ends, too.
            if self._pace.closing.is_set() or (made and time.monotonic() > until_s):
                return made, False
            try:
                for other in self._indexes.load_existing(
                    library, claim.scene_key, [reference_id], matching.extractor, context
                ):
                    self._let_callers_first()
                    made |= self._match_pair(matching, *pair_in_order(subject, other))
            except Closed:
                return made, False
        return made, True

    def _match_pair(self, matching: TierMatching, first: PosedView, second: PosedView) -> dict[Pair, StoredPair]:
        """Matches a pair, unless it needs no matches of this kind."""
        base = matching.base
        begun = None if base is None else self._matchings[matching].find_one(base.name, first, second)
        matches = matching.match_pair(first, second, begun, self._pause)
        if matches is None:
            return {}
        error_px = None if matching.kind.is_wide else matching.matcher.pairs.error_px(first, second)
        return {(first.key, second.key): StoredPair(matches, error_px)}

    def _nearest(self, matching: TierMatching, claim: Claim) -> list[str]:
        """Ids of the references that a query from the claimed one's place would choose first, without stored pairs.

        In a scene whose references were added at once, half of them precede the claimed one on average.
        """
        entries = self._indexes.entries(claim.scene_key, StageContext(self._check))
        if claim.reference_id not in entries:
            if not self._indexes.is_damaged(claim.scene_key, claim.reference_id):
                raise NotFound("the reference was deleted")
            raise DataLoss(f"reference {claim.reference_id!r} is damaged in the store; delete it and add it again")
        count = self.options.strong_pairs if matching.kind.is_strong else self.options.pairs
        id_of = {it.key: it.reference_id for it in rank_beside(entries, claim.reference_id, 2 * count)}
        missing = self._pairs.list_missing(matching.name, claim, list(id_of), count)
        return [id_of[key] for key in missing]

    def _check(self) -> None:
        if self._pace.closing.is_set():
            raise Closed

    def _wait_for_callers(self, quiet_s: float | None = None) -> None:
        self._check()
        self._let_callers_first(quiet_s=quiet_s)

    def _pause(self) -> None:
        """Pauses in the middle of a slow pair, which has about ten steps."""
        self._check()
        self._let_callers_first(1 / 30)

    def _let_callers_first(self, share_of_claim: float = 1 / 4, quiet_s: float | None = None) -> None:
        """Ends a step; waits at most this share of the time of a claim, which does not end meanwhile."""
        self._pace.end_step(self.options.quiet_s if quiet_s is None else quiet_s, CLAIM_S * share_of_claim)
