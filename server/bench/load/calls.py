"""Calls: when, by which client and of what kind they are made, planned beforehand, and how they ended.

Several clients call independently of one another and of the answers (open loop): at random, so that each one's calls
are a Poisson process, or at equal intervals, as robots do. In a closed loop a client calls again when it has its
answer, so a slow server gets fewer calls and seems better than it is.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from mapless.geometry import Array
from mapless_server.bounds import check_bounds


class Kind(str, Enum):
    """Kinds of calls."""

    QUERY = "query"
    CANCELLED = "cancelled"
    """A good query that is cancelled at a random moment."""
    BAD_IMAGE = "bad_image"
    HURRIED = "hurried"
    """A good query with a deadline shorter than most answers take."""


@dataclass(frozen=True, eq=False)
class Requests:
    """Serialized requests, each chosen with the same probability; images of `bad` ones are to be rejected."""

    good: Sequence[bytes]
    bad: Sequence[bytes] = ()


@dataclass(frozen=True)
class Mix:
    """The shares of calls that are not plain queries.

    Calls are cancelled within `cancel_within_s` of sending; if that is twice the time of an answer, about half of the
    cancellations are too late, so that both cases occur. Hurried calls have deadlines of up to `hurry_s`.
    """

    cancelled_share: float = 0.0
    bad_share: float = 0.0
    cancel_within_s: float = 1.0
    hurried_share: float = 0.0
    hurry_s: float = 0.2

    def __post_init__(self) -> None:
        shares = (self.cancelled_share, self.bad_share, self.hurried_share)
        if min(shares) < 0 or sum(shares) > 1:
            raise ValueError(f"shares must be at least 0 and together at most 1, are {shares}")
        check_bounds(self, "cancel_within_s hurry_s", above=0)


@dataclass(frozen=True, eq=False)
class PlannedCall:
    """A call to make `at_s` seconds from the start. Latency counts from there, also if the call is sent later.

    It is cancelled so many seconds after sending, if at all, and has the deadline of all others unless it has its own.
    """

    at_s: float
    client: int
    kind: Kind
    request: bytes
    cancel_after_s: float | None = None
    deadline_s: float | None = None


REGULAR_JITTER = 0.1
"""Largest deviation of a regular call from its time, as a share of the interval: exposure, encoding, the network."""


def poisson_times(rate_per_s: float, duration_s: float, random: np.random.Generator) -> Array:
    """Times of a Poisson process in [0, duration), seconds, ascending."""
    if not (rate_per_s > 0 and duration_s > 0):
        raise ValueError(f"rate and duration must be above 0, are {rate_per_s:g} and {duration_s:g}")
    # Given their number, which is Poisson's, the times of such a process are independent and uniform.
    count = random.poisson(rate_per_s * duration_s)
    return np.sort(random.uniform(0.0, duration_s, count))


def regular_times(rate_per_s: float, duration_s: float, random: np.random.Generator) -> Array:
    """Times of a robot's photographs: at equal intervals from any time on, each off by up to a tenth of an interval."""
    count = int(rate_per_s * duration_s)
    jitter = random.uniform(-REGULAR_JITTER, REGULAR_JITTER, count)
    return np.sort((np.arange(count) + random.uniform() + jitter).clip(min=0)) / rate_per_s


Times = Callable[[float, float, np.random.Generator], Array]
"""Times of a client's calls, seconds, of a rate, a duration and random numbers."""


def plan_calls(
    rate_per_s: float,
    duration_s: float,
    clients: int,
    requests: Requests,
    mix: Mix,
    seed: int,
    times: Times = poisson_times,
) -> list[PlannedCall]:
    """The calls of several clients, `rate_per_s` together, in order of time; the same for the same seed."""
    if clients < 1:
        raise ValueError(f"clients must be at least 1, are {clients}")
    if mix.bad_share > 0 and not requests.bad:
        raise ValueError(f"bad_share is {mix.bad_share:g}, and there are no bad requests")
    random = np.random.default_rng(seed)
    calls = [
        _planned(float(at_s), client, requests, mix, random)
        for client in range(clients)
        for at_s in times(rate_per_s / clients, duration_s, random)
    ]
    return sorted(calls, key=lambda call: call.at_s)


def _planned(at_s: float, client: int, requests: Requests, mix: Mix, random: np.random.Generator) -> PlannedCall:
    draw = random.random()
    if draw < mix.bad_share:
        return PlannedCall(at_s, client, Kind.BAD_IMAGE, _any_of(requests.bad, random))
    request = _any_of(requests.good, random)
    if draw < mix.bad_share + mix.cancelled_share:
        return PlannedCall(at_s, client, Kind.CANCELLED, request, random.uniform(0.0, mix.cancel_within_s))
    if draw >= 1 - mix.hurried_share:
        return PlannedCall(at_s, client, Kind.HURRIED, request, deadline_s=random.uniform(0.01, 1.0) * mix.hurry_s)
    return PlannedCall(at_s, client, Kind.QUERY, request)


def _any_of(requests: Sequence[bytes], random: np.random.Generator) -> bytes:
    return requests[int(random.integers(len(requests)))]


class Fate(str, Enum):
    """How a call ended, for its caller."""

    ANSWERED = "answered"
    """With a pose, or with the reason why there is none, before its deadline."""
    REFUSED = "refused"
    """The server is overloaded, or stops."""
    BAD_REQUEST = "bad request"
    """Its image is bad, and the server says so."""
    HUNG_UP = "hung up"
    """Its caller cancelled it before there was an answer."""
    TOO_HURRIED = "too hurried"
    """Its deadline was shorter than an answer takes, and it failed by then."""
    OVERDUE = "overdue"
    """Neither refused nor answered by its deadline: computing was wasted on it."""
    FAILED = "failed"
    """Any other error, a lost connection among them; there should be none."""


REFUSING_CODES = frozenset({"RESOURCE_EXHAUSTED", "UNAVAILABLE"})
INFEASIBLE = "DEADLINE_INFEASIBLE"
"""Why a call is refused whose deadline leaves too little time, however idle the server."""


@dataclass(frozen=True)
class CallRecord:
    """A call that has ended; times are seconds from the start of its step, its deadline from sending.

    It was sent later than planned (`at_s`) if the generator is slow. `detail` is the outcome of an answer, or the
    reason of an error; empty for an error of the client's own. `retry_after_s` is what a refusal requests.
    """

    kind: Kind
    client: int
    at_s: float
    sent_s: float
    ended_s: float
    deadline_s: float
    code: str
    detail: str
    retry_after_s: float | None = None

    @property
    def latency_s(self) -> float:
        """Time from the planned sending to the outcome, so that waiting on either side counts."""
        return self.ended_s - self.at_s

    @property
    def outcome(self) -> str:
        """Status and detail as one text."""
        return f"{self.code} {self.detail}".strip()

    @property
    def fate(self) -> Fate:
        """How it ended."""
        if self.code == "OK":
            return Fate.ANSWERED if self.ended_s - self.sent_s <= self.deadline_s else Fate.OVERDUE
        if self.code in REFUSING_CODES and self.detail:
            return Fate.REFUSED
        if self.code == "DEADLINE_EXCEEDED":
            if self.kind is Kind.HURRIED:
                return Fate.TOO_HURRIED
            return Fate.REFUSED if self.detail == INFEASIBLE else Fate.OVERDUE
        if self.code == "CANCELLED" and self.kind is Kind.CANCELLED:
            return Fate.HUNG_UP
        if self.code == "INVALID_ARGUMENT" and self.kind is Kind.BAD_IMAGE:
            return Fate.BAD_REQUEST
        return Fate.FAILED


@dataclass(frozen=True)
class Latencies:
    """Latencies of a group of calls, milliseconds; None for an empty group."""

    count: int
    p50_ms: float | None
    p95_ms: float | None
    p99_ms: float | None
    max_ms: float | None


@dataclass(frozen=True)
class Account:
    """The figures of the calls of a step.

    All leave out its beginning, except `sent`, to which `fates` and `outcomes` add up. Rates are by when calls were to
    be sent, from when deadlines count, too; only `completed_per_s` counts answers received in the window, whenever they
    were requested. `send_lag` are delays of sending, caused by the generator.
    """

    window_s: float
    sent: int
    offered_per_s: float
    goodput_per_s: float
    refused_per_s: float
    overdue_per_s: float
    completed_per_s: float
    answers: Latencies
    refusals: Latencies
    send_lag: Latencies
    fates: Mapping[str, int]
    outcomes: Mapping[str, int]

    def count(self, fate: Fate) -> int:
        """Number of calls that ended so."""
        return self.fates.get(fate.value, 0)


def latencies(seconds: Sequence[float]) -> Latencies:
    """Percentiles of durations, each one of them, without interpolation."""
    if not seconds:
        return Latencies(0, None, None, None, None)
    p50, p95, p99, most = (1000 * np.quantile(seconds, (0.5, 0.95, 0.99, 1.0), method="inverted_cdf")).tolist()
    return Latencies(len(seconds), p50, p95, p99, most)


def account_of(records: Sequence[CallRecord], duration_s: float, settle_s: float = 0.0) -> Account:
    """Figures of the calls of a step; rates leave out the first `settle_s`, while queues are filling."""
    window_s = duration_s - settle_s
    if not (settle_s >= 0 and window_s > 0):
        raise ValueError(f"of {duration_s:g} s nothing is left after {settle_s:g} s")
    counted = [record for record in records if record.at_s >= settle_s]
    answered = [r for r in counted if r.fate is Fate.ANSWERED and r.kind is not Kind.BAD_IMAGE]
    refused = [r for r in counted if r.fate is Fate.REFUSED]
    overdue = [r for r in counted if r.fate is Fate.OVERDUE]
    completed = [r for r in records if r.fate is Fate.ANSWERED and settle_s <= r.ended_s < duration_s]
    in_time = [r for r in answered if r.latency_s <= r.deadline_s]
    return Account(
        window_s=window_s,
        sent=len(records),
        offered_per_s=len(counted) / window_s,
        goodput_per_s=len(in_time) / window_s,
        refused_per_s=len(refused) / window_s,
        overdue_per_s=len(overdue) / window_s,
        completed_per_s=len(completed) / window_s,
        answers=latencies([r.latency_s for r in answered]),
        refusals=latencies([r.latency_s for r in refused]),
        send_lag=latencies([r.sent_s - r.at_s for r in counted]),
        fates=dict(Counter(record.fate.value for record in records)),
        outcomes=dict(Counter(record.outcome for record in records).most_common()),
    )
