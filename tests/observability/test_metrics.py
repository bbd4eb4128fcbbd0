"""Metrics count each event once, and do not grow with what callers send."""

import asyncio
import math
import re
import socket
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from types import ModuleType

import pytest
from prometheus_client import generate_latest

from mapless_server.cache import LruCache
from mapless_server.method.coarse.token_cache import TokenCacheCounters
from mapless_server.method.rejection import RejectionReason
from mapless_server.observability import exporter
from mapless_server.observability.exporter import MAX_CONNECTIONS, MetricsServer
from mapless_server.observability.metrics import COUNTED, LOCALIZED, STAGES, Metrics
from mapless_server.observability.scraped import SceneAge, gpu_memory
from mapless_server.scheduling import Ending, Refusal, StageLoad

LOCALIZE = "/mapless.v1.LocalizationService/Localize"
OUTCOMES = (LOCALIZED, *(reason.value for reason in RejectionReason))

Samples = dict[tuple[str, frozenset[tuple[str, str]]], float]
TOKENS = TokenCacheCounters(device_hits=2, host_hits=3, misses=4, device_bytes=7, host_bytes=8, evictions=5)


def reference_cache(hits: int) -> LruCache[str]:
    """A cache of one entry of 6 bytes that was found so often."""
    cache = LruCache[str](10)
    cache.put("key", "value", 6)
    for _ in range(hits):
        cache.get("key")
    return cache


def samples_of(metrics: Metrics) -> Samples:
    """The samples of a scrape by name and labels, before they are text, which takes long to read."""
    samples = (sample for family in metrics.registry.collect() for sample in family.samples)
    return {(it.name, frozenset(it.labels.items())): it.value for it in samples}


def changed(before: Samples, after: Samples) -> Samples:
    """By how much, where it did."""
    changes = {
        key: value - before.get(key, 0.0)
        for key, value in after.items()
        if key[0].startswith(("mapless", "grpc"))
        and key[0] != "mapless_python_allocated_blocks"  # it changes by itself
    }
    return {key: change for key, change in changes.items() if change}


def count_everything(metrics: Metrics) -> None:
    metrics.call_started(LOCALIZE)
    metrics.call_handled(LOCALIZE, "OK", 0.2)
    metrics.admitted(0.5)
    metrics.refused(Refusal.QUEUE_FULL)
    metrics.watch_queue(lambda stage: StageLoad(3, 1.5, 2) if stage == "coarse" else StageLoad(0, 0.0, 0))
    metrics.waited("coarse", 0.1)
    metrics.computed("coarse", "392x518x10", 2, 0.3)
    metrics.ended("refine", Ending.OK)
    metrics.beat()
    metrics.stages({"decode": 0.01})
    metrics.answered(
        LOCALIZED,
        inlier_count=80,
        match_count=100,
        reprojection_error_px=0.6,
        scale_deviation=0.01,
        accuracy_radius_m=0.02,
    )
    metrics.loop_lagged(0.001)
    metrics.stored("load_references", 0.002)
    metrics.store_failed()
    metrics.ran_out_of_memory()
    metrics.count("fatal")
    metrics.set_serving(True)
    metrics.warmed_up(3.0)
    metrics.built("1.2.3", "pi3x", "aliked", "ab" * 32)
    metrics.scraped.reference_cache = lambda: reference_cache(1)
    metrics.scraped.token_cache = lambda: TOKENS
    metrics.scraped.gpu_memory = lambda: {"allocated": 10.0, "reserved": 20.0}
    metrics.scraped.certificate_expiry = lambda: 2e9
    metrics.scraped.scenes = [SceneAge("hall", 100, 0.75, 0.9, None, 1, 3, 2)]


@pytest.fixture
def metrics() -> Metrics:
    return Metrics()


EVENTS: list[tuple[str, dict[str, str], Callable[[Metrics], None]]] = [
    *(("admission_rejected", {"reason": it.value}, partial(Metrics.refused, reason=it)) for it in Refusal),
    *(
        ("jobs_terminated", {"stage": stage, "outcome": it.value}, partial(Metrics.ended, stage=stage, ending=it))
        for stage in STAGES
        for it in Ending
    ),
    *(("answers", {"outcome": it}, partial(Metrics.answered, outcome=it)) for it in OUTCOMES),
    *((name, {}, partial(Metrics.count, name=name)) for name, (_, label, _) in COUNTED.items() if not label),
    *(
        (name, {label: value}, partial(Metrics.count, name=name, result=value))
        for name, (_, label, values) in COUNTED.items()
        for value in values
    ),
    ("gpu_oom", {}, Metrics.ran_out_of_memory),
    ("store_errors", {}, Metrics.store_failed),
]


def test_an_event_is_counted_once_and_was_zero_before(metrics: Metrics) -> None:
    keys = [(f"mapless_{name}_total", frozenset(labels.items())) for name, labels, _ in EVENTS]
    before = samples_of(metrics)
    assert {before[key] for key in keys} == {0}
    for _, _, event in EVENTS:
        event(metrics)
    assert changed(before, samples_of(metrics)) == dict.fromkeys(keys, 1)
    assert len(keys) == len(set(keys))


def test_watching_is_counted_without_a_latency(metrics: Metrics) -> None:
    before, watch = samples_of(metrics), "/mapless.v1.LocalizationService/WatchQueries"
    metrics.call_started(watch)
    metrics.call_handled(watch, "CANCELLED", 3600.0, "ab" * 16)
    after = changed(before, samples_of(metrics))
    assert {name for name, _ in after} == {"grpc_server_started_total", "grpc_server_handled_total"}
    watched = {
        name
        for name, labels in samples_of(metrics)
        if name.startswith("grpc_server_handling") and ("grpc_method", "WatchQueries") in labels
    }
    assert not watched


def test_a_stream_has_a_latency_and_a_first_answer_latency(metrics: Metrics) -> None:
    before, method = samples_of(metrics), "/mapless.v1.LocalizationService/LocalizeProgressively"
    metrics.answered_early(0.25)
    metrics.call_handled(method, "OK", 0.5, "")
    sums = {name: value for (name, _), value in changed(before, samples_of(metrics)).items() if name.endswith("_sum")}
    assert sums == {"mapless_early_answer_seconds_sum": 0.25, "grpc_server_handling_seconds_sum": 0.5}


def test_a_batch_adds_to_size_time_and_busy_seconds(metrics: Metrics) -> None:
    before = samples_of(metrics)
    metrics.computed("coarse", "392x518x10", 3, 0.25)
    changes = changed(before, samples_of(metrics))
    stage = ("stage", "coarse")
    assert changes["mapless_batch_size_sum", frozenset({stage})] == 3
    assert changes["mapless_batch_seconds_sum", frozenset({stage})] == 0.25
    assert changes["mapless_busy_seconds_total", frozenset({stage})] == 0.25
    assert changes["mapless_batches_total", frozenset({stage, ("bucket", "392x518x10")})] == 1


def test_stages_of_stronger_features_are_a_tier_not_a_name(metrics: Metrics) -> None:
    before = samples_of(metrics)
    metrics.stages({"features": 0.1, "aliked-n16-2048-1024px-0.01-c2ab3d81/features": 2.0})
    changes = changed(before, samples_of(metrics))
    sums = {dict(labels)["tier"]: value for (name, labels), value in changes.items() if name.endswith("_sum")}
    assert sums == {"0": 0.1, "1": 2.0}
    assert "aliked" not in generate_latest(metrics.registry).decode()


def test_series_are_bounded_whatever_is_counted(metrics: Metrics) -> None:
    count_everything(metrics)
    for i in range(100):
        metrics.computed(f"stage-{i}", f"bucket-{i}", 1, 0.1)
        metrics.stages({f"stage-{i}": 0.1})
        metrics.stored(f"op-{i}", 0.1)
        metrics.call_handled(f"/mapless.v1.Service-{i}/M", f"CODE_{i}", 0.1)
        metrics.answered(f"outcome-{i}")
    count = len(samples_of(metrics))
    for i in range(100, 2000):
        metrics.computed(f"stage-{i}", f"bucket-{i}", 1, 0.1)
        metrics.stages({f"stage-{i}": 0.1})
        metrics.stored(f"op-{i}", 0.1)
        metrics.call_started(f"/mapless.v1.Service-{i}/M")
        metrics.call_handled(f"/mapless.v1.Service-{i}/M", f"CODE_{i}", 0.1)
        metrics.answered(f"outcome-{i}")
    after = samples_of(metrics)
    assert len(after) <= count + 1  # "other" calls that started
    assert after["mapless_answers_total", frozenset({("outcome", "other")})] == 2000
    other = frozenset({("stage", "other"), ("bucket", "other")})
    batches = {labels: value for (name, labels), value in after.items() if name == "mapless_batches_total"}
    assert sum(batches.values()) == 2001
    assert batches[other] > 1900


def test_unknown_or_infinite_quality_is_not_counted(metrics: Metrics) -> None:
    metrics.answered(
        LOCALIZED, inlier_count=10, match_count=0, reprojection_error_px=math.nan, scale_deviation=math.inf
    )
    metrics.answered(LOCALIZED, inlier_count=30, match_count=40, reprojection_error_px=0.5)
    samples = samples_of(metrics)
    assert samples["mapless_inliers_sum", frozenset()] == 40
    assert (samples["mapless_inlier_ratio_count", frozenset()], samples["mapless_inlier_ratio_sum", frozenset()]) == (
        1,
        0.75,
    )
    assert samples["mapless_reprojection_error_px_sum", frozenset()] == 0.5
    assert samples["mapless_scale_deviation_count", frozenset()] == 0


def test_caches_are_read_at_every_scrape(metrics: Metrics) -> None:
    count_everything(metrics)
    samples = samples_of(metrics)
    assert samples["mapless_reference_cache_hits_total", frozenset()] == 1
    assert samples["mapless_reference_cache_bytes", frozenset()] == 6
    assert samples["mapless_token_cache_hits_total", frozenset({("tier", "device")})] == 2
    assert samples["mapless_token_cache_hits_total", frozenset({("tier", "host")})] == 3
    assert samples["mapless_token_cache_bytes", frozenset({("tier", "host")})] == 8
    assert samples["mapless_gpu_memory_bytes", frozenset({("kind", "reserved")})] == 20
    metrics.scraped.reference_cache = lambda: reference_cache(17)
    assert samples_of(metrics)["mapless_reference_cache_hits_total", frozenset()] == 17


def test_a_failing_source_does_not_hide_other_metrics(metrics: Metrics, caplog: pytest.LogCaptureFixture) -> None:
    count_everything(metrics)

    def broken() -> LruCache[str]:
        raise RuntimeError("the cache is gone")

    metrics.scraped.reference_cache = broken
    samples = samples_of(metrics)
    assert ("mapless_reference_cache_hits_total", frozenset()) not in samples
    assert samples["mapless_token_cache_misses_total", frozenset()] == 4
    assert samples["mapless_fatal_total", frozenset()] == 1
    assert "mapless_reference_cache_hits" in caplog.text
    assert "the cache is gone" in caplog.text


# The port


@pytest.fixture
def server(metrics: Metrics) -> Iterator[MetricsServer]:
    running = MetricsServer(metrics.registry, "127.0.0.1", 0, metrics)
    yield running
    running.close()


def scrape(port: int, host: str = "127.0.0.1") -> str:
    with urllib.request.urlopen(f"http://{host}:{port}/metrics", timeout=30) as response:
        return str(response.read().decode())


def metrics_threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "metrics" or "process_request" in thread.name]


def ask(port: int, path: str) -> tuple[int, str]:
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=30) as response:
            return response.status, response.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()


def test_ready_is_200_exactly_while_health_is_serving(metrics: Metrics, server: MetricsServer) -> None:
    assert ask(server.port, "/ready") == (503, "not serving\n")  # starting
    metrics.set_serving(True)
    assert ask(server.port, "/ready") == (200, "serving\n")
    assert ask(server.port, "/ready?from=probe") == (200, "serving\n")
    metrics.set_serving(False)
    metrics.not_serving_because = "stopping"
    assert ask(server.port, "/ready") == (503, "not serving: stopping\n")
    assert ask(server.port, "/metrics")[0] == 200


@pytest.mark.parametrize(
    ("silent_s", "ready", "live"), [(None, 200, 200), (0, 200, 200), (6, 503, 200), (50, 503, 200), (61, 503, 503)]
)
def test_a_stalled_server_is_not_ready_and_later_not_alive(
    metrics: Metrics, server: MetricsServer, silent_s: float | None, ready: int, live: int
) -> None:
    metrics.set_serving(True)
    if silent_s is not None:
        metrics.beat()
        assert metrics.beaten_s is not None
        metrics.beaten_s -= silent_s
    assert (ask(server.port, "/ready")[0], ask(server.port, "/live")[0]) == (ready, live)
    metrics.beat()
    assert (ask(server.port, "/ready")[0], ask(server.port, "/live")[0]) == (200, 200)
    metrics.set_serving(False)
    assert ask(server.port, "/live") == (200, "alive\n")  # a server that drains is not restarted


@pytest.mark.parametrize("path", ["/", "/favicon.ico", "/ready/", "/metrics/", "/metrics/../etc/passwd", "/live/"])
def test_nothing_else_is_on_the_port(metrics: Metrics, server: MetricsServer, path: str) -> None:
    metrics.set_serving(True)
    assert ask(server.port, path) == (404, "there are /metrics, /ready and /live\n")


def test_the_port_serves_exemplars_as_open_metrics(metrics: Metrics, server: MetricsServer) -> None:
    metrics.call_handled(LOCALIZE, "OK", 0.25, "0af7651916cd43dd8448eb211c80319c")
    request = urllib.request.Request(
        f"http://127.0.0.1:{server.port}/metrics", headers={"Accept": "application/openmetrics-text; version=1.0.0"}
    )
    with urllib.request.urlopen(request, timeout=30) as response:
        text = response.read().decode()
    assert '# {trace_id="0af7651916cd43dd8448eb211c80319c"} 0.25' in text
    assert text.endswith("# EOF\n")


def test_a_port_that_is_taken_is_an_error(metrics: Metrics, server: MetricsServer) -> None:
    with pytest.raises(OSError, match="in use"):
        MetricsServer(metrics.registry, "127.0.0.1", server.port, metrics)
    with pytest.raises(OSError):  # noqa: PT011  the resolver's words differ
        MetricsServer(metrics.registry, "no-such-host.invalid", 0, metrics)


def test_closing_frees_the_port_and_ends_connection_threads(metrics: Metrics) -> None:
    before = set(threading.enumerate())
    server = MetricsServer(metrics.registry, "127.0.0.1", 0, metrics)
    with socket.create_connection(("127.0.0.1", server.port), 10) as idle:
        scrape(server.port)
        server.close()
        assert set(threading.enumerate()) <= before
        assert idle.recv(1) == b""
    again = MetricsServer(metrics.registry, "127.0.0.1", server.port, metrics)
    again.close()


def test_idle_connections_take_few_threads_and_block_no_scrape(server: MetricsServer) -> None:
    idle = [socket.create_connection(("127.0.0.1", server.port), 10) for _ in range(10 * MAX_CONNECTIONS)]
    try:
        for connection in idle:
            connection.sendall(b"GET /metrics HTTP/1.1\r\nX-Slow: ")  # and never the rest
        assert "mapless_fatal_total" in scrape(server.port)
        deadline_s = time.monotonic() + 20
        while len(metrics_threads()) > MAX_CONNECTIONS + 1:
            assert time.monotonic() < deadline_s
            time.sleep(0.01)
    finally:
        for connection in idle:
            connection.close()


def test_a_silent_connection_is_closed(metrics: Metrics, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exporter._Handler, "timeout", 0.05)
    server = MetricsServer(metrics.registry, "127.0.0.1", 0, metrics)
    try:
        with socket.create_connection(("127.0.0.1", server.port), 30) as silent:
            assert silent.recv(1) == b""
    finally:
        server.close()


@pytest.mark.parametrize(
    "nonsense", [b"\x00\xff\xfe\r\n\r\n", b"POST /metrics HTTP/1.1\r\n\r\n", b"GET " + b"a" * 70000]
)
def test_malformed_http_is_rejected_and_the_next_served(server: MetricsServer, nonsense: bytes) -> None:
    with socket.create_connection(("127.0.0.1", server.port), 30) as connection:
        connection.sendall(nonsense)
        connection.shutdown(socket.SHUT_WR)
        answer = connection.recv(1000)
    assert re.search(rb"\b4\d\d\b", answer)
    assert "mapless_fatal_total" in scrape(server.port)


def test_the_port_answers_while_the_event_loop_is_blocked(server: MetricsServer) -> None:
    async def block() -> str:
        with ThreadPoolExecutor(1) as pool:
            return pool.submit(scrape, server.port).result(30)  # waited for on the loop's own thread

    assert "mapless_fatal_total" in asyncio.run(block())


def test_no_gpu_is_sought_while_torch_is_being_imported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", ModuleType("torch"))
    assert gpu_memory() == {}
