"""The work queue: which job is computed when, and by which thread. Imports the standard library only.

Terms, in the order of a job's way through the queue:

job         A call's work (`jobs`). It goes through stages, such as "prepare", "coarse" and "refine"; its current `Step`
            names the stage and carries the input. What a stage returns (`StageResult`) ends the job or gives the next
            step.
admission   A job is admitted if its predicted computing time and its memory fit within the bounds and it can end before
            its deadline (`admission`); otherwise it is refused at once. Predictions (`costs`) are averages of the
            caller's earlier jobs of the same kind, or else typical of all callers'.
lane        A group of threads, such as "host" or "device". Each stage is computed by one lane.
fairness    Of the jobs that wait for a stage (`fair_queue`), the next one is of those who have been given the least
            computing time: first among tenants, then among the tenant's callers, then among the caller's clients
            (`shares`). While short jobs keep coming, long steps leave one thread of a lane to them.
batch       Waiting jobs of the same stage and bucket are computed together, up to the stage's `max_batch`.
deadline    A job ends at its deadline wherever it is, and with its fallback, if it has one, shortly before. The thread
            that computes it notices at its next `Job.check`.

`Scheduler` decides all of this; it has no threads and no clock, so it is tested on a virtual one. `WorkQueue` executes:
threads that compute what the scheduler selects, and callers that wait on an event loop.
"""

from .admission import WorkQueueOptions
from .costs import CostModel
from .items import ComputeItem, ItemJob, ItemList, compute_items
from .jobs import (
    Abandoned,
    AnyFallback,
    AnyJob,
    AnyNext,
    AnyResult,
    Done,
    Ending,
    Expired,
    Fallback,
    Flow,
    Job,
    Next,
    Observer,
    Quota,
    Refusal,
    Refused,
    Stage,
    StageLoad,
    StageRecord,
    StageResult,
    Step,
)
from .processor import count_helper, give_way, may_have_helpers, processor_s
from .work_queue import Failure, Fatal, WorkQueue
