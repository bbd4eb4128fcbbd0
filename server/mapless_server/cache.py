"""A thread-safe cache that evicts the least recently used values."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any, Generic, TypeVar

Value = TypeVar("Value")


class LruCache(Generic[Value]):
    """Holds values whose sizes, in bytes or in any other unit, add up to at most a capacity; 0 holds nothing.

    Of a cache that `keeps_latest`, the latest value is held however large it is.

    Attributes:
        hits, misses: numbers of calls of `get` that found or missed a value.
        evictions: values dropped for lack of room.
        used: sum of the sizes of the values held.
    """

    def __init__(self, capacity: int, keeps_latest: bool = False) -> None:
        """Raises ValueError if the capacity is negative."""
        if capacity < 0:
            raise ValueError(f"cache capacity must not be negative, is {capacity}")
        self._capacity = capacity
        self._keeps_latest = keeps_latest
        self.hits = self.misses = self.evictions = self.used = 0
        self._entries: OrderedDict[Hashable, tuple[Value, int]] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: Hashable) -> Value | None:
        """Returns the value, which becomes the most recently used, or None."""
        with self._lock:
            entry = self._entries.get(key)
            if entry is None:
                self.misses += 1
                return None
            self.hits += 1
            self._entries.move_to_end(key)
            return entry[0]

    def pop(self, key: Hashable) -> Value | None:
        """Removes and returns a value, or None; not counted as an eviction."""
        with self._lock:
            value, size = self._entries.pop(key, (None, 0))
            self.used -= size
            return value

    def values(self) -> list[Value]:
        """The values held, the least recently used first; not counted as a use."""
        with self._lock:
            return [value for value, _ in self._entries.values()]

    def forget(self, is_gone: Callable[[Any, Value], bool]) -> list[Any]:
        """Drops the entries for which `is_gone(key, value)` is true; returns their keys.

        They are not counted as evictions.
        """
        with self._lock:
            gone = [key for key, (value, _) in self._entries.items() if is_gone(key, value)]
            for key in gone:
                _, size = self._entries.pop(key)
                self.used -= size
        return gone

    def put(self, key: Hashable, value: Value, size: int = 1) -> list[tuple[Any, Value]]:
        """Stores a value; returns what is evicted for it, or the value itself if it is larger than the whole cache."""
        if size > self._capacity and not self._keeps_latest:
            return [(key, value)]
        evicted = []
        with self._lock:
            _, replaced = self._entries.pop(key, (None, 0))
            self._entries[key] = (value, size)
            self.used += size - replaced
            while self.used > self._capacity and len(self._entries) > self._keeps_latest:
                oldest, (dropped, dropped_size) = self._entries.popitem(last=False)
                self.used -= dropped_size
                self.evictions += 1
                evicted.append((oldest, dropped))
        return evicted

    def clear(self) -> list[tuple[Any, Value]]:
        """Drops everything and returns it, the least recently used first; not counted as evictions."""
        with self._lock:
            dropped = [(key, value) for key, (value, _) in self._entries.items()]
            self._entries.clear()
            self.used = 0
        return dropped
