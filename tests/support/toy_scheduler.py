"""A scheduler on a virtual clock, with toy stages of known cost."""

import math
from contextlib import suppress
from typing import Any

import pytest

from mapless_server.scheduling import (
    AnyFallback,
    AnyJob,
    AnyResult,
    Done,
    Ending,
    Flow,
    Job,
    Next,
    Refused,
    Stage,
    Step,
    WorkQueueOptions,
)
from mapless_server.scheduling.jobs import Batch
from mapless_server.scheduling.scheduler import Scheduler
from support.queues import CountingObserver

STAGES = [
    Stage("describe", "host"),
    Stage("prepare", "host", "coarse"),
    Stage("coarse", "device", "refine", max_batch=3),
    Stage("refine", "host"),
]


LANES = {"host": 2, "device": 1}


COST_S = {"describe": 0.5, "prepare": 0.1, "coarse": 0.3, "refine": 0.2}


OPTIONS = WorkQueueOptions(max_queued_s=2.0, max_bytes=1000, quantum_s=0.2)


FAR_S = 1e6


class PlantedQuota:
    """Admits so many jobs, and keeps what is charged and settled."""

    def __init__(self, admitted: float = math.inf) -> None:
        self.admitted = admitted
        self.charged: list[float] = []
        self.settled: list[tuple[float, float]] = []

    def charge(self, tenant: str, caller: str, cost_s: float, now_s: float) -> float:
        self.charged.append(cost_s)
        return 0.0 if len(self.charged) <= self.admitted else 7.0

    def settle(self, tenant: str, caller: str, predicted_s: float, actual_s: float, now_s: float) -> None:
        self.settled.append((predicted_s, actual_s))


class Toy:
    """A scheduler that has learned what its stages cost, and its jobs."""

    def __init__(self, options: WorkQueueOptions = OPTIONS, quota: Any = None, low: int = 0) -> None:
        self.observer = CountingObserver()
        self.scheduler = Scheduler(STAGES, LANES, options, self.observer, quota=quota, low={"host": low})
        self.ends: dict[int, list[tuple[Ending, Any]]] = {}
        self.jobs: list[AnyJob] = []
        self.now_s = 0.0
        for stage, cost_s in COST_S.items():
            self.learn(stage, "toy", cost_s)

    def learn(self, stage: str, kind: str, cost_s: float, client: str = "earlier") -> None:
        self.scheduler.costs.observe(stage, kind, Flow("t", client), cost_s, self.now_s)

    def job(
        self,
        client: str = "c",
        deadline_s: float = FAR_S,
        size_bytes: int = 1,
        stage: str = "prepare",
        bucket: str = "b",
    ) -> AnyJob:
        number = len(self.jobs)
        ends = self.ends[number] = []
        step = Step(stage, "toy", bucket, number)
        job: AnyJob = Job(
            Flow("t", client), step, deadline_s, size_bytes, lambda ending, value: ends.append((ending, value))
        )
        self.jobs.append(job)
        return job

    def admit(self, **what: Any) -> AnyJob:
        job = self.job(**what)
        self.scheduler.admit(job, self.now_s)
        return job

    def ending_of(self, job: AnyJob) -> Ending | None:
        ends = self.ends[self.jobs.index(job)]
        assert len(ends) <= 1
        return ends[0][0] if ends else None

    def take(self, lane: str, is_low: bool = False) -> Batch:
        batch = self.scheduler.take(lane, self.now_s, is_low)
        assert batch is not None
        return batch

    def finish(self, batch: Batch, *verdicts: AnyResult, seconds: float | None = None) -> None:
        cost_s = COST_S[batch.stage.name] * len(batch.jobs)  # so that predictions stay what they are
        self.now_s = max(self.now_s, batch.start_s + (cost_s if seconds is None else seconds))
        self.scheduler.finish(batch, verdicts, self.now_s)

    def fill(self, client: str = "many") -> None:
        """Admits jobs of a caller until one is refused."""
        with suppress(Refused):
            while True:
                self.admit(client=client)

    def refusal(self, **what: Any) -> Refused:
        with pytest.raises(Refused) as caught:
            self.admit(**what)
        return caught.value


def onward(job: AnyJob, fallback: AnyFallback | None = None) -> AnyResult:
    """To the stage that usually follows."""
    stage = next(it for it in STAGES if it.name == job.step.stage)
    if stage.then is None:
        return Done("result")
    return Next((Step(stage.then, "toy", job.step.bucket, job.step.payload),), fallback, is_admitted=True)


def run_through(toy: Toy) -> None:
    """Computes until nothing waits."""
    for _ in range(1000):
        batches = [batch for lane in LANES if (batch := toy.scheduler.take(lane, toy.now_s)) is not None]
        if not batches:
            return
        for batch in batches:
            toy.finish(batch, *map(onward, batch.jobs))
    raise AssertionError("it never ends")
