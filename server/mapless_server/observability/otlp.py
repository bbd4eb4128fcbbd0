"""Traces by OpenTelemetry: names and attributes follow its conventions for RPC; OTLP sends them in the background.

Methods are called on the event loop, so they return at once and never raise.
"""

import json
import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any
from urllib.parse import urlsplit

from opentelemetry.context import Context
from opentelemetry.exporter.otlp.proto.grpc.trace_exporter import OTLPSpanExporter
from opentelemetry.sdk.resources import OTELResourceDetector, Resource
from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import BatchSpanProcessor, SpanExporter
from opentelemetry.trace import Span, SpanKind, Status, StatusCode, set_span_in_context
from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

from mapless.proxies import is_exempt
from mapless_server import __version__
from mapless_server.scheduling import StageRecord

from .logs import plain

EXPORT_LIMIT_S = 5.0
"""Time that a collector may take for a batch, retries included."""
_SERVER_FAULTS = frozenset({"UNKNOWN", "DEADLINE_EXCEEDED", "UNIMPLEMENTED", "INTERNAL", "UNAVAILABLE", "DATA_LOSS"})
"""Statuses that a server's span counts as errors; the others are the caller's."""
_CANCEL_LIMIT_S = 1.0

MAX_STAGES = 64
"""Stages in one trace; of a rig with many photographs only the first."""

Attribute = str | bool | int | float


def make_otlp_tracer(endpoint: str) -> "OtlpTracer":
    """Makes a tracer that sends to an address such as "http://host:4317"; ValueError if it is not one.

    Whether a collector listens is not checked.
    """
    address = urlsplit(endpoint)
    if address.scheme not in ("http", "https") or not address.hostname:
        raise ValueError(f"otlp_endpoint must be http://host:port or https://host:port, not {endpoint!r}")
    is_insecure = address.scheme == "http"
    options: Any = (("grpc.enable_http_proxy", int(not is_exempt(address.netloc))),)
    return OtlpTracer(
        OTLPSpanExporter(endpoint=endpoint, insecure=is_insecure, timeout=EXPORT_LIMIT_S, channel_options=options)
    )


class OtlpTracer:
    """Traces calls. Buffers at most 2048 spans, and drops further ones."""

    def __init__(self, exporter: SpanExporter) -> None:
        resource = Resource({"service.name": "mapless", "service.version": __version__})
        # The operator's OTEL_SERVICE_NAME and OTEL_RESOURCE_ATTRIBUTES have precedence.
        self._provider = TracerProvider(
            resource=resource.merge(OTELResourceDetector().detect()), shutdown_on_exit=False
        )
        self._exporter = exporter
        self._provider.add_span_processor(BatchSpanProcessor(exporter))
        self._tracer = self._provider.get_tracer("mapless", __version__)
        self._propagator = TraceContextTextMapPropagator()

    def begin(self, method: str, metadata: Sequence[tuple[str, str | bytes]], start_s: float) -> "CallSpan":
        """Begins the span of a call of "/package.Service/Method", at a time of `time.monotonic`."""
        keys = ("traceparent", "tracestate")
        carrier = {key: value for key, value in metadata if key in keys and isinstance(value, str)}
        span = self._tracer.start_span(
            method.removeprefix("/"),
            self._propagator.extract(carrier, context=Context()),
            SpanKind.SERVER,
            attributes={"rpc.system.name": "grpc", "rpc.method": method.removeprefix("/")},
            start_time=_epoch_ns(start_s),
        )
        return CallSpan(self, span)

    def close(self, limit_s: float) -> None:
        """Sends the remaining spans and ends; takes at most about `limit_s`."""
        flushing = threading.Thread(target=self._provider.shutdown, name="traces", daemon=True)
        flushing.start()
        flushing.join(limit_s)
        if flushing.is_alive():  # the collector does not answer: cancels the export
            self._exporter.shutdown()
            flushing.join(_CANCEL_LIMIT_S)

    def record(self, parent: Span, stages: Sequence[StageRecord]) -> None:
        """Adds two child spans for each stage: the wait for it, and its computation."""
        for it in stages[:MAX_STAGES]:
            self._add(parent, f"queue {it.stage}", it.queued_s, it.start_s, {})
            if it.jobs:
                self._add(parent, it.stage, it.start_s, it.end_s, {"batch": it.batch, "batch_size": it.jobs})

    def _add(self, parent: Span, name: str, start_s: float, end_s: float, about: Mapping[str, object]) -> None:
        context = set_span_in_context(parent, Context())
        span = self._tracer.start_span(name, context, attributes=_attributes(about), start_time=_epoch_ns(start_s))
        span.end(_epoch_ns(end_s))


class CallSpan:
    """The trace of one call, with 32 hexadecimal digits as its id; empty if the call is not traced."""

    def __init__(self, tracer: OtlpTracer, span: Span) -> None:
        self._tracer = tracer
        self._span = span
        context = span.get_span_context()
        self.trace_id = f"{context.trace_id:032x}" if context.trace_flags.sampled else ""

    def end(self, code: str, stages: Sequence[StageRecord], attributes: Mapping[str, object]) -> None:
        """Ends the span with a gRPC status; called once."""
        if not self._span.is_recording():
            return
        self._span.set_attributes({"rpc.response.status_code": code, **_attributes(attributes)})
        if code in _SERVER_FAULTS:
            self._span.set_attribute("error.type", code)
            self._span.set_status(Status(StatusCode.ERROR))
        self._tracer.record(self._span, stages)
        self._span.end()


def _attributes(fields: Mapping[str, object]) -> dict[str, Attribute]:
    """Converts fields of the log to attributes named "mapless.*"; nested values become JSON."""
    attributes: dict[str, Attribute] = {}
    for name, field in fields.items():
        value = plain(field)
        if isinstance(value, str):
            attributes[f"mapless.{name}"] = value.encode(
                errors="replace"
            ).decode()  # an unpaired surrogate would fail the batch
        elif isinstance(value, bool | int | float):
            attributes[f"mapless.{name}"] = value
        elif value is not None:
            attributes[f"mapless.{name}"] = json.dumps(value)
    return attributes


def _epoch_ns(monotonic_s: float) -> int:
    """Converts a time of `time.monotonic` to nanoseconds since 1970."""
    return time.time_ns() - round(1e9 * (time.monotonic() - monotonic_s))
