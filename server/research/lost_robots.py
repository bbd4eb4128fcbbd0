"""A fleet beside lost robots, in the server's own queue on a virtual clock whose cores are shared by threads.

Each robot has a token. The fleet's photographs are localized at once; those of a lost robot fail, climb all rungs, and
are followed by the next. Threads of low priority get the cores that the others leave, and a tenth of one that
these want.
"""

import heapq
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from mapless_server.scheduling import (
    AnyJob,
    AnyResult,
    Done,
    Ending,
    Fallback,
    Flow,
    Job,
    Next,
    Observer,
    Refused,
    Stage,
    Step,
    WorkQueueOptions,
)
from mapless_server.scheduling.jobs import Batch
from mapless_server.scheduling.scheduler import Scheduler

CORES, SECONDS, DEADLINE_S = 2, 120.0, 30.0
FLEET_STEPS_S = (0.22, 0.01, 0.08)
"""Processor times of the steps of a photograph of the fleet."""
LOST_STEPS_S = (0.52, 0.08, 0.7, 0.7, 1.35, 2.06, 0.5, 0.5, 0.5, 0.5, 0.5, 0.7, 0.7)
"""Those of a photograph of another place: its first attempt, wide matches, lines, a turn, stronger features, five pairs
by LightGlue, and wide matches and lines with these. Measured with `auto` on a CPU."""
CHEAP_STEPS = 4
"""So many of them are the first attempt and cheap rungs."""
FIRST_STEPS = 2
LOW_WEIGHT = 110 / 1024
"""Linux's share of a thread with a niceness of 10, for one with 0."""
PER_S = 2.2


@dataclass
class SharedCores:
    """A server's queue, and cores that its threads share; events are (time, number, what to do)."""

    with_low: bool = True
    now_s: float = 0.0
    seconds: list[float] = field(default_factory=list)
    refused: int = 0
    failed: int = 0

    def __post_init__(self) -> None:
        low = {"host": CORES} if self.with_low else None
        self.scheduler = Scheduler([Stage("work", "host")], {"host": CORES}, WorkQueueOptions(), Observer(), low=low)
        self._numbers = itertools.count()
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._left_s: dict[Batch, float] = {}
        self._weights: dict[Batch, float] = {}

    def at(self, time_s: float, do: Callable[[], None]) -> None:
        """Does something at a time."""
        heapq.heappush(self._events, (time_s, next(self._numbers), do))

    def run(self) -> None:
        """Computes until there is nothing more to do."""
        while self._events or self._left_s:
            speeds = self._speeds()
            event_s = self._events[0][0] if self._events else math.inf
            ends_s = {batch: self.now_s + left_s / speeds[batch] for batch, left_s in self._left_s.items()}
            until_s = min(event_s, *ends_s.values()) if ends_s else event_s
            for batch in self._left_s:
                self._left_s[batch] -= (until_s - self.now_s) * speeds[batch]
            self.now_s = until_s
            for batch in [it for it, end_s in ends_s.items() if end_s <= until_s]:
                del self._left_s[batch], self._weights[batch]
                self._finish(batch)
            if event_s <= until_s:
                heapq.heappop(self._events)[2]()
            self.scheduler.expire(self.now_s)
            for is_low in (False, True):
                while (taken := self.scheduler.take("host", self.now_s, is_low)) is not None:
                    self._left_s[taken] = taken.jobs[0].step.payload[0]
                    self._weights[taken] = LOW_WEIGHT if is_low else 1.0

    def _speeds(self) -> dict[Batch, float]:
        """Each thread's share of the cores by its weight, and at most one core."""
        speeds, cores, waiting = dict[Batch, float](), float(CORES), dict(self._weights)
        while waiting:
            per_weight = cores / sum(waiting.values())
            whole = [batch for batch, weight in waiting.items() if weight * per_weight >= 1]
            if not whole:
                return speeds | {batch: weight * per_weight for batch, weight in waiting.items()}
            for batch in whole:
                speeds[batch] = 1.0
                del waiting[batch]
            cores -= len(whole)
        return speeds

    def _finish(self, batch: Batch) -> None:
        (job,) = batch.jobs
        is_lost, later_s = job.owner.caller.startswith("lost"), job.step.payload[1:]
        done = len(LOST_STEPS_S) - len(later_s)
        is_further = is_lost and done >= FIRST_STEPS
        if is_lost and done >= CHEAP_STEPS and self.scheduler.gets_cheap_steps(job.owner, self.now_s):
            later_s = ()
        result: AnyResult = self._answered(job, not is_lost) if not later_s else self._next(job, later_s, is_further)
        self.scheduler.finish(batch, [result], self.now_s)

    def _next(self, job: AnyJob, later_s: tuple[float, ...], is_further: bool) -> AnyResult:
        steps = (Step("work", f"{job.step.kind.split()[0]} {len(later_s)}", "", later_s),)
        if not is_further:
            return Next(steps)
        fallback = Fallback[object, None](lambda _: self._answered(job, False), job.deadline_s - 0.2 * DEADLINE_S)
        return Next(steps, fallback, has_begun=True)

    def _answered(self, job: AnyJob, is_localized: bool) -> Done[None]:
        self.scheduler.failing.answered(job.owner, is_localized, self.now_s)
        return Done(None, Ending.OK if is_localized else Ending.LOW_CONFIDENCE)

    def ask(self, robot: str, steps_s: tuple[float, ...], then: Callable[[float | None, float], None]) -> None:
        """Makes a call, and then does something with its seconds, or None and the time after which to come again."""
        begin_s = self.now_s
        step = Step("work", f"{robot.split('-')[0]} {len(steps_s)}", "", steps_s)
        end_s = begin_s + DEADLINE_S
        job: AnyJob = Job(Flow("t", robot), step, end_s, 1, lambda *_: then(self.now_s - begin_s, 0.0))
        try:
            self.scheduler.admit(job, begin_s)
        except Refused as refused:
            then(None, refused.retry_after_s or 0.1)

    def ask_without_end(self, robot: str) -> None:
        """Makes the calls of a lost robot: the next when one has ended, or when the server says after a refusal."""

        def then(_: float | None, wait_s: float) -> None:
            if self.now_s < SECONDS:
                self.at(self.now_s + wait_s, partial(self.ask_without_end, robot))

        self.ask(robot, LOST_STEPS_S, then)

    def count(self, seconds: float | None, _: float) -> None:
        """Counts an answer to the fleet, or a refusal."""
        if seconds is None:
            self.refused += 1
        else:
            self.seconds.append(seconds)


def beside(
    lost: int,
    robots: int = 3,
    seed: int = 0,
    with_low: bool = True,
    fleet_steps_s: tuple[float, ...] = FLEET_STEPS_S,
) -> SharedCores:
    """The calls of a fleet beside lost robots; the fleet's are the same however many these are."""
    server, random = SharedCores(with_low), np.random.default_rng(seed)
    for at_s in np.sort(random.uniform(3.0, SECONDS, round(PER_S * SECONDS))).tolist():
        server.at(at_s, partial(server.ask, f"robot-{random.integers(robots)}", fleet_steps_s, server.count))
    for i in range(lost):
        server.at(0.0, partial(server.ask_without_end, f"lost-{i}"))
    server.run()
    return server
