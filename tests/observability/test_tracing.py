"""A call is one trace, continued from the caller's, with its steps in place; no collector can delay or fail it."""

import logging
import socket
import threading
import time
from collections.abc import Iterator
from functools import partial
from typing import Any

import pytest
from opentelemetry.proto.collector.trace.v1 import trace_service_pb2, trace_service_pb2_grpc
from opentelemetry.sdk.trace import ReadableSpan
from opentelemetry.sdk.trace.export import SpanExporter, SpanExportResult
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from opentelemetry.trace import SpanKind, StatusCode
from support.clients import hosted
from support.programs import printed

from mapless_server.observability.otlp import MAX_STAGES, OtlpTracer, make_otlp_tracer
from mapless_server.scheduling import StageRecord
from mapless_server.serve import running
from mapless_server.serve.startup import StartupError
from mapless_server.settings import Settings

METHOD = "/mapless.v1.LocalizationService/Localize"
TRACE_ID = "0af7651916cd43dd8448eb211c80319c"
PARENT_ID = "b7ad6b7169203331"
TRACEPARENT = ("traceparent", f"00-{TRACE_ID}-{PARENT_ID}-01")


def spans_of(*calls: tuple[Any, ...]) -> dict[str, ReadableSpan]:
    """The exported spans of calls (metadata, code, stages, attributes), by name."""
    exporter = InMemorySpanExporter()
    tracer = OtlpTracer(exporter)
    for metadata, code, stages, attributes in calls:
        tracer.begin(METHOD, metadata, time.monotonic()).end(code, stages, attributes)
    tracer.close(10)
    return {span.name: span for span in exporter.get_finished_spans()}


def id_of(span: ReadableSpan) -> int:
    assert span.context is not None
    return int(span.context.span_id)


def test_a_span_is_named_as_the_conventions_say() -> None:
    (span,) = spans_of(([], "OK", [], {"scene": "hall", "inlier_count": 90})).values()
    assert (span.name, span.kind) == ("mapless.v1.LocalizationService/Localize", SpanKind.SERVER)
    assert dict(span.attributes or {}) == {
        "rpc.system.name": "grpc",
        "rpc.method": "mapless.v1.LocalizationService/Localize",
        "rpc.response.status_code": "OK",
        "mapless.scene": "hall",
        "mapless.inlier_count": 90,
    }
    assert span.resource.attributes["service.name"] == "mapless"
    assert span.parent is None


def test_the_callers_trace_is_continued() -> None:
    tracer = OtlpTracer(InMemorySpanExporter())
    assert tracer.begin(METHOD, [TRACEPARENT], 0.0).trace_id == TRACE_ID
    tracer.close(10)
    (span,) = spans_of(([TRACEPARENT, ("authorization", "Bearer x"), ("bin-bin", b"\xff")], "OK", [], {})).values()
    assert span.context is not None
    assert f"{span.context.trace_id:032x}" == TRACE_ID
    assert span.parent is not None
    assert f"{span.parent.span_id:016x}" == PARENT_ID
    assert "Bearer" not in span.to_json()


@pytest.mark.parametrize(
    "given", ["", "nonsense", "00-0-0-01", f"00-{'0' * 32}-{PARENT_ID}-01", b"\xff\x00", "x" * 5000]
)
def test_a_malformed_parent_begins_a_trace_of_its_own(given: Any) -> None:
    tracer = OtlpTracer(InMemorySpanExporter())
    assert len(tracer.begin(METHOD, [("traceparent", given)], 0.0).trace_id) == 32
    assert tracer.begin(METHOD, [TRACEPARENT, ("tracestate", given)], 0.0).trace_id == TRACE_ID
    tracer.close(10)


def test_what_the_caller_does_not_sample_is_not_recorded() -> None:
    tracer = OtlpTracer(exporter := InMemorySpanExporter())
    span = tracer.begin(METHOD, [("traceparent", f"00-{TRACE_ID}-{PARENT_ID}-00")], 0.0)
    assert span.trace_id == ""
    span.end("OK", [StageRecord("coarse", 0.0, 0.0, 1.0, 1, 1)], {})
    tracer.close(10)
    assert exporter.get_finished_spans() == ()


FAULTS = ("INTERNAL", "DEADLINE_EXCEEDED", "UNAVAILABLE", "DATA_LOSS")


@pytest.mark.parametrize("code", ["OK", "CANCELLED", "NOT_FOUND", "RESOURCE_EXHAUSTED", *FAULTS])
def test_only_faults_of_the_server_are_errors(code: str) -> None:
    is_fault = code in FAULTS
    (span,) = spans_of(([], code, [], {})).values()
    assert (span.status.status_code is StatusCode.ERROR) == is_fault
    assert (span.attributes or {}).get("error.type") == (code if is_fault else None)


def test_waits_and_computations_are_children() -> None:
    start_s = time.monotonic() - 100
    before_ns = time.time_ns()
    spans = spans_of(([], "OK", [StageRecord("prepare", start_s, start_s + 1, start_s + 4, batch=7, jobs=2)], {}))
    root = spans["mapless.v1.LocalizationService/Localize"]
    parents = {name: span.parent.span_id if span.parent else None for name, span in spans.items()}
    assert parents["queue prepare"] == parents["prepare"] == id_of(root)
    assert len({span.context.trace_id for span in spans.values() if span.context}) == 1
    seconds = {
        name: ((span.start_time or 0) / 1e9 - before_ns / 1e9, (span.end_time or 0) / 1e9 - before_ns / 1e9)
        for name, span in spans.items()
    }
    assert seconds["queue prepare"] == pytest.approx((-100, -99), abs=1)
    assert seconds["prepare"] == pytest.approx((-99, -96), abs=1)
    assert dict(spans["prepare"].attributes or {}) == {"mapless.batch": 7, "mapless.batch_size": 2}


def test_a_trace_has_a_bounded_number_of_stages() -> None:
    spans = spans_of(([], "OK", [StageRecord(f"{i}", 0.0, 1.0, 2.0, i, 1) for i in range(1000)], {}))
    assert len(spans) == 1 + 2 * MAX_STAGES


def test_every_value_has_a_form_as_an_attribute() -> None:
    odd = {"half": "\ud800", "none": None, "image": b"abc", "map": {"a": 1.5}, "nan": float("nan"), "large": 2**80}
    (span,) = spans_of(([], "OK", [], odd)).values()
    attributes = {name: value for name, value in (span.attributes or {}).items() if name.startswith("mapless.")}
    assert attributes == {
        "mapless.half": "?",
        "mapless.image": "<3 bytes>",
        "mapless.map": '{"a": 1.5}',
        "mapless.nan": "nan",
        "mapless.large": hex(2**80),
    }


def test_opentelemetry_is_imported_only_where_traces_are_wanted() -> None:
    said = printed("""if True:
        import sys
        from mapless_server.serve import running
        from mapless_server.settings import Settings
        print(running._make_tracer(Settings()), 'opentelemetry' in sys.modules)
    """)
    assert said == "None False\n"


@pytest.mark.parametrize("endpoint", ["localhost:4317", "ftp://host:1", "http://", "nonsense"])
def test_an_endpoint_that_is_no_address_ends_the_start(endpoint: str) -> None:
    with pytest.raises(StartupError, match="otlp_endpoint must be http://host:port"):
        running._make_tracer(Settings(otlp_endpoint=endpoint))


# Collectors


class Collector(trace_service_pb2_grpc.TraceServiceServicer):
    """Keeps what it is sent, once its gate is open."""

    def __init__(self) -> None:
        self.received: list[Any] = []
        self.gate = threading.Event()

    def Export(self, request: Any, context: Any) -> Any:  # noqa: N802
        self.gate.wait(30)
        self.received.append(request)
        return trace_service_pb2.ExportTraceServiceResponse()


@pytest.fixture
def collector() -> Iterator[tuple[Collector, str]]:
    collector = Collector()
    add: Any = trace_service_pb2_grpc.add_TraceServiceServicer_to_server
    with hosted(add=partial(add, collector)) as address:
        yield collector, f"http://{address}"
        collector.gate.set()


def test_a_real_collector_gets_the_call_when_the_server_ends(collector: tuple[Collector, str]) -> None:
    receiver, endpoint = collector
    receiver.gate.set()
    tracer = make_otlp_tracer(endpoint)
    now_s = time.monotonic()
    span = tracer.begin(METHOD, [TRACEPARENT], now_s)
    span.end("OK", [StageRecord("coarse", now_s, now_s, now_s + 0.1, 7, 1)], {"scene": "hall"})
    tracer.close(20)
    (request,) = receiver.received
    (resource_spans,) = request.resource_spans
    assert {a.key: a.value.string_value for a in resource_spans.resource.attributes}["service.name"] == "mapless"
    child, root, _ = sorted(resource_spans.scope_spans[0].spans, key=lambda span: str(span.name))
    assert (child.name, root.name) == ("coarse", "mapless.v1.LocalizationService/Localize")
    assert child.parent_span_id == root.span_id
    assert root.parent_span_id.hex() == PARENT_ID
    assert root.trace_id.hex() == child.trace_id.hex() == TRACE_ID == span.trace_id


def tracing_threads() -> set[threading.Thread]:
    return {thread for thread in threading.enumerate() if "Otel" in thread.name or thread.name == "traces"}


@pytest.fixture
def nobody() -> Iterator[str]:
    """An endpoint that refuses connections."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # and does not listen
        yield f"http://127.0.0.1:{taken.getsockname()[1]}"


def test_an_absent_collector_delays_neither_calls_nor_end(nobody: str, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.CRITICAL, "opentelemetry")
    before = tracing_threads()
    tracer = make_otlp_tracer(nobody)
    for _ in range(5000):  # more than are held
        tracer.begin(METHOD, [], time.monotonic()).end("OK", [], {})
    tracer.close(0.2)
    assert not tracing_threads() - before


def test_a_silent_collector_delays_the_end_by_the_limit(
    collector: tuple[Collector, str], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.CRITICAL, "opentelemetry")
    receiver, endpoint = collector
    before = tracing_threads()
    tracer = make_otlp_tracer(endpoint)
    tracer.begin(METHOD, [], time.monotonic()).end("OK", [], {})
    tracer.close(0.2)
    assert receiver.received == []
    assert not tracing_threads() - before


class Broken(SpanExporter):
    def export(self, spans: Any) -> SpanExportResult:
        raise RuntimeError("broken")


def test_an_exporter_that_raises_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    tracer = OtlpTracer(Broken())
    tracer.begin(METHOD, [], time.monotonic()).end("OK", [], {})
    tracer.close(10)
    assert "broken" in caplog.text
