"""Fairness of the queue: a fleet beside a neighbour without end, clients of one token, tokens that come back."""

from collections.abc import Iterator
from statistics import median
from types import ModuleType

import numpy as np

from mapless_server.scheduling import WorkQueueOptions, admission, expected, failing, shares
from mapless_server.scheduling.shares import MAX_IDLE

from ..lost_robots import FLEET_STEPS_S, SharedCores, beside
from ..neighbours import (
    ATTEMPT_S,
    ATTEMPTS,
    FLEET_S,
    FOREIGN_S,
    NEIGHBOURS_CALLS,
    SECONDS,
    SHARE,
    THREADS,
    admitted_at_once,
    fleet,
    most_booked,
    next_client,
    returning,
)
from .page import Question, Row

SEEDS = 3
_LOST = (
    f"`research.lost_robots`: the server's own queue on a virtual clock, 2 cores, 2 threads and 2 of low priority, "
    f"120 s, {SEEDS} seeds. Three robots, each with a token, ask at random times, 2.2 a second together (0.31 s each); "
    "beside them eight lost robots ask without end, each with a token, photographs of another place (0.6 s, and "
    "further steps of 8.7 s). Median and 99th percentile of the fleet's times, for each seed alone and beside the lost "
    "ones, and how many of its calls were refused."
)
_FLEET = (
    f"`research.neighbours`: the server's own queue on a virtual clock, {THREADS} threads, {SECONDS:g} s, {SEEDS} "
    f"seeds, the worst of which counts. A fleet of one and of four robots asks at random times for {100 * SHARE:g} "
    f"% of the time ({FLEET_S} s each); a neighbour with another token has always {NEIGHBOURS_CALLS} calls of "
    f"photographs from another place ({FOREIGN_S} s, and up to {ATTEMPTS} attempts of {ATTEMPT_S} s), with one "
    "client id or a new one for each. The fleet's times are beside the neighbour over alone; the bar is 1.5 for the "
    "median, and 90 % of the answers."
)


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
            wait_s, answered = returning(tokens)
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


QUESTIONS = {
    "queue-credit": (
        Question(
            "queue-credit",
            "mapless_server.scheduling.shares:CREDIT_S",
            "A caller that has used less than its share comes first when it comes again. For how much computing time?",
            _FLEET + f" Beside others that return: the longest wait, and the calls answered, of a token with two "
            "calls a second when 2 or 10 tokens that had asked once and were away for a minute ask without end, "
            f"beside another that always did. The most that is booked is that of {MAX_IDLE} tokens, of which as "
            "many are remembered, with credits in equal steps, when each asks until it is refused, the one with the "
            "least credit first; 1 bound is what the queue of one caller holds.",
            "10 s. With less the fleet's 95th percentile is longer; 30 s are no better for it. With 100 s two tokens "
            "that return keep a regular one waiting for ten seconds, and ten leave it half of its answers. The most "
            "that can be booked grows with it: the tokens would need histories that are made for it, and equal ones "
            "book less than 3 bounds.",
        ),
        _credit,
    ),
    "queue-lately": (
        Question(
            "queue-lately",
            "mapless_server.scheduling.expected:LATELY_S",
            "Steps of a caller leave one thread to those who come before it, if these have asked lately. How lately?",
            _FLEET + " What is computed in all shows what threads that are left idle cost.",
            "1 s. Without it (0) the fleet waits for the neighbour's steps; longer does not help it, and leaves a "
            "thread idle that the neighbour could use. It is four times the fleet's mean time between calls.",
        ),
        _lately,
    ),
    "queue-failing": (
        Question(
            "queue-failing",
            "mapless_server.scheduling.failing:MEMORY",
            "A caller waits for the others if its last photograph failed, and most of its last ones. Of how many?",
            _LOST,
            "4. All keep the fleet's times: a new caller that is lost waits from its second photograph on. With 1 "
            "a token of many robots would wait after each photograph that fails; with 4 half of them may fail. With "
            "more, a robot that becomes lost delays the others for longer.",
        ),
        lambda: _lost(failing, "MEMORY", (1, 2, 4, 8)),
    ),
    "queue-shorter": (
        Question(
            "queue-shorter",
            "mapless_server.scheduling.expected:SHORTER",
            "Steps of a caller leave one thread to those who come before it and need less time. How much less?",
            _LOST + " Here the fleet's photographs are a single step of 0.33 s.",
            "1.25. Without a bound (0) a robot's step leaves a thread idle for another robot of its fleet, which takes "
            "as long, and the fleet waits for itself. Predictions of equal steps differ by some per cent, so that 1 is "
            "too little where they vary; beyond 1.25 nothing is gained.",
        ),
        lambda: _lost(expected, "SHORTER", (0.0, 1.0, 1.25, 2.0), (0.33,)),
    ),
    "queue-client-share": (
        Question(
            "queue-client-share",
            "mapless_server.scheduling.admission:CLIENT_SHARE",
            "How much of what a caller may book may one of its clients book?",
            f"The same queue. One token with 1, 2, 4 or 8 busy clients, each with 64 calls of {FLEET_S} s without "
            "end, and a further client with one call a second: how many of its calls are answered. How many of 64 "
            "calls of a token's only client are admitted at once. The time computed is that with one busy client. "
            + _FLEET,
            "0.75. With 1 the first client leaves nothing to the next. 0.75 leaves room beside four busy clients of "
            "one token, and little beside eight, as 0.5 would; but it admits more of a token's only client, which "
            "is the usual one: an import, or a batch with many calls at a time. Clients that need more have tokens "
            "of their own. The share does not matter for throughput, nor for other tokens.",
        ),
        _client_share,
    ),
}


def _times(lost: SharedCores) -> str:
    p50_s, p99_s = np.quantile(lost.seconds, (0.5, 0.99), method="inverted_cdf")
    return f"{p50_s:.2f}, {p99_s:.2f} s"


def _lost(
    module: ModuleType, name: str, values: tuple[float, ...], steps_s: tuple[float, ...] = FLEET_STEPS_S
) -> Iterator[Row]:
    for value in _each(module, name, values):
        row = dict[str, object](value=f"{value:g}")
        for seed in range(SEEDS):
            for title, robots in (("alone", 0), ("beside", 8)):
                server = beside(robots, seed=seed, fleet_steps_s=steps_s)
                row[f"{seed}, {title}"] = _times(server)
                row["refused"] = server.refused + int(str(row.get("refused", 0)))
        yield row


def measure(key: str, scenes: object) -> tuple[Question, Iterator[Row]]:
    """The question of a key, and its rows as they are measured; no photographs are needed."""
    question, rows = QUESTIONS[key]
    return question, rows()
