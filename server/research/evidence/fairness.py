"""Fairness of the queue: a fleet beside a neighbour without end, clients of one token, tokens that come back."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from statistics import median
from types import ModuleType

import numpy as np

from mapless_server.scheduling import WorkQueueOptions, admission, expected, failing, shares
from mapless_server.scheduling.shares import MAX_IDLE

from ..lost_robots import FLEET_STEPS_S, SharedCores, beside
from ..neighbours import (
    THREADS,
    admitted_at_once,
    fleet,
    most_booked,
    next_client,
    returning,
)
from .page import Measurement, Row, least, most

SEEDS = 3


def _beside() -> dict[str, object]:
    """The fleet's worst times and answers."""
    p50, p95, answered = [], [], []
    for robots in (1, 4):
        for seed in range(SEEDS):
            alone = fleet(None, robots, seed)
            for ids in ("one", "new"):
                beside = fleet(ids, robots, seed)
                p50.append(median(beside.seconds) / median(alone.seconds))
                p95.append(float(np.quantile(beside.seconds, 0.95) / np.quantile(alone.seconds, 0.95)))
                answered.append(len(beside.seconds) / len(alone.seconds))
    return {
        "fleet's p50": f"{max(p50):.2f}",
        "fleet's p95": f"{max(p95):.2f}",
        "fleet's answers": f"{100 * min(answered):.0f} %",
    }


def _each(module: ModuleType, name: str, values: tuple[float, ...]) -> Iterator[float]:
    """Sets a constant to each of the values, and back."""
    before = getattr(module, name)
    try:
        for value in values:
            setattr(module, name, value)
            yield value
    finally:
        setattr(module, name, before)


def _credit() -> Iterator[Row]:
    cost_s = 0.2
    for value in _each(shares, "CREDIT_S", (0.0, 1.0, 3.0, 10.0, 30.0, 100.0)):
        away = [value * i / (MAX_IDLE - 1) for i in reversed(range(MAX_IDLE))]
        booked = most_booked(away, cost_s) / (THREADS * WorkQueueOptions().max_queued_s)
        waits = {}
        for tokens in (2, 10):
            seeds = [returning(tokens, seed=seed) for seed in range(SEEDS)]
            wait_s, answered = max(it for it, _ in seeds), min(it for _, it in seeds)
            waits[f"beside {tokens} that return"] = f"{wait_s:.1f} s, {100 * answered:.0f} %"
        yield {"credit": f"{value:g} s", **_beside(), **waits, "most booked": f"{booked:.1f} bounds"}


def _lately() -> Iterator[Row]:
    for value in _each(expected, "LATELY_S", (0.0, 0.3, 1.0, 3.0, 10.0)):
        beside = _beside()
        busy_s = np.mean([fleet("new", 4, seed).busy_s for seed in range(SEEDS)])
        yield {"lately": f"{value:g} s", **beside, "computed in all": f"{busy_s:.0f} s"}


def _client_share() -> Iterator[Row]:
    for value in _each(admission, "CLIENT_SHARE", (0.25, 0.5, 0.75, 0.9, 1.0)):
        answered = {f"answered beside {it} busy": f"{100 * next_client(it)[0]:.0f} %" for it in (1, 2, 4, 8)}
        yield {
            "share": f"{value:g}",
            "admitted of one client at once": admitted_at_once(),
            **answered,
            "time computed": f"{100 * next_client(1)[1]:.0f} %",
            "fleet's p50": _beside()["fleet's p50"],
        }


def _times(lost: SharedCores) -> str:
    p50_s, p99_s = np.quantile(lost.seconds, (0.5, 0.99), method="inverted_cdf")
    return f"{p50_s:.2f}, {p99_s:.2f} s"


def _lost(
    module: ModuleType, name: str, values: tuple[float, ...], steps_s: tuple[float, ...] = FLEET_STEPS_S
) -> Iterator[Row]:
    for value in _each(module, name, values):
        row = dict[str, object](value=f"{value:g}")
        worst_s = 0.0
        for seed in range(SEEDS):
            for title, robots in (("alone", 0), ("beside", 8)):
                server = beside(robots, seed=seed, fleet_steps_s=steps_s)
                row[f"{seed}, {title}"] = _times(server)
                if robots:
                    worst_s = max(worst_s, float(np.quantile(server.seconds, 0.99)))
                row["refused"] = server.refused + int(str(row.get("refused", 0)))
        yield row | {"p99 beside, worst": f"{worst_s:.2f} s"}


def _without_scenes(
    rows: Callable[[], Iterator[Row]], decide: Callable[[Sequence[Row]], float] | None = None
) -> Measurement:
    return Measurement(lambda scenes: rows(), decide, needs_scenes=False)


_SHORTER = partial(_lost, expected, "SHORTER", (0.0, 1.0, 1.25, 2.0), (0.33,))
MEASUREMENTS = {
    "queue-credit": _without_scenes(_credit, least("fleet's p95")),
    "queue-lately": _without_scenes(_lately, least("fleet's p50")),
    "queue-failing": _without_scenes(partial(_lost, failing, "MEMORY", (1, 2, 4, 8))),
    "queue-shorter": _without_scenes(_SHORTER, least("p99 beside, worst")),
    "queue-client-share": _without_scenes(_client_share, most("answered beside 4 busy")),
}
