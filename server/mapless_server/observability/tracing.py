"""Traces: who takes what calls leave behind. OpenTelemetry is imported only where traces are wanted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

from .trail import Step

Metadata = Sequence[tuple[str, str | bytes]]
"""What a caller sent beside its message."""


class CallSpan(Protocol):
    """The trace of one call."""

    @property
    def trace_id(self) -> str:
        """32 hexadecimal digits; empty if the call is not traced."""

    def end(self, code: str, steps: Sequence[Step], attributes: Mapping[str, object]) -> None:
        """The call ended with a gRPC status; to be said once."""


class Tracer(Protocol):
    """Takes the traces of calls; called on the event loop, so it returns at once and never raises."""

    def begin(self, method: str, metadata: Metadata, start_s: float) -> CallSpan:
        """A call to "/package.Service/Method" arrived, `time.monotonic`."""

    def close(self, limit_s: float) -> None:
        """Sends what is left, and ends; blocks for `limit_s` at most."""


class _NoSpan:
    trace_id = ""

    def end(self, code: str, steps: Sequence[Step], attributes: Mapping[str, object]) -> None:
        pass


class NoTracer:
    """Traces nothing."""

    _span = _NoSpan()

    def begin(self, method: str, metadata: Metadata, start_s: float) -> CallSpan:
        """Implements Tracer."""
        return self._span

    def close(self, limit_s: float) -> None:
        """Implements Tracer."""


def make_tracer(otlp_endpoint: str) -> Tracer:
    """Sends traces to "http://host:4317", or https, by OTLP over gRPC; traces nothing if the endpoint is empty.

    Whether anybody listens there is found out later, and does not matter to calls.

    Raises:
        ImportError: OpenTelemetry is not installed; see `extras.install_hint`.
        ValueError: the endpoint is no such address.
    """
    if not otlp_endpoint:
        return NoTracer()
    from .otlp import make_otlp_tracer

    return make_otlp_tracer(otlp_endpoint)
