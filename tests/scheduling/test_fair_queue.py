"""Fair queueing: shares are equal whatever is sent, tenants before callers before clients, and nobody starves."""

import itertools
from collections import Counter
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapless_server.scheduling import Flow
from mapless_server.scheduling.expected import LATELY_S, MUCH_SHORTER, SHORTER, Expected
from mapless_server.scheduling.fair_queue import FairQueue
from mapless_server.scheduling.shares import CREDIT_S, MAX_IDLE, Shares

COSTS = st.floats(0.01, 3.0)


class Waiting:
    """A queue of jobs with names, each of which leaves the server when it is chosen."""

    def __init__(self) -> None:
        self.shares = Shares()
        self.queue: FairQueue[Any] = FairQueue(self.shares)
        self._costs_s: dict[Any, float] = {}
        self._flows: dict[Any, Flow] = {}

    def push(self, job: Any, flow: Flow, cost_s: float) -> None:
        self.shares.enter(flow)
        self.queue.push(job, flow, cost_s)
        self._costs_s[job], self._flows[job] = cost_s, flow

    def pop(self) -> Any:
        job = self.queue.pop(lambda job: self.shares.charge(self._flows[job], self._costs_s[job]))
        self.shares.leave(self._flows[job])
        return job

    def remove(self, job: Any) -> None:
        self.queue.remove(job)
        self.shares.leave(self._flows[job])

    def served(self, count: int) -> list[Any]:
        return [self.pop() for _ in range(count)]


def size_of(member: Any) -> int:
    """Number of members below one."""
    below = [*member.active.values(), *member.idle.values()]
    return len(below) + sum(map(size_of, below))


def test_a_hundred_requests_of_one_do_not_delay_another() -> None:
    waiting = Waiting()
    for i in range(100):
        waiting.push(f"many {i}", Flow("t", "many"), 1.0)
    assert waiting.served(3) == ["many 0", "many 1", "many 2"]
    waiting.push("one", Flow("t", "one"), 1.0)
    assert "one" in waiting.served(2)


def test_tenants_share_equally_however_many_clients_they_have() -> None:
    waiting = Waiting()
    for i in range(100):
        waiting.push(f"a {i}", Flow("a", "only"), 1.0)
        waiting.push(f"b {i}", Flow("b", f"client {i % 4}"), 1.0)
    counts = Counter(name.split()[0] for name in waiting.served(60))
    assert abs(counts["a"] - counts["b"]) <= 1


@given(
    st.dictionaries(st.integers(0, 4), st.lists(COSTS, min_size=1, max_size=30), min_size=2, max_size=5),
    st.integers(1, 60),
)
def test_two_waiting_callers_differ_by_one_job_of_each(costs: dict[int, list[float]], count: int) -> None:
    waiting = Waiting()
    for flow, of_flow in costs.items():
        for i, cost_s in enumerate(of_flow):
            waiting.push((flow, i), Flow("t", str(flow)), cost_s)
    got: Counter[int] = Counter()
    for _ in range(min(count, len(waiting.queue))):
        flow, i = waiting.pop()
        got[flow] += costs[flow][i]
        if i + 1 == len(costs[flow]):
            return  # from here on not all of them wait
        most = max(max(it) for it in costs.values())
        assert max(got[it] for it in costs) - min(got[it] for it in costs) <= most + 1e-9


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 2), COSTS), max_size=40), st.data())
def test_everything_comes_out_exactly_once(pushed: list[tuple[int, int, float]], data: st.DataObject) -> None:
    waiting = Waiting()
    for job, (tenant, client, cost_s) in enumerate(pushed):
        waiting.push(job, Flow(str(tenant), "token", str(client)), cost_s)
    out: list[int] = []
    while waiting.queue:
        if data.draw(st.booleans()):
            out.append(data.draw(st.sampled_from(sorted(waiting.queue))))
            waiting.remove(out[-1])
        else:
            out.append(waiting.pop())
        waiting_s = sum(cost_s for job, (_, _, cost_s) in enumerate(pushed) if job not in out)
        assert waiting.queue.cost_s == pytest.approx(waiting_s, abs=1e-6)
    assert sorted(out) == list(range(len(pushed)))


@pytest.mark.parametrize("count", [1, 8, 200])
def test_new_clients_of_a_caller_divide_its_share_alone(count: int) -> None:
    """Whether they all wait at once, or come one after the other with each call."""
    waiting = Waiting()
    for i in range(count):
        waiting.push(f"many {i}", Flow("t", "many", f"id {i}"), 1.0)
    for i in range(300):
        waiting.push(f"one {i}", Flow("t", "one", "robot"), 0.1)
    got: Counter[str] = Counter()
    for i in range(count, count + 60):
        job = waiting.pop()
        got[job.split()[0]] += 1 if job.startswith("many") else 0.1  # type: ignore[assignment]  # not int
        if job.startswith("many"):
            waiting.push(f"many {i}", Flow("t", "many", f"id {i}"), 1.0)
    assert abs(got["many"] - got["one"]) <= 1 + 1e-9


def test_clients_of_one_caller_share_equally() -> None:
    waiting = Waiting()
    for i in range(60):
        for client in ("a", "b", "c"):
            waiting.push(f"{client} {i}", Flow("t", "token", client), 1.0)
            waiting.push(f"other {client} {i}", Flow("t", "other", "only"), 1.0)
    assert Counter(it.split()[0] for it in waiting.served(60)) == {"a": 10, "b": 10, "c": 10, "other": 30}


def test_ever_new_callers_do_not_keep_an_old_one_waiting() -> None:
    """As on a server without tokens, where an id or a connection is a caller."""
    waiting = Waiting()
    for i in range(20):
        waiting.push(f"old {i}", Flow("t", "old"), 1.0)
    for i in range(8):
        waiting.push(f"new {i}", Flow("t", f"new {i}"), 1.0)
    order = []
    for i in range(8, 88):
        order.append(waiting.pop().split()[0])
        if order[-1] == "new":
            waiting.push(f"new {i}", Flow("t", f"new {i}"), 1.0)
    assert order.count("old") >= 80 / 9 - 2


def test_who_uses_less_than_its_share_comes_first_and_not_for_ever() -> None:
    waiting = Waiting()
    for i in range(60):
        waiting.push(f"greedy {i}", Flow("t", "greedy"), 1.0)
        if i % 4 == 0:
            waiting.push(f"modest {i}", Flow("t", "modest"), 1.0)
            waiting.served(2)
        else:
            waiting.served(1)
    for i in range(60):
        waiting.push(f"greedy again {i}", Flow("t", "greedy"), 1.0)
        waiting.push(f"modest again {i}", Flow("t", "modest"), 1.0)
    order = [job.split()[0] for job in waiting.served(60)]
    assert order[: int(CREDIT_S)] == ["modest"] * int(CREDIT_S)
    assert 20 <= order.count("greedy") <= 30


def test_callers_of_one_job_leave_little_state() -> None:
    """Each connection is a caller, and there is no end of them."""
    waiting = Waiting()
    for job in range(12):
        waiting.push(job, Flow("t", str(job)), 3.0)
    for job in range(12, 2000):
        waiting.pop()
        waiting.push(job, Flow("t", str(job)), 3.0)
        assert size_of(waiting.shares._all) <= 1 + 2 * (len(waiting.queue) + MAX_IDLE)  # the tenant; caller, client
    for _ in range(12):
        waiting.pop()


def test_the_next_step_of_a_long_job_waits_until_others_had_as_much() -> None:
    waiting = Waiting()
    order = []
    for i in range(40):
        waiting.push(f"short {i}", Flow("t", "short"), 0.1)
    waiting.push("long", Flow("t", "long"), 1.0)
    for _ in range(40):
        order.append(waiting.pop())
        if order[-1] == "long":
            waiting.push("long", Flow("t", "long"), 1.0)
    steps = [i for i, job in enumerate(order) if job == "long"]
    assert all(9 <= later - step <= 13 for step, later in itertools.pairwise(steps))


def test_a_prediction_is_corrected_when_the_step_has_ended() -> None:
    shares, one, other = Shares(), Flow("t", "one"), Flow("t", "other")
    for flow in (one, other):
        shares.enter(flow)
    for flow in (one, other):
        shares.charge(flow, 1.0)
    shares.charge(one, 4.0)
    assert shares.lead_s(one, other) == pytest.approx(4.0)
    assert sorted((one, other), key=shares.turn) == [other, one]


@settings(deadline=None)
@given(
    entered=st.lists(st.tuples(st.sampled_from("tu"), st.sampled_from("abc"), st.sampled_from("xy")), max_size=12),
    charged=st.lists(st.tuples(st.integers(0, 11), st.sampled_from([0.5, 1.0, 2.0])), max_size=12),
    arrivals=st.lists(st.tuples(st.integers(0, 17), st.sampled_from([0.1, 0.3, 1.0]), st.floats(0, 3)), max_size=8),
    step_s=st.sampled_from([0.2, 0.5, 2.0]),
)
def test_what_is_expected_is_that_of_the_plain_search(
    entered: list[tuple[str, str, str]],
    charged: list[tuple[int, float]],
    arrivals: list[tuple[int, float, float]],
    step_s: float,
) -> None:
    shares, now_s = Shares(), 3.0
    for it in entered:
        shares.enter(Flow(*it))
    for index, seconds in charged:
        if index < len(entered):
            shares.charge(Flow(*entered[index]), seconds)
    every = [Flow(tenant, caller, "z") for tenant in "tuv" for caller in "abc" for _ in "12"]
    came = [(every[index], its_s, came_s) for index, its_s, came_s in arrivals]
    expected = Expected(came, shares, now_s)
    for flow in set(every):
        others = [it for it in came if it[0].group != flow.group]
        is_shorter = [MUCH_SHORTER * its_s <= step_s and now_s - came_s <= step_s for _, its_s, came_s in others]
        lately = [it for it in others if now_s - it[2] <= LATELY_S and SHORTER * it[1] <= step_s]
        is_first = [shares.lead_s(flow, it) > 0 for it, _, _ in lately]
        assert expected.shorter(flow, step_s) == any(is_shorter)
        assert expected.first(flow, step_s) == any(is_first)
