"""The server's own account, from its metrics: calls by status, and how long its event loop was held up."""

from __future__ import annotations

import math
import urllib.error
import urllib.request
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from prometheus_client.parser import text_string_to_metric_families

TIMEOUT_S = 5.0
LOCALIZE = "Localize"
LOOP_LAG = "mapless_event_loop_lag_seconds"


@dataclass(frozen=True)
class Scrape:
    """Counters at one moment, all since the server began.

    Attributes:
        started: calls of Localize that began.
        handled: those that ended, by status.
        terminated: admitted jobs that ended, by outcome.
        lag_buckets: times that the event loop was late, by upper edge, seconds; each also counts in the wider ones.
    """

    started: int
    handled: Mapping[str, int]
    terminated: Mapping[str, int]
    lag_buckets: Mapping[float, int]

    def since(self, before: Scrape) -> Scrape:
        """What happened between two moments."""
        return Scrape(
            self.started - before.started,
            _difference(self.handled, before.handled),
            _difference(self.terminated, before.terminated),
            {edge: number - before.lag_buckets.get(edge, 0) for edge, number in self.lag_buckets.items()},
        )

    @property
    def longest_lag_s(self) -> float | None:
        """The edge below which the event loop always was; infinite beyond the last one, None where it is not told."""
        total = self.lag_buckets.get(math.inf, 0)
        if total == 0:
            return None
        return min(edge for edge, number in self.lag_buckets.items() if number == total)


@dataclass(frozen=True)
class Series:
    """All values of a metrics page, by the name of their series; labels are left out, and the values added up."""

    values: Mapping[str, float]

    def total(self, name: str) -> float:
        """Of a series, over all its labels; 0 if there is none."""
        return self.values.get(name, 0.0)


@dataclass(frozen=True)
class Reconciliation:
    """The client's account against the server's.

    Attributes:
        sent: calls that the client made.
        handled: calls that the server says have ended.
        running: calls that the server says have begun and not ended; all have ended for the client.
        missing: calls of a status that only the server gives, which the server did not count: by status.
        surplus: calls that the server counted beyond what the client was told and beyond those it hung up on.
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


def read_series(address: str) -> Series:
    """Scrapes the server for everything; OSError if it does not answer."""
    with urllib.request.urlopen(f"http://{address}/metrics", timeout=TIMEOUT_S) as response:
        page = response.read().decode()
    values: dict[str, float] = {}
    for family in text_string_to_metric_families(page):
        for sample in family.samples:
            values[sample.name] = values.get(sample.name, 0.0) + sample.value
    return Series(values)


def read_metrics(address: str) -> Scrape | None:
    """Scrapes the server; None if it serves no metrics there."""
    try:
        with urllib.request.urlopen(f"http://{address}/metrics", timeout=TIMEOUT_S) as response:
            return parse_metrics(response.read().decode())
    except urllib.error.URLError as error:
        if isinstance(error.reason, ConnectionRefusedError):
            return None
        raise


def parse_metrics(page: str) -> Scrape:
    """What a metrics page says."""
    started = 0
    handled: Counter[str] = Counter()
    terminated: Counter[str] = Counter()
    lag: Counter[float] = Counter()
    for family in text_string_to_metric_families(page):
        for sample in family.samples:
            value, labels = round(sample.value), sample.labels
            if sample.name == "grpc_server_started_total" and labels["grpc_method"] == LOCALIZE:
                started += value
            elif sample.name == "grpc_server_handled_total" and labels["grpc_method"] == LOCALIZE:
                handled[labels["grpc_code"]] += value
            elif sample.name == "mapless_jobs_terminated_total":
                terminated[labels["outcome"]] += value
            elif sample.name == f"{LOOP_LAG}_bucket":
                lag[float(labels["le"])] += value
    return Scrape(started, dict(handled), dict(terminated), dict(lag))


def reconcile(codes: Sequence[str], server: Scrape) -> Reconciliation:
    """The statuses of a client's calls against what the server counted meanwhile.

    The two may differ in calls that the client gave up, by hanging up or at their deadline: the server may have been
    done with these already, or never have begun.
    """
    told = Counter(codes)
    given_up = told["CANCELLED"] + told["DEADLINE_EXCEEDED"]
    sure = {code: number for code, number in told.items() if code not in ("CANCELLED", "DEADLINE_EXCEEDED")}
    missing = {code: n - server.handled.get(code, 0) for code, n in sure.items() if n > server.handled.get(code, 0)}
    handled = sum(server.handled.values())
    others = handled - sum(min(n, server.handled.get(code, 0)) for code, n in sure.items())
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
