"""Correspondences: matches of keypoints between photographs.

Matches between references, whose poses are known, must also satisfy the epipolar constraint; they depend only on the
two stored references, so they are made once, ahead of the queries (`scenes.background`) or by the first one that needs
them, and cached. Matches of the query with each reference come from descriptors alone, or from a network that compares
all keypoints of both photographs: implementations of `QueryMatching`. Where such a network is slow, it matches only the
references with the most matches again, and pairs of references ahead of the queries: `PairMatching`.

Between distant references few matches pass the ratio test over all keypoints. Wide correspondences add matches that
pass it among the keypoints along the epipolar line: many more, of which more are wrong, so they are used only for
queries that fail otherwise.

How two photographs are matched is in `matching`.
"""

import time
from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from mapless_server.cache import LruCache

from ..features.matching import (
    OPTIONS,
    CorrespondOptions,
    NearestNeighbours,
    PairMatching,
    QueryMatching,
    SharedThreads,
    StoredPairs,
)
from ..features.nearest import best_of_both, mutual_matches_of_ratios
from ..features.tracks import Tracks, build_tracks
from ..features.views import Matches, PosedView, View
from .agreement import ReferenceErrors, pair_error_px, thinned
from .epipolar import epipolar_distance_px, epipolar_distances_px
from .pair import PairKey, PairMatches, in_order, is_one_photograph
from .stationary import StationaryOptions, stationary_matches
from .stationary_filter import references_without_fixed, without_fixed

_PAIRS_THAT_COUNT = 10
"""For `Matcher.pair_s`, about."""

PAIR_RULE = 4
"""Version of how two references are matched; to be raised by every change that can change a match."""


@dataclass(frozen=True, eq=False)
class MatchedReferences:
    """References whose matches with one another are determined by their keys and a rule.

    Attributes:
        references: with their poses in the caller's world, in the order of the query.
        rule: name of everything else that determines the matches.
        cache: results of sets of references, whatever their order; its keys begin with the references' keys.
    """

    references: tuple[PosedView, ...]
    rule: str
    cache: LruCache[Any]

    def key(self, *further: Hashable) -> Hashable:
        """Key for a result that depends on the references, their matches and `further` values alone."""
        return tuple(sorted(reference.key for reference in self.references)), self.rule, *further


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Matches of one query and its references.

    Attributes:
        reference_pairs: for each i < j, matches between references i and j.
        query_matches: for each reference, matches (query keypoint, reference keypoint).
        reference_error_px: returns the error of a pair of references, by their indices, see `agreement`; None where
            the references were not matched by a `Matcher`.
        source: the references as they were matched, and where results from these alone are cached; None caches none.
        stationary_count: number of keypoints of the query whose matches were left out, see `stationary`.
    """

    reference_pairs: Mapping[tuple[int, int], Matches]
    query_matches: tuple[Matches, ...]
    source: MatchedReferences | None = None
    stationary_count: int = 0
    reference_error_px: ReferenceErrors | None = None
    _tracks: dict[int | None, Tracks] = field(default_factory=dict, init=False, repr=False)

    def tracks(self, references: Sequence[PosedView], anchor: int | None = None) -> Tracks:
        """Builds the tracks over the references, once for all stages; `anchor` as in `build_tracks`."""
        if anchor not in self._tracks:
            counts = [len(reference.view.features) for reference in references]
            self._tracks[anchor] = build_tracks(self.reference_pairs, counts, anchor)
        return self._tracks[anchor]


class Matcher:
    """Matches views and caches the matches of references. Thread-safe.

    A query's pairs are distributed over `threads`: a single query takes half the time on two threads, and concurrent
    queries take no more processor time, because each product is computed by one thread.

    Attributes:
        options: options of matching.
        pair_matching: matches the query again with its best references, and references ahead of the queries; None if
            nothing does. Its *strong* pairs of references are only looked up in `stored` by a query, which has no time
            to make them, and matches the others by nearest neighbours. So its answer depends on which are stored.
        pair_s: mean time of `pair_matching` for a pair of the last queries, seconds; None before the first.
        stored: where pairs that are not cached are looked up; None looks up none.
    """

    def __init__(
        self,
        options: CorrespondOptions | None = None,
        threads: int = 1,
        query_matching: QueryMatching | None = None,
        pair_matching: PairMatching | None = None,
    ) -> None:
        self.options = options or CorrespondOptions()
        self.pair_matching = pair_matching
        self.pair_s: float | None = None
        self.stationary = StationaryOptions()
        self.stored: StoredPairs | None = None
        self._threads = SharedThreads(threads)
        self._query_matching = query_matching or NearestNeighbours(self.options.query_ratio, self._threads)
        self._remembered: LruCache[PairMatches] = LruCache(self.options.remembered_pairs)
        self._errors: LruCache[float] = LruCache(self.options.remembered_pairs)
        self._distinct: LruCache[Matches] = LruCache(self.options.remembered_pairs)
        self._structures: LruCache[Any] = LruCache(self.options.structure_bytes)

    def correspond(
        self,
        query: View,
        references: Sequence[PosedView],
        wide: bool = False,
        check: Callable[[], None] = lambda: None,
        query_matches: Sequence[Matches] | None = None,
    ) -> Correspondences:
        """Finds matches between all pairs of references, wide ones if `wide`, and of the query with each reference.

        Calls `check` before each pair and does not catch what it raises. `query_matches`, if known already from
        `match_query` or another call with the same references, are used as they are.
        """
        pairs = list(combinations(range(len(references)), 2))
        self._look_up([in_order(references[i], references[j]) for i, j in pairs], wide)
        keys = {(i, j): self._key(in_order(references[i], references[j]), wide) for i, j in pairs}

        def of_pair(pair: tuple[int, int]) -> PairMatches:
            check()
            return self._pair(references[pair[0]], references[pair[1]], keys[pair])

        found = dict(zip(pairs, self._threads.map(of_pair, pairs), strict=True))
        if query_matches is None:
            query_matches = self.match_query(query, references, check)
        fixed = references_without_fixed(references, found, frozenset(keys.values()), self.stationary, self._structures)
        of_pairs, matches, count = without_fixed(query, references, found, query_matches, fixed)
        kept = Correspondences(of_pairs, matches, stationary_count=count)
        # Strong matches of a pair may be stored at any time, so that its matches are not determined.
        source = MatchedReferences(tuple(references), self.matching(wide), self._structures)
        known = source if self.pair_matching is None else None

        def error_px(i: int, j: int) -> float | None:
            return self.error_px(references[i], references[j])

        return replace(kept, source=known, reference_error_px=error_px)

    def match_query(
        self, query: View, references: Sequence[PosedView], check: Callable[[], None] = lambda: None
    ) -> Sequence[Matches]:
        """Finds matches between the query and each reference; `check` as in `correspond`."""
        matches = list(self.match_quickly(query, references, check))
        for i in self.to_rematch(matches):
            check()
            matches[i] = self.rematch(query, references[i])
        return matches

    def match_quickly(
        self, query: View, references: Sequence[PosedView], check: Callable[[], None] = lambda: None
    ) -> Sequence[Matches]:
        """Finds the matches that references are chosen by, without `rematch`; final if there is no `pair_matching`."""
        return self._query_matching.match(query, references, check)

    def match_best(
        self,
        query: View,
        references: Sequence[PosedView],
        count: int,
        choose: Callable[[Sequence[int], Sequence[int]], list[int]],
        check: Callable[[], None] = lambda: None,
    ) -> dict[int, Matches]:
        """Matches the query with those of many references that are chosen for it, as `match_quickly` does.

        They are chosen by a sample of the query's keypoints, if these have enough matches, so that the others need not
        be matched.

        Args:
            query: the query.
            references: at least one.
            count: how many are wanted.
            choose: function that returns the indices of these, in order, from indices of references and their numbers
                of matches.
            check: as in `correspond`.

        Returns:
            Index of each chosen reference, in order, and its matches.
        """
        candidates: Sequence[int] = range(len(references))
        if len(references) > count and isinstance(self._query_matching, NearestNeighbours):
            sample = replace(query, features=query.features.every(self.options.sampled_share))
            counts = [len(found) for found in self.match_quickly(sample, references, check)]
            chosen = choose(candidates, counts)
            if sum(counts[i] for i in chosen) >= self.options.enough_sampled * len(chosen):
                candidates = chosen
        matches = self.match_quickly(query, [references[i] for i in candidates], check)
        found = dict(zip(candidates, matches, strict=True))
        return {i: found[i] for i in choose(candidates, [len(it) for it in matches])}

    def to_rematch(self, matches: Sequence[Matches]) -> list[int]:
        """Returns the indices of the references that `rematch` should match with a query, the best first."""
        if self.pair_matching is None:
            return []
        best_first = sorted(range(len(matches)), key=lambda i: -len(matches[i]))
        return best_first[: self.options.rematched_references]

    def rematch(self, query: View, reference: PosedView) -> Matches:
        """Matches a query with one reference by the `pair_matching`."""
        assert self.pair_matching is not None
        begin_s = time.monotonic()
        matches = self.pair_matching.match_one(query, reference.view)
        spent_s = time.monotonic() - begin_s
        usual_s = self.pair_s  # read once: another thread may forget it
        self.pair_s = spent_s if usual_s is None else usual_s + (spent_s - usual_s) / _PAIRS_THAT_COUNT
        return matches

    def rematch_together(self, query: View, references: Sequence[PosedView]) -> list[Matches]:
        """Matches a query with each of some references by the `pair_matching`, in the threads that are free."""
        return self._threads.map(lambda reference: self.rematch(query, reference), references)

    @property
    def threads(self) -> int:
        """How many pairs are matched at a time, where no other query matches."""
        return self._threads.threads

    def close(self) -> None:
        """Ends the threads."""
        self._threads.close()

    def matching(self, wide: bool = False, strong: bool = False) -> str:
        """Returns a name for everything that determines a pair's matches, except for the two references."""
        options = self.options
        strict = f"{PAIR_RULE}-{options.reference_ratio}-{options.epipolar_px}"
        if strong:
            assert self.pair_matching is not None
            strict = f"{PAIR_RULE}-{self.pair_matching.name}-{options.epipolar_px}-{options.enough_matches}"
        return f"wide-{strict}-{options.wide_ratio}-{options.wide_similarity}" if wide else f"strict-{strict}"

    def match_references(self, first: PosedView, second: PosedView, wide: bool = False) -> Matches:
        """Finds matches between two references, each within `epipolar_px` of the epipolar line of the known poses.

        They are strong ones if the strict matches have been looked up as such; otherwise from nearest neighbours.
        """
        return self._pair(first, second, self._key(in_order(first, second), wide)).agreeing

    def _key(self, pair: tuple[PosedView, PosedView], wide: bool) -> PairKey:
        """The key of the matches of a pair, given `in_order`: strong ones, where they have been looked up."""
        return PairKey.of(pair, wide, self._remembered.get(PairKey.of(pair, False, True)) is not None)

    def _pair(self, first: PosedView, second: PosedView, key: PairKey) -> PairMatches:
        pair = in_order(first, second)
        matches = self._remembered.get(key)
        if matches is None:
            if key.strong and not key.wide:  # not cached any more
                return self._pair(first, second, key._replace(strong=False))
            strict = self._pair(*pair, self._key(pair, False)).all if key.wide else self._match_strictly(*pair)
            made = self._widened(*pair, strict) if key.wide else strict
            matches = PairMatches.of(*pair, made, self.stationary)
            self._remembered.put(key, matches)
        return matches if pair[0] is first else matches.swapped()

    def match_pair(
        self,
        first: PosedView,
        second: PosedView,
        wide: bool = False,
        strong: bool = False,
        strict: Matches | None = None,
        pause: Callable[[], None] = lambda: None,
    ) -> Matches:
        """Computes the matches of two references, given `in_order`, anew and without caching them.

        Stationary ones come last: what is fixed to a camera is found by them (see `stationary`).

        Args:
            first: a reference.
            second: another one.
            wide: whether the matches are wide ones.
            strong: whether to match by `pair_matching`.
            strict: the matches that are not wide, if they are known.
            pause: see PairMatching.
        """
        if strict is None:
            strict = self._match_strongly(first, second, pause) if strong else self._match_strictly(first, second)
        return self._widened(first, second, strict) if wide else strict

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

    def _look_up(self, pairs: Sequence[tuple[PosedView, PosedView]], wide: bool) -> None:
        """Caches those of these pairs that are stored, strong matches if there are any."""
        if self.stored is None:
            return
        strong = self._found(pairs, False, True) if self.pair_matching else [False] * len(pairs)
        others = [pair for pair, is_strong in zip(pairs, strong, strict=True) if not is_strong]
        self._found(others, wide, False)
        if wide and self.pair_matching:
            self._found([pair for pair, is_strong in zip(pairs, strong, strict=True) if is_strong], wide, True)

    def _found(self, pairs: Sequence[tuple[PosedView, PosedView]], wide: bool, strong: bool) -> list[bool]:
        """Caches these pairs' stored matches; returns which of the pairs are cached then."""
        keys = [PairKey.of(pair, wide, strong) for pair in pairs]
        found = [self._remembered.get(key) is not None for key in keys]
        missing = [i for i, is_cached in enumerate(found) if not is_cached]
        if missing and self.stored is not None:
            stored = self.stored.find(self.matching(wide, strong), [pairs[i] for i in missing])
            for i, it in zip(missing, stored, strict=True):
                if it is not None:
                    self._remembered.put(keys[i], PairMatches.of(*pairs[i], it.matches, self.stationary))
                    self._note_error(*pairs[i], it.error_px)
                    found[i] = True
        return found

    def forget(self, keys: Collection[str]) -> None:
        """Removes what was computed from deleted references from the caches, in time linear in their size."""
        gone = frozenset(keys)
        self._remembered.forget(lambda pair, _: pair.first in gone or pair.second in gone)
        for of_pairs in (self._errors, self._distinct):
            of_pairs.forget(lambda pair, _: not gone.isdisjoint(pair))
        self._structures.forget(lambda key, _: not gone.isdisjoint(key[0]))

    def _match_strictly(self, first: PosedView, second: PosedView) -> Matches:
        ratios = self.options.reference_ratio, self.options.distinct_ratio
        return self._filtered(
            first, second, *mutual_matches_of_ratios(first.view.features, second.view.features, ratios)
        )

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
        added = best_of_both(similarity, self.options.wide_ratio, self.options.wide_similarity)
        taken = np.isin(added[:, 0], strict[:, 0]) | np.isin(added[:, 1], strict[:, 1])
        return np.concatenate([strict, added[~taken]])


def make_matcher(features: str, threads: int = 1, weights: Path | None = None, device: str = "cpu") -> Matcher:
    """Makes the matcher for an extractor.

    Args:
        features: one of `OPTIONS`.
        threads: number of threads that a query's pairs are distributed over.
        weights: of the features' LightGlue; None takes nearest neighbours alone. On a CUDA device LightGlue matches the
            query; on a CPU, where it is slow, it is the `Matcher.pair_matching`.
        device: "cpu" or a CUDA device, for LightGlue.

    Raises:
        ValueError: unknown name, or features without a LightGlue.
        CheckpointError: the weights do not fit.
        ImportError: a package that LightGlue needs is not installed.
    """
    if features not in OPTIONS:
        raise ValueError(f"unknown features {features!r}; known: {', '.join(OPTIONS)}")
    if weights is None:
        return Matcher(OPTIONS[features], threads)
    from mapless_server.networks.lightglue import load_lightglue

    from ..features.lightglue import LightGlueMatching

    network, sha256 = load_lightglue(features, weights)
    light_glue = LightGlueMatching(network, device, sha256=sha256)
    if device == "cpu":
        return Matcher(OPTIONS[features], threads, pair_matching=light_glue)
    return Matcher(OPTIONS[features], threads, light_glue)
