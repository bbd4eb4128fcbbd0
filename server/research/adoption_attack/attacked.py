"""A server in this process whose scene adopts, with a clock, and an adopter that considers when it is asked."""

import asyncio
import time
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from datetime import datetime, timedelta, timezone
from pathlib import Path

from mapless import AdoptionPolicy, NewReference
from mapless.aio import Client
from mapless.geometry import Camera, RigidTransform
from mapless.v1 import localization_service_pb2 as pb
from mapless.wire import camera_to_message
from mapless_server.engine.query import Caller
from mapless_server.scenes.adoption.policy import Evidence
from mapless_server.scenes.observer import BackgroundObserver
from mapless_server.scheduling import Flow
from mapless_server.security import DEFAULT_TENANT, Principal, Role
from mapless_server.serve.adoption.adopter import Adopter
from mapless_server.serve.adoption.surveyed import SurveyedLocalizer
from mapless_server.serve.running import Running, running_server
from mapless_server.services.messages.queries import query_from_message
from mapless_server.settings import Settings, load_settings
from mapless_server.store import SceneAttributes, Store
from mapless_tools.dataset import Frame
from mapless_tools.ingest.formats.cameras import read_folder

SCENE = "attacked"
LIMIT_S = 300.0
HOURS = 24.0 * 3650
ATTACKER = Principal(DEFAULT_TENANT, Role.LOCALIZE, "attacker")
"""A holder of a token that may localize and nothing else."""


@dataclass
class Clock:
    """The adopter's clock: days pass when they are set."""

    start: datetime = field(default_factory=lambda: datetime.now(timezone.utc))
    day: int = 0

    def __call__(self) -> datetime:
        """The time at present."""
        return self.start + timedelta(days=self.day)


@dataclass(frozen=True)
class Attacked:
    """The server under attack: asked in this process, so that nothing waits for it to be idle."""

    running: Running
    store: Store
    client: Client
    adopter: Adopter
    clock: Clock

    async def answer(self, image: bytes, camera: Camera) -> Evidence | None:
        """The answer to a photograph that is not offered; None without a pose or its radii."""
        return await self._asked(image, camera, None)

    async def send(self, image: bytes, camera: Camera, sender: Principal = ATTACKER) -> tuple[Evidence | None, str]:
        """Its answer, and what became of it: rejected, uncertain, adopted, or why not."""
        answered = await self._asked(image, camera, sender)
        candidate = self.adopter.take()
        if answered is None:
            return None, "rejected"
        if candidate is None:
            return answered, "uncertain"
        refused = await self.adopter.consider(candidate)
        return answered, "adopted" if refused is None else refused.value

    async def _asked(self, image: bytes, camera: Camera, sender: Principal | None) -> Evidence | None:
        engine = self.running.engine
        request = pb.LocalizeRequest(scene=f"scenes/{SCENE}", image=image, intrinsics=camera_to_message(camera))
        request.options.allow_adoption = sender is not None
        query = query_from_message(request, DEFAULT_TENANT, engine.options, SceneAttributes())
        caller = Caller(Flow(DEFAULT_TENANT, "attack"), time.monotonic() + LIMIT_S)
        result = await engine.run(engine.query_job(query, caller))
        if sender is not None:
            self.adopter.offer(request.options, query, result, sender)
        return SurveyedLocalizer.evidence(query, result)


def settings_of(data_dir: Path) -> Settings:
    """The settings of the environment, for a server in this process."""
    flags = {"host": "127.0.0.1", "port": 0, "metrics": False, "data_dir": data_dir}
    return load_settings(flags).settings


async def surveyed(survey: Path, data_dir: Path) -> None:
    """Makes a store whose scene adopts by the default policy and has the survey's references, unless it is there.

    All of their features have been found, also those that only doubtful photographs need.
    """
    if data_dir.is_dir():
        return
    making = data_dir.with_name(f"{data_dir.name}-making")
    async with running_server(settings_of(making)) as running, Client(running.address) as client:
        await client.create_scene(SCENE, adoption=AdoptionPolicy())
        frames = read_folder(survey).frames
        references = [NewReference(it.name, it.image_path, it.camera, it.world_from_camera) for it in frames]
        await client.add_references(SCENE, references, timeout_s=3600)
        while any(it.kind == "features" for it in (await client.get_scene(SCENE)).pending_work):
            await asyncio.sleep(0.2)
    making.rename(data_dir)


@asynccontextmanager
async def attacked(data_dir: Path) -> AsyncIterator[Attacked]:
    """Runs a server over a copy of such a store."""
    store = Store.open(data_dir)
    async with running_server(settings_of(data_dir), store=store) as running, Client(running.address) as client:
        clock = Clock()
        adopter = Adopter(running.engine, store, BackgroundObserver(), HOURS, now=clock)
        yield Attacked(running, store, client, adopter, clock)


Posed = tuple[RigidTransform, Evidence | None]


async def answers(server: Attacked, frames: Sequence[Frame]) -> list[Posed]:
    """True poses of photographs of the surveyed room, and their answers; they are not adopted."""
    return [(it.world_from_camera, await server.answer(it.image_path.read_bytes(), it.camera)) for it in frames]
