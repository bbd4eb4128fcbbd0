"""What a call leaves behind: what is known of it and what was done for it, for its line in the log and its trace."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

MAX_STEPS = 128
"""Of one call's trace; an upload of a thousand photographs adds up its further steps only."""


@dataclass(frozen=True)
class Step:
    """One thing that was done for a call.

    Attributes:
        name: "queue coarse", "coarse".
        start_s: when it began, `time.monotonic`.
        end_s: when it ended.
        attributes: what else is known of it, "batch_id".
        part_seconds: what it consisted of, one after the other from its start.
    """

    name: str
    start_s: float
    end_s: float
    attributes: Mapping[str, object] = field(default_factory=dict)
    part_seconds: Mapping[str, float] = field(default_factory=dict)


@dataclass
class Trail:
    """Grows while a call is answered.

    Attributes:
        notes: fields of its line in the log.
        steps: the first of them, in the order in which they ended.
        queue_s: how long it waited in all; None if it never did.
        stage_seconds: how long was computed for it, by stage or part of one, in order.
    """

    notes: dict[str, object] = field(default_factory=dict)
    steps: list[Step] = field(default_factory=list)
    queue_s: float | None = None
    stage_seconds: dict[str, float] = field(default_factory=dict)

    def waited(self, stage: str, start_s: float, end_s: float) -> None:
        """It waited for a stage."""
        self.queue_s = (self.queue_s or 0.0) + end_s - start_s
        self._add(Step(f"queue {stage}", start_s, end_s))

    def computed(
        self, stage: str, start_s: float, end_s: float, part_seconds: Mapping[str, float], **attributes: object
    ) -> None:
        """A stage was computed for it, and what it consisted of, if that is known."""
        for name, seconds in (part_seconds or {stage: end_s - start_s}).items():
            self.stage_seconds[name] = self.stage_seconds.get(name, 0.0) + seconds
        self._add(Step(stage, start_s, end_s, attributes, part_seconds))

    def _add(self, step: Step) -> None:
        if len(self.steps) < MAX_STEPS:
            self.steps.append(step)
