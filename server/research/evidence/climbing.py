"""Photographs climb the whole ladder, of their own place and of others: what each rung earns, and what could be known.

The engine works in this process, on a store of its own, and makes every attempt, worth it or not.
"""

import asyncio
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from mapless_server.engine.options import EngineOptions
from mapless_server.engine.query import Caller, Photo, Query, Tried
from mapless_server.engine.queue_engine import QueueEngine
from mapless_server.method.judge.answer import Localization
from mapless_server.method.options import DoubtOptions, LocalizeOptions
from mapless_server.method.promise import PromiseOptions
from mapless_server.scenes import ANYWHERE
from mapless_server.scheduling import Flow
from mapless_server.security import SceneKey
from mapless_server.serve.assembly import engine_over
from mapless_server.serve.features import make_tiers
from mapless_server.settings import load_settings
from mapless_server.store import NewReference, SceneAttributes, Store
from mapless_tools.dataset import Frame
from mapless_tools.evaluate.metrics import pose_error
from research.all_features import describe_all
from research.places import Place, Scenes, is_right, own_and_other

ALL = EngineOptions(doubt=DoubtOptions(promise=PromiseOptions(least_gain_per_s=0.0)), workers=1)
"""Every attempt is made."""
OWN, OTHERS = 6, 2
"""Photographs of a folder, and of others, that are asked in it."""
SCENE = SceneKey("climbs")
LIMIT_S = 600.0


@dataclass(frozen=True)
class Climb:
    """How a photograph climbed.

    Attributes:
        folder: where it was asked.
        is_own: whether it shows that place.
        is_right: whether the answer is right.
        attempts: its attempts, in order.
    """

    folder: str
    is_own: bool
    is_right: bool
    attempts: tuple[Tried, ...]


def climbs(scenes: Scenes) -> Iterator[Climb]:
    """Photographs of each scene and of others, asked in it."""
    for name, place, own, others in own_and_other(scenes, OWN, OTHERS):
        yield from _asked(name, place, own, others)


def _asked(folder: str, place: Place, own: Sequence[Frame], others: Sequence[Frame]) -> Iterator[Climb]:
    loop = asyncio.new_event_loop()
    with closing(loop), tempfile.TemporaryDirectory() as data, Store.open(Path(data)) as store:
        tiers = make_tiers(load_settings({"data_dir": data}).settings)
        engine = engine_over(store, tiers, ALL)
        loop.run_until_complete(_store(engine, store, place))
        for frame in own:
            yield loop.run_until_complete(_climb(engine, folder, place, frame, is_own=True))
        for frame in others:
            yield loop.run_until_complete(_climb(engine, folder, place, frame, is_own=False))
        loop.run_until_complete(engine.close())


async def _store(engine: QueueEngine, store: Store, place: Place) -> None:
    photos = [Photo(it.image_path.read_bytes(), it.camera, "image") for it in place.reference_frames]
    described = describe_all(engine, photos)
    store.create_scene(SCENE, SceneAttributes(arbitrary_unit=not place.dataset.metric))
    frames = zip(place.reference_frames, photos, described, strict=True)
    references = [
        NewReference(f"r{i}", photo.image, photo.camera, frame.world_from_camera, it.views, it.descriptors)
        for i, (frame, photo, it) in enumerate(frames)
    ]
    store.add_references(SCENE, references)


async def _climb(engine: QueueEngine, folder: str, place: Place, frame: Frame, is_own: bool) -> Climb:
    photo = Photo(frame.image_path.read_bytes(), frame.camera, "image")
    query = Query(SCENE, (), photo, ANYWHERE, 10, LocalizeOptions())
    result = await engine.run(engine.query_job(query, _caller()))
    outcome, support, right = result.answer.outcome, result.answer.support, False
    if is_own and isinstance(outcome, Localization):
        off, off_deg = pose_error(frame.world_from_camera, outcome.world_from_camera)
        distance = getattr(support, "distance_m", float)() or place.radius
        right = is_right(off, off_deg, distance, place.dataset.metric)
    return Climb(folder, is_own, right, result.attempts)


def _caller() -> Caller:
    return Caller(Flow("", "research"), time.monotonic() + LIMIT_S)
