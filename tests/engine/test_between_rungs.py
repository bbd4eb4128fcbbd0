"""Faults between two rungs and in a further one: the caller leaves, references are deleted, the attempt fails."""

import asyncio
import gc
import threading
import weakref
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import pytest
from support.planted_engine import (
    DOUBT,
    DOUBTFUL_INLIERS,
    SCENE,
    SURE_INLIERS,
    Setting,
    caller,
    localized,
    query_of,
    rejected,
)
from support.servers import whole
from support.waiting import until

from mapless_server.engine.query import COARSE, PREPARE, REFINE, Result
from mapless_server.engine.stages import Method, QueryStages
from mapless_server.method.features.views import PosedView, View
from mapless_server.method.judge.answer import Answer, Localization
from mapless_server.method.rejection import Rejection
from mapless_server.scheduling import Done, Flow
from mapless_server.scheduling.lanes import Lane

LIMIT_S = 20.0


def ended(result: Result) -> list[tuple[str, str, bool]]:
    return [(it.rung, it.outcome, it.is_chosen) for it in result.attempts]


def test_what_a_caller_leaves_between_rungs_is_freed(setting: Setting, monkeypatch: pytest.MonkeyPatch) -> None:
    """The next rung is not computed; others, which hold both threads meanwhile, are answered."""
    has_work = Lane.has_work  # threads of low priority would compute the rung at once
    monkeypatch.setattr(Lane, "has_work", lambda it, is_low: not is_low and has_work(it, is_low))
    entered, gate, freed = threading.Semaphore(0), threading.Event(), threading.Event()

    def reply(view: View, references: Sequence[PosedView], _: object) -> Answer:
        entered.release()
        if references[0].name.endswith("r0"):
            weakref.finalize(view, freed.set)
            assert begun.wait(LIMIT_S)
            return localized(DOUBTFUL_INLIERS)
        assert gate.wait(LIMIT_S)
        return localized(SURE_INLIERS)

    begun = threading.Event()
    setting.replies = {"cheap": reply, "strong": localized(SURE_INLIERS)}
    engine, queue = setting.engine, setting.engine.queue
    others = [replace(caller(), flow=Flow("tenant", f"other {i}")) for i in range(2)]

    def waiting() -> int:
        return sum(queue.load(stage).waiting for stage in (PREPARE, COARSE, REFINE))

    async def entering() -> None:
        assert await asyncio.to_thread(entered.acquire, timeout=LIMIT_S)

    async def run() -> list[Result]:
        mine = asyncio.ensure_future(engine.run(engine.query_job(query_of(("r0", "r1")), caller())))
        await entering()
        held = [asyncio.ensure_future(engine.run(engine.query_job(query_of(("r1", "r2")), it))) for it in others]
        await entering()
        begun.set()
        await entering()  # both threads are the others'
        await until(lambda: waiting() == 1)
        setting.seen.clear()
        mine.cancel()
        await asyncio.wait([mine])
        del mine  # and with it the frames of the call
        gc.collect()
        assert (queue.job_count, waiting()) == (2, 0)
        assert await asyncio.to_thread(freed.wait, LIMIT_S)
        gate.set()
        return list(await asyncio.gather(*held))

    results = setting.loop.run_until_complete(run())
    assert all(isinstance(it.answer.outcome, Localization) for it in results)
    assert "strong" not in setting.asked


@pytest.mark.parametrize("first", [localized(DOUBTFUL_INLIERS), rejected()], ids=["pose", "rejection"])
@pytest.mark.parametrize("deleted", ["one", "all", "the scene"])
@pytest.mark.parametrize("names", [("r0", "r1"), ()], ids=["named", "chosen"])
def test_deleted_references_cost_no_verdict(
    setting: Setting, names: tuple[str, ...], deleted: str, first: Answer
) -> None:
    """Deleted between two rungs. Where the server had chosen them, the next one is tried with what is left."""

    def reply(*_: object) -> Answer:
        if deleted == "the scene":
            setting.store.delete_scene(SCENE)
        else:
            for name in ("r0",) if deleted == "one" else ("r0", "r1", "r2"):
                setting.store.delete_reference(SCENE, name)
        return first

    setting.replies = {"cheap": reply, "strong": localized(SURE_INLIERS)}
    result = setting.localize(reference_ids=names, reference_count=3)
    outcome, last = result.answer.outcome, [(it.rung, it.outcome) for it in result.attempts if it.rung == "stronger"]
    if not names and deleted == "one":
        assert last == [("stronger", "localized")]
        assert isinstance(outcome, Localization)
        assert len(result.references) == 2
        return
    assert last == [("stronger", "failed" if names or deleted == "the scene" else "no_usable_references")]
    assert isinstance(outcome, Localization) is isinstance(first.outcome, Localization)
    if isinstance(outcome, Rejection):
        assert outcome.hint is not None
        assert outcome.message


@pytest.mark.parametrize("fault", [RuntimeError("planted"), MemoryError()], ids=["failed", "out_of_memory"])
@pytest.mark.parametrize("stage", [PREPARE, COARSE, REFINE])
def test_a_fault_in_any_stage_leaves_the_verdict(setting: Setting, stage: str, fault: Exception) -> None:
    setting.replies = dict.fromkeys(("cheap", "strong"), localized(DOUBTFUL_INLIERS))
    planted = whole(lambda *_: localized(DOUBTFUL_INLIERS))
    asked = dict.fromkeys((PREPARE, COARSE, REFINE), 0)

    def second(name: str, compute: Callable[..., Any]) -> Callable[..., Any]:
        """The same, except that its second call raises."""

        def call(*arguments: Any) -> Any:
            asked[name] += 1
            if (name, asked[name]) == (stage, 2):
                raise fault
            return compute(*arguments)

        return call

    method = Method(
        second(PREPARE, planted.prepare),
        second(COARSE, planted.reconstruct),
        second(REFINE, planted.solve),
        planted.coarse_answer,
        planted.tracked_support,
    )
    stages = QueryStages(setting.engine.tiers, DOUBT, method)
    job = setting.engine.query_job(query_of(("r0", "r1")), caller())
    while True:
        (result,) = getattr(stages, job.step.stage)([job])
        if isinstance(result, Done):
            break
        assert not isinstance(result, Exception)
        job.step = result.steps[0]
    expected = "out_of_memory" if isinstance(fault, MemoryError) else "failed"
    assert ended(result.value) == [("as it is", "localized", True), ("stronger", expected, False)]
