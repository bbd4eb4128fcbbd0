"""Whether a job's further step is computed: one that it was not admitted for, and that a fallback stands in for."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from enum import Enum, auto
from typing import NamedTuple

from .admission import Admission, Ledger, WorkQueueOptions
from .costs import StageCosts
from .jobs import AnyJob, AnyStep, Flow, Stage
from .lanes import Lane

_TRY_ONE_IN = 8


class When(Enum):
    """When a further step is computed."""

    IN_ORDER = auto()
    WHEN_IDLE = auto()
    """When a thread would be idle otherwise."""
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

    def choose(self, job: AnyJob, steps: Sequence[AnyStep], now_s: float) -> Choice:
        """Chooses the first step that ends before the job is due and fits within the bounds.

        If none does, the cheapest waits for an idle thread; or, if no thread will be idle because other callers ask for
        more than their share, for its turn; or none is computed.
        """
        costs = [(step, self._costs.of(step, job.flow, now_s)) for step in steps]
        for step, cost_s in costs:
            if self._is_worthwhile(job, step, cost_s, now_s):
                return Choice(step, When.IN_ORDER, cost_s)
        step, cost_s = min(costs, key=lambda it: it[1].total())
        if self._may_wait(job, cost_s, now_s):
            return Choice(step, When.WHEN_IDLE, cost_s)
        # Those that cost more are never tried anyway: that could cost what the cheapest gives.
        is_computed = self._has_turn(job, cost_s, now_s) or self._is_tried_anyway(step)
        return Choice(step, When.IN_ORDER if is_computed else When.NEVER, cost_s)

    def _is_worthwhile(self, job: AnyJob, step: AnyStep, cost_s: Counter[str], now_s: float) -> bool:
        """Whether a job's step fits within the bounds and ends before the job is due."""
        stage = self._stages[step.stage]
        lane = self._lanes[stage.lane]
        coming_first = lane.queues[lane.stages.index(stage) :]
        wait_s = sum(self._costs.of_step(other, now_s) for queue in coming_first for other in queue)
        return self._admission.fits(job, cost_s) and now_s + wait_s / lane.threads + cost_s.total() <= job.due_s

    def _may_wait(self, job: AnyJob, cost_s: Counter[str], now_s: float) -> bool:
        """Whether a step beyond the bounds can be computed in time when all that is admitted has been.

        It does not wait if jobs were refused lately: more come than is computed, so that its turn would never come.
        """
        if self._is_recent(self._refused_s, now_s):
            return False
        before_s = (
            (self._ledger.booked_s(name) + sum(it.cost_s for it in lane.spare)) / lane.threads
            for name, lane in self._lanes.items()
        )
        return now_s + max(before_s) + cost_s.total() <= job.due_s

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
