"""Whether the scenes of a store contradict themselves: their references compared with their poses, pair by pair.

The errors of pairs (`method.pairs.agreement`) are those that background matching has stored. Where they are too few,
because it is off, has not come so far or was done by an earlier version, some pairs of a few references are matched
here, unless queries have matched them already. What is known of a scene is kept in memory, and derived again after a
start when it is first asked for.
"""

import logging
import math
import threading
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence, Set
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from mapless_server.errors import NotFound
from mapless_server.method.features.extractors import FeatureExtractor
from mapless_server.method.features.views import PosedView
from mapless_server.method.options import StageContext
from mapless_server.method.pairs.agreement import MAX_ERROR_PX
from mapless_server.method.pairs.correspond import Matcher
from mapless_server.method.pairs.pair import in_order
from mapless_server.security import SceneKey
from mapless_server.store import Store
from mapless_server.store.adoption import list_adopted
from mapless_server.store.pairs import Pair, PairStore

from .agreement import Agreement, agreement_of
from .depth_checks import DepthCheck, DepthChecks, depth_warnings
from .explaining import NAMED, SceneExplainer, spread
from .indexes import SceneIndexes
from .library import Closed, ReferenceLibrary
from .observer import BackgroundObserver
from .retrieval.ranking import rank_beside
from .stored import TierMatching

log = logging.getLogger(__name__)

LEAST_REFERENCES = 3
"""Fewer are not compared with one another."""
ENOUGH_PAIRS, SAMPLED_REFERENCES, SAMPLED_NEIGHBOURS = 12, 12, 3
"""If fewer pairs are stored, so many references are matched with so many others each, those that look most similar."""

GROWTH = 1.5
"""A scene with so many times the references is sampled again."""

KNOWN_GROWTH, UNKNOWN_GROWTH = 2.0, 1.2
"""With so many times the pairs, a mistake or a depth that is known is sought again, and one that was not found."""

READ_PAIRS = 20_000
STALE_S, REST_FACTOR = 2.0, 50.0
"""An agreement is derived again after so long, and after so many times what reading its pairs took: 20,000
take a tenth of a second, which queries would have to share."""
FAILED_S = 60.0
"""Where that failed, it is tried again after so long."""
DEPTHS_S, DEPTHS_REST_FACTOR = 2.0, 4.0
"""Depths of references are compared so long at once, 0.1 s each, and then not for so many times as long."""
LONGEST_WAIT_S = 3.0
"""For what must be computed, by who asks for the agreement as it is now."""
_KNOWN_SCENES = 10_000
_REMEMBERED = 24


@dataclass(frozen=True)
class _Basis:
    """The pairs by which something was found: their number, and some of them."""

    count: int = 0
    some: frozenset[Pair] = frozenset()

    @staticmethod
    def of(pairs: Iterable[Pair]) -> "_Basis":
        ordered = sorted(pairs)
        return _Basis(len(ordered), frozenset(spread(ordered, _REMEMBERED)))

    def is_outdated(self, pairs: Collection[Pair], is_known: bool) -> bool:
        """Whether there are many more pairs now, or half of those are gone."""
        has_grown = len(pairs) >= max(1.0, self.count * (KNOWN_GROWTH if is_known else UNKNOWN_GROWTH))
        return has_grown or 2 * sum(it in pairs for it in self.some) < len(self.some)


@dataclass(eq=False)
class _Known:
    """A scene's state: errors of sampled pairs, the references that were sampled, and the last result.

    `sampled_size` is the number of its references when they were sampled, `explained` has the pairs by which it was
    explained, `measured` those by which its depth was measured; before `rests_until_s`, by `time.monotonic`, nothing is
    derived again. `depths` are the results for depths by the ids of references, each with the number of depths that
    there were, complete as of `depths_generation`.
    """

    errors_px: dict[Pair, float] = field(default_factory=dict)
    sampled: set[str] = field(default_factory=set)
    sampled_size: int = 0
    agreement: Agreement | None = None
    explained: _Basis = _Basis()
    measured: _Basis = _Basis()
    rests_until_s: float = -math.inf
    depths: dict[str, tuple[DepthCheck, int]] = field(default_factory=dict)
    depths_generation: int = -1
    update: "Future[None] | None" = None

    @property
    def depth_warnings(self) -> tuple[str, ...]:
        """Sentences about its depths."""
        return tuple(depth_warnings({it: found for it, (found, _) in self.depths.items()}))


class SceneAgreements:
    """The agreement of the scenes of a store; thread-safe. What takes long is computed in a thread of its own."""

    def __init__(
        self,
        store: Store,
        indexes: SceneIndexes,
        library: ReferenceLibrary,
        extractor: FeatureExtractor,
        matcher: Matcher,
        observer: BackgroundObserver,
        depths: DepthChecks | None = None,
    ) -> None:
        """The extractor and the matcher compare references: those of one of the tiers; None compares no depths."""
        self._store, self._depths = store, depths
        self._pairs = PairStore(store.database)
        self._indexes, self._matcher = indexes, matcher
        self._explainer = SceneExplainer(indexes, library, extractor, matcher, self._check)
        self._matching = TierMatching(extractor, matcher).name
        self._observer = observer
        self._scenes: dict[SceneKey, _Known] = {}
        self._guard = threading.Lock()
        self._contradicting: set[SceneKey] = set()
        self._closing = threading.Event()
        self._thread = ThreadPoolExecutor(1, "agreement")

    def close(self) -> None:
        """Ends what is being computed at its next step."""
        self._closing.set()
        self._thread.shutdown(wait=True, cancel_futures=True)

    def known(self, scene_key: SceneKey) -> Agreement:
        """The agreement as last computed, without waiting; brings it up to date in the background."""
        self.touch(scene_key)
        return self._agreement(scene_key)

    def current(self, scene_key: SceneKey) -> Agreement:
        """The agreement as it is now; waits some seconds at most for what must be computed."""
        until_s = time.monotonic() + LONGEST_WAIT_S
        # An update that runs may have read the pairs before the last change: then another one follows it.
        for _ in range(2):
            update = self.touch(scene_key)
            if update is not None:
                with suppress(TimeoutError):
                    update.result(max(0.0, until_s - time.monotonic()))
        return self._agreement(scene_key)

    def touch(self, scene_key: SceneKey) -> "Future[None] | None":
        """Brings the agreement of a scene up to date in the background, unless that was done a moment ago."""
        with self._guard:
            known = self._known(scene_key)
            is_running = known.update is not None and not known.update.done()
            if not is_running and time.monotonic() >= known.rests_until_s:
                self._submit(scene_key, known)
            return known.update

    def _submit(self, scene_key: SceneKey, known: _Known) -> None:
        """Has the scene brought up to date; with the guard."""
        if not self._closing.is_set():
            known.update = self._thread.submit(self._update, scene_key, known)

    def changed(self, scene_key: SceneKey) -> None:
        """Brings the agreement up to date in the background, however recent it is: references were added."""
        with self._guard:
            self._known(scene_key).rests_until_s = -math.inf
        self.touch(scene_key)

    def forget_references(self, keys: Collection[str]) -> None:
        """Drops pairs of deleted references."""
        gone = frozenset(keys)
        with self._guard:
            for known in self._scenes.values():
                for pair in [it for it in known.errors_px if not gone.isdisjoint(it)]:
                    del known.errors_px[pair]
                known.sampled -= gone
                known.depths = {it: found for it, found in known.depths.items() if found[0].key not in gone}
                if known.agreement is not None:
                    known.agreement = replace(known.agreement, depths=known.depth_warnings)
                known.rests_until_s = -math.inf

    def forget_scene(self, scene_key: SceneKey) -> None:
        """Drops what is known of a deleted scene."""
        with self._guard:
            self._scenes.pop(scene_key, None)
            self._contradicting.discard(scene_key)
        self._count()

    def derive_all(self) -> None:
        """Brings the scenes with stored pairs that do not agree up to date, for the metric and the log."""
        self._derive_next(iter(self._pairs.list_scenes_with_errors(self._matching, MAX_ERROR_PX, _KNOWN_SCENES)))

    def _derive_next(self, scene_keys: Iterator[SceneKey]) -> None:
        """One scene after the other, so that a scene that is asked for does not wait for all of them."""
        scene_key = next(scene_keys, None)
        if scene_key is not None:
            self.touch(scene_key)
            with self._guard:
                if not self._closing.is_set():
                    self._thread.submit(self._derive_next, scene_keys)

    def _known(self, scene_key: SceneKey) -> _Known:
        """Returns a scene's state, to be changed while the guard is held."""
        return self._scenes.setdefault(scene_key, _Known())

    def _agreement(self, scene_key: SceneKey) -> Agreement:
        with self._guard:
            known = self._scenes.get(scene_key)
        return (known and known.agreement) or Agreement()

    def _update(self, scene_key: SceneKey, known: _Known) -> None:
        with self._guard:
            known.rests_until_s = time.monotonic() + STALE_S
        try:
            self._derive(scene_key, known)
        except NotFound:
            self.forget_scene(scene_key)
        except Closed:
            pass
        except Exception:
            log.warning("the pairs of scene %s could not be compared with its poses", scene_key, exc_info=True)
            with self._guard:
                known.rests_until_s = time.monotonic() + FAILED_S
            return
        with self._guard:
            if known.rests_until_s == -math.inf and self._scenes.get(scene_key) is known:  # changed meanwhile
                self._submit(scene_key, known)

    def _derive(self, scene_key: SceneKey, known: _Known) -> None:
        begin_s = time.monotonic()
        stored = self._pairs.list_errors(self._matching, scene_key, READ_PAIRS)
        # What the scene says of itself is what its survey says.
        adopted = {it.key for it in list_adopted(self._store.database, scene_key)}
        errors_px = self._with_kept(known, stored, adopted)
        found = agreement_of(errors_px)
        with self._guard:
            if known.rests_until_s > begin_s:  # nothing has changed meanwhile
                took_s = time.monotonic() - begin_s
                known.rests_until_s = max(known.rests_until_s, begin_s + REST_FACTOR * took_s)
        # Known before it is explained, which takes a second or two.
        self._settle(scene_key, known, replace(found, same_pose=self._agreement(scene_key).same_pose))
        if len(stored) < ENOUGH_PAIRS:
            self._sample(scene_key, known, stored)
            errors_px = self._with_kept(known, stored, adopted)
            found = agreement_of(errors_px)
        groups = self._explainer.same_poses(scene_key, errors_px) if found.agreeing_count < found.pair_count else []
        found = replace(found, same_pose=tuple(_some([it.text for it in groups])))
        self._settle(scene_key, known, found)
        if found.contradicts_itself:
            excluded = {key for it in groups for key in it.keys}
            others = {pair: it for pair, it in errors_px.items() if excluded.isdisjoint(pair)}
            if agreement_of(others).contradicts_itself:  # otherwise the repeated poses are the mistake
                self._explain(scene_key, known, found, list(others))
        else:
            self._measure(scene_key, known, found, errors_px)
            self._check_depths(scene_key, known)

    def _check_depths(self, scene_key: SceneKey, known: _Known) -> None:
        """Compares depths that were measured with references with their neighbours, the new ones first.

        In a scene of arbitrary unit they are not judged.
        """
        if self._depths is None or self._store.get_attributes(scene_key).arbitrary_unit:
            return
        if (generation := self._store.get_generation(scene_key)) == known.depths_generation:
            return
        begin_s, wanted = time.monotonic(), self._depths.with_depth(scene_key)
        known.depths = {it: known.depths[it] for it in wanted if it in known.depths}
        for reference_id in sorted(wanted, key=lambda it: it in known.depths):
            if time.monotonic() > begin_s + DEPTHS_S:
                break
            before, count = known.depths.get(reference_id, (None, 0))
            # A right one may have better neighbours when there are many more; a wrong one may be corrected by others.
            if before is None or before.is_alarm or len(wanted) >= KNOWN_GROWTH * count:
                found = self._depths.check(scene_key, reference_id, self._check)
                if found is not None:
                    with self._guard:  # a new dictionary, for others may read the old one
                        known.depths = {**known.depths, reference_id: (found, len(wanted))}
        else:
            known.depths_generation = generation
        with self._guard:
            if known.rests_until_s > begin_s:  # nothing has changed meanwhile
                spent_s = time.monotonic() - begin_s
                known.rests_until_s = max(known.rests_until_s, begin_s + DEPTHS_REST_FACTOR * spent_s)
        self._settle(scene_key, known, self._agreement(scene_key))

    def _explain(self, scene_key: SceneKey, known: _Known, found: Agreement, pairs: Sequence[Pair]) -> None:
        """Finds the likely mistake, if the pairs are others than when that was tried."""
        if known.explained.is_outdated(set(pairs), bool(self._agreement(scene_key).explanation)):
            explanation = self._explainer.explanation(scene_key, found, pairs)
            known.explained = _Basis.of(pairs)
            self._settle(scene_key, known, replace(found, explanation=explanation))

    def _measure(self, scene_key: SceneKey, known: _Known, found: Agreement, errors_px: Mapping[Pair, float]) -> None:
        """Finds how far away is what the references show, if the pairs are others than when that was tried."""
        agreeing = {pair for pair, error_px in errors_px.items() if error_px <= MAX_ERROR_PX}
        if known.measured.is_outdated(agreeing, self._agreement(scene_key).median_depth is not None):
            median_depth = self._explainer.median_depth(scene_key, list(agreeing))
            known.measured = _Basis.of(agreeing)
            self._settle(scene_key, known, replace(found, median_depth=median_depth))

    def _with_kept(self, known: _Known, stored: Mapping[Pair, float], adopted: Set[str]) -> dict[Pair, float]:
        """All errors that are known, of references that exist and are not adopted."""
        with self._guard:
            kept = {pair: it for pair, it in known.errors_px.items() if pair not in stored}
        keys = {key for pair in kept for key in pair} - {key for pair in stored for key in pair}
        existing = self._pairs.list_existing(keys) if keys else set()
        without = (keys - existing) | adopted
        return {pair: it for pair, it in {**stored, **kept}.items() if without.isdisjoint(pair)}

    def _settle(self, scene_key: SceneKey, known: _Known, found: Agreement) -> None:
        """Makes a result known; an explanation that was found before remains while the scene contradicts itself.

        So does a depth while pairs agree.
        """
        before = known.agreement or Agreement()
        if found.contradicts_itself and not found.explanation:
            found = replace(found, explanation=before.explanation)
        if found.agreeing_count and found.median_depth is None:
            found = replace(found, median_depth=before.median_depth)
        found = replace(found, depths=known.depth_warnings)
        new = [it for it in found.depths if it not in before.depths]
        with self._guard:
            known.agreement = found
            if self._scenes.get(scene_key) is not known:  # deleted meanwhile
                return
            (self._contradicting.add if found.contradicts_itself else self._contradicting.discard)(scene_key)
        if found.contradicts_itself != before.contradicts_itself:
            self._count()
            if found.contradicts_itself:
                log.warning("scene %s: %s", scene_key, found.contradiction)
            else:
                log.info("scene %s does not contradict itself any more", scene_key)
        elif found.explanation and not before.explanation:
            log.warning("scene %s: likely: %s", scene_key, found.explanation)
        for text in new:
            log.warning("scene %s: %s", scene_key, text)

    def _count(self) -> None:
        self._observer.waiting("contradicting_scenes", len(self._contradicting))

    def _check(self) -> None:
        if self._closing.is_set():
            raise Closed

    def _sample(self, scene_key: SceneKey, known: _Known, stored: Collection[Pair]) -> None:
        """Matches a few references with those that look most similar; not pairs that are stored."""
        entries = self._indexes.entries(scene_key, StageContext(self._check))
        rows = entries.rows()
        is_small = len(rows) <= SAMPLED_REFERENCES
        if len(rows) < LEAST_REFERENCES or (not is_small and len(rows) < GROWTH * known.sampled_size):
            return
        known.sampled_size = len(rows)
        places = np.linspace(0, len(rows) - 1, min(len(rows), SAMPLED_REFERENCES)).round().astype(int)
        for row in rows[np.unique(places)]:
            reference_id, key, _ = entries.reference(int(row))
            if key in known.sampled:
                continue
            beside = rank_beside(entries, reference_id, SAMPLED_NEIGHBOURS)
            if len(beside) == SAMPLED_NEIGHBOURS:  # of a smaller scene others may follow
                known.sampled.add(key)
            views = self._explainer.load(scene_key, [reference_id, *(it.reference_id for it in beside)])
            for other in views[1:]:
                self._check()
                first, second = in_order(views[0], other)
                if (first.key, second.key) not in stored:
                    self._compare(known, first, second)

    def _compare(self, known: _Known, first: PosedView, second: PosedView) -> None:
        pair = first.key, second.key
        if pair not in known.errors_px:
            self._matcher.pairs.match(first, second)
            error_px = self._matcher.pairs.error_px(first, second)
            if error_px is not None:
                with self._guard:
                    known.errors_px[pair] = error_px


def _some(texts: Sequence[str]) -> list[str]:
    """The first sentences, and how many more there are."""
    more = [f"the same holds for {len(texts) - NAMED} more poses"] if len(texts) > NAMED else []
    return [*texts[:NAMED], *more]
