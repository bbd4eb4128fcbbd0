"""A thread-safe cache that evicts the least recently used values."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any, Generic, TypeVar

Value = TypeVar("Value")


class LruCache(Generic[Value]):
    """Holds values of at most `capacity_bytes` together; 0 holds nothing.

    Attributes:
        hits, misses: of `get`.
        evictions: values dropped for lack of room.
        used_bytes: sum of the sizes of the values held.
    """

    def __init__(self, capacity_bytes: int) -> None:
        """Raises ValueError if the capacity is negative."""
        if capacity_bytes < 0:
            raise ValueError(f"cache capacity must not be negative, is {capacity_bytes} bytes")
        self._capacity_bytes = capacity_bytes
        self.hits = self.misses = self.evictions = self.used_bytes = 0
        self._entries: OrderedDict[Hashable, tuple[Value, int]] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: Hashable) -> Value | None:
        """The value, which becomes the most recently used, or None."""
        with self._lock:
            entry = self._entries.get(key)
            if entry is None:
                self.misses += 1
                return None
            self.hits += 1
            self._entries.move_to_end(key)
            return entry[0]

    def forget(self, is_gone: Callable[[Any, Value], bool]) -> list[Any]:
        """Drops the entries whose key and value `is_gone` accepts, looking at each; returns their keys.

        They are not counted as evictions.
        """
        with self._lock:
            gone = [key for key, (value, _) in self._entries.items() if is_gone(key, value)]
            for key in gone:
                _, size_bytes = self._entries.pop(key)
                self.used_bytes -= size_bytes
        return gone

    def put(self, key: Hashable, value: Value, size_bytes: int) -> None:
        """Holds a value, unless it is larger than the whole cache."""
        if size_bytes > self._capacity_bytes:
            return
        with self._lock:
            _, replaced_bytes = self._entries.pop(key, (None, 0))
            self._entries[key] = (value, size_bytes)
            self.used_bytes += size_bytes - replaced_bytes
            while self.used_bytes > self._capacity_bytes:
                _, (_, dropped_bytes) = self._entries.popitem(last=False)
                self.used_bytes -= dropped_bytes
                self.evictions += 1
