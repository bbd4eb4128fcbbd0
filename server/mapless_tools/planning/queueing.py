"""Waiting for one of several devices: Erlang's formula, and a simulation for services that are not exponential."""

from __future__ import annotations

import heapq
import math

import numpy as np

from .city import Floats


def waiting_probability(servers: int, offered: float) -> float:
    """Erlang C: the share of calls that wait in M/M/c; 1 where more comes than can be served.

    Args:
        servers: c.
        offered: arrivals a second times the mean service, so that the utilisation is offered / servers.
    """
    if offered >= servers:
        return 1.0
    blocked = 1.0  # Erlang B, by its recursion
    for i in range(1, servers + 1):
        blocked = offered * blocked / (i + offered * blocked)
    return blocked / (1.0 - offered / servers * (1.0 - blocked))


def waiting_quantile_s(servers: int, rate_per_s: float, service_s: float, quantile: float) -> float:
    """The time in the queue that a share `quantile` of all calls does not exceed in M/M/c; infinite in overload."""
    offered = rate_per_s * service_s
    if offered >= servers:
        return math.inf
    waiting = waiting_probability(servers, offered)
    if waiting <= 1.0 - quantile:
        return 0.0
    return service_s / (servers - offered) * math.log(waiting / (1.0 - quantile))


def latencies_s(servers: int, gaps_s: Floats, services_s: Floats) -> Floats:
    """(N,) time from arrival to the end for calls that take their turn before several servers, the first free one next.

    Args:
        servers: how many.
        gaps_s: (N,) from one arrival to the next.
        services_s: (N,) how long each call computes.
    """
    free_s = [0.0] * servers
    taken = np.empty(len(gaps_s))
    for i, (now_s, service_s) in enumerate(zip(np.cumsum(gaps_s).tolist(), services_s.tolist(), strict=True)):
        end_s = max(free_s[0], now_s) + service_s
        heapq.heapreplace(free_s, end_s)
        taken[i] = end_s - now_s
    return taken


def spread_services(mean_s: float, spread: float, count: int, generator: np.random.Generator) -> Floats:
    """(count,) log-normal services; `spread` is the standard deviation of their logarithm."""
    return mean_s * np.exp(generator.normal(-0.5 * spread**2, spread, count))
