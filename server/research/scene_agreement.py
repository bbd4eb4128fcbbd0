"""Warnings and answers of servers about scenes whose poses are read otherwise than they were meant.

`python -m research.scene_agreement SCENES [--features sift] [--references 16] [--queries 6] [--only NAME ...]`: each
folder of SCENES with `cameras.json` becomes a scene in an engine of this process, with its poses as given, in OpenGL's
axes, inverse, and in millimetres. References are added one at a time. The table has, for each reading, after how many
references the scene is said to contradict itself, the pairs that agree, the median depth of what these show and whether
the unit is warned of, and the queries that are answered: rightly, wrongly, and rejected with the advice to check the
references' poses. Axes and inverse must be said, and nothing answered; the others must not be said. Of scenes in
metres, millimetres must be warned of, and nothing else.
"""

import argparse
import asyncio
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapless.geometry import RigidTransform, rotation_angle_deg
from mapless_server.engine.options import EngineOptions
from mapless_server.engine.query import Caller, Description, Photo, Query
from mapless_server.engine.queue_engine import QueueEngine
from mapless_server.images import ImageLimits
from mapless_server.method.judge.answer import Localization
from mapless_server.method.options import LocalizeOptions
from mapless_server.method.rejection import Advice
from mapless_server.scenes import ANYWHERE
from mapless_server.scenes.agreement import Agreement
from mapless_server.scheduling import Flow
from mapless_server.security import SceneKey
from mapless_server.serve.assembly import engine_over, make_tiers
from mapless_server.settings import load_settings
from mapless_server.store import NewReference, SceneAttributes, Store
from mapless_tools.dataset import Frame
from mapless_tools.ingest.formats.cameras import read_folder

RIGHT_SHARE, RIGHT_DEG = 0.05, 5.0
"""A right answer is off by at most this share of the median distance of the cameras from one another, and degrees."""
MAX_FRAMES = 400
OPENGL = np.diag([1.0, -1.0, -1.0])
Reading = Callable[[RigidTransform], RigidTransform]
READINGS: dict[str, Reading] = {
    "as given": lambda pose: pose,
    "OpenGL axes": lambda pose: RigidTransform(pose.rotation @ OPENGL, pose.translation),
    "inverse": lambda pose: pose.inverse(),
    "millimetres": lambda pose: RigidTransform(pose.rotation, 1000 * pose.translation),
}


COLUMNS = (
    "scene",
    "reading",
    "references",
    "said at",
    "pairs that agree",
    "median depth",
    "unit",
    "right",
    "wrong",
    "advised",
    "rejected",
    "cpu s",
)


@dataclass(frozen=True)
class Sample:
    """References and queries of a folder, evenly spread and disjoint, and the photographs' features."""

    name: str
    is_metric: bool
    references: Sequence[Frame]
    queries: Sequence[Frame]
    described: Sequence[Description]


@dataclass
class Found:
    """A scene's result: after how many references it was said, or 0, in the end, and the outcomes of its queries."""

    said_at: int
    agreement: Agreement
    warns_of_unit: bool
    outcomes: Counter[str]
    cpu_s: float


def photo_of(frame: Frame) -> Photo:
    """A frame as a request has it."""
    return Photo(frame.image_path.read_bytes(), frame.camera, "image")


def caller() -> Caller:
    """A caller without haste."""
    return Caller(Flow("tenant", "client"), time.monotonic() + 600)


async def sample_of(engine: QueueEngine, folder: Path, references: int, queries: int) -> Sample:
    """Reads a folder, and describes its references."""
    dataset = read_folder(folder)
    frames = list(dataset.frames)[:MAX_FRAMES]
    asked = sorted(set(np.linspace(1, len(frames) - 2, queries).round().astype(int).tolist()))
    others = [i for i in range(len(frames)) if i not in asked]
    chosen = np.unique(np.linspace(0, len(others) - 1, min(references, len(others))).round().astype(int))
    kept = [frames[others[i]] for i in chosen]
    described = await engine.describe([photo_of(it) for it in kept], caller())
    return Sample(folder.name, dataset.metric, kept, [frames[i] for i in asked], described)


async def examine(engine: QueueEngine, store: Store, sample: Sample, reading: Reading, name: str) -> Found:
    """Adds the references one by one, then asks with the queries."""
    key = SceneKey(f"/{name}")
    store.create_scene(key, SceneAttributes(arbitrary_unit=not sample.is_metric))
    agreements, said_at = engine.references.agreements, 0
    for i, (frame, found) in enumerate(zip(sample.references, sample.described, strict=True)):
        pose = reading(frame.world_from_camera)
        given = f"r{i:03d}", frame.image_path.read_bytes(), frame.camera, pose, found.views, found.descriptors
        store.add_references(key, [NewReference(*given)])
        agreements.changed(key)
        if agreements.current(key).contradicts_itself and not said_at:
            said_at = i + 1
    outcomes: Counter[str] = Counter()
    begin_s = time.process_time()
    for frame in sample.queries:
        query = Query(key, (), photo_of(frame), ANYWHERE, 10, LocalizeOptions())
        result = await engine.run(engine.query_job(query, caller()))
        outcomes[outcome_of(result.answer.outcome, reading(frame.world_from_camera), sample, reading)] += 1
    seconds = time.process_time() - begin_s
    agreements.changed(key)
    now = agreements.current(key)
    warns_of_unit = not now.contradicts_itself and bool(now.warnings(arbitrary_unit=not sample.is_metric))
    return Found(said_at, now, warns_of_unit, outcomes, seconds)


def outcome_of(outcome: object, true: RigidTransform, sample: Sample, reading: Reading) -> str:
    """Names the outcome of a query."""
    if isinstance(outcome, Localization):
        centres = np.array([reading(it.world_from_camera).translation for it in sample.references])
        reach = float(np.median(np.linalg.norm(centres - np.median(centres, axis=0), axis=1)))
        off = float(np.linalg.norm(outcome.world_from_camera.translation - true.translation))
        off_deg = rotation_angle_deg(outcome.world_from_camera.rotation.T @ true.rotation)
        return "right" if off <= max(RIGHT_SHARE * reach, 1e-9) * 4 and off_deg <= RIGHT_DEG else "wrong"
    hint = getattr(outcome, "hint", None)
    return "advised" if hint is not None and hint.advice is Advice.CHECK_REFERENCE_POSES else "rejected"


async def main(arguments: argparse.Namespace) -> None:
    """Prints the table, a row at a time."""
    settings = load_settings({"features": arguments.features}).settings
    limits = ImageLimits(max_bytes=2**28, max_pixels=200_000_000)
    print(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}")
    for folder in sorted(it for it in arguments.scenes.iterdir() if (it / "cameras.json").exists()):
        if arguments.only and folder.name not in arguments.only:
            continue
        with tempfile.TemporaryDirectory() as place:
            store = Store.open(Path(place), 2**28)
            engine = engine_over(store, make_tiers(settings), EngineOptions(image_limits=limits))
            sample = await sample_of(engine, folder, arguments.references, arguments.queries)
            for i, (reading, change) in enumerate(READINGS.items()):
                if arguments.readings and reading not in arguments.readings:
                    continue
                found = await examine(engine, store, sample, change, f"scene-{i}")
                counts = (found.outcomes[it] for it in ("right", "wrong", "advised", "rejected"))
                cells: list[object] = [sample.name, reading, len(sample.references), found.said_at or "-"]
                depth = found.agreement.median_depth
                cells += [f"{found.agreement.agreeing_count}/{found.agreement.pair_count}"]
                cells += ["-" if depth is None else f"{depth:.3g}", "warned" if found.warns_of_unit else "-"]
                cells += [*counts, f"{found.cpu_s:.1f}"]
                print("| " + " | ".join(map(str, cells)) + " |", flush=True)
                if arguments.verbose:
                    print(f"<!-- {found.agreement.contradiction} -->", flush=True)
            await engine.close()
            store.close()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", type=Path)
    parser.add_argument("--features", default="sift")
    parser.add_argument("--references", type=int, default=16)
    parser.add_argument("--queries", type=int, default=6)
    parser.add_argument("--only", nargs="*")
    parser.add_argument("--readings", nargs="*")
    parser.add_argument("--verbose", action="store_true")
    sys.exit(asyncio.run(main(parser.parse_args())))
