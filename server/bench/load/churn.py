"""Calls besides queries: scenes and references that are created and deleted, watchers, and wrong requests.

Each worker makes one kind of call repeatedly, at random times, and counts how its calls end. An error that a worker has
caused, also another one by deleting a scene, is expected; any other is a failure.
"""

import asyncio
import random
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from itertools import count, takewhile
from typing import Any

import grpc
from grpc_health.v1 import health_pb2, health_pb2_grpc

from mapless import ConnectOptions, MaplessError, aio
from mapless.names import scene_name
from mapless.v1 import localization_service_pb2 as pb
from mapless.v1 import localization_service_pb2_grpc as rpcs
from mapless.v1 import reference_service_pb2 as reference_pb
from mapless.v1 import reference_service_pb2_grpc as reference_rpcs
from mapless_tools.demo import Photograph, Place

from .driving import SCENE
from .sender import own_channel

ONCE = ConnectOptions(max_attempts=1, timeout_s=20.0)
"""The outcome of each call is counted, not that of a retry."""
EXTRA_REFERENCES = 4
"""Number of references at a time beside those of the queried scene: added in turn, the oldest deleted."""
SCENES = 5
"""Ids that scenes are created with, again and again: a scene's generation is kept for ever."""
ENDING_S = 120.0
"""For workers to finish: their calls have deadlines."""
BUSY = frozenset({"RESOURCE_EXHAUSTED", "DEADLINE_EXCEEDED"})
"""Statuses with which a server may answer any call at its limit."""
UNCERTAIN = ("ALREADY_EXISTS", "NOT_FOUND")
"""Statuses that a call may get after one whose end is unknown, because its deadline passed."""


@dataclass
class Outcomes:
    """Counts how calls ended, by worker and status; the first failure of each kind; statuses of calls of Localize."""

    counts: Counter[tuple[str, str]] = field(default_factory=Counter)
    failures: dict[str, str] = field(default_factory=dict)
    localize_codes: list[str] = field(default_factory=list)

    async def count(self, worker: str, call: Awaitable[object], *expected: str) -> bool:
        """Awaits a call and counts its status; returns whether it is OK. The `expected` statuses are no failures."""
        code, text = "OK", ""
        try:
            await call
        except MaplessError as error:
            code, text = error.code, str(error)
        except grpc.aio.AioRpcError as error:
            code, text = error.code().name, error.details() or ""
        self.counts[worker, code] += 1
        if code != "OK" and code not in BUSY and code not in expected:
            self.failures.setdefault(f"{worker}: {code}", text)
        return code == "OK"


WORK: Mapping[str, str] = {
    "references": "adds references to the queried scene, and deletes the oldest",
    "scenes": "creates scenes, localizes in them, and deletes them",
    "watch queries": "watches the queries for a while",
    "watch health": "watches the health for a while",
    "comers": "opens a connection each time, one in three closed in the middle of a call",
    "wrong": "sends requests that are to be refused",
}
"""The work of each worker, by the name that its calls are counted under."""


@dataclass(frozen=True)
class Workers:
    """Data that the workers share: times between calls are divided by `pace`; they end once `stopping` is set."""

    address: str
    place: Place
    outcomes: Outcomes
    pace: float = 1.0
    stopping: asyncio.Event = field(default_factory=asyncio.Event)

    async def references(self, chance: random.Random) -> None:
        """Adds references to the scene that is queried, and deletes the oldest."""
        stored: list[str] = []
        async with aio.Client(self.address, ONCE) as client:
            for number in self._rounds():
                new = chance.choice(self.place.references).reference(f"extra-{number}")
                if await self.outcomes.count("references", client.add_reference(SCENE, new)):
                    stored.append(new.reference_id)
                # One whose answer came too late was perhaps stored all the same, and stays: a few at most.
                while len(stored) > EXTRA_REFERENCES:
                    deleted = client.delete_reference(SCENE, stored.pop(0))
                    await self.outcomes.count("references", deleted, "NOT_FOUND")
                await self._pause(chance, 8.0)

    async def scenes(self, chance: random.Random) -> None:
        """Creates scenes, localizes in them, and deletes them, sometimes during a query."""
        first, second = self.place.references[:2]
        async with aio.Client(self.address, ONCE) as client:
            for number in self._rounds():
                scene = f"scene-{number % SCENES}"
                await self.outcomes.count("scenes", client.create_scene(scene), *UNCERTAIN)
                for photo in (first, second):
                    await self.outcomes.count("scenes", client.add_reference(scene, photo.reference()), *UNCERTAIN)
                asked = asyncio.create_task(self._localize(client, scene, self.place.queries[0]))
                await asyncio.sleep(chance.choice([0.0, 0.05, 0.2, 3.0]))
                await self.outcomes.count("scenes", client.delete_scene(scene), *UNCERTAIN)
                await asked
                await self._pause(chance, 20.0)

    async def _localize(self, client: aio.Client, scene: str, photo: Photograph) -> None:
        code = "OK"
        try:
            await client.localize(photo.data, photo.camera, scene)
        except MaplessError as error:
            code = error.code
            if code not in ("NOT_FOUND", "UNAVAILABLE", *BUSY):
                self.outcomes.failures.setdefault(f"scenes: {code}", str(error))
        self.outcomes.counts["scenes", code] += 1
        self.outcomes.localize_codes.append(code)

    async def watchers(self, chance: random.Random) -> None:
        """Watches the scene's queries and the server's health for a while each, and cancels."""
        async with own_channel(self.address) as channel:
            for _ in self._rounds():
                watched = rpcs.LocalizationServiceStub(channel).WatchQueries(
                    pb.WatchQueriesRequest(scene=scene_name(SCENE))
                )
                health = health_pb2_grpc.HealthStub(channel).Watch(health_pb2.HealthCheckRequest())
                leaving = asyncio.create_task(self._pause(chance, 10.0))
                seen = await asyncio.gather(*(_seen_until(leaving, stream) for stream in (watched, health)))
                for name, (messages, how) in zip(("watch queries", "watch health"), seen, strict=True):
                    self.outcomes.counts[name, "messages"] += messages
                    self.outcomes.counts[name, how] += 1
                    # The server ends a connection after its maximum age.
                    if how not in ("left", "UNAVAILABLE", *BUSY):
                        self.outcomes.failures.setdefault(f"{name}: {how}", "the server ended it")

    async def comers(self, chance: random.Random) -> None:
        """Opens a connection each time, makes a call or two, and closes it, sometimes in the middle of a call."""
        for _ in self._rounds():
            async with aio.Client(self.address, ONCE) as client:
                await self.outcomes.count("comers", client.is_serving())
                listing = asyncio.create_task(self.outcomes.count("comers", _listed(client), "CANCELLED"))
                if chance.random() < 1 / 3:
                    await asyncio.sleep(chance.uniform(0.0, 0.01))
                    listing.cancel()
                    with suppress(asyncio.CancelledError):
                        await listing
                else:
                    await listing
            host, _, port = self.address.rpartition(":")
            _, writer = await asyncio.open_connection(host, int(port))
            writer.write(chance.choice([b"", b"PRI * HTTP/2.0\r\n\r\n", b"GET / HTTP/1.1\r\n\r\n"]))
            writer.transport.abort()
            await self._pause(chance, 3.0)

    async def wrong(self, chance: random.Random) -> None:
        """Requests scenes that do not exist, creates one that exists, and sends bytes that are not a message."""
        photo = self.place.queries[0]
        async with aio.Client(self.address, ONCE) as client, own_channel(self.address) as channel:
            raw: Any = channel.unary_unary("/mapless.v1.ReferenceService/GetScene")
            page = reference_pb.ListReferencesRequest(scene=scene_name(SCENE), page_token="of another list")
            wrongs: Sequence[tuple[Callable[[], Awaitable[object]], str]] = (
                (lambda: client.get_scene("there-is-none"), "NOT_FOUND"),
                (lambda: client.create_scene(SCENE), "ALREADY_EXISTS"),
                (lambda: client.delete_reference(SCENE, "there-is-none"), "NOT_FOUND"),
                (lambda: client.retrieve_references(photo.data[:100], photo.camera, SCENE, 3), "INVALID_ARGUMENT"),
                (lambda: raw(b"\xff\xff no message", timeout=20), "INVALID_ARGUMENT"),
                (
                    lambda: reference_rpcs.ReferenceServiceStub(channel).ListReferences(page, timeout=20),
                    "INVALID_ARGUMENT",
                ),
            )
            for _ in self._rounds():
                call, code = chance.choice(wrongs)
                await self.outcomes.count("wrong", call(), code)
                await self._pause(chance, 2.0)

    def _rounds(self) -> Iterator[int]:
        return takewhile(lambda _: not self.stopping.is_set(), count())

    async def _pause(self, chance: random.Random, mean_s: float) -> None:
        with suppress(asyncio.TimeoutError):
            await asyncio.wait_for(self.stopping.wait(), chance.expovariate(self.pace / mean_s))


@asynccontextmanager
async def churning(workers: Workers, seed: int) -> AsyncIterator[Outcomes]:
    """Runs all workers until the end of the block; RuntimeError if one has failed."""
    kinds = (workers.references, workers.scenes, workers.watchers, workers.comers, workers.wrong)
    tasks = [asyncio.create_task(work(random.Random(seed + number))) for number, work in enumerate(kinds)]
    try:
        yield workers.outcomes
        workers.stopping.set()
        await asyncio.wait(tasks, timeout=ENDING_S)
    finally:
        for task in tasks:
            task.cancel()
        ended = await asyncio.gather(*tasks, return_exceptions=True)
    for error in ended:
        if isinstance(error, BaseException):
            raise RuntimeError("a worker beside the queries failed, or does not end") from error


async def _listed(client: aio.Client) -> int:
    return len([reference async for reference in client.list_references(SCENE)])


async def _seen_until(leaving: asyncio.Task[None], stream: Any) -> tuple[int, str]:
    """Counts messages until `leaving` ends, then returns "left"; or the status if the server ended the stream."""
    seen = 0

    async def read() -> None:
        nonlocal seen
        async for _ in stream:
            seen += 1

    reading = asyncio.create_task(read())
    try:
        await asyncio.wait({reading, leaving}, return_when=asyncio.FIRST_COMPLETED)
        ended = reading.done()
    finally:
        stream.cancel()
        await asyncio.gather(reading, return_exceptions=True)
    return seen, (await stream.code()).name if ended else "left"
