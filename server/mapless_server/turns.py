"""Who computes when: a bounded queue before a pool of threads, so that the event loop never computes.

A call that finds the queue full is refused at once, with an estimate of when to come back. A call whose deadline has
passed or whose caller has gone is not computed when its turn comes, and stops between steps when it already is. What is
computed is of no interest here.
"""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

from .errors import DeadlineExceeded, Overloaded
from .stopwatch import timed

T = TypeVar("T")


class Turn:
    """One piece of work: asked between its steps whether anybody still wants the result.

    Attributes:
        submitted_s: when it was asked for, `time.monotonic`.
        stage_seconds: time of each stage so far, in order.
    """

    def __init__(self, deadline_s: float) -> None:
        self.submitted_s = time.monotonic()
        self.stage_seconds: dict[str, float] = {}
        self._deadline_s = deadline_s
        self._abandoned = threading.Event()

    def abandon(self) -> None:
        """Nobody wants the result any more."""
        self._abandoned.set()

    def check(self) -> None:
        """Raises DeadlineExceeded when the result is of no use any more."""
        if self._abandoned.is_set() or time.monotonic() > self._deadline_s:
            raise DeadlineExceeded("the deadline passed while the call waited or was computed")

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Checks, then times one step."""
        self.check()
        with timed(self.stage_seconds, name):
            yield


class Turns:
    """The queue and the threads. `place` and `run` are called on the event loop alone."""

    def __init__(self, workers: int, max_waiting: int) -> None:
        self._workers = workers
        self._max_admitted = workers + max_waiting
        self._pool = ThreadPoolExecutor(workers, thread_name_prefix="engine")
        self._running: set[Turn] = set()
        self._admitted_count = 0
        self._typical_call_s = 1.0

    @property
    def admitted_count(self) -> int:
        """Calls that are computed or wait."""
        return self._admitted_count

    @contextmanager
    def place(self) -> Iterator[None]:
        """A place in the queue, which a call keeps until its answer is there. Raises Overloaded if there is none."""
        if self._admitted_count >= self._max_admitted:
            retry_after_s = max(0.1, self._typical_call_s * self._admitted_count / self._workers)
            raise Overloaded(f"{self._admitted_count} calls are in progress or wait", retry_after_s=retry_after_s)
        self._admitted_count += 1
        start_s = time.monotonic()
        try:
            yield
        finally:
            waiting_ahead = max(1.0, self._admitted_count / self._workers)
            self._typical_call_s += 0.1 * ((time.monotonic() - start_s) / waiting_ahead - self._typical_call_s)
            self._admitted_count -= 1

    async def run(self, work: Callable[[Turn], T], deadline_s: float) -> T:
        """What the work gives, computed by one of the threads as soon as one is free."""
        turn = Turn(deadline_s)
        self._running.add(turn)
        try:
            # Cancelling the wrapper takes work that has not begun out of the pool's queue.
            return await asyncio.wrap_future(self._pool.submit(work, turn))
        finally:
            turn.abandon()
            self._running.discard(turn)

    def close(self) -> None:
        """Ends what is being computed at its next step, and drops what waits."""
        for turn in list(self._running):
            turn.abandon()
        self._pool.shutdown(wait=True, cancel_futures=True)
