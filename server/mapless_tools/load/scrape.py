"""The server's metrics at one time: calls by status, delays of the event loop, and sums of all series."""

from __future__ import annotations

import math
import urllib.error
import urllib.request
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from prometheus_client.parser import text_string_to_metric_families

TIMEOUT_S = 5.0
LOCALIZE = "Localize"
LOOP_LAG = "mapless_event_loop_lag_seconds"


@dataclass(frozen=True)
class Scrape:
    """Metrics at one time, or the difference of two.

    `started` calls of Localize began, and `handled` ended, by status; admitted jobs ended by outcome. `lag_buckets` are
    cumulative numbers of the event loop's delays, by upper edge, seconds; `totals` the sum of each metric over its
    labels.
    """

    started: int
    handled: Mapping[str, int]
    terminated: Mapping[str, int]
    lag_buckets: Mapping[float, int]
    totals: Mapping[str, float] = field(default_factory=dict)

    def since(self, before: Scrape) -> Scrape:
        """The difference from an earlier time."""
        return Scrape(
            self.started - before.started,
            _difference(self.handled, before.handled),
            _difference(self.terminated, before.terminated),
            {edge: number - before.lag_buckets.get(edge, 0) for edge, number in self.lag_buckets.items()},
            {name: value - before.totals.get(name, 0.0) for name, value in self.totals.items()},
        )

    @property
    def longest_lag_s(self) -> float | None:
        """Upper bound of the event loop's delays; infinite beyond the last edge, None without the metric."""
        total = self.lag_buckets.get(math.inf, 0)
        if total == 0:
            return None
        return min(edge for edge, number in self.lag_buckets.items() if number == total)

    @property
    def mean_lag_ms(self) -> float:
        """Mean delay of the event loop's timers, milliseconds; 0 if there were none."""
        count = self.totals.get(f"{LOOP_LAG}_count", 0.0)
        return 1000 * self.totals[f"{LOOP_LAG}_sum"] / count if count else 0.0


@dataclass(frozen=True)
class Reconciliation:
    """Comparison of the client's and the server's counts.

    All calls have ended for the client, but some perhaps not by the server's count (`running`). `missing` are calls, by
    a status that only a server can give, which the server did not count; `surplus` those that it counted beyond those
    that ended for the client and those it cancelled; `unseen` those that the client gave up before the server began
    with them.
    """

    sent: int
    handled: int
    running: int
    missing: Mapping[str, int]
    surplus: int
    unseen: int

    @property
    def complete(self) -> bool:
        """Whether all calls are accounted for."""
        return not self.missing and self.surplus == 0 and self.running == 0 and self.unseen >= 0


def read_metrics(address: str) -> Scrape | None:
    """Reads the server's metrics; None if it serves no metrics, OSError if it does not answer."""
    try:
        with urllib.request.urlopen(f"http://{address}/metrics", timeout=TIMEOUT_S) as response:
            return parse_metrics(response.read().decode())
    except urllib.error.URLError as error:
        if isinstance(error.reason, ConnectionRefusedError):
            return None
        raise


def parse_metrics(page: str) -> Scrape:
    """Parses a page of metrics."""
    started = 0
    handled: Counter[str] = Counter()
    terminated: Counter[str] = Counter()
    lag: Counter[float] = Counter()
    totals: dict[str, float] = {}
    for sample in (sample for family in text_string_to_metric_families(page) for sample in family.samples):
        value, labels = round(sample.value) if math.isfinite(sample.value) else 0, sample.labels
        totals[sample.name] = totals.get(sample.name, 0.0) + sample.value
        if sample.name == "grpc_server_started_total" and labels["grpc_method"] == LOCALIZE:
            started += value
        elif sample.name == "grpc_server_handled_total" and labels["grpc_method"] == LOCALIZE:
            handled[labels["grpc_code"]] += value
        elif sample.name == "mapless_jobs_terminated_total":
            terminated[labels["outcome"]] += value
        elif sample.name == f"{LOOP_LAG}_bucket":
            lag[float(labels["le"])] += value
    return Scrape(started, dict(handled), dict(terminated), dict(lag), totals)


def reconcile(codes: Sequence[str], server: Scrape) -> Reconciliation:
    """Compares the statuses of a client's calls with the server's counts in the same time.

    The two may differ in calls that the client gave up, by cancelling or at their deadline: the server may have
    finished these already, or never have begun.
    """
    counts = Counter(codes)
    given_up = counts["CANCELLED"] + counts["DEADLINE_EXCEEDED"]
    certain = {code: number for code, number in counts.items() if code not in ("CANCELLED", "DEADLINE_EXCEEDED")}
    missing = {code: n - server.handled.get(code, 0) for code, n in certain.items() if n > server.handled.get(code, 0)}
    handled = sum(server.handled.values())
    others = handled - sum(min(n, server.handled.get(code, 0)) for code, n in certain.items())
    return Reconciliation(
        sent=len(codes),
        handled=handled,
        running=server.started - handled,
        missing=missing,
        surplus=max(0, others - given_up),
        unseen=given_up - others,
    )


def _difference(after: Mapping[str, int], before: Mapping[str, int]) -> dict[str, int]:
    return {key: number - before.get(key, 0) for key, number in after.items() if number != before.get(key, 0)}
