"""Groups in a busy server: what they hold is counted, what they have computed is kept, and all stages are recorded."""

import asyncio
import itertools
import threading
import time
import weakref
from collections import Counter
from collections.abc import Coroutine
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from support.servers import CAMERA

from mapless_server.engine.groups import GroupResult, PhotoGroup
from mapless_server.engine.options import EngineOptions
from mapless_server.engine.query import PREPARE, Caller, Photo, Query, Result
from mapless_server.engine.queue_engine import JOIN, QueueEngine
from mapless_server.errors import DeadlineExceeded, NotFound, Overloaded, RequestError, Unavailable
from mapless_server.method.options import ChosenCamera, IntrinsicsSource, LocalizeOptions
from mapless_server.method.rejection import Rejection, RejectionReason
from mapless_server.rpc import Call
from mapless_server.scenes import Cone, Narrowing
from mapless_server.scheduling import (
    AnyJob,
    Flow,
    ItemList,
    Job,
    Observer,
    Stage,
    Step,
    WorkQueue,
    WorkQueueOptions,
    compute_items,
)
from mapless_server.security import SceneKey
from mapless_server.services.photographs import localize_group, localize_photographs

LIMIT_S = 30.0
MAX_BYTES = 1000
PART = Query(
    SceneKey("s"), (), Photo(bytes(100), CAMERA, "image"), Narrowing(), 2, LocalizeOptions(), is_part=True
)  # fmt: skip


class Toy(QueueEngine):
    """The engine's queue, with photographs that take a moment each."""

    def __init__(self, seconds: float = 0.002, max_queued_s: float = 2.0) -> None:
        self.options = EngineOptions(workers=2, max_batch=1)
        self.seconds, self.fails_at, self._numbers = seconds, -1, itertools.count(1)
        self.failure: Exception = RuntimeError("planted")
        self.jobs: weakref.WeakSet[AnyJob] = weakref.WeakSet()
        options = WorkQueueOptions(max_queued_s=max_queued_s, max_bytes=MAX_BYTES)
        stages = {Stage(PREPARE, "host"): compute_items, Stage(JOIN, "host"): compute_items}
        self.queue = WorkQueue(stages, {"host": 2}, options, Observer())

    def query_job(
        self,
        query: Query,
        caller: Caller,
        source: object = None,
        *,
        views: object = None,
        on_better: object = None,
        gives_way: bool = False,
    ) -> AnyJob:
        def compute(_: None, check: object) -> None:
            number = next(self._numbers)
            time.sleep(self.seconds)
            if number == self.fails_at:
                raise self.failure

        step = Step(PREPARE, "p", "p", ItemList([None], compute))
        job: AnyJob = Job(caller.flow, step, caller.deadline_s, 0 if query.is_part else len(query.photo.image))
        self.jobs.add(job)
        return job

    async def run(self, job: AnyJob) -> Result:
        try:
            await self.queue.run(job)
        except Exception as error:
            raise error if str(error) == "planted" else Overloaded(str(error), retry_after_s=0.05) from error
        return cast(Result, SimpleNamespace())

    async def close(self) -> None:
        await self.queue.close()


def caller(name: str, lasts_s: float = LIMIT_S) -> Caller:
    return Caller(Flow("tenant", name), time.monotonic() + lasts_s)


def run(engine: Toy, work: Coroutine[Any, Any, None]) -> None:
    async def all_of_it() -> None:
        try:
            await asyncio.wait_for(work, LIMIT_S)
        finally:
            await engine.close()

    asyncio.run(all_of_it())


def test_groups_in_progress_are_bounded_and_others_refused() -> None:
    engine, held, most = Toy(), 0, 0
    outcomes: Counter[str] = Counter()

    async def one(number: int) -> None:
        nonlocal held, most
        queries, who = [PART] * 3, caller(f"c{number}")
        try:
            with engine.hold(queries, who):
                held += 300
                most = max(most, held)
                try:
                    await PhotoGroup(engine, queries, who, "images").localize()
                    await engine.join(lambda: None, who)
                finally:
                    held -= 300
            outcomes["answered"] += 1
        except Overloaded as refused:
            outcomes[refused.reason] += 1

    async def work() -> None:
        await asyncio.gather(*(one(i) for i in range(50)))
        assert 300 <= most <= MAX_BYTES
        assert outcomes["TOO_MUCH_MEMORY"] > 0
        assert outcomes["answered"] > 0
        assert set(outcomes) == {"answered", "TOO_MUCH_MEMORY"}
        await one(99)  # what was held is free again
        assert outcomes["answered"] + outcomes["TOO_MUCH_MEMORY"] == 51

    run(engine, work())


def test_memory_of_a_group_is_reserved_until_it_ends() -> None:
    engine = Toy()
    single = replace(PART, photo=Photo(bytes(500), CAMERA, "image"), is_part=False)

    async def work() -> None:
        for error in (None, ValueError("planted")):
            try:
                with engine.hold([PART] * 6, caller("rig")):
                    with pytest.raises(Overloaded, match="memory"):
                        await engine.run(engine.query_job(single, caller("other")))
                    if error is not None:
                        raise error
            except ValueError:
                pass
            await engine.run(engine.query_job(single, caller("other")))

    run(engine, work())


def test_one_caller_s_groups_leave_room_for_another_s() -> None:
    engine = Toy()

    async def work() -> None:
        with engine.hold([PART] * 5, caller("loud")):
            with pytest.raises(Overloaded, match="memory"), engine.hold([PART] * 4, caller("loud")):
                pass
            with engine.hold([PART] * 3, caller("quiet")):
                pass

    run(engine, work())


def test_a_group_above_the_limit_is_refused_without_retry() -> None:
    engine = Toy()

    async def work() -> None:
        with pytest.raises(Overloaded) as refused, engine.hold([PART] * 11, caller("rig")):
            pass
        assert (refused.value.reason, refused.value.retry_after_s) == ("TOO_LARGE", None)

    run(engine, work())


def test_computed_photos_are_posed_together_in_a_full_queue() -> None:
    engine = Toy(max_queued_s=0.3)
    is_released = threading.Event()

    def held(_: None, check: object) -> None:
        assert is_released.wait(LIMIT_S)

    async def work() -> None:
        rig = caller("rig")
        for _ in range(3):  # the queue learns what a joint pose costs: two of them fill it
            await engine.join(lambda: time.sleep(0.25), rig)
        await PhotoGroup(engine, [PART] * 4, rig, "images").localize()
        callers = (*map(caller, "abcd"), *[rig] * 8)
        others = [asyncio.ensure_future(engine._each(JOIN, [None], held, it, 0)) for it in callers]
        try:
            await asyncio.sleep(0.05)
            refused = others[-1].exception()  # as the joint pose would be, did it not continue what is done
            assert isinstance(refused, Overloaded)
            assert refused.reason == "QUEUE_FULL"
            joint = asyncio.ensure_future(engine.join(lambda: "pose", rig))
            await asyncio.sleep(0.05)
        finally:
            is_released.set()
            await asyncio.gather(*others, return_exceptions=True)
        assert await joint == "pose"

    run(engine, work())


def test_and_while_the_server_drains_but_not_after_its_end() -> None:
    engine, rig = Toy(), caller("rig")

    async def work() -> None:
        await PhotoGroup(engine, [PART] * 2, rig, "images").localize()
        engine.queue.drain()
        assert await engine.join(lambda: "pose", caller("rig")) == "pose"
        with pytest.raises(DeadlineExceeded):
            await engine.join(lambda: "pose", caller("rig", -1.0))
        await engine.close()
        with pytest.raises(RequestError) as over:
            await engine.join(lambda: "pose", caller("rig"))
        assert over.value.code == "UNAVAILABLE"

    run(engine, work())


def test_a_failed_group_has_its_stage_times() -> None:
    engine = Toy()
    engine.fails_at = 3

    async def work() -> None:
        rig = caller("rig")
        group = PhotoGroup(engine, [PART] * 4, rig, "images")
        with pytest.raises(RuntimeError, match="planted"):
            await group.localize()
        seen = [len(records) for records in group.records]
        assert sum(seen) >= 2  # the one that failed, and the one that had to be through before it began
        assert all(it.stage == PREPARE for records in group.records for it in records)
        engine.fails_at = next(engine._numbers) + 3
        call = Call("id", time.monotonic(), time.monotonic() + LIMIT_S)
        with pytest.raises(RuntimeError, match="planted"):
            await localize_photographs(engine, [PART] * 4, call, "images")
        assert sum(it.end_s - it.start_s for it in call.stages if it.stage == PREPARE) >= engine.seconds

    run(engine, work())


@pytest.mark.parametrize("failure", [Unavailable("planted"), DeadlineExceeded("planted"), NotFound("planted")])
def test_a_search_elsewhere_that_fails_leaves_the_rejection(failure: RequestError) -> None:
    engine = Toy()
    engine.fails_at, engine.failure = 3, failure
    likely = Narrowing(likely_headings=(Cone(np.array([0.0, 0.0, 1.0]), 10.0),))
    rejection = Rejection(RejectionReason.GATE, "planted")

    async def reject(*_: object) -> Rejection:
        return rejection

    async def work() -> None:
        call = Call("id", time.monotonic(), time.monotonic() + LIMIT_S)
        group, outcome = await localize_group(engine, [replace(PART, narrowing=likely)] * 2, call, "images", reject)
        assert (len(group.results), outcome) == (2, rejection)
        assert next(engine._numbers) > 3  # it was tried

    run(engine, work())


def test_a_second_round_keeps_the_cameras_of_the_first() -> None:
    chosen = ChosenCamera(CAMERA, None, IntrinsicsSource.ESTIMATED)

    def results(*cameras: ChosenCamera | None) -> GroupResult:
        of_nothing: Any = None
        made = [Result(of_nothing, of_nothing, (), of_nothing, CAMERA, camera=it) for it in cameras]
        return GroupResult(tuple(made), (0.0,) * 3, (0.0,) * 3, (0.0,) * 3)

    later = results(None, None, chosen).read_as_in(results(chosen, None, None))
    assert [it.camera for it in later.results] == [chosen, None, chosen]


def test_a_photo_that_a_full_store_failed_is_tried_again() -> None:
    engine = Toy(seconds=0.05)
    engine.fails_at, engine.failure = 1, Overloaded("the store is full", reason="STORE_FULL", retry_after_s=0.01)

    async def work() -> None:
        result = await PhotoGroup(engine, [PART] * 3, caller("rig"), "images").localize()
        assert len(result.results) == 3
        assert engine.queue.job_count == 0
        assert engine.queue.backlog_s == 0

    run(engine, work())


def test_what_has_been_localized_holds_no_photograph() -> None:
    engine = Toy()
    alive: list[int] = []

    async def work() -> None:
        group = PhotoGroup(engine, [PART] * 12, caller("rig"), "images")
        query_job = engine.query_job

        def watched(*arguments: Any) -> AnyJob:
            alive.append(len(engine.jobs))
            return query_job(*arguments)

        engine.query_job = watched  # type: ignore[method-assign, assignment]
        await group.localize()

    run(engine, work())
    assert len(alive) == 12
    assert max(alive) <= 4, "two are computed at a time, and threads let go of theirs a moment later"
