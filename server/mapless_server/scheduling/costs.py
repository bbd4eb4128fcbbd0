"""Predicted computing times: of a job in a stage, from earlier ones of its kind, and in all the stages that follow."""

from collections import Counter, OrderedDict, deque
from collections.abc import Mapping
from dataclasses import replace
from statistics import median_low
from typing import NamedTuple

from .jobs import AnyJob, AnyStep, Flow, Stage

FIRST_GUESS_S = 0.25
"""Predicted before anything is observed."""
_EXPECTED = ", if reached"
"""Ending of a stage's name, where jobs that did not reach it count."""
MEMORY = 10
"""About so many of the last jobs of a kind count."""
MAX_OF_CALLERS = 4000
"""Predictions for single callers that are kept, about six of each."""
MAX_OF_CLIENTS = 100
"""A caller's clients of which predictions are kept, so that one caller does not displace those of others."""
FORGOTTEN_S = 30.0
"""Age after which the costs of a caller's jobs do not count: as long as it is refused, nothing corrects its
prediction."""


class CostModel:
    """Predicts the computing time of a job in a stage from earlier ones of its kind.

    Photographs of a client resemble one another, and those of another may take fifty times as long: so its own jobs
    count, as an average with more weight for recent ones, which begins with what is typical. That is the average of its
    caller's jobs; of a new caller, the median of all callers' last jobs.
    """

    def __init__(self) -> None:
        self._of_callers: OrderedDict[tuple[str, str, tuple[str, str]], _OfCaller] = OrderedDict()
        self._of_all: dict[tuple[str, str], deque[float]] = {}

    def forget(self) -> None:
        """Forgets all observations."""
        self._of_callers.clear()
        self._of_all.clear()

    def predict(self, stage: str, kind: str, flow: Flow, now_s: float, is_certain: bool = True) -> float:
        """Predicted seconds; for an unknown kind, what is typical of all kinds in the stage.

        Unless it `is_certain` that the job reaches the stage, jobs that did not count as well, with nothing.
        """
        stage += "" if is_certain else _EXPECTED
        of_caller = self._of_callers.get((stage, kind, flow.group))
        if of_caller is not None and (recent_s := of_caller.recent_s(flow, now_s)) is not None:
            return recent_s
        known = self._of_all.get((stage, kind)) or self._of_all.get((stage, ""))
        return median_low(known) if known else FIRST_GUESS_S

    def observe(self, stage: str, kind: str, flow: Flow, seconds: float | None, now_s: float) -> None:
        """Records the computing time of a job, its share if it was computed with others; None if it was not reached."""
        if seconds is not None:
            self._observe(stage, kind, flow, seconds, now_s)
        self._observe(stage + _EXPECTED, kind, flow, seconds or 0.0, now_s)

    def _observe(self, stage: str, kind: str, flow: Flow, seconds: float, now_s: float) -> None:
        of_caller = self._of_callers.pop((stage, kind, flow.group), None) or _OfCaller()
        known = self._of_all.get((stage, kind))
        of_caller.observe(flow, seconds, now_s, median_low(known) if known else None)
        self._of_callers[stage, kind, flow.group] = of_caller
        if len(self._of_callers) > MAX_OF_CALLERS:
            self._of_callers.popitem(last=False)
        for key in (kind, ""):
            self._of_all.setdefault((stage, key), deque(maxlen=MEMORY)).append(seconds)


class _Mean(NamedTuple):
    """An average of the last jobs, about as many as `weight`, with more weight for recent ones."""

    weight: int
    mean_s: float
    seen_s: float

    def with_value(self, seconds: float, now_s: float) -> "_Mean":
        weight = min(self.weight + 1, MEMORY)
        return _Mean(weight, self.mean_s + (seconds - self.mean_s) / weight, now_s)


class _OfCaller:
    """Times of the jobs of a caller's clients in a stage: of each client, and of all together."""

    def __init__(self) -> None:
        self._all: _Mean | None = None
        self._of_clients: OrderedDict[str, _Mean] = OrderedDict()

    def recent_s(self, flow: Flow, now_s: float) -> float | None:
        """The average of the client, else that of the caller; None if both are too old."""
        for it in (self._of_clients.get(flow.client), self._all):
            if it is not None and now_s - it.seen_s <= FORGOTTEN_S:
                return it.mean_s
        return None

    def observe(self, flow: Flow, seconds: float, now_s: float, typical_s: float | None) -> None:
        """Counts a job; `typical_s` is what others took, if any have been observed."""
        begin = _Mean(0, 0.0, now_s) if typical_s is None else _Mean(1, typical_s, now_s)
        if self._all is not None and now_s - self._all.seen_s <= FORGOTTEN_S:
            begin = self._all
        of_client = self._of_clients.pop(flow.client, None)
        if of_client is None or now_s - of_client.seen_s > FORGOTTEN_S:
            of_client = begin._replace(weight=min(begin.weight, 1))
        self._of_clients[flow.client] = of_client.with_value(seconds, now_s)
        if len(self._of_clients) > MAX_OF_CLIENTS:
            self._of_clients.popitem(last=False)
        self._all = begin.with_value(seconds, now_s)


class StageCosts:
    """Predicts what jobs cost in the stages that they go through."""

    def __init__(self, model: CostModel, stages: Mapping[str, Stage]) -> None:
        """`stages` are by name."""
        self._model = model
        self._stages = stages

    def of(self, step: AnyStep, flow: Flow, now_s: float) -> Counter[str]:
        """Predicted computing time, by lane, of a caller's step and of those that usually follow."""
        cost_s: Counter[str] = Counter()
        stage: Stage | None = self._stages[step.stage]
        kind, is_certain = step.kind, True
        while stage is not None:
            predicted_s = self._model.predict(stage.name, kind, flow, now_s, is_certain)
            cost_s[stage.lane] += predicted_s  # type: ignore[assignment]  # not int
            stage = self._stages[stage.then] if stage.then else None
            kind, is_certain = step.later_kind or step.kind, False
        return cost_s

    def of_step(self, job: AnyJob, now_s: float) -> float:
        """Predicted computing time of a job's current step."""
        return self._model.predict(job.step.stage, job.step.kind, job.flow, now_s)

    def learn(self, job: AnyJob, seconds: float, is_done: bool, now_s: float) -> None:
        """Records what a job took in its stage, and that one that is done does not reach those that usually follow."""
        stage, kind = self._stages[job.step.stage], job.step.kind
        self._model.observe(stage.name, kind, job.flow, seconds, now_s)
        while is_done and stage.then:
            stage, kind = self._stages[stage.then], job.step.later_kind or kind
            self._model.observe(stage.name, kind, job.flow, None, now_s)


class FirstSteps:
    """The first step of each caller's last job in a stage, without its payload."""

    def __init__(self) -> None:
        self._steps: OrderedDict[tuple[tuple[str, str], str], AnyStep] = OrderedDict()

    def remember(self, flow: Flow, step: AnyStep) -> None:
        """Keeps the first step of a job."""
        key = flow.group, step.stage
        if (known := self._steps.get(key)) is None or known.kind != step.kind:
            self._steps[key] = replace(step, payload=None)
        self._steps.move_to_end(key)
        if len(self._steps) > MAX_OF_CALLERS:
            self._steps.popitem(last=False)

    def last(self, flow: Flow, step: AnyStep) -> AnyStep:
        """The step of the caller's last job in the stage of a step; this step if there was none."""
        return self._steps.get((flow.group, step.stage), step)
