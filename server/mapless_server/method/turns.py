"""One computation's own stopwatch and conscience: where its time goes, and whether anybody still wants the result."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from .stopwatch import timed


@dataclass(eq=False)
class Turn:
    """A computation that is asked between its steps whether to go on.

    Attributes:
        check: raises when nobody wants the result any more.
        stage_seconds: time of each stage so far, in order.
    """

    check: Callable[[], None]
    stage_seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Checks, then times one step."""
        self.check()
        with timed(self.stage_seconds, name):
            yield
