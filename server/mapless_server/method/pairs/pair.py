"""Pairs of references: their order, their key in a cache, and their matches as they are cached."""

from typing import NamedTuple

import numpy as np

from ..features.views import Matches, PosedView
from .stationary import StationaryOptions, stationary_matches


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
    wide: bool
    strong: bool

    @classmethod
    def of(cls, pair: tuple[PosedView, PosedView], wide: bool, strong: bool) -> "PairKey":
        """The key of a pair, given `in_order`."""
        return cls(pair[0].key, pair[1].key, wide, strong)


def is_one_photograph(first: PosedView, second: PosedView) -> bool:
    """Whether two references are one photograph at two poses, of two places that are copies of each other.

    Its matches with itself say nothing of the place, but satisfy the epipolar constraint of poses that are only shifted
    against each other: points at infinity, with which any position agrees.
    """
    return np.array_equal(first.view.features.keypoints, second.view.features.keypoints)


def in_order(first: PosedView, second: PosedView) -> tuple[PosedView, PosedView]:
    """Returns two references in the order in which they are always matched, whichever comes first in a query.

    The ratio test of wide matches is not symmetric, and the order decides how sums are rounded. Names, unlike keys, are
    the same wherever the scene is stored.
    """
    return (first, second) if (first.name, first.key) <= (second.name, second.key) else (second, first)
