"""What a call holds while and after it is answered, on an engine that computes nothing."""

import asyncio
import gc
import math
import time
import weakref
from contextlib import suppress
from types import SimpleNamespace
from typing import Any, cast

from mapless.v1 import localization_service_pb2 as pb
from mapless_server.errors import Overloaded
from mapless_server.rpc import Call
from mapless_server.scheduling import Flow, Job, Step
from mapless_server.services.localization import LocalizationService
from mapless_server.services.messages.answers import answer_frames_of


class Refusing:
    """Refuses every job, and notes which there were."""

    def __init__(self) -> None:
        self.jobs: list[weakref.ref[Job]] = []

    def query_job(self, query: Any, caller: Any, *, on_coarse: Any = None) -> Job:
        job = Job(Flow("", ""), Step("prepare", "", "", on_coarse), math.inf, 0)
        self.jobs.append(weakref.ref(job))
        return job

    async def run(self, job: Job) -> Any:
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
