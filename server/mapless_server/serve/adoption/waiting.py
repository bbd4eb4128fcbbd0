"""Photographs that wait to be considered as references: bounded, with room for every tenant."""

import asyncio
import time
from collections import Counter, deque
from contextlib import suppress
from dataclasses import dataclass

from mapless.geometry import Array
from mapless_server.engine.query import Query
from mapless_server.scenes.adoption.policy import Evidence
from mapless_server.security import tenant_of

MAX_WAITING, MAX_WAITING_BYTES = 32, 64 * 2**20
"""Photographs that wait to be considered, and their bytes together."""
MOST_WAITING_S = 3600.0
"""After this time a photograph that was never considered, since the server was not idle, is dropped."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """An answered photograph that may become a reference.

    Attributes:
        query: as it was asked.
        answered: its answer.
        inliers_px: (M, 2) the keypoints of the matches that agree with it, pixels of the photograph as it was sent.
        distance_m: median distance of what it shows; see `evidence.distance_shown`.
        holder: its caller, see `policy.holder_of`.
        offered_s: when it was answered, by `time.monotonic`.
    """

    query: Query
    answered: Evidence
    inliers_px: Array
    distance_m: float
    holder: str
    offered_s: float

    @property
    def tenant(self) -> str:
        """The tenant of its scene."""
        return tenant_of(self.query.scene_key)

    @property
    def size_bytes(self) -> int:
        """Size of its files."""
        return self.query.photo.size_bytes


class Waiting:
    """Candidates in the order of their arrival. Used on the event loop only."""

    def __init__(self) -> None:
        """Makes an empty queue."""
        self._candidates: deque[Candidate] = deque()
        self._arrived = asyncio.Event()

    def __contains__(self, candidate: Candidate) -> bool:
        return candidate in self._candidates

    def __len__(self) -> int:
        return len(self._candidates)

    @property
    def size_bytes(self) -> int:
        """Size of all files."""
        return sum(it.size_bytes for it in self._candidates)

    def add(self, candidate: Candidate) -> int:
        """Adds a candidate; returns how many found no room: it, or others.

        Where the queue is full, the newest of the tenant that has most leave it, as long as it has more than the
        candidate's tenant would have.
        """
        left = 0
        while len(self._candidates) >= MAX_WAITING or self.size_bytes + candidate.size_bytes > MAX_WAITING_BYTES:
            counts = Counter(it.tenant for it in self._candidates)
            most = max(counts, key=lambda it: counts[it], default=candidate.tenant)
            if counts[most] <= counts[candidate.tenant] + 1:
                return left + 1
            self._candidates.remove(next(it for it in reversed(self._candidates) if it.tenant == most))
            left += 1
        self._candidates.append(candidate)
        self._arrived.set()
        return left

    def pop(self) -> Candidate | None:
        """Removes and returns the candidate that came first; None without any."""
        return self._candidates.popleft() if self._candidates else None

    def drop_old(self) -> int:
        """Removes the candidates that have waited too long; returns how many there were."""
        before, count = time.monotonic() - MOST_WAITING_S, len(self._candidates)
        while self._candidates and self._candidates[0].offered_s < before:
            self._candidates.popleft()
        return count - len(self._candidates)

    async def arrived(self, limit_s: float) -> None:
        """Waits until there is a candidate, or for so long."""
        if not self._candidates:
            self._arrived.clear()
            with suppress(TimeoutError):
                await asyncio.wait_for(self._arrived.wait(), limit_s)
