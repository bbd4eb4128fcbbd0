"""Fair queueing: shares are equal whatever is sent, tenants before callers before clients, and nobody starves."""

import itertools
from collections import Counter
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapless_server.scheduling import Flow
from mapless_server.scheduling.fair_queue import MAX_DEBTORS, FairQueue

COSTS = st.floats(0.01, 3.0)


def served(queue: FairQueue[str], count: int) -> list[str]:
    return [queue.pop() for _ in range(count)]


def size_of(group: Any) -> int:
    """Number of groups below one."""
    below = [*group.waiting.values(), *group.idle.values()]
    return len(below) + sum(map(size_of, below))


def test_a_hundred_requests_of_one_do_not_delay_another() -> None:
    queue: FairQueue[str] = FairQueue()
    for i in range(100):
        queue.push(f"many {i}", Flow("t", "many"), 1.0)
    assert served(queue, 3) == ["many 0", "many 1", "many 2"]
    queue.push("one", Flow("t", "one"), 1.0)
    assert "one" in served(queue, 2)


def test_tenants_share_equally_however_many_clients_they_have() -> None:
    queue: FairQueue[str] = FairQueue()
    for i in range(100):
        queue.push(f"a {i}", Flow("a", "only"), 1.0)
        queue.push(f"b {i}", Flow("b", f"client {i % 4}"), 1.0)
    counts = Counter(name.split()[0] for name in served(queue, 60))
    assert abs(counts["a"] - counts["b"]) <= 8


@given(
    st.dictionaries(st.integers(0, 4), st.lists(COSTS, min_size=1, max_size=30), min_size=2, max_size=5),
    st.integers(1, 60),
)
def test_two_waiting_callers_differ_by_one_job_of_each(costs: dict[int, list[float]], count: int) -> None:
    queue: FairQueue[tuple[int, int]] = FairQueue()
    for flow, of_flow in costs.items():
        for i, cost_s in enumerate(of_flow):
            queue.push((flow, i), Flow("t", str(flow)), cost_s)
    got: Counter[int] = Counter()
    for _ in range(min(count, len(queue))):
        flow, i = queue.pop()
        got[flow] += costs[flow][i]  # type: ignore[assignment]
        if i + 1 == len(costs[flow]):
            return  # from here on not all of them wait
        most = max(max(it) for it in costs.values())
        assert max(got[it] for it in costs) - min(got[it] for it in costs) <= most + 1e-9


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 2), COSTS), max_size=40), st.data())
def test_everything_comes_out_exactly_once(pushed: list[tuple[int, int, float]], data: st.DataObject) -> None:
    queue: FairQueue[int] = FairQueue()
    for job, (tenant, client, cost_s) in enumerate(pushed):
        queue.push(job, Flow(str(tenant), str(client)), cost_s)
    out: list[int] = []
    while queue:
        how = data.draw(st.sampled_from(["pop", "along", "remove"]))
        if how == "remove":
            out.append(data.draw(st.sampled_from(sorted(queue))))
            queue.remove(out[-1])
            continue
        out.append(queue.pop())
        if how == "along":
            parity, at_most = out[-1] % 2, data.draw(st.integers(0, 3))
            along = queue.pop_alike(lambda job: job % 2 == parity, at_most)  # noqa: B023
            assert len(along) <= at_most
            assert all(job % 2 == parity for job in along)
            out += along
        waiting_s = sum(cost_s for job, (_, _, cost_s) in enumerate(pushed) if job not in out)
        assert queue.cost_s == pytest.approx(waiting_s, abs=1e-6)
    assert sorted(out) == list(range(len(pushed)))


def test_new_clients_of_a_caller_divide_its_share_alone() -> None:
    """Whether they all wait at once, or come one after the other with each call."""
    for waiting in (1, 8, 200):
        queue: FairQueue[str] = FairQueue()
        for i in range(waiting):
            queue.push(f"many {i}", Flow("t", "many", f"id {i}"), 1.0)
        for i in range(300):
            queue.push(f"one {i}", Flow("t", "one", "robot"), 0.1)
        got: Counter[str] = Counter()
        for i in range(waiting, waiting + 60):
            job = queue.pop()
            got[job.split()[0]] += 1 if job.startswith("many") else 0.1  # type: ignore[assignment]
            if job.startswith("many"):
                queue.push(f"many {i}", Flow("t", "many", f"id {i}"), 1.0)
        assert abs(got["many"] - got["one"]) <= 1 + 1e-9


def test_clients_of_one_caller_share_equally() -> None:
    queue: FairQueue[str] = FairQueue()
    for i in range(60):
        for client in ("a", "b", "c"):
            queue.push(f"{client} {i}", Flow("t", "token", client), 1.0)
            queue.push(f"other {client} {i}", Flow("t", "other", "only"), 1.0)
    assert Counter(it.split()[0] for it in served(queue, 60)) == {"a": 10, "b": 10, "c": 10, "other": 30}


def test_callers_of_one_job_leave_little_state() -> None:
    """Each connection is a caller, and there is no end of them."""
    queue: FairQueue[int] = FairQueue()
    for job in range(12):
        queue.push(job, Flow("t", str(job)), 3.0)
    for job in range(12, 2000):
        queue.pop()
        queue.push(job, Flow("t", str(job)), 3.0)
        assert size_of(queue._all) <= 1 + 2 * (len(queue) + MAX_DEBTORS)  # the tenant; each caller with its client
    for _ in range(12):
        queue.pop()


def test_the_next_step_of_a_long_job_waits_until_others_had_as_much() -> None:
    queue: FairQueue[str] = FairQueue()
    order = []
    for i in range(40):
        queue.push(f"short {i}", Flow("t", "short"), 0.1)
    queue.push("long", Flow("t", "long"), 1.0)
    for _ in range(40):
        order.append(queue.pop())
        if order[-1] == "long":
            queue.push("long", Flow("t", "long"), 1.0)
    steps = [i for i, job in enumerate(order) if job == "long"]
    assert all(9 <= later - step <= 13 for step, later in itertools.pairwise(steps))


def test_a_job_taken_into_a_batch_early_is_charged_later() -> None:
    queue: FairQueue[str] = FairQueue()
    for i in range(20):
        queue.push(f"a {i}", Flow("t", "a"), 1.0)
        queue.push(f"b {i}", Flow("t", "b"), 1.0)
    first = queue.pop()
    along = queue.pop_alike(lambda job: job.startswith("a"), 4)
    assert first.startswith("a")
    assert len(along) == 4
    assert Counter(name[0] for name in served(queue, 6)) == {"b": 5, "a": 1}
