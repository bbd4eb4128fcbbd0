"""Callers whose last photographs failed: whom they wait for, and when they are like others again."""

import numpy as np
import pytest
from support.toy_scheduler import FAR_S, Toy, run_through

from mapless_server.scheduling import Done, Fallback, Flow, Next, Refused, Step
from mapless_server.scheduling.failing import FAILURES, FORGOTTEN_S
from research.lost_robots import beside

LOST, OTHER = Flow("t", "lost"), Flow("t", "other")


def lost(toy: Toy, *callers: Flow) -> None:
    """Lets photographs of callers fail."""
    for caller in callers or (LOST,):
        for _ in range(FAILURES):
            toy.scheduler.failing.answered(caller, False, toy.now_s)


@pytest.mark.parametrize(
    ("answers", "wait_s", "is_failing"),
    [
        ([False], 0.0, True),
        ([False] * 10 + [True], 0.0, False),
        ([True] * 10 + [False], 0.0, False),
        ([True] * 10 + [False] * 3, 0.0, True),
        ([True, False] * 10, 0.0, False),
        ([False] * 10, FORGOTTEN_S + 1, False),
    ],
    ids=["the only one failed", "then localized", "one failed", "became lost", "half of them", "long ago"],
)
def test_a_caller_fails_whose_last_photographs_did(answers: list[bool], wait_s: float, is_failing: bool) -> None:
    """Whatever its clients call themselves."""
    toy = Toy()
    for it in answers:
        toy.scheduler.failing.answered(LOST, it, toy.now_s)
    assert toy.scheduler.failing.is_failing(LOST, toy.now_s + wait_s) == is_failing
    assert toy.scheduler.failing.is_failing(LOST._replace(client="another"), toy.now_s + wait_s) == is_failing
    assert not toy.scheduler.failing.is_failing(OTHER, toy.now_s)


@pytest.mark.parametrize("seed", [0, 1])
def test_lost_robots_leave_a_fleet_its_times(seed: int) -> None:
    """Eight that ask without end beside three that are localized, each with a token."""
    alone, lost = beside(0, seed=seed), beside(8, seed=seed)
    p99_s = [float(np.quantile(it.seconds, 0.99, method="inverted_cdf")) for it in (alone, lost)]
    assert len(lost.seconds) == len(alone.seconds)
    assert p99_s[1] <= 1.5 * p99_s[0]


def test_many_failing_callers_leave_others_their_turns() -> None:
    """Together they are like one more caller: eight of them come every third time beside two others."""
    toy, turns = Toy(), list[str]()
    names = [f"lost {i}" for i in range(8)]
    lost(toy, *(Flow("t", it) for it in names))
    for client in ("one", "two", *names):
        toy.admit(client=client, stage="refine")
    for _ in range(30):
        batch = toy.take("host")
        client = batch.jobs[0].owner.caller
        turns.append(client)
        toy.finish(batch, Done(None))
        toy.admit(client=client, stage="refine")
    assert sum(it.startswith("lost") for it in turns) == pytest.approx(10, abs=2)


def test_low_threads_alone_compute_what_waits_aside() -> None:
    """So that a thread is free for what was admitted, however long a further step takes."""
    toy = Toy(low=1)
    job = toy.admit(stage="refine", client="mine")
    toy.finish(toy.take("host"), Next((Step("prepare", "toy", "b", 0),), Fallback(lambda _: Done(None), FAR_S)))
    assert toy.scheduler.take("host", toy.now_s) is None
    low = toy.take("host", is_low=True)
    assert low.jobs == (job,)
    assert [toy.admit(client=f"other {i}") in toy.take("host").jobs for i in range(2)] == [True, True]
    assert toy.scheduler.take("host", toy.now_s, is_low=True) is None
    toy.finish(low, Done(None))
    assert job.is_over


def test_low_threads_compute_what_failing_callers_ask() -> None:
    """At every stage, and until the deadline."""
    toy = Toy(low=1)
    lost(toy)
    job = toy.admit(client="lost", deadline_s=100.0)
    assert not toy.scheduler.has_work("host")
    toy.finish(toy.take("host", is_low=True), Next((Step("refine", "toy", "b", 0),)))
    assert not toy.scheduler.has_work("host")
    toy.finish(toy.take("host", is_low=True), Done("found"))
    assert [it for it, _ in toy.ends[0]] == ["ok"]
    assert job.owner == LOST


@pytest.mark.parametrize(("others", "later_s", "expected"), [(1, 0.0, True), (0, 0.0, False), (1, 5.0, False)])
def test_a_failing_caller_gets_cheap_steps_while_others_ask(others: int, later_s: float, expected: bool) -> None:
    """Not beside other failing callers alone: each would be cut because of the others, for ever."""
    toy = Toy()
    lost(toy, LOST, Flow("t", "lost too"))
    toy.admit(client="lost")
    toy.admit(client="lost too")
    for _ in range(others):
        job = toy.admit(client="other")
        if later_s:
            toy.scheduler.cancel(job, toy.now_s)
    assert toy.scheduler.gets_cheap_steps(LOST, toy.now_s + later_s) == expected
    assert not toy.scheduler.gets_cheap_steps(OTHER, toy.now_s)


def test_a_refused_job_is_its_callers_again() -> None:
    """If a photograph of the caller was localized meanwhile."""
    toy = Toy()
    toy.fill("lost")
    lost(toy)
    toy.fill("lost")
    job = toy.job(client="lost")
    with pytest.raises(Refused):
        toy.scheduler.admit(job, toy.now_s)
    assert job.flow != LOST
    toy.scheduler.failing.answered(LOST, True, toy.now_s)
    run_through(toy)
    toy.scheduler.admit(job, toy.now_s)
    assert (job.owner, job.flow) == (LOST, LOST)
