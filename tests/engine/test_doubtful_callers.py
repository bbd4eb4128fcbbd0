"""200 callers whose photographs climb every rung leave others their answers, in the server's queue on a virtual clock.

Scheduler, stages, ladder and predictions are the server's. What a stage finds is planted, and so is the time it takes.
"""

import heapq
import itertools
from collections.abc import Callable, Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.planted_engine import DOUBT, SURE_INLIERS, Setting, localized, query_of, rejected
from support.servers import whole

from mapless_server.engine import search, stages
from mapless_server.engine.query import COARSE, PREPARE, REFINE, Caller
from mapless_server.engine.queue_engine import HOST
from mapless_server.engine.stages import QueryStages
from mapless_server.method.features.views import PosedView
from mapless_server.method.judge.answer import Answer
from mapless_server.scheduling import Ending, Flow, Observer, Refused, Stage, WorkQueueOptions
from mapless_server.scheduling.jobs import Batch
from mapless_server.scheduling.scheduler import Scheduler

THREADS = 2
COST_S = {PREPARE: 0.1, COARSE: 0.02, REFINE: 0.08}, {PREPARE: 0.5, COARSE: 0.02, REFINE: 0.15}
"""Seconds of a stage with the first features, and with stronger ones."""
DOUBTFUL_CALLERS, AGAIN_S = 200, 40.0
"""Each asks again after so long: their first attempts take half of the server's time, all attempts three times as much
as it has."""
GOOD_CALLERS, GOOD_PER_S = 10, 4.0
"""Good photographs take 40 % of the time."""
SECONDS, MIN_PAUSE_S = 45.0, 0.2
"""Good photographs are sent for so long; a refused call is repeated after such a pause, as the client does."""


class Server:
    """Computes the stages on threads of a virtual clock; events are (time, number, what to do).

    Attributes:
        ended: how the calls with good photographs have ended, and how those with doubtful ones have.
    """

    def __init__(self, setting: Setting, deadline_s: float) -> None:
        self.now_s, self.ended = 1e6, {True: list[Ending | Refused](), False: list[Ending | Refused]()}
        self._setting, self._deadline_s = setting, deadline_s
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._numbers = itertools.count()

        def answer(_: object, references: Sequence[PosedView], *__: object) -> Answer:
            is_good = references[0].name.endswith("r0")
            return localized(SURE_INLIERS) if is_good else rejected()

        computed = QueryStages(setting.tiers, DOUBT, whole(answer))
        self._compute = {PREPARE: computed.prepare, COARSE: computed.coarse, REFINE: computed.refine}
        laid = Stage(PREPARE, HOST, COARSE), Stage(COARSE, HOST, REFINE), Stage(REFINE, HOST)
        self._scheduler = Scheduler(laid, {HOST: THREADS}, WorkQueueOptions(), Observer())

    def at(self, time_s: float, do: Callable[[], None]) -> None:
        """Does something at a time."""
        heapq.heappush(self._events, (time_s, next(self._numbers), do))

    def run(self) -> None:
        """Computes until there are no events."""
        while self._events:
            self.now_s, _, do = heapq.heappop(self._events)
            do()
            self._scheduler.expire(self.now_s)
            while (batch := self._scheduler.take(HOST, self.now_s)) is not None:
                (job,) = batch.jobs
                cost_s = COST_S[job.step.payload.attempt.features][batch.stage.name]
                self.at(self.now_s + cost_s, partial(self._finish, batch))

    def ask(self, caller: str, is_good: bool, begin_s: float | None = None) -> None:
        """Makes a call, and repeats it after a refusal until its deadline."""
        deadline_s = (begin_s or self.now_s) + self._deadline_s
        query = query_of(("r0", "r1") if is_good else ("r1", "r2"))
        job = self._setting.engine.query_job(query, Caller(Flow("t", caller), deadline_s))
        job.on_end = lambda ending, _: self.ended[is_good].append(ending)
        try:
            self._scheduler.admit(job, self.now_s)
        except Refused as refused:
            again_s = self.now_s + max(refused.retry_after_s or 0.0, MIN_PAUSE_S)
            if again_s < deadline_s:
                self.at(again_s, partial(self.ask, caller, is_good, deadline_s - self._deadline_s))
            else:
                self.ended[is_good].append(refused)

    def _finish(self, batch: Batch) -> None:
        results: Any = self._compute[batch.stage.name](batch.jobs)
        self._scheduler.finish(batch, results, self.now_s)


@pytest.mark.parametrize(("come", "deadline_s"), [("together", 30.0), ("one by one", 5.0)])
def test_callers_with_good_photographs_keep_their_answers(
    setting: Setting, monkeypatch: pytest.MonkeyPatch, come: str, deadline_s: float
) -> None:
    """In time; nearly as many as without the others, each of which gets an answer, too."""
    answered = []
    for is_beside in (False, True):
        server, random = Server(setting, deadline_s), np.random.default_rng(0)
        for module in (stages, search):
            monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda it=server: it.now_s))
        begin_s = server.now_s
        for at_s in random.uniform(0, SECONDS, round(GOOD_PER_S * SECONDS)).tolist():
            server.at(begin_s + at_s, partial(server.ask, f"good-{random.integers(GOOD_CALLERS)}", True))
        for i in range(DOUBTFUL_CALLERS if is_beside else 0):
            first_s = 0.0 if come == "together" else AGAIN_S * i / DOUBTFUL_CALLERS
            for at_s in [0.0] if come == "together" else np.arange(first_s, SECONDS, AGAIN_S).tolist():
                server.at(begin_s + at_s, partial(server.ask, f"doubtful-{i}", False))
        server.run()
        answered.append(server.ended[True].count(Ending.OK))
    alone, beside = answered
    assert alone == len(server.ended[True])
    assert beside >= 0.95 * alone
    doubtful = server.ended[False]
    assert doubtful.count(Ending.LOW_CONFIDENCE) >= 0.95 * len(doubtful)
