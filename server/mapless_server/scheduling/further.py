"""Whether a job's further step is computed: one that it was not admitted for, and that a fallback stands in for."""

import math
from collections import Counter
from collections.abc import Mapping
from enum import Enum, auto
from typing import NamedTuple

from .admission import Admission, Ledger, WorkQueueOptions
from .costs import StageCosts
from .jobs import AnyJob, AnyNext, AnyStep, Flow, Stage
from .lanes import Lane

_TRY_ONE_IN = 8


class When(Enum):
    """When a further step is computed."""

    IN_ORDER = auto()
    ASIDE = auto()
    """When a thread would be idle otherwise, or the further steps of all callers together have their turn."""
    NEVER = auto()


class Choice(NamedTuple):
    """A further step, when it is computed, and its predicted computing time by lane, with the stages that follow."""

    step: AnyStep
    when: When
    cost_s: Counter[str]


class Further:
    """Chooses the further steps of jobs, by the other jobs and the refusals of the last seconds."""

    def __init__(
        self,
        options: WorkQueueOptions,
        stages: Mapping[str, Stage],
        lanes: Mapping[str, Lane],
        costs: StageCosts,
        ledger: Ledger,
        admission: Admission,
    ) -> None:
        """Reads the scheduler's own stages and lanes, by name, predictions and bookings; changes none of them."""
        self._options = options
        self._stages = stages
        self._lanes = lanes
        self._costs = costs
        self._ledger = ledger
        self._admission = admission
        # When a job was last refused because of those admitted, and when one of a caller that has not most of these.
        self._refused_s = self._crowded_s = -math.inf
        self._declined: Counter[tuple[str, str]] = Counter()

    def refused(self, flow: Flow, now_s: float) -> None:
        """Notes that a caller's job was refused because of those that are admitted."""
        self._refused_s = now_s
        if not self._has_most(flow):
            self._crowded_s = now_s

    def choose(self, job: AnyJob, following: AnyNext, now_s: float) -> Choice:
        """Chooses the first step that ends before the job is due, after all that was admitted.

        If none does, or jobs are refused, the cheapest waits for its turn among the jobs of callers that ask for more
        than their share; or none is computed. A step that the job was admitted with is computed if it ends in time.
        """
        costs = [(step, self._costs.of(step, job.flow, now_s)) for step in following.steps]
        if following.is_admitted:
            step, cost_s = costs[0]
            is_computed = now_s + self._wait_s(step, now_s) + cost_s.total() <= job.due_s or self._is_tried_anyway(step)
            return Choice(step, When.IN_ORDER if is_computed else When.NEVER, cost_s)
        before_s = self._before_s(job)
        for step, cost_s in costs:
            if self._may_wait(job, cost_s, before_s, now_s, following.has_begun):
                return Choice(step, When.ASIDE, cost_s)
        step, cost_s = min(costs, key=lambda it: it[1].total())
        # Those that cost more are never tried anyway: that could cost what the cheapest gives.
        is_computed = self._has_turn(job, cost_s, now_s) or self._is_tried_anyway(step)
        return Choice(step, When.IN_ORDER if is_computed else When.NEVER, cost_s)

    def _wait_s(self, step: AnyStep, now_s: float) -> float:
        """Time until the jobs that come before a step in order have been computed."""
        stage = self._stages[step.stage]
        lane = self._lanes[stage.lane]
        coming_first = lane.queues[lane.stages.index(stage) :]
        return sum(self._costs.of_step(other, now_s) for queue in coming_first for other in queue) / lane.threads

    def _before_s(self, job: AnyJob) -> float:
        """Time until what is admitted, and what is set aside, has been computed, without the job."""
        return max(
            (self._ledger.booked_s(name) - job.booked_s[name] + sum(it.cost_s for it in lane.aside)) / lane.threads
            for name, lane in self._lanes.items()
        )

    def _may_wait(
        self, job: AnyJob, cost_s: Counter[str], before_s: float, now_s: float, has_begun: bool = False
    ) -> bool:
        """Whether a step can be computed in time after so much else.

        It does not wait if jobs were refused lately: more come than is computed, so that its turn would hardly come.
        The only job does, since it waits for nothing. What has begun goes on if it alone is in time: what was spent on
        it would be lost otherwise, and it waits aside whatever comes.
        """
        if has_begun:
            return now_s + cost_s.total() <= job.due_s
        if self._is_recent(self._refused_s, now_s) and len(self._ledger.jobs) > 1:
            return False
        return now_s + before_s + cost_s.total() <= job.due_s

    def _has_turn(self, job: AnyJob, cost_s: Counter[str], now_s: float) -> bool:
        """Whether a step beyond the bounds takes turns with the jobs of callers that ask for more than their share."""
        is_crowded = self._is_recent(self._crowded_s, now_s)
        if is_crowded or not self._is_recent(self._refused_s, now_s) or not self._admission.has_turn(job, cost_s):
            return False
        return now_s + self._options.max_queued_s <= job.due_s

    def _is_recent(self, refused_s: float, now_s: float) -> bool:
        return now_s - refused_s <= self._options.max_queued_s

    def _is_tried_anyway(self, step: AnyStep) -> bool:
        """Whether to try a step against its prediction: once in a while, since only computing corrects a prediction."""
        self._declined[step.stage, step.kind] += 1
        return self._declined[step.stage, step.kind] % _TRY_ONE_IN == 0

    def _has_most(self, flow: Flow) -> bool:
        """Whether a caller's admitted jobs take longer than those of all others together."""
        ledger = self._ledger
        return any(2 * ledger.booked_s_of_caller(lane, flow) > ledger.booked_s(lane) for lane in self._lanes)
