"""The interface of a tracer, and the one that traces nothing; `otlp` has the other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

from .call_record import TracedStep

Metadata = Sequence[tuple[str, str | bytes]]
"""The keys and values that a caller sends beside its message."""


class CallSpan(Protocol):
    """The trace of one call."""

    @property
    def trace_id(self) -> str:
        """32 hexadecimal digits; empty if the call is not traced."""

    def end(self, code: str, steps: Sequence[TracedStep], attributes: Mapping[str, object]) -> None:
        """Ends the span with a gRPC status; called once."""


class Tracer(Protocol):
    """Traces calls; called on the event loop, so its methods return at once and never raise."""

    def begin(self, method: str, metadata: Metadata, start_s: float) -> CallSpan:
        """Begins the span of a call to "/package.Service/Method", at `time.monotonic`."""

    def close(self, limit_s: float) -> None:
        """Sends what is left, and ends; blocks for `limit_s` at most."""


class _NoSpan:
    trace_id = ""

    def end(self, code: str, steps: Sequence[TracedStep], attributes: Mapping[str, object]) -> None:
        pass


class NoTracer:
    """Traces nothing."""

    _span = _NoSpan()

    def begin(self, method: str, metadata: Metadata, start_s: float) -> CallSpan:
        """Implements Tracer."""
        return self._span

    def close(self, limit_s: float) -> None:
        """Implements Tracer."""
