"""The server's metrics at a moment: calls by status, delays of the event loop, and sums of all series."""

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
    """Metrics at one moment, or the difference of two.

    Attributes:
        started: calls of Localize that began.
        handled: those that ended, by status.
        terminated: admitted jobs that ended, by outcome.
        lag_buckets: times that the event loop was late, by upper edge, seconds; each also counts in the wider ones.
        totals: every series, its labels added up.
    """

    started: int
    handled: Mapping[str, int]
    terminated: Mapping[str, int]
    lag_buckets: Mapping[float, int]
    totals: Mapping[str, float] = field(default_factory=dict)

    def since(self, before: Scrape) -> Scrape:
        """What happened between two moments."""
        return Scrape(
            self.started - before.started,
            _difference(self.handled, before.handled),
            _difference(self.terminated, before.terminated),
            {edge: number - before.lag_buckets.get(edge, 0) for edge, number in self.lag_buckets.items()},
            {name: value - before.totals.get(name, 0.0) for name, value in self.totals.items()},
        )

    @property
    def longest_lag_s(self) -> float | None:
        """The edge below which the event loop always was; infinite beyond the last one, None without the metric."""
        total = self.lag_buckets.get(math.inf, 0)
        if total == 0:
            return None
        return min(edge for edge, number in self.lag_buckets.items() if number == total)

    @property
    def mean_lag_ms(self) -> float:
        """How late timers of the event loop were, on average; 0 if there were none."""
        count = self.totals.get(f"{LOOP_LAG}_count", 0.0)
        return 1000 * self.totals[f"{LOOP_LAG}_sum"] / count if count else 0.0


@dataclass(frozen=True)
class Reconciliation:
    """The client's account against the server's.

    Attributes:
        sent: calls that the client made.
        handled: calls that the server says have ended.
        running: calls that the server says have begun and not ended; all have ended for the client.
        missing: calls of a status that only the server gives, which the server did not count: by status.
        surplus: calls that the server counted beyond those that ended for the client and those it cancelled.
        unseen: calls that the client gave up before the server began with them.
    """

    sent: int
    handled: int
    running: int
    missing: Mapping[str, int]
    surplus: int
    unseen: int

    @property
    def complete(self) -> bool:
        """Whether every call is accounted for."""
        return not self.missing and self.surplus == 0 and self.running == 0 and self.unseen >= 0


def read_metrics(address: str) -> Scrape | None:
    """Scrapes the server; None if it serves no metrics there, OSError if it does not answer."""
    try:
        with urllib.request.urlopen(f"http://{address}/metrics", timeout=TIMEOUT_S) as response:
            return parse_metrics(response.read().decode())
    except urllib.error.URLError as error:
        if isinstance(error.reason, ConnectionRefusedError):
            return None
        raise


def parse_metrics(page: str) -> Scrape:
    """The metrics of a page."""
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
    """The statuses of a client's calls against what the server counted meanwhile.

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
