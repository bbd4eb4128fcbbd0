"""The times, clients and kinds of calls, decided before the first call is sent.

Several clients call independently of one another and of the answers (open loop), as many robots do; so each one's calls
are a Poisson process. In a closed loop a client calls again when it has its answer, so a slow server gets fewer calls
and seems better than it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from mapless.geometry import Array
from mapless_server.method.options import check_bounds


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


def poisson_times(rate_per_s: float, duration_s: float, random: np.random.Generator) -> Array:
    """Times of a Poisson process in [0, duration), seconds, ascending."""
    if not (rate_per_s > 0 and duration_s > 0):
        raise ValueError(f"rate and duration must be above 0, are {rate_per_s:g} and {duration_s:g}")
    # Given their number, which is Poisson's, the times of such a process are independent and uniform.
    count = random.poisson(rate_per_s * duration_s)
    return np.sort(random.uniform(0.0, duration_s, count))


def plan_calls(
    rate_per_s: float, duration_s: float, clients: int, requests: Requests, mix: Mix, seed: int
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
        for at_s in poisson_times(rate_per_s / clients, duration_s, random)
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
