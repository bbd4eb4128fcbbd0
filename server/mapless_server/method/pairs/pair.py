"""Pairs of references, whose poses are known: their matches, which also satisfy the epipolar constraint.

They depend only on the two references, so they are made once, ahead of the queries (`scenes.background`) or by the
first query that needs them, and cached.

Between distant references few matches pass the ratio test over all keypoints. Wide matches are more that pass it among
the keypoints along the epipolar line: many more, of which more are wrong, so they are used only for queries that fail
otherwise. Strong ones are made by a network that compares all keypoints of both photographs.
"""

from collections.abc import Callable, Sequence
from enum import Enum
from typing import NamedTuple

import numpy as np

from mapless_server.cache import LruCache

from ..features.matching import CorrespondOptions, PairMatching, StoredPairs, best_of_both, mutual_matches_of_ratios
from ..features.views import Matches, PosedView
from .agreement import pair_error_px, thinned
from .epipolar import epipolar_distance_px, epipolar_distances_px
from .stationary import StationaryOptions, stationary_matches

PAIR_RULE = 4
"""Version of how two references are matched; to be raised by every change that can change a match."""

Pair = tuple[PosedView, PosedView]


class Matching(Enum):
    """How two references are matched with one another."""

    STRICT = "nearest"
    WIDE = "nearest, wide"
    STRONG = "network"
    STRONG_WIDE = "network, wide"

    @property
    def is_wide(self) -> bool:
        """Whether matches along the epipolar lines are added."""
        return self in (Matching.WIDE, Matching.STRONG_WIDE)

    @property
    def is_strong(self) -> bool:
        """Whether a `PairMatching` makes the matches, or those that wide ones begin with."""
        return self in (Matching.STRONG, Matching.STRONG_WIDE)

    @property
    def base(self) -> "Matching | None":
        """The matching whose matches of a pair this one begins with; None for strict ones."""
        if self is Matching.STRICT:
            return None
        return Matching.STRONG if self is Matching.STRONG_WIDE else Matching.STRICT

    @property
    def widened(self) -> "Matching":
        """The matching that adds matches along the epipolar lines to this one's."""
        return Matching.STRONG_WIDE if self.is_strong else Matching.WIDE

    @property
    def narrow(self) -> "Matching":
        """The matching without matches along the epipolar lines."""
        return Matching.STRONG if self.is_strong else Matching.STRICT


class PairMatches(NamedTuple):
    """The matches of two references.

    Attributes:
        agreeing: matches that agree with the known poses.
        stationary: matches at the same pixels, where the poses do not allow any.
    """

    agreeing: Matches
    stationary: Matches

    @classmethod
    def of(cls, first: PosedView, second: PosedView, matches: Matches, options: StationaryOptions) -> "PairMatches":
        """Separates the matches that are stored of a pair."""
        fixed = stationary_matches(first, second, matches, options)
        return cls(matches[~fixed], matches[fixed]) if fixed.any() else cls(matches, matches[:0])

    @property
    def all(self) -> Matches:
        """All of them, as they are stored."""
        return np.concatenate(self) if len(self.stationary) else self.agreeing

    def swapped(self) -> "PairMatches":
        """The same matches with the views exchanged."""
        return PairMatches(*(np.ascontiguousarray(it[:, ::-1]) for it in self))


class PairKey(NamedTuple):
    """The key of a pair of references in the cache."""

    first: str
    second: str
    matching: Matching

    @classmethod
    def of(cls, pair: Pair, matching: Matching) -> "PairKey":
        """The key of a pair, given `in_order`."""
        return cls(pair[0].key, pair[1].key, matching)


def is_one_photograph(first: PosedView, second: PosedView) -> bool:
    """Whether two references are one photograph at two poses, of two places that are copies of each other.

    Its matches with itself say nothing of the place, but satisfy the epipolar constraint of poses that are only shifted
    against each other: points at infinity, with which any position agrees.
    """
    return np.array_equal(first.view.features.keypoints, second.view.features.keypoints)


def in_order(first: PosedView, second: PosedView) -> Pair:
    """Returns two references in the order of their names, in which they are always matched.

    The ratio test of wide matches is not symmetric, and the order decides how sums are rounded. Names, unlike keys, are
    the same wherever the scene is stored.
    """
    return (first, second) if (first.name, first.key) <= (second.name, second.key) else (second, first)


class ReferencePairs:
    """Matches pairs of references, and caches the matches. Thread-safe.

    A pair has *strong* matches only where `stored` has them: a query has no time to make them, and matches the others
    by nearest neighbours. So its answer depends on which are stored.

    Attributes:
        options: options of matching.
        pair_matching: makes the strong matches; None if nothing does.
        stationary: options of finding what is fixed to the cameras.
        stored: where pairs that are not cached are looked up; None looks up none.
    """

    def __init__(
        self,
        options: CorrespondOptions,
        pair_matching: PairMatching | None = None,
    ) -> None:
        self.options = options
        self.pair_matching = pair_matching
        self.stationary = StationaryOptions()
        self.stored: StoredPairs | None = None
        self._cached: LruCache[PairMatches] = LruCache(options.remembered_pairs)
        self._errors: LruCache[float] = LruCache(options.remembered_pairs)
        self._distinct: LruCache[Matches] = LruCache(options.remembered_pairs)

    def name(self, matching: Matching = Matching.STRICT) -> str:
        """Returns a name for everything that determines a pair's matches, except for the two references."""
        options = self.options
        base = f"{PAIR_RULE}-{options.reference_ratio}-{options.epipolar_px}"
        if matching.is_strong:
            assert self.pair_matching is not None
            base = f"{PAIR_RULE}-{self.pair_matching.name}-{options.epipolar_px}-{options.enough_matches}"
        return (
            f"wide-{base}-{options.distinct_ratio}-{options.wide_similarity}" if matching.is_wide else f"strict-{base}"
        )

    def match(self, first: PosedView, second: PosedView, matching: Matching = Matching.STRICT) -> Matches:
        """Finds matches between two references, each within `epipolar_px` of the epipolar line of the known poses.

        `matching` is strict or wide. They are strong ones if these are cached; otherwise from nearest neighbours.
        """
        return self.find(first, second, matching)[1].agreeing

    def find(self, first: PosedView, second: PosedView, matching: Matching) -> tuple[PairKey, PairMatches]:
        """The same with stationary matches, and the key of what was found: it says whether they are strong ones."""
        pair = in_order(first, second)
        key = PairKey.of(pair, Matching.STRONG)
        found = base = self._cached.get(key)
        if base is None or matching.is_wide:
            key = PairKey.of(pair, matching if base is None else Matching.STRONG_WIDE)
            found = self._cached.get(key)
        if found is None:
            if matching.is_wide:
                begun = self.find(*pair, Matching.STRICT)[1] if base is None else base
                made = self._widened(*pair, begun.all)
            else:
                made = self._match_strictly(*pair)
            found = PairMatches.of(*pair, made, self.stationary)
            self._cached.put(key, found)
        return key, found if pair[0] is first else found.swapped()

    def make(
        self,
        first: PosedView,
        second: PosedView,
        matching: Matching = Matching.STRICT,
        begun: Matches | None = None,
        pause: Callable[[], None] = lambda: None,
    ) -> Matches:
        """Computes the matches of two references, given `in_order`, anew and without caching them.

        Stationary ones come last: what is fixed to a camera is found by them (see `stationary`). `begun` are the
        matches that wide ones begin with, if they are known; for `pause` see PairMatching.
        """
        if begun is None:
            strong = matching.is_strong
            begun = self._match_strongly(first, second, pause) if strong else self._match_strictly(first, second)
        return self._widened(first, second, begun) if matching.is_wide else begun

    def error_px(self, first: PosedView, second: PosedView) -> float | None:
        """The error of a pair by `pair_error_px`; None if it has too few matches, or was neither matched nor stored.

        It is computed when it is first asked for, in a millisecond or two.
        """
        pair = in_order(first, second)
        key = pair[0].key, pair[1].key
        error_px = self._errors.get(key)
        if error_px is None and (distinct := self._distinct.get(key)) is not None:
            error_px = pair_error_px(*pair, distinct)
            self._note_error(*pair, error_px)
            self._distinct.pop(key)
        return error_px

    def has_enough(self, nearest: Matches) -> bool:
        """Whether nearest neighbours find so many matches of a pair that `pair_matching` is not used for it."""
        return len(nearest) >= self.options.enough_matches

    def look_up(self, pairs: Sequence[Pair], matching: Matching) -> None:
        """Caches those of these pairs, given `in_order`, that are stored: strong matches if there are any."""
        if self.stored is None:
            return
        strong = self._look_up(pairs, Matching.STRONG) if self.pair_matching else [False] * len(pairs)
        self._look_up([pair for pair, is_strong in zip(pairs, strong, strict=True) if not is_strong], matching)
        if matching.is_wide and self.pair_matching:
            found = [pair for pair, is_strong in zip(pairs, strong, strict=True) if is_strong]
            self._look_up(found, Matching.STRONG_WIDE)

    def _look_up(self, pairs: Sequence[Pair], matching: Matching) -> list[bool]:
        """Caches these pairs' stored matches; returns which of the pairs are cached then."""
        keys = [PairKey.of(pair, matching) for pair in pairs]
        found = [self._cached.get(key) is not None for key in keys]
        missing = [i for i, is_cached in enumerate(found) if not is_cached]
        if missing and self.stored is not None:
            stored = self.stored.find(self.name(matching), [pairs[i] for i in missing])
            for i, it in zip(missing, stored, strict=True):
                if it is not None:
                    self._cached.put(keys[i], PairMatches.of(*pairs[i], it.matches, self.stationary))
                    self._note_error(*pairs[i], it.error_px)
                    found[i] = True
        return found

    def forget(self, gone: frozenset[str]) -> None:
        """Removes what was computed from references with these keys, in time linear in the size of the caches."""
        self._cached.forget(lambda pair, _: pair.first in gone or pair.second in gone)
        for of_pairs in (self._errors, self._distinct):
            of_pairs.forget(lambda pair, _: not gone.isdisjoint(pair))

    def _match_strictly(self, first: PosedView, second: PosedView) -> Matches:
        ratios, features = (self.options.reference_ratio, self.options.distinct_ratio), first.view.features
        matches, distinct = mutual_matches_of_ratios(features, second.view.features, ratios)
        return self._filtered(first, second, matches, distinct)

    def _match_strongly(self, first: PosedView, second: PosedView, pause: Callable[[], None]) -> Matches:
        assert self.pair_matching is not None
        matches = self.pair_matching.match_one(first.view, second.view, pause)
        return self._filtered(first, second, matches, matches)

    def _note_error(self, first: PosedView, second: PosedView, error_px: float | None) -> None:
        if error_px is not None:
            self._errors.put((first.key, second.key), error_px)

    def _filtered(self, first: PosedView, second: PosedView, matches: Matches, distinct: Matches) -> Matches:
        if is_one_photograph(first, second):
            return matches[:0]
        moving = distinct[~stationary_matches(first, second, distinct, self.stationary)]
        self._distinct.put((first.key, second.key), thinned(moving))
        stationary = stationary_matches(first, second, matches, self.stationary)
        agreeing = epipolar_distance_px(first, second, matches) < self.options.epipolar_px
        return PairMatches(matches[agreeing & ~stationary], matches[stationary]).all

    def _widened(self, first: PosedView, second: PosedView, strict: Matches) -> Matches:
        """Returns the strict matches, and matches along the epipolar lines of the other keypoints."""
        if is_one_photograph(first, second):
            return strict
        similarity = first.view.features.unit_descriptors() @ second.view.features.unit_descriptors().T
        similarity[epipolar_distances_px(first, second) >= self.options.epipolar_px] = -1.0
        (added,) = best_of_both(similarity, (self.options.distinct_ratio,), self.options.wide_similarity)
        taken = np.isin(added[:, 0], strict[:, 0]) | np.isin(added[:, 1], strict[:, 1])
        return np.concatenate([strict, added[~taken]])
