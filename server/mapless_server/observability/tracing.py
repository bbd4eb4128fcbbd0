"""The record of one call, for its line in the log and its trace; and what `otlp`, which sends traces, implements."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from mapless_server.scheduling import StageRecord

MAX_STAGES = 64
"""Stages in one trace; of a rig with many photographs only the first."""


@dataclass
class CallRecord:
    """The record of a call.

    Attributes:
        notes: fields of its line in the log.
        stages: the queue's stages that its jobs have passed, in the order in which they ended.
    """

    notes: dict[str, object] = field(default_factory=dict)
    stages: list[StageRecord] = field(default_factory=list)

    @property
    def queue_s(self) -> float:
        """Total time in the queue."""
        return sum(it.waited_s for it in self.stages)

    @property
    def stage_seconds(self) -> dict[str, float]:
        """Computing time by stage, in order."""
        seconds: dict[str, float] = {}
        for it in self.stages:
            if it.jobs:
                seconds[it.stage] = seconds.get(it.stage, 0.0) + it.end_s - it.start_s
        return seconds


Metadata = Sequence[tuple[str, str | bytes]]
"""The keys and values that a caller sends beside its message."""


class CallSpan:
    """The trace of one call; this one is nowhere."""

    trace_id = ""
    """32 hexadecimal digits; empty if the call is not traced."""

    def end(self, code: str, stages: Sequence[StageRecord], attributes: Mapping[str, object]) -> None:
        """Ends the span with a gRPC status; called once."""


class Tracer:
    """Traces calls; called on the event loop, so its methods return at once and never raise. This one traces none."""

    def begin(self, method: str, metadata: Metadata, start_s: float) -> CallSpan:
        """Begins the span of a call of "/package.Service/Method", at a time of `time.monotonic`."""
        return CallSpan()

    def close(self, limit_s: float) -> None:
        """Sends the remaining spans and ends; takes at most `limit_s`."""
