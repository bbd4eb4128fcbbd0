"""The context of one computation: whether its result is still wanted, and where its time goes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

Check = Callable[[], None]
"""Called between the steps of a computation; raises when its result is no longer wanted."""


def never_cancelled() -> None:
    """A `Check` that never raises."""


@dataclass(eq=False)
class StageContext:
    """A computation that can be cancelled between its stages, which are timed.

    Attributes:
        check: raises when the result is no longer wanted.
        stage_seconds: time of each stage so far, in order; a stage that runs twice counts twice.
    """

    check: Check = never_cancelled
    stage_seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Checks, then times a stage, however it ends."""
        self.check()
        start_s = time.perf_counter()
        try:
            yield
        finally:
            self.add(name, time.perf_counter() - start_s)

    def add(self, name: str, seconds: float) -> None:
        """Counts time that was spent elsewhere, such as a share of a batch."""
        self.stage_seconds[name] = self.stage_seconds.get(name, 0.0) + seconds
