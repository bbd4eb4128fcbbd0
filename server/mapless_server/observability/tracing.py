"""The record of one call, for its line in the log and its trace; and what `otlp`, which sends traces, implements."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

MAX_STEPS = 128
"""Steps in one trace; an upload of a thousand photographs only adds up the times of further ones."""


@dataclass(frozen=True)
class TracedStep:
    """One step of a call: a wait, or a computation.

    Attributes:
        name: "queue coarse", "coarse".
        start_s: when it began, by `time.monotonic`.
        end_s: when it ended.
        attributes: further facts, such as "batch_id".
        part_seconds: durations of its parts, one after the other from its start.
    """

    name: str
    start_s: float
    end_s: float
    attributes: Mapping[str, object] = field(default_factory=dict)
    part_seconds: Mapping[str, float] = field(default_factory=dict)


@dataclass
class CallRecord:
    """The record of a call, to which its steps are added.

    Attributes:
        notes: fields of its line in the log.
        steps: the first `MAX_STEPS`, in the order in which they ended.
        queue_s: total time in the queue; None if it never waited.
        stage_seconds: computing time by stage, or part of a stage, in order.
    """

    notes: dict[str, object] = field(default_factory=dict)
    steps: list[TracedStep] = field(default_factory=list)
    queue_s: float | None = None
    stage_seconds: dict[str, float] = field(default_factory=dict)

    def waited(self, stage: str, start_s: float, end_s: float) -> None:
        """Adds a wait for a stage."""
        self.queue_s = (self.queue_s or 0.0) + end_s - start_s
        self._add(TracedStep(f"queue {stage}", start_s, end_s))

    def computed(
        self, stage: str, start_s: float, end_s: float, part_seconds: Mapping[str, float], **attributes: object
    ) -> None:
        """Adds the computation of a stage, and of its parts, if they are known."""
        for name, seconds in (part_seconds or {stage: end_s - start_s}).items():
            self.stage_seconds[name] = self.stage_seconds.get(name, 0.0) + seconds
        self._add(TracedStep(stage, start_s, end_s, attributes, part_seconds))

    def _add(self, step: TracedStep) -> None:
        if len(self.steps) < MAX_STEPS:
            self.steps.append(step)


Metadata = Sequence[tuple[str, str | bytes]]
"""The keys and values that a caller sends beside its message."""


class CallSpan:
    """The trace of one call; this one is nowhere."""

    trace_id = ""
    """32 hexadecimal digits; empty if the call is not traced."""

    def end(self, code: str, steps: Sequence[TracedStep], attributes: Mapping[str, object]) -> None:
        """Ends the span with a gRPC status; called once."""


class Tracer:
    """Traces calls; called on the event loop, so its methods return at once and never raise. This one traces none."""

    def begin(self, method: str, metadata: Metadata, start_s: float) -> CallSpan:
        """Begins the span of a call of "/package.Service/Method", at a time of `time.monotonic`."""
        return CallSpan()

    def close(self, limit_s: float) -> None:
        """Sends the remaining spans and ends; takes at most `limit_s`."""
