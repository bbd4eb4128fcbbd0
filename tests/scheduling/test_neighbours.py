"""A token that asks without end, as a new client with each call, leaves a fleet its answers; on a virtual clock."""

import heapq
import itertools
from dataclasses import dataclass, field
from functools import partial
from statistics import median
from typing import Any

import numpy as np
import pytest
from support.queues import CountingObserver

from mapless_server.scheduling import Done, Ending, Fallback, Flow, Job, Next, Refused, Stage, Step, WorkQueueOptions
from mapless_server.scheduling.scheduler import Scheduler

THREADS = 2
FLEET_S, FOREIGN_S, ATTEMPT_S, ATTEMPTS = 0.2, 0.3, 0.6, 6
"""A photograph of the fleet; one of another place, and the steps by which it is tried again."""
SHARE, SECONDS, DEADLINE_S = 0.4, 60.0, 30.0


@dataclass
class Server:
    """Computes on threads of a virtual clock; events are (time, number, what to do)."""

    now_s: float = 0.0
    events: list[tuple[float, int, Any]] = field(default_factory=list)
    answers_s: list[float] = field(default_factory=list)
    refused: int = 0

    def __post_init__(self) -> None:
        self.numbers = itertools.count()
        options = WorkQueueOptions()
        self.scheduler = Scheduler([Stage("work", "host")], {"host": THREADS}, options, CountingObserver())

    def at(self, time_s: float, do: Any) -> None:
        heapq.heappush(self.events, (time_s, next(self.numbers), do))

    def run(self) -> None:
        while self.events:
            self.now_s, _, do = heapq.heappop(self.events)
            do()
            self.scheduler.expire(self.now_s)
            while (batch := self.scheduler.take("host", self.now_s)) is not None:
                seconds = batch.jobs[0].step.payload
                self.at(self.now_s + seconds, partial(self.finish, batch))

    def finish(self, batch: Any) -> None:
        (job,) = batch.jobs
        left = int(job.step.bucket)
        result: Any = Done(None)
        if left:
            fallback = Fallback(lambda: Done(None, Ending.LOW_CONFIDENCE), job.deadline_s - 1)
            result = Next(Step("work", "again", str(left - 1), ATTEMPT_S), fallback)
        self.scheduler.finish(batch, [result], self.now_s)

    def ask(self, flow: Flow, step: Step, then: Any) -> None:
        begin_s = self.now_s
        job = Job(flow, step, self.now_s + DEADLINE_S, 1, lambda ending, _: then(ending, self.now_s - begin_s))
        try:
            self.scheduler.admit(job, self.now_s)
        except Refused as refused:
            then(refused, 0.0)

    def fleet_asks(self, robot: str) -> None:
        def then(ending: Any, seconds: float) -> None:
            if ending is Ending.OK:
                self.answers_s.append(seconds)
            else:
                self.refused += 1

        self.ask(Flow("t", "fleet", robot), Step("work", "fleet", "0", FLEET_S), then)

    def neighbour_asks(self, ids: Any) -> None:
        if self.now_s > SECONDS:
            return

        def then(ending: Any, _: float) -> None:
            wait_s = (ending.retry_after_s or 0.1) if isinstance(ending, Refused) else 0.0
            self.at(self.now_s + wait_s, lambda: self.neighbour_asks(ids))

        self.ask(Flow("t", "neighbour", next(ids)), Step("work", "foreign", str(ATTEMPTS), FOREIGN_S), then)


def fleet(beside: Any, robots: int) -> Server:
    """The fleet's calls at 40 % of what the server can do, alone or beside a neighbour's clients with these ids."""
    server, random = Server(), np.random.default_rng(0)
    rate_per_s = SHARE * THREADS / FLEET_S
    for at_s in np.sort(random.uniform(0, SECONDS, int(rate_per_s * SECONDS))).tolist():
        server.at(at_s, partial(server.fleet_asks, f"robot-{random.integers(robots)}"))
    if beside is not None:
        for _ in range(8):
            server.at(0.0, lambda: server.neighbour_asks(beside))
    server.run()
    return server


@pytest.mark.parametrize("robots", [1, 4])
@pytest.mark.parametrize("ids", ["one", "new"])
def test_a_neighbour_leaves_a_fleet_its_answers(ids: str, robots: int) -> None:
    alone = fleet(None, robots)
    beside = fleet((f"{i if ids == 'new' else 0}" for i in itertools.count()), robots)
    assert len(beside.answers_s) >= 0.9 * len(alone.answers_s)
    assert median(beside.answers_s) <= 1.5 * median(alone.answers_s)
