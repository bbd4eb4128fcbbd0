"""Lists of similar rows: a search reads those whose centroids are the most similar to the photograph.

An inverted file (Sivic and Zisserman 2003; Jegou et al. 2011): spherical k-means over a sample of the rows gives the
lists, and each row stands in that whose mean points most like it. The rows themselves are compared as in the exact
search, so an answer can lack a row and never has another similarity.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mapless_server.bounds import check_bounds

Floats = NDArray[np.float32]

SEED = 20261129

_ROWS_AT_A_TIME = 4096


@dataclass(frozen=True)
class ListOptions:
    """Options of the lists.

    Attributes:
        rows_per_list: mean length of a list; decision 041 has others.
        sampled: rows in the sample, for each list.
        rounds: passes of k-means over the sample.
    """

    rows_per_list: int = 500
    sampled: int = 40
    rounds: int = 6

    def __post_init__(self) -> None:
        check_bounds(self, "rows_per_list sampled rounds", at_least=1)

    def list_count(self, row_count: int) -> int:
        """Number of lists for so many rows."""
        return max(1, row_count // self.rows_per_list)


def train(sample: Floats, list_count: int, rounds: int, pause: Callable[[], None]) -> Floats:
    """Computes the means (L, D) of lists of a sample (N, D) of unit vectors; calls `pause` between steps.

    L is `list_count`, or N if that is smaller. The same sample always gives the same lists.
    """
    random = np.random.default_rng(SEED)
    list_count = min(list_count, len(sample))
    means = sample[np.sort(random.choice(len(sample), list_count, replace=False))]
    for _ in range(rounds):
        nearest = nearest_lists(sample, means, pause)
        order, counts = np.argsort(nearest, kind="stable"), np.bincount(nearest, minlength=list_count)
        filled = np.flatnonzero(counts)
        sums = np.empty_like(means)
        sums[filled] = np.add.reduceat(sample[order], (np.cumsum(counts) - counts)[filled], axis=0)
        empty = np.flatnonzero(counts == 0)
        sums[empty] = sample[random.choice(len(sample), len(empty))]
        means = sums / np.maximum(counts, 1).astype(np.float32)[:, None]
    return means


def inverse_lengths(means: Floats) -> Floats:
    """Inverse lengths (L,) of means (L, D), which make centroids of them; 0 for zeros."""
    lengths = np.linalg.norm(means, axis=1)
    return np.asarray(np.divide(1, lengths, out=np.zeros_like(lengths), where=lengths > 0), np.float32)


def nearest_lists(vectors: Floats, means: Floats, pause: Callable[[], None]) -> NDArray[np.intp]:
    """Index (N,) of the list, by its mean (L, D), whose centroid is the most similar to each vector (N, D)."""
    centroids = means * inverse_lengths(means)[:, None]
    found = np.empty(len(vectors), np.intp)
    for start in range(0, len(vectors), _ROWS_AT_A_TIME):
        pause()
        part = slice(start, start + _ROWS_AT_A_TIME)
        found[part] = (vectors[part] @ centroids.T).argmax(axis=1)
    return found


def order_of(lists: Iterable[NDArray[np.intp]], list_count: int) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
    """The order (N,) of rows by their lists, kept within a list, and where each list begins (L + 1,)."""
    nearest = np.concatenate([np.empty(0, np.intp), *lists])
    starts = np.zeros(list_count + 1, np.int64)
    np.cumsum(np.bincount(nearest, minlength=list_count), out=starts[1:])
    return np.argsort(nearest, kind="stable"), starts


class Lists(Protocol):
    """Lists of rows.

    Attributes:
        means, inverse_lengths: (L, D) and (L,), see `train` and `inverse_lengths`.
        starts: (L + 1,), see `order_of`.
    """

    means: Floats
    inverse_lengths: Floats
    starts: NDArray[np.int64]


def likely_rows(rows: NDArray[np.intp], vector: Floats, lists: Lists, count: int) -> tuple[NDArray[np.intp], float]:
    """Chooses those of some rows (N,), ascending, that stand in the lists most similar to a vector (D,).

    Args:
        rows: rows, more than `count`.
        vector: a vector of unit length.
        lists: all lists.
        count: how many rows there must be, at least.

    Returns:
        The rows, ascending, of the fewest lists that have so many; and about the median similarity of all of them.
    """
    cuts = np.searchsorted(rows, lists.starts)
    lengths = np.diff(cuts)
    similarity = lists.means @ vector
    best = np.argsort(-similarity * lists.inverse_lengths, kind="stable")
    enough = int(np.searchsorted(np.cumsum(lengths[best]), count)) + 1
    chosen = [rows[cuts[it] : cuts[it + 1]] for it in np.sort(best[:enough])]
    by_similarity = np.argsort(similarity)
    middle = int(np.searchsorted(np.cumsum(lengths[by_similarity]), len(rows) / 2))
    return np.concatenate(chosen), float(similarity[by_similarity[middle]])
