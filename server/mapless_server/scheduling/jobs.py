"""The types of the work queue: jobs, their steps, what stages return, and how jobs end."""

import math
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

from .processor import give_way

PayloadT = TypeVar("PayloadT")
"""The input of the job's stages."""
ValueT = TypeVar("ValueT")
"""The job's result."""


class Flow(NamedTuple):
    """The owner of a job: tenants get equal shares, so do the callers of a tenant, and the clients of a caller.

    Attributes:
        tenant: empty for the server's own jobs.
        caller: who cannot be more than one: the name of a token or certificate. Where there is neither, what the client
            calls itself, or its address.
        client: the client's own name among those of a token or certificate, or its address.
    """

    tenant: str
    caller: str
    client: str = ""

    @property
    def group(self) -> tuple[str, str]:
        """The tenant and the caller, without the client."""
        return self[:2]

    @property
    def named_caller(self) -> str:
        """The token's or certificate's name; empty if the caller has neither."""
        return self.caller if self.client else ""


class Refusal(str, Enum):
    """Reasons why a job is not admitted."""

    QUEUE_FULL = "queue_full"
    TOO_MUCH_MEMORY = "too_much_memory"
    DEADLINE_INFEASIBLE = "deadline_infeasible"
    TENANT_QUOTA = "tenant_quota"
    DRAINING = "draining"
    TOO_LARGE = "too_large"


class Ending(str, Enum):
    """How an admitted job ends; each ends exactly once."""

    OK = "ok"
    LOW_CONFIDENCE = "low_confidence"
    """There is an answer: that no result is good enough."""
    DEGRADED = "degraded"
    """A preliminary result was given, because the rest could not be computed in time."""
    EXPIRED = "expired"
    CANCELLED = "cancelled"
    OUT_OF_MEMORY = "oom"
    REFUSED_INPUT = "bad_input"
    """The input turned out to be invalid: the caller's error."""
    FAILED = "backend_error"


class Abandoned(Exception):
    """The job has ended and its result is not needed any more; raised in a stage, by `Job.check`, to stop computing."""


class Refused(Exception):
    """A job is not admitted, with the reason, and the seconds after which another attempt may succeed.

    They are None if the same job is never admitted.
    """

    def __init__(self, reason: Refusal, message: str, retry_after_s: float | None = None) -> None:
        super().__init__(message)
        self.reason = reason
        self.retry_after_s = retry_after_s


class Expired(Exception):
    """The job's deadline passed."""


@dataclass(frozen=True)
class Stage:
    """One kind of computation.

    Attributes:
        name: its unique name.
        lane: the threads that compute it.
        then: name of the stage that usually follows; None for the last.
        max_batch: largest number of jobs that are computed together.
    """

    name: str
    lane: str
    then: str | None = None
    max_batch: int = 1


class StageLoad(NamedTuple):
    """The jobs that wait for a stage, their predicted computing time from there on, and the jobs that it computes.

    The time is without that of further steps, which wait aside: it shows how far the queue is filled.
    """

    waiting: int
    cost_s: float
    running: int


@dataclass(frozen=True, eq=False)
class Step(Generic[PayloadT]):
    """The next computation of a job.

    Attributes:
        stage: name of the stage that computes it.
        kind: jobs of one kind take about the same time in the stage.
        bucket: jobs of one bucket can be computed together.
        payload: the stage's input.
        later_kind: the kind in the stages that usually follow; empty if it is the same.
    """

    stage: str
    kind: str
    bucket: str
    payload: PayloadT
    later_kind: str = ""


@dataclass(frozen=True, eq=False)
class Done(Generic[ValueT]):
    """The job is complete; `value` is its result."""

    value: ValueT
    ending: Ending = Ending.OK


@dataclass(frozen=True, eq=False)
class Fallback(Generic[PayloadT, ValueT]):
    """Makes the result that is given at `at_s`, by the queue's clock, if there is no better one.

    It is made from the payload of the step that the job has then.
    """

    make: Callable[[PayloadT], Done[ValueT]]
    at_s: float


@dataclass(frozen=True, eq=False)
class Next(Generic[PayloadT, ValueT]):
    """The job needs another step. From now on it ends with the fallback, if there is one, instead of expiring.

    With a fallback, the steps are further ones, in order of preference, unless the job was admitted with them. The
    first that is predicted to end in time is computed when a thread would be idle otherwise, or the further steps of
    all callers, which are like one more caller, have their turn. If none is, the fallback is given at once. Without a
    fallback the first is computed.

    Attributes:
        steps: one of them is computed.
        fallback: the job's result if no step leads to a result in time.
        is_admitted: whether the job was admitted with these steps, which then wait with those of other jobs.
        has_begun: whether they continue a further step that was computed, and go on though jobs are refused.
    """

    steps: tuple[Step[PayloadT], ...]
    fallback: Fallback[PayloadT, ValueT] | None = None
    is_admitted: bool = False
    has_begun: bool = False

    def __post_init__(self) -> None:
        if not self.steps:
            raise ValueError("Next.steps must have at least one step")


StageResult = Next[PayloadT, ValueT] | Done[ValueT] | Exception
"""The result of a stage for one job."""


@dataclass(frozen=True)
class StageRecord:
    """A job's time in a stage, by the queue's clock.

    Attributes:
        stage: name of the stage.
        queued_s: when the job began to wait.
        start_s: when it began to be computed, or stopped waiting without that.
        end_s: when it left the stage.
        batch: number of its batch; 0 if it was not computed.
        jobs: size of its batch; 0 if it was not computed.
        processor_s: its share of the processor time that the batch took, see `processor`.
    """

    stage: str
    queued_s: float
    start_s: float
    end_s: float
    batch: int
    jobs: int
    processor_s: float = 0.0

    @property
    def waited_s(self) -> float:
        """Time that the job waited until it was computed or stopped waiting."""
        return self.start_s - self.queued_s


@dataclass(eq=False)
class _Life:
    """The part of a job that `Job.check` needs; payloads refer to it instead of the job, which is then freed early."""

    over: bool = False
    checked_s: float = -math.inf

    def check(self) -> None:
        give_way()
        self.checked_s = time.monotonic()
        if self.over:
            raise Abandoned


@dataclass(eq=False)
class Job(Generic[PayloadT, ValueT]):
    """A call's work, from admission to its end.

    Attributes:
        flow: its owner, or as whom the scheduler has admitted it.
        step: its current step.
        deadline_s: when its result becomes useless, by the queue's clock.
        size_bytes: memory that it needs.
        on_end: called once, with how it ended and its result or exception.
        records: the stages that it has been through.
        owner: its owner, once it was admitted.
        continues: whether it completes what other jobs of its call have computed; then it is always admitted, also
            while the server drains, since their work would otherwise be lost.
        gives_way: whether all of its steps wait aside, and nothing is booked for them: nobody waits for its result.
        used_s: computing time so far.
        fallback: replaces expiry.
        waits_since_s: when it began to wait for the step, by the queue's clock.
        begins_until_s: until when it waits aside for a further step; None if it does not wait so.
        is_aside: whether its current step is a further one, which waits or has waited aside.
        booked_s: computing time still predicted for it, by lane.
        charged_s: computing time charged to its tenant at admission.
        charged_step_s: computing time charged to its owner for the current step, as predicted.
        unusual_s: part of the current batch's computing time that is not used for predictions; set by its stage.
        is_computed: whether it is in a batch now.
        timer_s: the `due_s` of the timer that the scheduler has set.
    """

    flow: Flow
    step: Step[PayloadT]
    deadline_s: float
    size_bytes: int
    on_end: Callable[[Ending, ValueT | Exception], None] = lambda *_: None
    records: list[StageRecord] = field(default_factory=list)
    continues: bool = False
    gives_way: bool = False
    used_s: float = 0.0
    fallback: Fallback[PayloadT, ValueT] | None = None
    waits_since_s: float = 0.0
    begins_until_s: float | None = None
    is_aside: bool = False
    booked_s: Counter[str] = field(default_factory=Counter)
    charged_s: float = 0.0
    charged_step_s: float = 0.0
    unusual_s: float = 0.0
    is_computed: bool = False
    timer_s: float = -math.inf
    owner: Flow = field(default_factory=lambda: Flow("", ""))
    _life: _Life = field(default_factory=_Life)

    @property
    def is_over(self) -> bool:
        """Whether it has ended; a thread may still be computing it."""
        return self._life.over

    @property
    def checked_s(self) -> float:
        """Time of a stage's last call of `check`, by `time.monotonic`: shows that the computing thread is alive."""
        return self._life.checked_s

    @property
    def due_s(self) -> float:
        """Latest time of its end, by the queue's clock."""
        due_s = self.deadline_s if self.fallback is None else min(self.fallback.at_s, self.deadline_s)
        return due_s if self.begins_until_s is None else min(due_s, self.begins_until_s)

    @property
    def check(self) -> Callable[[], None]:
        """Makes a function that raises Abandoned if the job has ended; stages call it between steps, on any thread."""
        return self._life.check

    def end(self, ending: Ending, value: ValueT | Exception) -> None:
        """Ends the job; called by the scheduler only."""
        assert not self.is_over
        self._life.over = True
        self.on_end(ending, value)


AnyStep = Step[Any]
AnyFallback = Fallback[Any, Any]
AnyNext = Next[Any, Any]
AnyResult = StageResult[Any, Any]
AnyJob = Job[Any, Any]
"""Jobs of all kinds wait together: the scheduler neither reads their payloads nor makes their results."""


@dataclass(frozen=True, eq=False)
class Batch:
    """Jobs, at least one, of one stage and bucket that are computed together.

    The numbers of batches are counted from 1; `start_s` is by the queue's clock.
    """

    stage: Stage
    jobs: tuple[AnyJob, ...]
    start_s: float
    number: int


class Observer:
    """Receives the queue's events; ignores them unless a method is overridden.

    Methods are called from any thread with the queue locked, so they must return at once and never raise.
    """

    def admitted(self, cost_s: float) -> None:
        """A job was admitted; `cost_s` is its predicted computing time."""

    def refused(self, reason: Refusal) -> None:
        """A job was refused."""

    def waited(self, stage: str, seconds: float) -> None:
        """A job was taken from a stage's waiting jobs after this time; not called if it waited aside."""

    def computed(self, stage: str, bucket: str, jobs: int, seconds: float) -> None:
        """A batch of this many jobs of a bucket was computed."""

    def ended(self, stage: str, ending: Ending) -> None:
        """A job ended, in or before this stage."""

    def ran_out_of_memory(self) -> None:
        """A batch was too large for the device; called in the thread that computed it, without the lock."""


class Quota(Protocol):
    """Limits the computing rate of tenants, and divides it among their tokens; without one, the caller is empty."""

    def charge(self, tenant: str, caller: str, cost_s: float, now_s: float) -> float:
        """Books predicted computing time and returns 0; if the limit is reached, returns the seconds to wait."""
        ...

    def settle(self, tenant: str, caller: str, predicted_s: float, actual_s: float, now_s: float) -> None:
        """Replaces booked computing time by the time used."""
        ...
