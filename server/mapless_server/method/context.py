"""The context of one computation: cancellation between stages, and the time of each stage."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

Check = Callable[[], None]
"""Called between the steps of a computation; raises to cancel it."""


def never_cancelled() -> None:
    """A `Check` that never raises."""


@dataclass(eq=False)
class StageContext:
    """A computation that can be cancelled between its stages, which are timed.

    Attributes:
        check: raises to cancel the computation.
        stage_seconds: time of each stage so far, in order; a stage that runs twice counts twice.
    """

    check: Check = never_cancelled
    stage_seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Calls `check`, then times a stage, also one that raises."""
        self.check()
        start_s = time.perf_counter()
        try:
            yield
        finally:
            self.add(name, time.perf_counter() - start_s)

    def add(self, name: str, seconds: float) -> None:
        """Adds time that was measured elsewhere, such as that of a batch."""
        self.stage_seconds[name] = self.stage_seconds.get(name, 0.0) + seconds
