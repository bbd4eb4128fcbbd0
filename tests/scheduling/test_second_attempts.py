"""Further steps, which jobs were not admitted with, such as second attempts: when they are computed."""

import pytest
from support.toy_scheduler import FAR_S, Toy, run_through

from mapless_server.scheduling import AnyJob, Done, Ending, Fallback, Next, Refusal, Step


def again(toy: Toy, kind: str, others: int, due_s: float = 150.0) -> AnyJob:
    """A job that needs more than it was admitted with, as when stronger features are to be tried."""
    toy.learn("prepare", "slow", 50.0)
    job = toy.admit(stage="refine", client="mine", deadline_s=200.0)
    for i in range(others):
        toy.admit(client=f"other {i}")
    step = Step("prepare", kind, "b", "again")
    toy.finish(toy.take("host"), Next((step,), Fallback(lambda _: Done("first"), due_s)))
    return job


@pytest.mark.parametrize(
    ("kind", "others", "is_last"), [("toy", 0, False), ("toy", 6, True), ("slow", 0, False), ("slow", 1, True)]
)
def test_a_further_step_waits_for_an_idle_thread(kind: str, others: int, is_last: bool) -> None:
    """Whatever it costs, and whatever room there is."""
    toy = Toy()
    job = again(toy, kind, others)
    assert (toy.ending_of(job), bool(job.booked_s)) == (None, False)
    order = []
    while toy.scheduler.has_work("host"):
        batch = toy.take("host")
        order += [*batch.jobs]
        toy.finish(batch, *(Done(None) for _ in batch.jobs))
    assert order[-1 if is_last else 0] is job
    assert (job.begins_until_s, toy.ending_of(job)) == (None, Ending.OK)


def test_further_steps_together_have_the_share_of_one_caller() -> None:
    """However many callers they have, beside one whose jobs never end."""
    toy, asides = Toy(), list[bool]()
    for i in range(20):
        toy.admit(stage="refine", client=f"doubtful {i}")
        toy.finish(toy.take("host"), Next((Step("prepare", "toy", "b", i),), Fallback(lambda _: Done(None), FAR_S)))
    while len(asides) < 20:
        toy.fill("busy")
        batch = toy.take("host")
        asides.append(batch.jobs[0].is_aside)
        toy.finish(batch, Done(None))
    assert sum(asides) == 7


def test_a_further_step_is_charged_to_its_caller_too() -> None:
    """Who has been given more than another by further steps waits longer with the next job, as for any step."""
    toy = Toy()
    for client in ("other", "mine"):  # so that they have begun alike
        toy.admit(client=client)
    run_through(toy)
    job = toy.admit(stage="refine", client="mine")
    toy.finish(toy.take("host"), Next((Step("prepare", "toy", "b", 0),), Fallback(lambda _: Done(None), FAR_S)))
    toy.finish(toy.take("host"), Done(None))
    assert job.is_over
    toy.admit(stage="refine", client="other")
    toy.finish(toy.take("host"), Done(None))
    mine, other = toy.admit(client="mine"), toy.admit(client="other")
    assert [toy.take("host").jobs[0] for _ in range(2)] == [other, mine]


def test_a_step_beyond_the_bounds_takes_no_room() -> None:
    """Jobs that wait for an idle thread neither reduce admission nor ask for more servers."""
    toy, without = Toy(), Toy()
    again(toy, "toy", 6)
    without.admit(stage="refine", client="mine")
    for i in range(6):
        without.admit(client=f"other {i}")
    without.finish(without.take("host"), Done(None))
    load, its_load = toy.scheduler.load("prepare"), without.scheduler.load("prepare")
    assert load == its_load._replace(waiting=its_load.waiting + 1)
    for it in (toy, without):
        it.fill()
    assert toy.observer.admissions == without.observer.admissions


def test_what_waits_for_an_idle_thread_is_no_job_of_its_caller() -> None:
    """The client's next job is admitted like a first one, which needs no more than its turn among the others' jobs."""
    toy = Toy()
    job = again(toy, "slow", 4)
    toy.admit(client="other 0")
    mine = toy.admit(client="mine")
    assert "this caller's jobs in it: 1" in str(toy.refusal(client="mine"))
    toy.scheduler.cancel(mine, toy.now_s)
    toy.scheduler.cancel(job, toy.now_s)
    run_through(toy)
    assert not toy.scheduler.jobs
    assert toy.scheduler.backlog_s == 0
    toy.admit()
    assert toy.refusal(deadline_s=toy.now_s + 0.1).reason is Refusal.DEADLINE_INFEASIBLE  # not idle any more


def test_a_step_waits_until_it_would_end_too_late() -> None:
    toy = Toy()
    job = again(toy, "slow", 4)
    assert toy.scheduler.next_due_s is not None
    toy.scheduler.expire(99.0)
    assert toy.ending_of(job) is None
    toy.scheduler.expire(99.9)  # 150 s less the predicted 50.5 s
    assert toy.ends[0] == [(Ending.OK, "first")]
    assert again(Toy(), "slow", 4, due_s=51.0).is_over  # too late from the beginning


def test_nothing_waits_for_an_idle_thread_while_jobs_are_refused() -> None:
    """The answer that there is would come late for nothing: more calls come than are computed."""
    toy = Toy()
    toy.fill()
    job = toy.admit(stage="refine", client="mine", deadline_s=200.0)
    toy.learn("prepare", "slow", 50.0)
    batch = toy.take("host")
    assert batch.jobs == (job,)
    toy.finish(batch, Next((Step("prepare", "slow", "b", "again"),), Fallback(lambda _: Done("first"), 150.0)))
    assert toy.ending_of(job) is Ending.OK


@pytest.mark.parametrize(
    ("is_crowded", "own_jobs", "due_s", "goes_on"),
    [(False, 1, 150.0, True), (True, 1, 150.0, False), (False, 2, 150.0, False), (False, 1, 1.9, False)],
)
def test_a_greedy_caller_takes_no_others_turn(is_crowded: bool, own_jobs: int, due_s: float, goes_on: bool) -> None:
    """Where its own jobs are refused, steps of others' only jobs take turns with them, if there is time for that.

    Not where others have no room, too.
    """
    toy = Toy()
    toy.learn("coarse", "more", 0.9)
    job, *_ = [toy.admit(stage="refine", client="mine", deadline_s=200.0) for _ in range(own_jobs)]
    batch = toy.take("host")
    toy.fill()
    for client in map(str, range(100) if is_crowded else ()):
        toy.fill(client)
    step = Step("prepare", "more", "b", "again")
    toy.finish(batch, Next((step,), Fallback(lambda _: Done("first"), due_s)))
    assert toy.ending_of(job) is (None if goes_on else Ending.OK)
    assert not goes_on or job in toy.take("host").jobs + toy.take("host").jobs


@pytest.mark.parametrize(
    ("due_s", "others", "kind"),
    [(3.0, 0, "slow"), (1.0, 0, "toy"), (2.9, 5, "toy"), (0.7, 0, None), (0.7, 6, None)],
)
def test_the_alternative_is_computed_where_the_step_is_not(due_s: float, others: int, kind: str | None) -> None:
    """Where that would be too late; the fallback is given only if the alternative is too late as well."""
    toy = Toy()
    toy.learn("prepare", "slow", 2.0)
    toy.learn("refine", "another", 50.0)  # says nothing about `later_kind`
    step, alternative = Step("prepare", "slow", "b", 0, "toy"), Step("prepare", "toy", "b", 0)
    job = toy.admit(stage="refine", client="mine")
    for i in range(others):
        toy.admit(client=f"other {i}")
    toy.finish(toy.take("host"), Next((step, alternative), Fallback(lambda _: Done("first"), due_s)))
    assert toy.ending_of(job) is (None if kind else Ending.OK)
    assert kind in (None, job.step.kind)


@pytest.mark.parametrize(("due_s", "kind"), [(99.0, "best"), (3.0, "slow"), (1.0, "toy"), (0.7, None)])
def test_the_first_step_that_ends_in_time_is_computed(due_s: float, kind: str | None) -> None:
    toy = Toy()
    toy.learn("prepare", "best", 5.0)
    toy.learn("prepare", "slow", 2.0)
    steps = tuple(Step("prepare", it, "b", 0, "toy") for it in ("best", "slow", "toy"))
    job = toy.admit(stage="refine", client="mine")
    toy.finish(toy.take("host"), Next(steps, Fallback(lambda _: Done("first"), due_s)))
    assert (job.step.kind if kind else None, toy.ending_of(job)) == (kind, None if kind else Ending.OK)


def test_steps_but_the_cheapest_are_never_tried_anyway() -> None:
    """Only the cheapest is tried against its prediction, once in a while: the others would cost what it gives."""
    toy, tried = Toy(), []
    for kind, seconds in (("best", 60.0), ("slow", 50.0)):
        toy.learn("prepare", kind, seconds)
    for _ in range(16):
        job = toy.admit(stage="refine", client="mine")
        steps = tuple(Step("prepare", kind, "b", 0) for kind in ("best", "slow"))
        toy.finish(toy.take("host"), Next(steps, Fallback(lambda _: Done("first"), toy.now_s + 1)))
        tried += [] if job.is_over else [job.step.kind]
        toy.scheduler.cancel(job, toy.now_s)
    assert tried == ["slow"] * 2


def test_without_a_fallback_the_first_step_is_computed() -> None:
    """It was admitted with it, however late it is."""
    toy = Toy()
    toy.learn("coarse", "slow", 50.0)
    job = toy.admit(deadline_s=5.0)
    toy.finish(toy.take("host"), Next((Step("coarse", "slow", "b", 0), Step("coarse", "toy", "b", 0))))
    assert job.step.kind == "slow"


def test_a_job_that_continues_needs_a_step() -> None:
    with pytest.raises(ValueError, match=r"Next\.steps must have at least one"):
        Next(())


def test_the_only_job_leaves_room_for_the_next_caller() -> None:
    """Though it costs more than the server computes for all callers, and another thread is free."""
    toy = Toy()
    toy.learn("prepare", "slow", 50.0)
    job = toy.admit(stage="refine", client="mine", deadline_s=200.0)
    step = Step("prepare", "slow", "b", "again")
    toy.finish(toy.take("host"), Next((step,), Fallback(lambda _: Done("first"), 150.0)))
    toy.take("host")
    other = toy.admit(client="other", deadline_s=5.0)
    assert toy.take("host").jobs == (other,)
    assert toy.ending_of(job) is None


def test_a_further_step_of_an_earlier_stage_has_its_turn() -> None:
    """Beside those of other callers, which wait for a later stage."""
    toy, jobs = Toy(), list[AnyJob]()
    for i, stage in enumerate(["prepare", *["refine"] * 30]):
        jobs.append(toy.admit(stage="refine", client=f"doubtful {i}"))
        toy.finish(toy.take("host"), Next((Step(stage, "toy", "b", i),), Fallback(lambda _: Done(None), FAR_S)))
    while not jobs[0].is_over:
        toy.fill("busy")
        toy.finish(toy.take("host"), Done(None))
    assert sum(it.is_over for it in jobs) < len(jobs) / 2


@pytest.mark.parametrize("has_begun", [True, False])
def test_an_attempt_that_has_begun_goes_on_though_jobs_are_refused(has_begun: bool) -> None:
    """Its computed part would be lost otherwise."""
    toy = Toy()
    job = toy.admit(stage="refine", client="mine", deadline_s=200.0)
    batch = toy.take("host")
    toy.fill()
    fallback = Fallback[object, str](lambda _: Done("first"), 150.0)
    toy.learn("prepare", "slow", 50.0)
    toy.finish(batch, Next((Step("prepare", "slow", "b", "next"),), fallback, has_begun=has_begun))
    assert job.is_over != has_begun


def background(toy: Toy) -> AnyJob:
    """A job that gives way, of two stages."""
    job = toy.job(client="own")
    job.gives_way = True
    toy.scheduler.admit(job, toy.now_s)
    return job


def test_a_job_that_gives_way_has_threads_of_its_own() -> None:
    """None that jobs in order need, and its later stages wait aside, too."""
    toy = Toy(low=1)
    job = background(toy)
    assert not toy.scheduler.has_work("host")
    toy.finish(toy.take("host", is_low=True), Next((Step("refine", "toy", "b", 0),)))
    first = toy.admit(client="first", stage="refine")
    assert toy.take("host").jobs == (first,)
    assert not toy.scheduler.has_work("host")
    toy.finish(toy.take("host", is_low=True), Done(None))
    assert toy.ending_of(job) is Ending.OK


@pytest.mark.parametrize("is_admitted", [False, True])
def test_a_job_that_gives_way_leaves_a_server_idle(is_admitted: bool) -> None:
    """One that tries again, too; an idle server admits a call whatever is predicted."""
    toy = Toy(low=1)
    for _ in range(2):
        job = background(toy)
        fallback = Fallback[object, str](lambda _: Done("first"), FAR_S)
        step = Step("prepare", "toy", "b", "again")
        toy.finish(toy.take("host", is_low=True), Next((step,), fallback, is_admitted=is_admitted))
        assert (toy.ending_of(job), sum(job.booked_s.values())) == (None, 0)
        toy.finish(toy.take("host", is_low=True), Done(None))
        assert toy.ending_of(job) is Ending.OK
    toy.admit(deadline_s=toy.now_s + 0.3)


def test_a_job_that_gives_way_takes_no_room() -> None:
    """Neither while it waits nor while it is computed."""
    toy, without = Toy(low=1), Toy(low=1)
    background(toy)
    toy.take("host", is_low=True)
    background(toy)
    for it in (toy, without):
        it.fill()
    assert toy.observer.admissions == without.observer.admissions + 2
