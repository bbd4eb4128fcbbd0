"""Correspondences: matches of keypoints between photographs, without those of what is fixed to the camera.

Matches between references are in `pair`. Matches of the query with each reference come from descriptors alone, or from
a network that compares all keypoints of both photographs: implementations of `QueryMatching` (see `features.matching`).
Where such a network is slow, it matches only the references with the most matches again, and pairs of references ahead
of the queries: `PairMatching`. What depends on the references alone is cached for them.
"""

import time
from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np

from mapless_server.cache import LruCache

from ..features.matching import (
    CorrespondOptions,
    NearestNeighbours,
    PairMatching,
    QueryMatching,
    RowMaxima,
    SharedThreads,
)
from ..features.views import Features, Matches, PosedView, ReferenceErrors, View
from .fixed import references_without_fixed, without_fixed
from .pair import Matching, PairKey, PairMatches, ReferencePairs, in_order


@dataclass(frozen=True, eq=False)
class Compared:
    """The comparisons of a query's keypoints with references so far, by their keys, so that none is made twice.

    Attributes:
        query: the query, whose features are compared.
        sampled: those of a sample of its keypoints.
        rest: those of the others.
        matches: of a `QueryMatching` that compares no keypoints one by one, the matches.
    """

    query: View
    sampled: dict[str, RowMaxima] = field(default_factory=dict)
    rest: dict[str, RowMaxima] = field(default_factory=dict)
    matches: dict[str, Matches] = field(default_factory=dict)


_PAIRS_THAT_COUNT = 10
"""Pairs over which `Matcher.pair_s` is a mean, about."""


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
    cache: LruCache[object]

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


class Matcher:
    """Matches views and caches the matches of references. Thread-safe.

    A query's pairs are distributed over `threads`: a single query takes half the time on two threads, and concurrent
    queries take no more processor time, because each product is computed by one thread.

    Attributes:
        options: options of matching.
        pairs: the matches of references with one another.
        pair_s: mean time of `pair_matching` for a pair of the last queries, seconds; None before the first.
    """

    def __init__(
        self,
        options: CorrespondOptions | None = None,
        threads: int = 1,
        query_matching: QueryMatching | None = None,
        pair_matching: PairMatching | None = None,
    ) -> None:
        self.options = options or CorrespondOptions()
        self.pairs = ReferencePairs(self.options, pair_matching)
        self.pair_s: float | None = None
        self._threads = SharedThreads(threads)
        self._query_matching = query_matching or NearestNeighbours(self.options.query_ratio, self._threads)
        self._structures: LruCache[object] = LruCache(self.options.structure_bytes)

    def correspond(
        self,
        query: View,
        references: Sequence[PosedView],
        matching: Matching = Matching.STRICT,
        check: Callable[[], None] = lambda: None,
        query_matches: Sequence[Matches] | None = None,
    ) -> Correspondences:
        """Finds matches between all pairs of references, strict or wide ones, and of the query with each reference.

        Calls `check` before each pair and does not catch what it raises. `query_matches`, if known already from
        `match_query` or another call with the same references, are used as they are.
        """
        pairs = list(combinations(range(len(references)), 2))
        self.pairs.look_up([in_order(references[i], references[j]) for i, j in pairs], matching)

        def of_pair(pair: tuple[int, int]) -> tuple[PairKey, PairMatches]:
            check()
            return self.pairs.find(references[pair[0]], references[pair[1]], matching)

        made = self._threads.map(of_pair, pairs)
        found = {pair: matches for pair, (_, matches) in zip(pairs, made, strict=True)}
        if query_matches is None:
            query_matches = self.match_query(query, references, check)
        of_pairs, matches, count = {pair: it.agreeing for pair, it in found.items()}, tuple(query_matches), 0
        if any(len(it.stationary) for it in found.values()):
            keys, options = frozenset(key for key, _ in made), self.pairs.stationary
            fixed = references_without_fixed(references, found, keys, options, self._structures)
            if fixed.ignored:
                of_pairs, matches, count = without_fixed(query, references, found, query_matches, fixed)
        # Strong matches of a pair may be stored at any time, so that its matches are not determined.
        source = MatchedReferences(tuple(references), self.pairs.name(matching), self._structures)
        known = source if self.pair_matching is None else None

        def error_px(i: int, j: int) -> float | None:
            return self.pairs.error_px(references[i], references[j])

        return Correspondences(of_pairs, matches, known, count, error_px)

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
        compared: Compared | None = None,
    ) -> dict[int, Matches]:
        """Matches the query with those of many references that are chosen for it, as `match_quickly` does.

        They are chosen by a sample of the query's keypoints, if these have enough matches, so that the others need not
        be matched.

        Args:
            query: the query.
            references: at least one.
            count: how many are wanted.
            choose: returns the indices of these, in order, from indices of references and their numbers of matches.
            check: as in `correspond`.
            compared: comparisons of the query that were made before; those made now are added.

        Returns:
            Index of each chosen reference, in order, and its matches.
        """
        candidates: Sequence[int] = range(len(references))
        if len(references) > count and isinstance(self._query_matching, NearestNeighbours):
            ratio = self._query_matching.ratio
            sampled = self._sampled(query, references, check, compared)
            counts = [len(it.matches(ratio)) for it in sampled]
            chosen = choose(candidates, counts)
            if sum(counts[i] for i in chosen) >= self.options.enough_sampled * len(chosen):
                candidates = chosen
            some = [references[i] for i in candidates]
            matches = self._completed(query, some, [sampled[i] for i in candidates], check, compared)
        elif compared is not None:
            matches = self.match_compared(compared, references, check)
        else:
            matches = self.match_quickly(query, references, check)
        found = dict(zip(candidates, matches, strict=True))
        return {i: found[i] for i in choose(candidates, [len(it) for it in matches])}

    def match_sample(
        self, compared: Compared, references: Sequence[PosedView], check: Callable[[], None]
    ) -> tuple[Sequence[Matches], int]:
        """Finds matches of a sample of a query's keypoints, one in so many: of all of them where that costs as much."""
        if not isinstance(self._query_matching, NearestNeighbours):
            return self.match_compared(compared, references, check), 1
        step, ratio = self.options.sampled_share, self._query_matching.ratio
        found = (it.matches(ratio) for it in self._sampled(compared.query, references, check, compared))
        return [it * np.array([step, 1], np.int32) for it in found], step

    def match_compared(
        self, compared: Compared, references: Sequence[PosedView], check: Callable[[], None]
    ) -> Sequence[Matches]:
        """Finds the matches that `match_quickly` finds, with those comparisons that were made before."""
        if isinstance(self._query_matching, NearestNeighbours):
            sampled = self._sampled(compared.query, references, check, compared)
            return self._completed(compared.query, references, sampled, check, compared)
        known = compared.matches
        lacking = [it for it in references if it.key not in known]
        made = self.match_quickly(compared.query, lacking, check) if lacking else ()
        known |= {it.key: matches for it, matches in zip(lacking, made, strict=True)}
        return [known[it.key] for it in references]

    def _sampled(
        self,
        query: View,
        references: Sequence[PosedView],
        check: Callable[[], None],
        compared: Compared | None,
    ) -> Sequence[RowMaxima]:
        """The comparisons of a sample of a query's keypoints with references."""
        ours = query.features.every(self.options.sampled_share)
        return self._compare(ours, references, check, None if compared is None else compared.sampled)

    def _completed(
        self,
        query: View,
        references: Sequence[PosedView],
        sampled: Sequence[RowMaxima],
        check: Callable[[], None],
        compared: Compared | None,
    ) -> Sequence[Matches]:
        """The matches of all of a query's keypoints with references with which a sample of them was compared."""
        assert isinstance(self._query_matching, NearestNeighbours)
        step, ratio = self.options.sampled_share, self._query_matching.ratio
        ours = query.features.but_every(step)
        rest = self._compare(ours, references, check, None if compared is None else compared.rest)
        return [it.with_every(step, some).matches(ratio) for it, some in zip(rest, sampled, strict=True)]

    def _compare(
        self,
        ours: Features,
        references: Sequence[PosedView],
        check: Callable[[], None],
        known: dict[str, RowMaxima] | None,
    ) -> Sequence[RowMaxima]:
        assert isinstance(self._query_matching, NearestNeighbours)
        if known is None:
            return self._query_matching.compare(ours, references, check)
        lacking = [it for it in references if it.key not in known]
        made = self._query_matching.compare(ours, lacking, check) if lacking else ()
        known |= {it.key: found for it, found in zip(lacking, made, strict=True)}
        return [known[it.key] for it in references]

    def to_rematch(self, matches: Sequence[Matches]) -> list[int]:
        """Returns the indices of the references that `rematch` should match with a query, the best first."""
        if self.pair_matching is None:
            return []
        best_first = sorted(range(len(matches)), key=lambda i: -len(matches[i]))
        return best_first[: self.options.rematched_references]

    def is_promising(self, rematched: Sequence[Matches]) -> bool:
        """Whether to match further references after these, the best first, which `rematch` has matched."""
        options = self.options
        is_tried = len(rematched) >= options.promising_references
        return not is_tried or max(map(len, rematched)) >= options.promising_matches

    def rematch(self, query: View, reference: PosedView) -> Matches:
        """Matches the strongest keypoints of a query with those of one reference by the `pair_matching`."""
        assert self.pair_matching is not None
        begin_s = time.monotonic()
        ours, theirs = (
            replace(view, features=view.features.first(self.options.rematched_keypoints))
            for view in (query, reference.view)
        )
        matches = self.pair_matching.match_one(ours, theirs)
        spent_s = time.monotonic() - begin_s
        usual_s = self.pair_s  # read once: another thread may forget it
        self.pair_s = spent_s if usual_s is None else usual_s + (spent_s - usual_s) / _PAIRS_THAT_COUNT
        return matches

    def rematch_together(self, query: View, references: Sequence[PosedView]) -> list[Matches]:
        """Matches a query with each of some references by the `pair_matching`, in the threads that are free."""
        return self._threads.map(lambda reference: self.rematch(query, reference), references)

    @property
    def pair_matching(self) -> PairMatching | None:
        """Matches the query again with its best references, and references ahead of the queries; None: nothing does."""
        return self.pairs.pair_matching

    @property
    def threads(self) -> int:
        """How many pairs are matched at a time, where no other query matches."""
        return self._threads.threads

    def close(self) -> None:
        """Ends the threads."""
        self._threads.close()

    def forget(self, keys: Collection[str]) -> None:
        """Removes what was computed from deleted references from the caches, in time linear in their size."""
        gone = frozenset(keys)
        self.pairs.forget(gone)
        self._structures.forget(lambda key, _: not gone.isdisjoint(key[0]))
