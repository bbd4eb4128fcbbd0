"""Photographs that wait to be considered as references: bounded, with room for every tenant and holder."""

import asyncio
import time
from collections import Counter, deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

from mapless.geometry import Array
from mapless_server.engine.query import Query
from mapless_server.scenes.adoption.policy import Evidence
from mapless_server.security import tenant_of

MAX_WAITING, MAX_WAITING_BYTES = 32, 64 * 2**20
"""Photographs that wait to be considered, and their bytes together, of which each takes its part or its own size."""
MOST_WAITING_S = 3600.0
"""After this time a photograph that was never considered, since the server was not idle, is dropped."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """An answered photograph that may become a reference.

    Attributes:
        query: as it is asked again, see `evidence.kept_query`.
        as_stated: likewise, with what its call stated of its camera; else the same.
        answered: its answer.
        by_survey: whether no adopted reference has part in that.
        inliers_px: (M, 2) the keypoints of the matches that agree with it, pixels of the photograph as it was sent.
        distance_m: median distance of what it shows; see `evidence.distance_shown`.
        holder: its caller, see `policy.holder_of`.
        offered_s: when it was answered, by `time.monotonic`.
    """

    query: Query
    as_stated: Query
    answered: Evidence
    by_survey: bool
    inliers_px: Array
    distance_m: float
    holder: str
    offered_s: float

    @property
    def tenant(self) -> str:
        """The tenant of its scene."""
        return tenant_of(self.query.scene_key)

    @property
    def room_bytes(self) -> int:
        """How much of the queue it takes: the size of its files, or a small one's part of the queue."""
        return max(self.query.photo.size_bytes, MAX_WAITING_BYTES // MAX_WAITING)


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

    def add(self, candidate: Candidate) -> int:
        """Adds a candidate; returns how many found no room: it, or others.

        Where the queue is full, others leave it as `_leaving` says. None does for a candidate that has no room then.
        """
        stay = list(self._candidates)
        while sum(it.room_bytes for it in stay) + candidate.room_bytes > MAX_WAITING_BYTES:
            if (leaving := _leaving(stay, candidate)) is None:
                return 1
            stay.remove(leaving)
        left = len(self._candidates) - len(stay)
        self._candidates = deque([*stay, candidate])
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


def _leaving(waiting: Sequence[Candidate], candidate: Candidate) -> Candidate | None:
    """The one that makes room for a candidate: the newest of the holder with most room, of the tenant with most.

    Where no tenant has more than the candidate's would have, it is one of that; None if no holder of it has more than
    the candidate's would have, either.
    """
    of_tenant, of_holder = Counter[str](), Counter[str]()
    for it in waiting:
        of_tenant[it.tenant] += it.room_bytes
    tenant = max(of_tenant, key=lambda it: of_tenant[it], default=candidate.tenant)
    is_own = of_tenant[tenant] <= of_tenant[candidate.tenant] + candidate.room_bytes
    its = [it for it in waiting if it.tenant == (candidate.tenant if is_own else tenant)]
    for it in its:
        of_holder[it.holder] += it.room_bytes
    holder = max(of_holder, key=lambda it: of_holder[it], default=candidate.holder)
    if is_own and of_holder[holder] <= of_holder[candidate.holder] + candidate.room_bytes:
        return None
    return next(it for it in reversed(its) if it.holder == holder)
