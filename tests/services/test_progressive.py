"""Better answers come in order, before the final one, and an error in its place."""

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
from mapless_server.services.localization import LocalizationService
from mapless_server.services.messages.answers import answer_frames_of
from mapless_server.services.progressive import GiveBetter, better_then_final
from mapless_server.services.rejected import Asked

FINAL = pb.LocalizeResponse(localization=pb.Localization(inlier_count=100))


def message(number: int) -> pb.LocalizeResponse:
    return pb.LocalizeResponse(localization=pb.Localization(inlier_count=number))


class Planted:
    """A final answer that waits for `may_end`, after these better and better ones."""

    def __init__(self, better: Sequence[int] = (), end: Exception | None = None) -> None:
        self._better, self._end = better, end
        self.may_end = asyncio.Event()

    async def answer(self, give: GiveBetter) -> pb.LocalizeResponse:
        for number in self._better:
            give(message(number))
        await self.may_end.wait()
        if self._end is not None:
            raise self._end
        return FINAL

    def messages(self) -> Any:
        return better_then_final(self.answer)


def seen(response: pb.LocalizeProgressivelyResponse) -> tuple[int, bool]:
    return response.answer.localization.inlier_count, response.is_final


@pytest.mark.parametrize("better", [(), (1,), (1, 2, 3)])
async def test_all_messages_come_in_order_and_the_final_one_last(better: Sequence[int]) -> None:
    """Even where the final answer is there before the first message is read."""
    planted = Planted(better)
    planted.may_end.set()
    assert [seen(it) async for it in planted.messages()] == [*((it, False) for it in better), (100, True)]


async def test_a_better_answer_is_sent_before_the_final_one_is_known() -> None:
    planted = Planted([1, 2])
    messages = planted.messages()
    assert [seen(await asyncio.wait_for(anext(messages), 10)) for _ in range(2)] == [(1, False), (2, False)]
    planted.may_end.set()
    assert [seen(it) async for it in messages] == [(100, True)]


@pytest.mark.parametrize("better", [(), (1,), (1, 2)])
async def test_an_error_comes_in_the_place_of_the_final_answer(better: Sequence[int]) -> None:
    planted = Planted(better, KeyError("planted"))
    planted.may_end.set()
    messages = planted.messages()
    for number in better:
        assert seen(await anext(messages)) == (number, False)
    with pytest.raises(KeyError, match="planted"):
        await anext(messages)


async def test_a_caller_that_stops_reading_ends_the_job() -> None:
    """The job does not end by itself."""
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

    def query_job(self, query: Any, caller: Any, *, views: Any = None, on_better: Any = None) -> AnyJob:
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
        given: list[pb.LocalizeResponse] = []
        with suppress(Overloaded):
            await service._answer(request, Asked(cast(Any, query)), answer_frames_of(request), call, given.append)

    gc.collect()
    gc.disable()
    try:
        asyncio.run(test())
        assert [job() for job in engine.jobs] == [None]
    finally:
        gc.enable()
