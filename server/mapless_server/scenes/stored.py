"""Lets queries find what was made of references before: matches of pairs, and depths."""

import logging
import threading
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

from mapless_server.cache import LruCache
from mapless_server.method.features.extractors import FeatureExtractor
from mapless_server.method.features.matching import StoredPair
from mapless_server.method.features.views import KeypointDepths, Matches, PosedView
from mapless_server.method.pairs.correspond import Matcher
from mapless_server.method.pairs.pair import Matching
from mapless_server.store.database import Database
from mapless_server.store.depths import load_depths
from mapless_server.store.pairs import Pair, PairStore

from .observer import BackgroundObserver

log = logging.getLogger(__name__)

_CACHE_BYTES = 32 * 2**20
"""Depths at the keypoints of some 4000 references with 2000 keypoints each."""


@dataclass(frozen=True, eq=False)
class TierMatching:
    """A way in which references are matched, by the extractor's features and the matcher of the queries."""

    extractor: FeatureExtractor
    matcher: Matcher
    kind: Matching = Matching.STRICT

    @property
    def name(self) -> str:
        """Name of the matching, as `PairStore` expects it."""
        return matching_name(self.extractor.name, self.matcher.pairs.name(self.kind))

    @property
    def base(self) -> "TierMatching | None":
        """The matching whose matches of a pair this one begins with."""
        return None if self.kind.base is None else replace(self, kind=self.kind.base)

    def match_pair(
        self, first: PosedView, second: PosedView, begun: Matches | None, pause: Callable[[], None]
    ) -> Matches | None:
        """Matches two references, given `in_order`; None if the pair needs no matches of this kind.

        `begun` are matches by `base`, if they are stored; for `pause` see `PairMatching`.
        """
        pairs = self.matcher.pairs
        if self.kind is Matching.STRONG:
            nearest = pairs.make(first, second) if begun is None else begun
            return None if pairs.has_enough(nearest) else pairs.make(first, second, self.kind, pause=pause)
        if self.kind is Matching.STRONG_WIDE and begun is None:
            return None
        return pairs.make(first, second, self.kind, begun)


def matching_name(extractor: str, rule: str) -> str:
    """Returns a name for the features and the rule by which they are matched, see `ReferencePairs.name`."""
    return f"{extractor}/{rule}"


class PairFinder:
    """Implements `method.features.matching.StoredPairs` for the matcher of one extractor's features."""

    def __init__(self, pairs: PairStore, extractor: str, observer: BackgroundObserver) -> None:
        """`extractor` is the name of the features that are matched."""
        self._pairs = pairs
        self._extractor = extractor
        self._observer = observer
        self._damaged: dict[str, set[Pair]] = {}
        self._guard = threading.Lock()

    def find(self, matching: str, pairs: Sequence[tuple[PosedView, PosedView]]) -> list[StoredPair | None]:
        """See `StoredPairs.find`."""
        try:
            found, damaged_count = self._read(matching_name(self._extractor, matching), pairs)
        except Exception as error:  # the query can do without
            log.warning("stored matches cannot be read, and are made by the query: %s", error)
            self._observer.count("stored_pairs_failures")
            return [None] * len(pairs)
        stored_count = sum(it is not None for it in found)
        absent_count = len(pairs) - stored_count - damaged_count
        self._observer.looked_up("stored_pairs", stored_count, absent_count, damaged_count)
        return found

    def find_one(self, name: str, first: PosedView, second: PosedView) -> Matches | None:
        """The matches of a pair, given `in_order`, for the background; None if not stored. Errors as in PairStore."""
        stored = self._read(name, [(first, second)])[0][0]
        return None if stored is None else stored.matches

    def _read(self, name: str, pairs: Sequence[tuple[PosedView, PosedView]]) -> tuple[list[StoredPair | None], int]:
        """Reads what is stored, undamaged, of each pair; also returns the number of damaged ones."""
        keys = [(first.key, second.key) for first, second in pairs]
        stored = self._pairs.load(name, keys)
        found = {
            key: it
            for key, pair in zip(keys, pairs, strict=True)
            if (it := stored.get(key)) is not None and _is_within(it.matches, *pair)
        }
        damaged = stored.keys() - found.keys()
        if damaged:
            log.error("%d damaged pairs of references are matched again", len(damaged))
            with self._guard:
                self._damaged.setdefault(name, set()).update(damaged)
        return [found.get(key) for key in keys], len(damaged)

    def take_damaged(self, name: str) -> Collection[Pair]:
        """Returns the pairs of a matching that were found damaged since the last call."""
        with self._guard:
            return self._damaged.pop(name, set())


def _is_within(matches: Matches, first: PosedView, second: PosedView) -> bool:
    """Whether all matched keypoints exist in both photographs."""
    counts = len(first.view.features), len(second.view.features)
    return bool(((matches >= 0) & (matches < counts)).all())


class DepthFinder:
    """Adds stored depths to loaded references; thread-safe."""

    def __init__(self, database: Database, observer: BackgroundObserver, kind: str | None = None) -> None:
        """`kind` is that of the depths; None for any kind of the present version, made by any server."""
        self._database = database
        self._observer = observer
        self._kind = kind
        self._cache: LruCache[KeypointDepths] = LruCache(_CACHE_BYTES)
        self._damaged: set[tuple[str, str]] = set()
        self._guard = threading.Lock()

    def with_depths(self, references: Sequence[PosedView], extractor: str) -> tuple[PosedView, ...]:
        """Returns the references with the depths stored for their keypoints, of this extractor; never raises."""
        found = {it.key: self._cache.get((it.key, extractor)) for it in references}
        missing = [it for it in references if found[it.key] is None]
        if missing:
            try:
                found |= self._read(missing, extractor)
            except Exception as error:  # the query can do without
                log.warning("kept depths cannot be read, and are not used: %s", error)
                self._observer.count("depth_failures")
        return tuple(it if found[it.key] is None else replace(it, depths=found[it.key]) for it in references)

    def _read(self, references: Sequence[PosedView], extractor: str) -> dict[str, KeypointDepths]:
        stored = load_depths(self._database, [it.key for it in references], self._kind)
        if stored.damaged:
            log.error("%d damaged depths of references are not used, and made again", len(stored.damaged))
            with self._guard:
                self._damaged |= stored.damaged
        found = {it.key: stored.depths[it.key].at_keypoints(it.view) for it in references if it.key in stored.depths}
        for key, depths in found.items():
            self._cache.put((key, extractor), depths, depths.depth.nbytes)
        damaged_count = len({key for _, key in stored.damaged} - found.keys())
        absent_count = len(references) - len(found) - damaged_count
        self._observer.looked_up("stored_depths", len(found), absent_count, damaged_count)
        return found

    def take_damaged(self) -> frozenset[tuple[str, str]]:
        """Returns kinds and keys of the depths that were found damaged since the last call."""
        with self._guard:
            damaged, self._damaged = frozenset(self._damaged), set()
        return damaged
