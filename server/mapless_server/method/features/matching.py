"""How two photographs are matched: options of each kind of features, nearest descriptors, and what a network offers."""

import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from mapless_server.bounds import check_bounds
from mapless_server.choices import EDGEPOINT2
from mapless_server.kernels import nearest
from mapless_server.kernels.nearest import Nearest, Whole
from mapless_server.scheduling import count_helper, give_way, may_have_helpers

from .limits import EPIPOLAR_PX
from .views import Features, Matches, PosedView, View

ScalarT = TypeVar("ScalarT", bound=np.generic)

_ROWS_AT_ONCE = 256
"""With 2,000 columns a block has 2 MB, as the second-level cache of a core; BLAS is slower with fewer rows."""


def mutual_matches(first: Features, second: Features, ratio: float, either: bool = False) -> Matches:
    """Mutual nearest neighbours that pass the ratio test from first to second or, if `either`, from second to first."""
    if either:
        return mutual_matches_of_ratios(first, second, (ratio,))[0]
    return row_maxima(first, second).matches(ratio)


@dataclass(frozen=True, eq=False)
class RowMaxima:
    """The two largest cosines of each of N descriptors with M others, and the largest of each of these.

    Attributes:
        column: (N,) index of the nearest of the others.
        best, second_best: (N,) float32, its cosine and that of the second-nearest.
        best_of_column: (M,) float32, largest cosine of each of the others.
    """

    column: NDArray[np.integer]
    best: NDArray[np.float32]
    second_best: NDArray[np.float32]
    best_of_column: NDArray[np.float32]

    def matches(self, ratio: float) -> Matches:
        """The mutual nearest neighbours that pass the ratio test."""
        if len(self.best) < 2 or len(self.best_of_column) < 2:
            return np.empty((0, 2), np.int32)
        mutual = self.best >= self.best_of_column[self.column]
        return _passing(self.column, self.best, self.second_best, mutual, ratio)

    def with_every(self, step: int, others: "RowMaxima") -> "RowMaxima":
        """Those of all descriptors, if these are of `Features.but_every` and the others of `Features.every`."""
        rest = np.ones(len(self.best) + len(others.best), bool)
        rest[::step] = False

        def of_all(ours: NDArray[ScalarT], theirs: NDArray[ScalarT]) -> NDArray[ScalarT]:
            both = np.empty(len(rest), ours.dtype)
            both[rest], both[::step] = ours, theirs
            return both

        return RowMaxima(
            of_all(self.column, others.column),
            of_all(self.best, others.best),
            of_all(self.second_best, others.second_best),
            np.maximum(self.best_of_column, others.best_of_column),
        )


def row_maxima(first: Features, second: Features) -> RowMaxima:
    """The nearest of the second photograph's descriptors of each of the first."""
    if (found := _compiled_nearest(first, second)) is not None:
        return RowMaxima(found.column, found.best, found.second_best, found.best_of_column)
    nearest, best, second_best = np.zeros(len(first), np.int32), *np.full((2, len(first)), -np.inf, np.float32)
    best_of_column, begin = np.full(len(second), -np.inf, np.float32), 0
    for cosines in cosine_blocks(first, second) if len(second) else ():
        part, rows = slice(begin, begin + len(cosines)), np.arange(len(cosines))
        nearest[part] = cosines.argmax(axis=1)
        best[part] = cosines[rows, nearest[part]]
        np.maximum(best_of_column, cosines.max(axis=0), out=best_of_column)
        cosines[rows, nearest[part]] = -1.0
        second_best[part] = cosines.max(axis=1)
        begin = part.stop
    return RowMaxima(nearest, best, second_best, best_of_column)


def mutual_matches_of_ratios(first: Features, second: Features, ratios: Sequence[float]) -> list[Matches]:
    """For each ratio, the mutual nearest neighbours that pass the test from either side, of one comparison."""
    if len(first) < 2 or len(second) < 2:
        return [np.empty((0, 2), np.int32) for _ in ratios]
    if (found := _compiled_nearest(first, second)) is not None:
        mutual = found.best >= found.best_of_column[found.column]
        mutual &= _once(found.column, mutual, len(second))
        second_best = np.minimum(found.second_best, found.second_of_column[found.column])
        return [_passing(found.column, found.best, second_best, mutual, ratio) for ratio in ratios]
    similarity = np.empty((len(first), len(second)), np.float32)
    deque(cosine_blocks(first, second, similarity), 0)
    return best_of_both(similarity, ratios, either=True)


def _compiled_nearest(first: Features, second: Features) -> Nearest | None:
    """The nearest descriptors of int8 by compiled code; None for others, and where that is not available."""
    is_whole = first.descriptors.dtype == second.descriptors.dtype == np.int8
    if not is_whole or not nearest.is_available(first.descriptors.shape[1]):
        return None
    ours, theirs = (Whole(it.descriptors.astype(np.int8, copy=False), it.inverse_lengths) for it in (first, second))
    return nearest.nearest(ours, theirs)


def _passing(
    nearest: NDArray[np.integer],
    best: NDArray[np.float32],
    second_best: NDArray[np.float32],
    mutual: NDArray[np.bool_],
    ratio: float,
    smallest: float = -1.0,
) -> Matches:
    """The mutual ones (row, column) that pass the ratio test; with a cosine s the distance is sqrt(2 - 2 s)."""
    keep = np.flatnonzero(mutual & (best > smallest) & (1 - best < ratio**2 * (1 - second_best)))
    return np.stack([keep, nearest[keep]], axis=1).astype(np.int32)


def _once(nearest: NDArray[np.integer], mutual: NDArray[np.bool_], columns: int) -> NDArray[np.bool_]:
    """Mask (N,) of the rows that are not tied with another one that is as near to the same column."""
    return np.asarray(np.bincount(nearest[mutual], minlength=columns)[nearest] == 1)


def cosine_blocks(
    first: Features, second: Features, whole: NDArray[np.float32] | None = None
) -> Iterator[NDArray[np.float32]]:
    """Yields the matrix of cosines (N, M) in blocks of rows: of `whole` (N, M), or each overwritten by the next.

    Those of int8 are products of whole numbers, which float32 holds exactly, over the lengths: as `kernels.nearest`
    computes them, to the last bit.
    """
    exact = first.descriptors.dtype == second.descriptors.dtype == np.int8
    ours, theirs = (it.descriptors.astype(np.float32) if exact else it.unit_descriptors() for it in (first, second))
    block = np.empty((min(_ROWS_AT_ONCE, len(first)), len(second)), np.float32)
    for i in range(0, len(first), _ROWS_AT_ONCE):
        part = slice(i, min(i + _ROWS_AT_ONCE, len(first)))
        cosines = np.matmul(ours[part], theirs.T, out=block[: part.stop - i] if whole is None else whole[part])
        if exact:
            cosines *= second.inverse_lengths
            cosines *= first.inverse_lengths[part, None]
        yield cosines


def best_of_both(
    similarity: NDArray[np.float32], ratios: Sequence[float], smallest: float = -1.0, either: bool = False
) -> list[Matches]:
    """For each ratio, entries of a matrix of cosines (N, M) that are mutual maxima and pass the ratio test by row.

    All are above `smallest`. If `either`, it suffices to pass the ratio test by column. Overwrites the matrix.
    """
    if not similarity.size:
        return [np.empty((0, 2), np.int32) for _ in ratios]
    rows = np.arange(len(similarity))
    nearest = similarity.argmax(axis=1)
    best = similarity[rows, nearest]
    # The maximum of its column too: compared by value, because an argmax along columns takes ten times as long.
    mutual = best >= similarity.max(axis=0)[nearest]
    similarity[rows[mutual], nearest[mutual]] = -1.0
    second_best = similarity.max(axis=1)
    if either:
        mutual &= _once(nearest, mutual, similarity.shape[1])
        second_best = np.minimum(second_best, similarity.max(axis=0)[nearest])
    return [_passing(nearest, best, second_best, mutual, ratio, smallest) for ratio in ratios]


ItemT = TypeVar("ItemT")
ResultT = TypeVar("ResultT")


@dataclass(frozen=True)
class CorrespondOptions:
    """Options of matching that depend on the descriptor; `OPTIONS` has a set for each extractor.

    Attributes:
        reference_ratio: Lowe's ratio, the largest distance of the nearest descriptor over that of the second-nearest,
            between references, from either of them; loose, because the epipolar constraint filters too.
        query_ratio: the same ratio for matches with the query, which have no other filter.
        epipolar_px: largest distance from the epipolar line, in both images.
        distinct_ratio: the ratio of matches between references that are distinct without the poses, which show whether
            these agree; and among the few keypoints along an epipolar line.
        wide_similarity: smallest cosine of descriptors of a match along the line.
        guided_similarity: smallest cosine of descriptors of a match that is searched near a point's projection.
        sampled_share: one in so many of the query's keypoints is matched with all references among which those of a
            query are chosen.
        enough_sampled: if the chosen have fewer matches of sampled keypoints each, on average, they are chosen again by
            all.
        rematched_references: so many references of a query, those with the most matches, are matched again by a
            `PairMatching`, if there is one.
        rematched_keypoints: so many keypoints of each photograph, the strongest, are matched again. Evidence:
            rematched-keypoints.
        promising_references, promising_matches: if it finds fewer matches with each of so many, the others are not
            matched. Evidence: promising-matches.
        enough_matches: pairs of references for which nearest neighbours find so many are not matched by it. Evidence:
            enough-matches.
        remembered_pairs: number of cached pairs of references, about 8 KiB each.
        structure_bytes: memory of the cached structures of sets of references, about 0.25 MB for ten at 640x480.
    """

    reference_ratio: float = 0.9
    query_ratio: float = 0.85
    distinct_ratio: float = 0.8
    epipolar_px: float = EPIPOLAR_PX
    wide_similarity: float = 0.85
    guided_similarity: float = 0.89
    sampled_share: int = 6
    enough_sampled: float = 30.0
    rematched_references: int = 5
    rematched_keypoints: int = 512
    promising_references: int = 2
    promising_matches: int = 30
    enough_matches: int = 500
    remembered_pairs: int = 20_000
    structure_bytes: int = 32 * 2**20

    def __post_init__(self) -> None:
        check_bounds(self, "reference_ratio query_ratio distinct_ratio", above=0, at_most=1)
        check_bounds(self, "wide_similarity guided_similarity", at_least=-1)
        check_bounds(self, "epipolar_px", above=0)
        check_bounds(self, "sampled_share rematched_keypoints promising_references", at_least=1)
        check_bounds(self, "enough_sampled", at_least=0)
        check_bounds(self, "promising_matches", at_least=0)
        check_bounds(self, "rematched_references enough_matches remembered_pairs structure_bytes", at_least=0)


_ALIKED = CorrespondOptions(
    reference_ratio=1.0,
    query_ratio=0.95,
    distinct_ratio=0.9,
    wide_similarity=0.6,
    guided_similarity=0.65,
)
"""Options of ALIKED's features."""

_EDGEPOINT2 = replace(_ALIKED, wide_similarity=0.84, guided_similarity=0.86)
"""Options of EdgePoint2's and XFeat's features, whose cosines are larger."""

OPTIONS: Mapping[str, CorrespondOptions] = {
    "sift": CorrespondOptions(),
    **dict.fromkeys(EDGEPOINT2, _EDGEPOINT2),
    "aliked": _ALIKED,
    "xfeat": _EDGEPOINT2,
    # Not measured, for lack of the weights. The cosine is that of a distance of 0.7, which is usual.
    "superpoint": replace(_ALIKED, query_ratio=0.9, wide_similarity=0.755, guided_similarity=0.755),
}
"""For each extractor that a setting can name.

Distances of learned descriptors differ less, so their ratios are larger. Between references they need no ratio test:
the epipolar constraint removes nearly all false matches. Evidence: learned-ratios.
"""


class QueryMatching(Protocol):
    """Matches a query with its references; implemented by nearest neighbours and by LightGlue."""

    def match(self, query: View, references: Sequence[PosedView], check: Callable[[], None]) -> Sequence[Matches]:
        """Matches (query keypoint, reference keypoint) with each reference; each keypoint occurs at most once in them.

        Calls `check` between its steps and does not catch what it raises.
        """
        ...


class PairMatching(Protocol):
    """Matches two photographs better than nearest neighbours do, at many times the cost.

    Attributes:
        name: names everything that determines the matches, except for the photographs.
    """

    name: str

    def match_one(self, first: View, second: View, pause: Callable[[], None] = lambda: None) -> Matches:
        """Matches (keypoint of the first, keypoint of the second); each keypoint occurs at most once in them.

        Calls `pause`, which may wait, between its steps.
        """
        ...


@dataclass(frozen=True, eq=False)
class StoredPair:
    """A pair of references as it is stored.

    Attributes:
        matches: (M, 2), within the distance from the epipolar lines that the matching allows.
        error_px: see `agreement.pair_error_px`; None if it is not known.
    """

    matches: Matches
    error_px: float | None = None


class StoredPairs(Protocol):
    """Matches of pairs of references that were made before."""

    def find(self, matching: str, pairs: Sequence[tuple[PosedView, PosedView]]) -> Sequence[StoredPair | None]:
        """Returns what is stored of each pair, given `in_order`; None for a pair that is not stored.

        `matching` is what `ReferencePairs.name` returns. Does not raise.
        """
        ...


class SharedThreads:
    """Helps queries to match: each computes in its own thread, and threads that are free take over a part."""

    def __init__(self, threads: int) -> None:
        """Uses so many threads for one query, its own among them."""
        self.threads = threads
        self._pool = ThreadPoolExecutor(max(1, threads - 1), "match")

    def map(self, compute: Callable[[ItemT], ResultT], items: Sequence[ItemT]) -> list[ResultT]:
        """The results for all items, in order; raises what a computation raises, when no other one is running."""
        results: dict[int, ResultT] = {}
        rest = iter(list(enumerate(items)))  # the next item is taken under the interpreter's lock

        def work() -> None:
            try:
                for i, item in rest:
                    give_way()
                    results[i] = compute(item)
            except BaseException:
                deque(rest, 0)
                raise

        def help_out() -> float:
            begin_s = time.thread_time()
            work()
            return time.thread_time() - begin_s

        helper_count = min(self.threads, len(items)) - 1 if may_have_helpers() else 0
        helpers = [self._pool.submit(help_out) for _ in range(helper_count)]
        try:
            work()
        finally:
            running = [it for it in helpers if not it.cancel()]
            wait(running)
        for helper in running:
            count_helper(helper.result())
        return [results[i] for i in range(len(items))]

    def close(self) -> None:
        """Ends the threads."""
        self._pool.shutdown()


class NearestNeighbours:
    """Matches mutual nearest neighbours that pass the ratio test, for any descriptor."""

    def __init__(self, ratio: float, threads: SharedThreads) -> None:
        self.ratio = ratio
        self._threads = threads

    def match(self, query: View, references: Sequence[PosedView], check: Callable[[], None]) -> Sequence[Matches]:
        """See QueryMatching.match."""
        return tuple(self._each(query.features, references, check, partial(mutual_matches, ratio=self.ratio)))

    def compare(self, ours: Features, references: Sequence[PosedView], check: Callable[[], None]) -> list[RowMaxima]:
        """The nearest descriptors of each reference, of which `matches` makes what `match` returns."""
        return self._each(ours, references, check, row_maxima)

    def _each(
        self,
        ours: Features,
        references: Sequence[PosedView],
        check: Callable[[], None],
        compute: Callable[[Features, Features], ResultT],
    ) -> list[ResultT]:
        if ours.descriptors.dtype == np.uint8:  # once for all references
            ours = replace(ours, descriptors=ours.unit_descriptors())

        def with_one(reference: PosedView) -> ResultT:
            check()
            return compute(ours, reference.view.features)

        return self._threads.map(with_one, references)
