"""Jobs that compute items of one list together, one item a step."""

from collections import deque
from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

from .jobs import Done, Job, Next, StageResult

ItemT = TypeVar("ItemT")
ResultT = TypeVar("ResultT")

ComputeItem = Callable[[ItemT, Callable[[], None]], ResultT]
"""Computes one item of an `ItemList`; calls the given function between its steps, which raises if the job has ended."""


class ItemList(Generic[ItemT, ResultT]):
    """Items that several jobs compute together, one item per step, so that jobs of other callers run in between.

    If the queue admits only one of the jobs, it computes all items.

    Attributes:
        results: in the order of the items; complete when all jobs have ended.
    """

    def __init__(self, items: Sequence[ItemT], compute: ComputeItem[ItemT, ResultT]) -> None:
        self._remaining = deque(enumerate(items))
        self._compute = compute
        self.results: list[ResultT] = [None] * len(items)  # type: ignore[list-item]  # each is set before it is read

    def compute_next(self, job: "ItemJob[ItemT, ResultT]") -> StageResult["ItemList[ItemT, ResultT]", None]:
        """Computes one item, if one is left; the job is done with the last."""
        try:
            index, item = self._remaining.popleft()
        except IndexError:
            return Done(None)
        self.results[index] = self._compute(item, job.check)
        return Next((job.step,)) if self._remaining else Done(None)


ItemJob = Job[ItemList[ItemT, ResultT], None]
"""Computes items of a list, in turn with other jobs."""


def compute_items(jobs: Sequence[ItemJob[ItemT, ResultT]]) -> list[StageResult[ItemList[ItemT, ResultT], None]]:
    """Computes the next item of each job; the `ComputeBatch` of stages whose payload is an `ItemList`."""
    return [job.step.payload.compute_next(job) for job in jobs]
