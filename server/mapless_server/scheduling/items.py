"""Work that consists of items: several jobs of the queue share it, each one item after another.

Between two items others have their turn, and where the queue admits but one of the jobs, it does them all.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar

from .jobs import Done, Job, Next, Verdict

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")

Compute = Callable[[Item, Callable[[], None]], Outcome]
"""Computes one item; calls the function given between its steps, which raises when nobody wants the result any more."""


class Items(Generic[Item, Outcome]):
    """Items and what became of them; shared by the threads that work them off.

    Attributes:
        results: in the order of the items, complete when all jobs are done.
    """

    def __init__(self, items: Sequence[Item], compute: Compute[Item, Outcome]) -> None:
        self._remaining = deque(enumerate(items))
        self._compute = compute
        self.results: list[Outcome] = [None] * len(items)  # type: ignore[list-item]  # each is set before anybody looks

    def next(self, job: Job) -> Verdict:
        """Computes one item; done when none is left."""
        try:
            index, item = self._remaining.popleft()
        except IndexError:
            return Done(None)
        self.results[index] = self._compute(item, job.check)
        return Next(job.step)


def work_off(jobs: Sequence[Job]) -> list[Verdict]:
    """The next item of each job; a stage of the work queue."""
    verdicts: list[Verdict] = []
    for job in jobs:
        items: Items[Any, Any] = job.step.payload
        verdicts.append(items.next(job))
    return verdicts
