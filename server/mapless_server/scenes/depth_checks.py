"""Whether the depths that sensors measured with references fit what other references see.

A reference with depth is compared with the references that look most similar, if they share matches that agree with
their poses: by the points that it triangulates with them, and by their depths. If none shares enough, by their depths
alone. See `method.structure.depth_mistakes`. A depth whose median cannot be metres is wrong by that alone, and is
compared with nothing.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from mapless.depth import implausible_median
from mapless_server.cache import LruCache
from mapless_server.errors import DataLoss, NotFound
from mapless_server.method.features.extractors import FeatureExtractor
from mapless_server.method.features.views import Matches, PosedView
from mapless_server.method.options import StageContext
from mapless_server.method.pairs.correspond import Matcher
from mapless_server.method.pairs.pair import in_order
from mapless_server.method.structure.depth_mistakes import MIN_PLACES, DepthVerdict, judge_depth
from mapless_server.method.structure.measured_depth import MeasuredDepth
from mapless_server.method.structure.seen_depths import GRID, SeenDepths, depths_of_neighbour, triangulated_depths
from mapless_server.security import SceneKey
from mapless_server.store import Store

from .indexes import SceneIndexes
from .library import ReferenceLibrary
from .measured import read_measured
from .retrieval.ranking import rank_beside

NEIGHBOURS = 2
"""References that each is compared with; the second shows which of two depths is wrong."""
NAMED = 3
"""Wrong depths of a scene that are named."""
_CACHED_VERDICTS, _CACHED_BYTES = 10_000, 32 * 2**20
"""Depths of a few references, so that each is not decoded for every neighbour."""


@dataclass(frozen=True)
class DepthCheck:
    """The key of a reference, the verdict on its depth, and the ids of the neighbours that it was compared with."""

    key: str
    verdict: DepthVerdict
    neighbours: tuple[str, ...]

    @property
    def is_alarm(self) -> bool:
        """Whether this depth is wrong, or it or a neighbour's may be."""
        return bool(self.verdict.mistake or self.verdict.doubt)

    @property
    def doubt(self) -> str:
        """A clause that this depth or the neighbours' may be wrong; empty if none is in doubt."""
        others = ", ".join(map(repr, self.neighbours))
        return self.verdict.doubt and f"either this depth is wrong or that of {others}: {self.verdict.doubt}"


class DepthChecks:
    """Checks measured depths of stored references; thread-safe. A verdict is kept while its neighbours are the same."""

    def __init__(
        self,
        store: Store,
        indexes: SceneIndexes,
        library: ReferenceLibrary,
        extractor: FeatureExtractor,
        matcher: Matcher,
    ) -> None:
        """The extractor and the matcher compare references: those of one of the tiers."""
        self._store, self._indexes, self._library = store, indexes, library
        self._extractor, self._matcher = extractor, matcher
        self._verdicts: LruCache[DepthCheck] = LruCache(_CACHED_VERDICTS)
        self._depths: LruCache[MeasuredDepth] = LruCache(_CACHED_BYTES, keeps_latest=True)

    def with_depth(self, scene_key: SceneKey) -> list[str]:
        """Ids of the references of a scene with a measured depth."""
        return self._store.list_with_depth(scene_key)

    def check(self, scene_key: SceneKey, reference_id: str, check: Callable[[], None]) -> DepthCheck | None:
        """Compares the depth of a reference with its neighbours; None without one, or if it is damaged or deleted.

        `check` is called between steps, and may raise.
        """
        context = StageContext(check)
        entries = self._indexes.entries(scene_key, context)
        if reference_id not in entries:
            return None
        beside = [it.reference_id for it in rank_beside(entries, reference_id, NEIGHBOURS)]
        keys = tuple(entries.reference(int(entries.rows([it])[0]))[1] for it in (reference_id, *beside))
        found = self._verdicts.get(keys)
        if found is None:
            load = self._indexes.load_existing
            views = load(self._library, scene_key, [reference_id, *beside], self._extractor, context)
            if not views or views[0].key != keys[0]:
                return None
            try:
                if not self._has_depth(scene_key, views[0]):
                    return None
                found = self._compared(scene_key, views[0], views[1:], check)
            except (DataLoss, NotFound):
                return None
            self._verdicts.put(keys, found)
        return found

    def _compared(
        self, scene_key: SceneKey, subject: PosedView, others: Sequence[PosedView], check: Callable[[], None]
    ) -> DepthCheck:
        if text := implausible_median(self._depth(scene_key, subject).median):
            text = f"its median is {text}, so it is not used: is unit_m right, 0.001 for millimetres?"
            return DepthCheck(subject.key, DepthVerdict(mistake=text), ())
        matches = {}
        for other in others:
            check()
            matches[other.key] = self._matches(subject, other)
        overlapping = [it for it in others if len(matches[it.key]) >= MIN_PLACES]
        parts: list[SeenDepths] = []
        next_place = len(subject.view.features)
        for other in overlapping or others:
            parts.append(triangulated_depths(subject, other, matches[other.key]) if overlapping else SeenDepths.of([]))
            if self._has_depth(scene_key, other) and not implausible_median(self._depth(scene_key, other).median):
                depth, count = self._depth(scene_key, other), GRID // len(overlapping or others)
                parts.append(depths_of_neighbour(subject, other, depth, next_place, count))
                next_place += len(parts[-1])
        verdict = judge_depth(subject, self._depth(scene_key, subject), SeenDepths.of(parts), bool(overlapping))
        return DepthCheck(subject.key, verdict, tuple(_id_of(it) for it in overlapping or others))

    def _matches(self, subject: PosedView, other: PosedView) -> Matches:
        """Matches (M, 2) of keypoints that agree with both poses."""
        first, second = in_order(subject, other)
        matches = self._matcher.pairs.match(first, second)
        return matches if first is subject else matches[:, ::-1]

    def _has_depth(self, scene_key: SceneKey, view: PosedView) -> bool:
        """Whether a depth was measured with a reference, also one that is not used."""
        return bool(self._store.get_reference(scene_key, _id_of(view)).depth_sha256)

    def _depth(self, scene_key: SceneKey, view: PosedView) -> MeasuredDepth:
        found = self._depths.get(view.key)
        if found is None:
            measured = read_measured(self._store, self._store.get_reference(scene_key, _id_of(view)))
            found = measured.in_photograph(view.view.camera)
            self._depths.put(view.key, found, found.depth.nbytes)
        return found


def depth_warnings(checks: Mapping[str, DepthCheck]) -> list[str]:
    """One sentence each about wrong depths, by the ids of references; of doubts those that no wrong depth explains."""
    wrong = {it: f"the depth of reference {it!r}: {found.verdict.mistake}" for it, found in checks.items()}
    wrong = {it: text for it, text in wrong.items() if checks[it].verdict.mistake}
    explained = set(wrong)
    texts = list(wrong.values())
    for reference_id, found in checks.items():
        if found.doubt and reference_id not in explained and explained.isdisjoint(found.neighbours):
            texts.append(f"the depth of reference {reference_id!r}: {found.doubt}")
            explained |= {reference_id, *found.neighbours}
    more = [f"the depths of {len(texts) - NAMED} more references are wrong, too"] if len(texts) > NAMED else []
    return [*texts[:NAMED], *more]


def _id_of(view: PosedView) -> str:
    return view.name.rpartition("/")[2]
