"""The load generator: arrivals are Poisson's, every call is accounted for once, and time counts from the intention."""

import asyncio
import itertools
import json
import math
import os
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
from google.rpc import error_details_pb2, status_pb2
from grpc_status import rpc_status
from hypothesis import given
from hypothesis import strategies as st

from bench.load.calls import (
    REGULAR_JITTER,
    CallRecord,
    Fate,
    Kind,
    Mix,
    PlannedCall,
    Requests,
    account_of,
    latencies,
    plan_calls,
    poisson_times,
    regular_times,
)
from bench.load.charts import LATENCIES, RATES, draw_load
from bench.load.no_op import CAMERA, padded_photo
from bench.load.pipeline import PipelineOptions, PipelineResult, pipeline_checks, pipeline_json
from bench.load.report import check_lines, report_part, step_lines
from bench.load.sender import Target, connected, send_closed_loop, send_open_loop
from bench.load.step import Step, run_step
from bench.load.watch import (
    ProcessSample,
    Scrape,
    ServerUnderLoad,
    parse_metrics,
    reconcile,
)
from mapless_server.images import ImageLimits, decode_image

METHOD = "/toy.Toy/Call"
GOOD, BAD = b"good", b"bad"
REQUESTS = Requests((GOOD,), (BAD,))
Handler = Callable[[bytes, Any], Awaitable[bytes]]


def record(fate: Fate = Fate.ANSWERED, at_s: float = 0.0, took_s: float = 0.1, sent_late_s: float = 0.0) -> CallRecord:
    code, detail, kind = {
        Fate.ANSWERED: ("OK", "localized", Kind.QUERY),
        Fate.REFUSED: ("RESOURCE_EXHAUSTED", "QUEUE_FULL", Kind.QUERY),
        Fate.BAD_REQUEST: ("INVALID_ARGUMENT", "IMAGE_FORMAT", Kind.BAD_IMAGE),
        Fate.HUNG_UP: ("CANCELLED", "", Kind.CANCELLED),
        Fate.OVERDUE: ("DEADLINE_EXCEEDED", "", Kind.QUERY),
        Fate.TOO_HURRIED: ("DEADLINE_EXCEEDED", "", Kind.HURRIED),
        Fate.FAILED: ("INTERNAL", "INTERNAL", Kind.QUERY),
    }[fate]
    return CallRecord(kind, 0, at_s, at_s + sent_late_s, at_s + took_s, 1.0, code, detail)


# Arrivals


def test_regular_arrivals_are_at_equal_intervals_but_for_the_jitter() -> None:
    times = regular_times(4.0, 100.0, np.random.default_rng(7))
    assert len(times) == 400
    assert times[0] >= 0
    assert times[-1] < 100.5
    assert np.abs(np.diff(times) - 0.25).max() <= 2 * REGULAR_JITTER * 0.25
    assert np.std(np.diff(times)) > 0.01


def test_arrivals_are_a_poisson_process_of_the_rate() -> None:
    rate, duration_s = 50.0, 400.0
    times = poisson_times(rate, duration_s, np.random.default_rng(7))
    assert (np.diff(times) >= 0).all()
    assert times[0] >= 0
    assert times[-1] < duration_s
    assert abs(len(times) - rate * duration_s) < 4 * math.sqrt(rate * duration_s)
    # Gaps are exponential: their spread is their mean, and a share of 1/e of them is longer.
    gaps = np.diff(times)
    assert np.std(gaps) == pytest.approx(1 / rate, rel=0.05)
    assert np.mean(gaps > 1 / rate) == pytest.approx(1 / math.e, abs=0.02)
    # In whole seconds the counts vary as much as they are large, and say nothing of the next second's.
    counts = np.bincount(times.astype(int), minlength=int(duration_s))
    assert np.var(counts) == pytest.approx(rate, rel=0.25)
    assert abs(np.corrcoef(counts[:-1], counts[1:])[0, 1]) < 0.2


def test_clients_together_make_the_rate_and_the_mix() -> None:
    mix = Mix(cancelled_share=0.1, bad_share=0.2, cancel_within_s=0.5)
    plan = plan_calls(100.0, 100.0, 8, REQUESTS, mix, seed=3)
    assert [call.at_s for call in plan] == sorted(call.at_s for call in plan)
    assert abs(len(plan) - 10_000) < 400
    by_client = Counter(call.client for call in plan)
    assert sorted(by_client) == list(range(8))
    assert all(abs(count - 1250) < 150 for count in by_client.values())
    kinds = Counter(call.kind for call in plan)
    assert kinds[Kind.CANCELLED] / len(plan) == pytest.approx(0.1, abs=0.01)
    assert kinds[Kind.BAD_IMAGE] / len(plan) == pytest.approx(0.2, abs=0.015)
    for call in plan:
        assert call.request == (BAD if call.kind is Kind.BAD_IMAGE else GOOD)
        assert (call.cancel_after_s is not None) == (call.kind is Kind.CANCELLED)
        assert call.cancel_after_s is None or 0 <= call.cancel_after_s <= 0.5


# Accounts


def test_percentiles_of_known_values() -> None:
    found = latencies([i / 1000 for i in range(1, 201)])
    figures = (found.count, found.p50_ms, found.p95_ms, found.p99_ms, found.max_ms)
    assert figures == pytest.approx((200, 100, 190, 198, 200))
    assert latencies([]).p99_ms is None


@pytest.mark.parametrize(
    ("code", "detail", "kind", "took_s", "fate"),
    [
        ("OK", "localized", Kind.QUERY, 0.1, Fate.ANSWERED),
        ("OK", "rejected LOW_OVERLAP", Kind.QUERY, 0.1, Fate.ANSWERED),
        ("OK", "localized", Kind.CANCELLED, 0.1, Fate.ANSWERED),
        ("OK", "localized", Kind.QUERY, 1.1, Fate.OVERDUE),
        ("RESOURCE_EXHAUSTED", "QUEUE_FULL", Kind.QUERY, 0.1, Fate.REFUSED),
        ("RESOURCE_EXHAUSTED", "", Kind.QUERY, 0.1, Fate.FAILED),
        ("UNAVAILABLE", "DRAINING", Kind.QUERY, 0.1, Fate.REFUSED),
        ("UNAVAILABLE", "", Kind.QUERY, 0.1, Fate.FAILED),
        ("DEADLINE_EXCEEDED", "DEADLINE_INFEASIBLE", Kind.QUERY, 0.1, Fate.REFUSED),
        ("DEADLINE_EXCEEDED", "DEADLINE_EXCEEDED", Kind.QUERY, 0.9, Fate.OVERDUE),
        ("DEADLINE_EXCEEDED", "", Kind.QUERY, 1.0, Fate.OVERDUE),
        ("INVALID_ARGUMENT", "IMAGE_FORMAT", Kind.BAD_IMAGE, 0.1, Fate.BAD_REQUEST),
        ("INVALID_ARGUMENT", "IMAGE_FORMAT", Kind.QUERY, 0.1, Fate.FAILED),
        ("CANCELLED", "", Kind.CANCELLED, 0.1, Fate.HUNG_UP),
        ("CANCELLED", "", Kind.QUERY, 0.1, Fate.FAILED),
        ("INTERNAL", "INTERNAL", Kind.QUERY, 0.1, Fate.FAILED),
    ],
)
def test_how_a_call_ended_for_its_caller(code: str, detail: str, kind: Kind, took_s: float, fate: Fate) -> None:
    assert CallRecord(kind, 0, 0.0, 0.0, took_s, 1.0, code, detail).fate is fate


@given(st.lists(st.tuples(st.sampled_from(Fate), st.floats(0, 9.99), st.floats(0, 3)), max_size=40))
def test_every_call_is_counted_once_within_the_offered_rate(calls: list[tuple[Fate, float, float]]) -> None:
    records = [record(fate, at_s, took_s) for fate, at_s, took_s in calls]
    account = account_of(records, 10.0, 2.0)
    assert sum(account.fates.values()) == sum(account.outcomes.values()) == account.sent == len(records)
    assert account.fates == Counter(r.fate.value for r in records)
    shares = account.goodput_per_s + account.refused_per_s + account.overdue_per_s
    assert shares <= account.offered_per_s + 1e-9
    assert account.answers.count + account.refusals.count <= account.offered_per_s * 8 + 1e-9


def test_rates_leave_out_the_beginning_and_late_answers() -> None:
    records = [
        record(at_s=1.0),  # before it has settled
        record(at_s=3.0),
        record(at_s=4.0, took_s=1.3, sent_late_s=0.5),  # in time for its deadline, not for who wanted it
        record(Fate.REFUSED, at_s=5.0, took_s=0.02),
        record(Fate.OVERDUE, at_s=6.0, took_s=1.0),
    ]
    account = account_of(records, 10.0, 2.0)
    assert account.offered_per_s == pytest.approx(4 / 8)
    assert account.goodput_per_s == pytest.approx(1 / 8)
    assert account.refused_per_s == account.overdue_per_s == pytest.approx(1 / 8)
    assert account.completed_per_s == pytest.approx(2 / 8)
    assert account.answers.max_ms == pytest.approx(1300)
    assert account.refusals.max_ms == pytest.approx(20)
    assert account.send_lag.max_ms == pytest.approx(500)


# Calls


@asynccontextmanager
async def toy_server(handler: Handler, deadline_s: float = 30.0, clients: int = 2) -> AsyncIterator[Target]:
    """A server in this loop, and connections to it."""
    server = grpc.aio.server()
    methods = {"Call": grpc.unary_unary_rpc_method_handler(handler)}
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler("toy.Toy", methods),))
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    try:
        async with connected(f"127.0.0.1:{port}", METHOD, clients, deadline_s, bytes.decode) as target:
            yield target
    finally:
        await server.stop(None)


async def abort(context: Any, code: grpc.StatusCode, reason: str) -> bytes:
    message = status_pb2.Status(code=code.value[0], message="no")
    message.details.add().Pack(error_details_pb2.ErrorInfo(reason=reason, domain="mapless"))
    status = rpc_status.to_status(message)
    await context.abort(status.code, status.details, (*status.trailing_metadata, ("x-request-id", "1")))
    raise AssertionError("abort raises")


async def test_calls_to_a_refusing_and_silent_server_are_counted_once() -> None:
    number = 0

    async def handler(request: bytes, context: Any) -> bytes:
        nonlocal number
        if request == BAD:
            return await abort(context, grpc.StatusCode.INVALID_ARGUMENT, "IMAGE_FORMAT")
        number += 1
        if number % 3 == 1:
            return await abort(context, grpc.StatusCode.RESOURCE_EXHAUSTED, "QUEUE_FULL")
        if number % 3 == 2:
            await asyncio.sleep(60)
        return b"localized"

    plan = plan_calls(400.0, 0.5, 2, REQUESTS, Mix(0.2, 0.2, 0.05), seed=5)

    async with toy_server(handler, deadline_s=2.0) as target:
        records = await send_open_loop(target, plan)
    assert [(r.at_s, r.kind, r.client) for r in records] == [(c.at_s, c.kind, c.client) for c in plan]
    account = account_of(records, 0.5)
    assert sum(account.fates.values()) == len(plan)
    assert account.count(Fate.FAILED) == 0
    assert account.count(Fate.BAD_REQUEST) == sum(call.kind is Kind.BAD_IMAGE for call in plan)
    assert set(account.outcomes) <= {
        "OK localized",
        "RESOURCE_EXHAUSTED QUEUE_FULL",
        "DEADLINE_EXCEEDED",
        "INVALID_ARGUMENT IMAGE_FORMAT",
        "CANCELLED",
    }
    for fate in (Fate.ANSWERED, Fate.REFUSED, Fate.OVERDUE, Fate.HUNG_UP):
        assert account.count(fate) > 0
    for r in records:
        assert r.at_s <= r.sent_s <= r.ended_s


async def test_a_stalled_server_shows_in_every_latency_meanwhile() -> None:
    loop, gate, seen, released_s = asyncio.get_running_loop(), asyncio.Event(), 0, math.inf
    plan = [PlannedCall(0.01 * i, i, Kind.QUERY, GOOD) for i in range(20)]

    async def handler(_: bytes, __: Any) -> bytes:
        nonlocal seen, released_s
        seen += 1
        if seen == len(plan):  # it has not waited for answers: all are there while not one is answered
            released_s = loop.time()
            gate.set()
        await gate.wait()
        return b"localized"

    async with toy_server(handler) as target:
        begin_s = loop.time()
        records = await send_open_loop(target, plan, begin_s)
    assert [r.fate for r in records] == [Fate.ANSWERED] * 20
    for r in records:
        assert r.latency_s >= released_s - begin_s - r.at_s - 1e-9


async def test_a_closed_loop_keeps_so_many_calls_in_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    """Directly: a proxy of the environment is not for servers on this machine."""
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:9")
    running = most = 0
    seen: Counter[bytes] = Counter()

    async def handler(request: bytes, _: Any) -> bytes:
        nonlocal running, most
        running, most = running + 1, max(most, running + 1)
        seen[request] += 1
        await asyncio.sleep(0.01)
        running -= 1
        return b"localized"

    async with toy_server(handler) as target:
        records = await send_closed_loop(target, [b"a", b"b", b"c"], 3, 0.3)
    assert most == 3
    assert sum(seen.values()) == len(records)
    assert max(seen.values()) - min(seen.values()) <= 1


async def test_a_refused_closed_loop_caller_waits_the_retry_delay() -> None:
    came_s: list[float] = []

    async def handler(_: bytes, context: Any) -> bytes:
        came_s.append(asyncio.get_running_loop().time())
        status = status_pb2.Status(code=8, message="too much to do")
        for detail in (
            error_details_pb2.ErrorInfo(reason="QUEUE_FULL"),
            error_details_pb2.RetryInfo(retry_delay={"nanos": 100_000_000}),
        ):
            status.details.add().Pack(detail)
        context.set_trailing_metadata((("grpc-status-details-bin", status.SerializeToString()),))
        await context.abort(grpc.StatusCode.RESOURCE_EXHAUSTED, "too much to do")
        return b""

    async with toy_server(handler) as target:
        records = await send_closed_loop(target, [b"a"], 1, 0.55)
    assert {(it.fate, it.retry_after_s) for it in records} == {(Fate.REFUSED, 0.1)}
    assert 2 <= len(records) <= 6
    assert min(later - sooner for sooner, later in itertools.pairwise(came_s)) > 0.09


# The server's process and its own account


PAGE = """
grpc_server_started_total{grpc_service="s",grpc_method="Localize"} 12.0
grpc_server_handled_total{grpc_service="s",grpc_method="Localize",grpc_code="OK"} 7.0
grpc_server_handled_total{grpc_service="s",grpc_method="Localize",grpc_code="CANCELLED"} 5.0
grpc_server_handled_total{grpc_service="s",grpc_method="GetScene",grpc_code="OK"} 99.0
mapless_jobs_terminated_total{stage="refine",outcome="ok"} 6.0
mapless_jobs_terminated_total{stage="coarse",outcome="ok"} 1.0
# TYPE mapless_event_loop_lag_seconds histogram
mapless_event_loop_lag_seconds_bucket{le="0.01"} 90.0
mapless_event_loop_lag_seconds_bucket{le="0.02"} 100.0
mapless_event_loop_lag_seconds_bucket{le="+Inf"} 100.0
mapless_event_loop_lag_seconds_count 100.0
mapless_event_loop_lag_seconds_sum 0.5
"""


def test_the_metrics_page_is_read_and_its_differences_taken() -> None:
    after = parse_metrics(PAGE)
    assert after.started == 12
    assert after.handled == {"OK": 7, "CANCELLED": 5}
    assert after.terminated == {"ok": 7}
    assert (after.longest_lag_s, after.lag_s(0.5)) == (0.02, 0.01)
    before = replace(
        after, started=10, handled={"OK": 6, "CANCELLED": 4}, lag_buckets={0.01: 80, 0.02: 90, math.inf: 90}
    )
    since = after.since(before)
    assert (since.started, since.handled, since.longest_lag_s) == (2, {"OK": 1, "CANCELLED": 1}, 0.01)
    assert parse_metrics("").longest_lag_s is None


@pytest.mark.parametrize(
    ("handled", "complete"),
    [
        ({"OK": 6, "RESOURCE_EXHAUSTED": 2, "CANCELLED": 2}, True),
        ({"OK": 7, "RESOURCE_EXHAUSTED": 2, "CANCELLED": 1}, True),  # answered while its caller hung up
        ({"OK": 6, "RESOURCE_EXHAUSTED": 2}, True),  # both given up before the server saw them
        ({"OK": 5, "RESOURCE_EXHAUSTED": 2, "CANCELLED": 3}, False),  # an answer that the server did not count
        ({"OK": 6, "RESOURCE_EXHAUSTED": 2, "CANCELLED": 3}, False),  # one call more than were made
        ({"OK": 8, "RESOURCE_EXHAUSTED": 3, "CANCELLED": 0}, False),
    ],
)
def test_both_accounts_agree_but_for_calls_that_were_given_up(handled: dict[str, int], complete: bool) -> None:
    codes = ["OK"] * 6 + ["RESOURCE_EXHAUSTED"] * 2 + ["CANCELLED", "DEADLINE_EXCEEDED"]
    server = Scrape(sum(handled.values()), handled, {}, {})
    assert reconcile(codes, server).complete is complete
    assert not reconcile(codes, replace(server, started=server.started + 1)).complete


# Requests


def test_the_padded_photo_is_an_image_of_the_size_asked_for() -> None:
    for size_bytes in (1_000, 70_000, 300_000):
        photo = padded_photo(size_bytes)
        assert abs(len(photo) - size_bytes) < 100
        pixels = decode_image(photo, ImageLimits())
        assert pixels.shape == (CAMERA.height_px, CAMERA.width_px, 3)


# Reports


def step(name: str, asked_per_s: float | None, records: Sequence[CallRecord], scraped: Scrape | None = None) -> Step:
    samples = [ProcessSample(i / 2, 400.0 + (i % 2), 14, 25, 0.9 * i) for i in range(21)]
    account = account_of(records, 10.0)
    codes = [r.code for r in records]
    return Step(name, asked_per_s, 10.0, account, codes, samples, 0.0, scraped, 0.1, 10.0)


def planted_result(slowest_refusal_s: float = 0.004) -> PipelineResult:
    """A server that answers 8 a second in 0.2 s, and refuses the rest."""

    def calls(answered: int, refused: int) -> list[CallRecord]:
        answers = [record(at_s=10 * i / max(answered, 1) * 0.9, took_s=0.2 + 0.001 * i) for i in range(answered)]
        refusals = [record(Fate.REFUSED, at_s=10 * i / max(refused, 1), took_s=0.003) for i in range(refused)]
        if refusals:
            refusals[-1] = replace(refusals[-1], ended_s=refusals[-1].at_s + slowest_refusal_s)
        return answers + refusals

    scraped = Scrape(0, {}, {}, {0.01: 100, math.inf: 100})
    options = PipelineOptions(shares=(0.7, 1.0, 3.0))
    steps = [
        step("70 %", 5.6, calls(56, 0), scraped),
        step("100 %", 8.0, calls(78, 2), scraped),
        step("300 %", 24.0, calls(79, 161), scraped),
    ]
    ramp = [step("2 at a time", None, calls(80, 0), scraped)]
    unloaded = step("unloaded", None, calls(80, 0), scraped)
    regular = step("70 %, regular", 5.6, calls(56, 0), scraped)
    hammered = step("hammering", None, calls(70, 900), scraped)
    return PipelineResult("a planted place", options, unloaded, ramp, 8.0, steps, regular, hammered)


def test_a_good_server_meets_bars_and_slow_refusals_miss_one() -> None:
    def by_figure(result: PipelineResult) -> dict[str, bool | None]:
        return {check.figure: check.met for check in pipeline_checks(result)}

    good, slow = by_figure(planted_result()), by_figure(planted_result(slowest_refusal_s=0.051))
    ours = {figure: met for figure, met in good.items() if "CPU" not in figure}  # the machine's cores decide that
    assert set(ours.values()) == {True}
    different = [figure for figure in good if good[figure] is not slow[figure]]
    assert different == ["slowest of 161 refusals at 3 times saturation"]


def test_the_report_has_every_figure_and_keeps_earlier_parts(tmp_path: Path) -> None:
    """Also of a step without any answer."""
    planted = planted_result()
    refused = [record(Fate.REFUSED, at_s=0.1 * i, took_s=0.003) for i in range(50)]
    result = replace(planted, steps=[*planted.steps[:2], step("300 %", 24.0, refused)])
    checks = pipeline_checks(result)
    assert next(it for it in checks if it.figure.startswith("goodput")).met is False
    assert any("300 %" in line for line in step_lines(result.all_steps))
    file = tmp_path / "load.json"
    report_part(file, "pipeline", [], checks, pipeline_json(result))
    report_part(file, "soak", [], [], {"figure": 1})
    content = json.loads(file.read_text())
    assert sorted(content) == ["pipeline", "soak"]
    assert content["pipeline"]["steps"][2]["refusals"]["count"] == 50
    verdicts = [line for line in check_lines(checks) if "| yes |" in line or "**no**" in line]
    assert len(verdicts) == len(content["pipeline"]["checks"])
    for axes, names in zip(draw_load(result).axes, (LATENCIES, RATES), strict=True):
        drawn = [label.partition(":")[0] for label in axes.get_legend_handles_labels()[1]]
        assert set(names) <= set(drawn)


async def test_a_step_uses_the_servers_account_of_its_time_only(monkeypatch: pytest.MonkeyPatch) -> None:
    pages = iter([Scrape(10, {"OK": 10}, {}, {}), Scrape(13, {"OK": 13}, {}, {})])
    monkeypatch.setattr("bench.load.watch.read_metrics", lambda _: next(pages))

    async def send() -> list[CallRecord]:
        await asyncio.sleep(0.05)
        return [record(at_s=0.01 * i, took_s=0.01) for i in range(3)]

    under_load = ServerUnderLoad(os.getpid(), "nowhere")
    measured = await run_step("toy", under_load, send, 1.0, sample_every_s=0.01)
    assert measured.scraped is not None
    assert (measured.scraped.started, measured.scraped.handled) == (3, {"OK": 3})
    assert measured.answers == 3
    assert len(measured.samples) >= 2
    assert [s.at_s for s in measured.samples] == sorted(s.at_s for s in measured.samples)
