"""What a memory that forgets the least recently used still has: by trial, and by Che's approximation."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable, Iterable
from typing import TypeVar

import numpy as np

from .city import Floats

Key = TypeVar("Key", bound=Hashable)


class LeastRecentlyUsed(OrderedDict[Key, None]):
    """A set that holds so many keys at most, and forgets those that were asked for longest ago."""

    def __init__(self, capacity: int, keys: Iterable[Key] = ()) -> None:
        """The keys of the beginning come in the order of their use, the last one most recently."""
        super().__init__()
        self.capacity = capacity
        for key in keys:
            self.ask(key)

    def ask(self, key: Key) -> bool:
        """Whether it was there; it is from now on."""
        if key in self:
            self.move_to_end(key)
            return True
        if self.capacity > 0:
            if len(self) >= self.capacity:
                self.popitem(last=False)
            self[key] = None
        return False


def expected_hit_rate(shares: Floats, capacity: float) -> float:
    """Hit rate where each query is for key i with probability `shares[i]`, whatever came before.

    Che, Tung, Wang, "Hierarchical Web Caching Systems" (2002): a key is there if it was asked for within the last T
    queries, with the one T for which the expected number of keys is the capacity.
    """
    if capacity >= np.count_nonzero(shares):
        return 1.0
    if capacity <= 0:
        return 0.0
    low, high = 0.0, 1.0
    while _kept(shares, high).sum() < capacity:
        high *= 2.0
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if _kept(shares, middle).sum() < capacity else (low, middle)
    return float(shares @ _kept(shares, high))


def _kept(shares: Floats, window: float) -> Floats:
    return -np.expm1(-shares * window)
