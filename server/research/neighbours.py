"""A fleet beside a neighbour that asks without end, in the server's own queue on a virtual clock.

Threads compute what the scheduler selects; nothing waits in real time, so that a minute takes part of a second.
"""

import heapq
import itertools
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from mapless_server.scheduling import (
    AnyJob,
    AnyResult,
    Done,
    Ending,
    Fallback,
    Flow,
    Job,
    Next,
    Observer,
    Refused,
    Stage,
    Step,
    WorkQueueOptions,
)
from mapless_server.scheduling.admission import Admission, Ledger
from mapless_server.scheduling.jobs import Batch
from mapless_server.scheduling.scheduler import Scheduler
from mapless_server.scheduling.shares import Shares

THREADS = 2
FLEET_S, FOREIGN_S, ATTEMPT_S, ATTEMPTS = 0.2, 0.3, 0.6, 6
"""A photograph of the fleet; one of another place, and the steps by which it is tried again."""
SHARE, SECONDS, DEADLINE_S = 0.4, 60.0, 30.0
NEIGHBOURS_CALLS = 8

Ended = Callable[[Ending | Refused, float], None]
"""Receives how a call ended, and its seconds."""


@dataclass
class Server:
    """Computes on threads of a virtual clock; events are (time, number, what to do)."""

    now_s: float = 0.0
    busy_s: float = 0.0
    events: list[tuple[float, int, Callable[[], None]]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._numbers = itertools.count()
        self.scheduler = Scheduler([Stage("work", "host")], {"host": THREADS}, WorkQueueOptions(), Observer())

    def at(self, time_s: float, do: Callable[[], None]) -> None:
        """Does something at a time."""
        heapq.heappush(self.events, (time_s, next(self._numbers), do))

    def run(self, until_s: float = np.inf) -> None:
        """Computes until there are no events, or to a time."""
        while self.events and self.events[0][0] <= until_s:
            self.now_s, _, do = heapq.heappop(self.events)
            do()
            self.scheduler.expire(self.now_s)
            while (batch := self.scheduler.take("host", self.now_s)) is not None:
                seconds = batch.jobs[0].step.payload
                self.busy_s += seconds
                self.at(self.now_s + seconds, partial(self._finish, batch))

    def _finish(self, batch: Batch) -> None:
        (job,) = batch.jobs
        left = int(job.step.bucket)
        result: AnyResult = Done(None)
        if left:
            fallback = Fallback[object, None](lambda _: Done(None, Ending.LOW_CONFIDENCE), job.deadline_s - 1)
            result = Next((Step("work", "again", str(left - 1), ATTEMPT_S),), fallback)
        self.scheduler.finish(batch, [result], self.now_s)

    def ask(self, flow: Flow, kind: str, seconds: float, then: Ended, attempts: int = 0) -> None:
        """Makes a call of so many seconds, and so many further attempts."""
        begin_s = self.now_s
        step = Step("work", kind, str(attempts), seconds)
        job: AnyJob = Job(flow, step, self.now_s + DEADLINE_S, 1, lambda ending, _: then(ending, self.now_s - begin_s))
        try:
            self.scheduler.admit(job, self.now_s)
        except Refused as refused:
            then(refused, 0.0)

    def ask_without_end(self, flows: Iterator[Flow], kind: str, seconds: float, attempts: int, until_s: float) -> None:
        """Makes a call, and the next when it has ended, or when the server says after a refusal."""
        if self.now_s > until_s:
            return

        def then(ending: Ending | Refused, _: float) -> None:
            wait_s = (ending.retry_after_s or 0.1) if isinstance(ending, Refused) else 0.0
            self.at(self.now_s + wait_s, lambda: self.ask_without_end(flows, kind, seconds, attempts, until_s))

        self.ask(next(flows), kind, seconds, then, attempts)


@dataclass
class Answers:
    """The seconds of the answers of regular callers, how many calls were refused or late, and the server's time."""

    seconds: list[float] = field(default_factory=list)
    failed: int = 0
    busy_s: float = 0.0

    def count(self, ending: Ending | Refused, seconds: float) -> None:
        """Counts a call's end."""
        if ending is Ending.OK:
            self.seconds.append(seconds)
        else:
            self.failed += 1


def fleet(ids: str | None, robots: int, seed: int = 0) -> Answers:
    """A fleet's calls at 40 % of what the server can do; `ids` of a neighbour are "one", "new", or None without one."""
    server, random, answers = Server(), np.random.default_rng(seed), Answers()

    def ask(robot: str) -> None:
        server.ask(Flow("t", "fleet", robot), "fleet", FLEET_S, answers.count)

    rate_per_s = SHARE * THREADS / FLEET_S
    for at_s in np.sort(random.uniform(0, SECONDS, int(rate_per_s * SECONDS))).tolist():
        server.at(at_s, partial(ask, f"robot-{random.integers(robots)}"))
    if ids is not None:
        flows = (Flow("t", "neighbour", f"{i if ids == 'new' else 0}") for i in itertools.count())
        for _ in range(NEIGHBOURS_CALLS):
            server.at(0.0, partial(server.ask_without_end, flows, "foreign", FOREIGN_S, ATTEMPTS, SECONDS))
    server.run()
    answers.busy_s = server.busy_s
    return answers


def returning(tokens: int, calls: int = 4, seed: int = 0) -> tuple[float, float]:
    """The longest wait, seconds, and the share answered, of a token's calls when others that were away ask at once.

    They have each asked once before, and ask without end after a minute, in which it asked regularly and another one
    always.
    """
    server, answers = Server(), Answers()
    random = np.random.default_rng(seed)
    for i in range(tokens):
        server.at(0.1 * i, partial(server.ask, Flow("t", f"away-{i}"), "fleet", FLEET_S, lambda ending, seconds: None))
    begin_s = 0.1 * tokens
    back_s = begin_s + SECONDS
    for at_s in np.sort(random.uniform(begin_s, back_s + SECONDS, int(2 * SECONDS))).tolist():
        server.at(at_s, partial(server.ask, Flow("t", "regular"), "fleet", FLEET_S, answers.count))
    busy = itertools.repeat(Flow("t", "busy"))
    for _ in range(NEIGHBOURS_CALLS):
        server.at(begin_s, partial(server.ask_without_end, busy, "fleet", FLEET_S, 0, back_s + SECONDS))
    for i in range(tokens):
        for _ in range(calls):
            them = itertools.repeat(Flow("t", f"away-{i}"))
            server.at(back_s, partial(server.ask_without_end, them, "fleet", FLEET_S, 0, back_s + SECONDS))
    server.run()
    return max(answers.seconds), len(answers.seconds) / (len(answers.seconds) + answers.failed)


def next_client(busy: int, calls: int = 24) -> tuple[float, float]:
    """Share of a client's calls that are answered beside busy clients of its token, and the share of time computed.

    It makes one call a second; each busy one makes so many at a time without end.
    """
    server, answers = Server(), Answers()
    for i in range(busy):
        flows = itertools.repeat(Flow("t", "token", f"busy-{i}"))
        for _ in range(calls):
            server.at(i, partial(server.ask_without_end, flows, "fleet", FLEET_S, 0, SECONDS))
    for at_s in range(busy + 1, int(SECONDS)):
        server.at(at_s + 0.05, partial(server.ask, Flow("t", "token", "next"), "fleet", FLEET_S, answers.count))
    server.run()
    return len(answers.seconds) / (len(answers.seconds) + answers.failed), server.busy_s / (THREADS * server.now_s)


def admitted_at_once(calls: int = 64) -> int:
    """How many calls of a token's only client are admitted before the first refusal."""
    server = Server()
    refused: list[float] = []
    for _ in range(calls):
        server.ask(Flow("t", "token", "only"), "fleet", FLEET_S, lambda ending, seconds: refused.append(seconds))
    return calls - len(refused)


def longest_wait(tokens: int, seconds: float = 20.0) -> float:
    """The longest time from admission to answer, where so many tokens have one call each without end."""
    server, longest = Server(), [0.0]

    def ask(flow: Flow) -> None:
        if server.now_s > seconds:
            return

        def then(ending: Ending | Refused, took_s: float) -> None:
            wait_s = 0.0
            if isinstance(ending, Refused):
                wait_s = ending.retry_after_s or 0.1
            else:
                longest[0] = max(longest[0], took_s)
            server.at(server.now_s + wait_s, partial(ask, flow))

        server.ask(flow, "fleet", FLEET_S, then)

    for i in range(tokens):
        server.at(0.0, partial(ask, Flow("t", f"token-{i}")))
    server.run()
    return longest[0]


def most_booked(given_s: Sequence[float], cost_s: float, in_turns: bool = False) -> float:
    """Computing time booked when all of some tokens ask until they are refused, one after the other or in turns.

    Each has been given so much computing time before, and another token that is active as much as the most of them.
    """
    shares = Shares()
    ledger = Ledger(shares)
    admission = Admission(WorkQueueOptions(), {"host": THREADS}, ledger)
    cost = Counter[str]({"host": cost_s})
    flows = [Flow("t", f"token-{i}") for i in range(len(given_s))]
    for flow in flows:
        shares.enter(flow)
    for flow, seconds in zip(flows, given_s, strict=True):
        shares.charge(flow, seconds)
    for flow in flows:
        shares.leave(flow)
    active = Flow("t", "active")
    shares.enter(active)
    shares.charge(active, max(given_s))

    def is_admitted(flow: Flow) -> bool:
        job: AnyJob = Job(flow, Step("work", "any", "0", cost_s), np.inf, 1, lambda ending, value: None)
        try:
            admission.check(job, cost, 0.0)
        except Refused:
            return False
        ledger.open(job, admission.bookable(cost))
        return True

    if not in_turns:
        for flow in flows:
            while is_admitted(flow):
                pass
    while in_turns and (flows := [it for it in flows if is_admitted(it)]):
        pass
    return ledger.booked_s("host")
