"""A coarse answer comes once, before the final one, and an error in its place."""

import asyncio
import gc
import math
import time
import weakref
from collections.abc import Sequence
from contextlib import suppress
from types import SimpleNamespace
from typing import Any, cast

import pytest

from mapless.v1 import localization_service_pb2 as pb
from mapless_server.errors import Overloaded
from mapless_server.rpc import Call
from mapless_server.scheduling import AnyJob, Flow, Job, Step
from mapless_server.services.localization import FutureCoarseAnswer, LocalizationService, coarse_then_final
from mapless_server.services.messages.answers import answer_frames_of

FINAL = pb.LocalizeResponse(localization=pb.Localization(inlier_count=100))


def message(number: int) -> pb.LocalizeResponse:
    return pb.LocalizeResponse(localization=pb.Localization(inlier_count=number))


class Planted:
    """A final answer that waits for `may_end`, after these coarse ones."""

    def __init__(self, coarse: Sequence[int] = (), end: Exception | None = None) -> None:
        self._coarse, self._end = coarse, end
        self.may_end = asyncio.Event()

    async def answer(self, coarse: FutureCoarseAnswer) -> pb.LocalizeResponse:
        for number in self._coarse:
            coarse.set_result(message(number))
        await self.may_end.wait()
        if self._end is not None:
            raise self._end
        return FINAL

    def messages(self) -> Any:
        return coarse_then_final(self.answer)


def seen(response: pb.LocalizeProgressivelyResponse) -> tuple[int, bool]:
    return response.answer.localization.inlier_count, response.is_final


@pytest.mark.parametrize(("coarse", "expected"), [((), []), ((1,), [(1, False)])])
async def test_there_are_two_messages_at_most_and_the_order_is_kept(
    coarse: Sequence[int], expected: list[tuple[int, bool]]
) -> None:
    """Even where the final answer is there before the first message is read."""
    planted = Planted(coarse)
    planted.may_end.set()
    assert [seen(it) async for it in planted.messages()] == [*expected, (100, True)]


@pytest.mark.parametrize("coarse", [(), (1,)])
async def test_an_error_comes_in_the_place_of_the_final_answer(coarse: Sequence[int]) -> None:
    planted = Planted(coarse, KeyError("planted"))
    planted.may_end.set()
    messages = planted.messages()
    for number in coarse:
        assert seen(await anext(messages)) == (number, False)
    with pytest.raises(KeyError, match="planted"):
        await anext(messages)


async def test_a_caller_that_stops_reading_ends_the_job() -> None:
    """Which does not end by itself."""
    messages = Planted([1]).messages()
    await anext(messages)
    await asyncio.wait_for(messages.aclose(), 10)


async def test_an_error_of_an_abandoned_call_is_not_logged(caplog: pytest.LogCaptureFixture) -> None:
    planted = Planted([1], KeyError("planted"))
    planted.may_end.set()
    messages = planted.messages()
    await anext(messages)
    await asyncio.sleep(0.01)
    await messages.aclose()
    gc.collect()
    assert not caplog.records


class Refusing:
    """Refuses every job, and notes which there were."""

    def __init__(self) -> None:
        self.jobs: list[weakref.ref[AnyJob]] = []

    def query_job(self, query: Any, caller: Any, *, on_better: Any = None) -> AnyJob:
        job: AnyJob = Job(Flow("", ""), Step("prepare", "", "", on_better), math.inf, 0)
        self.jobs.append(weakref.ref(job))
        return job

    async def run(self, job: AnyJob) -> Any:
        raise Overloaded("planted")


def test_a_progressive_call_leaves_its_job_in_no_cycle() -> None:
    """The job holds the decoded photograph, which would wait for the collector."""
    engine = Refusing()
    service = LocalizationService(lambda: cast(Any, engine), *cast(Any, (None, None, None)))
    request, query = pb.LocalizeRequest(), SimpleNamespace(options=None)

    async def test() -> None:
        call = Call("id", time.monotonic(), math.inf)
        coarse = asyncio.get_running_loop().create_future()
        with suppress(Overloaded):
            await service._answer(request, cast(Any, query), answer_frames_of(request), call, coarse)
        coarse.cancel()

    gc.collect()
    gc.disable()
    try:
        asyncio.run(test())
        assert [job() for job in engine.jobs] == [None]
    finally:
        gc.enable()
