"""When a scene contradicts itself: each scene's poses as given, in OpenGL's axes, inverse, and in millimetres."""

import asyncio
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np

from mapless.geometry import RigidTransform
from mapless_server.engine.options import EngineOptions
from mapless_server.engine.query import Description, Photo
from mapless_server.engine.queue_engine import QueueEngine
from mapless_server.images import ImageLimits
from mapless_server.scenes.agreement import Agreement
from mapless_server.security import SceneKey
from mapless_server.serve.assembly import engine_over
from mapless_server.serve.features import make_tiers
from mapless_server.settings import load_settings
from mapless_server.store import NewReference, SceneAttributes, Store
from mapless_tools.dataset import Frame
from mapless_tools.ingest.formats.cameras import read_folder
from research.all_features import describe_all
from research.places import spread

from .page import Measurement, Row

REFERENCES, MAX_FRAMES = 10, 400
OPENGL = np.diag([1.0, -1.0, -1.0])
READINGS: dict[str, Callable[[RigidTransform], RigidTransform]] = {
    "as given": lambda pose: pose,
    "OpenGL axes": lambda pose: RigidTransform(pose.rotation @ OPENGL, pose.translation),
    "inverse": lambda pose: pose.inverse(),
    "millimetres": lambda pose: RigidTransform(pose.rotation, 1000 * pose.translation),
}


def _rows(folder: Path) -> Iterator[Row]:
    settings = load_settings({"features": "sift"}).settings
    options = EngineOptions(image_limits=ImageLimits(max_bytes=2**28, max_pixels=200_000_000))
    for path in sorted(it.parent for it in folder.glob("*/cameras.json")):
        dataset = read_folder(path)
        frames = spread(list(dataset.frames)[:MAX_FRAMES], REFERENCES)
        row: dict[str, object] = {"scene": path.name, "references": len(frames)}
        loop = asyncio.new_event_loop()
        with closing(loop), tempfile.TemporaryDirectory() as place, Store.open(Path(place), 2**28) as store:
            engine = engine_over(store, make_tiers(settings), options)
            photos = [Photo(it.image_path.read_bytes(), it.camera, "image") for it in frames]
            described = describe_all(engine, photos)
            for reading, change in READINGS.items():
                is_millimetres = reading == "millimetres"
                if is_millimetres and not dataset.metric:
                    row[reading] = "-"
                    continue
                key = SceneKey(f"/{reading.replace(' ', '-')}")
                store.create_scene(key, SceneAttributes(arbitrary_unit=not dataset.metric))
                said_at, found = _added(engine, store, key, _references(frames, change, described))
                is_warned = not found.contradicts_itself and bool(found.warnings(arbitrary_unit=not dataset.metric))
                agreeing = f"{found.agreeing_count} of {found.pair_count}"
                said = f", said at {said_at}" if said_at else ""
                row[reading] = ("warned" if is_warned else "not warned") if is_millimetres else agreeing + said
            loop.run_until_complete(engine.close())
        yield row


def _references(
    frames: Sequence[Frame], change: Callable[[RigidTransform], RigidTransform], described: Sequence[Description]
) -> list[NewReference]:
    return [
        NewReference(
            f"r{i:03d}",
            frame.image_path.read_bytes(),
            frame.camera,
            change(frame.world_from_camera),
            it.views,
            it.descriptors,
        )
        for i, (frame, it) in enumerate(zip(frames, described, strict=True))
    ]


def _added(
    engine: QueueEngine, store: Store, key: SceneKey, references: Sequence[NewReference]
) -> tuple[int, Agreement]:
    """Adds references one by one; after how many the scene was said to contradict itself, or 0, and the agreement."""
    agreements, said_at = engine.references.agreements, 0
    for i, reference in enumerate(references):
        store.add_references(key, [reference])
        agreements.changed(key)
        if agreements.current(key).contradicts_itself and not said_at:
            said_at = i + 1
    return said_at, agreements.current(key)


MEASUREMENTS = {"scene-agreement": Measurement(_rows)}
