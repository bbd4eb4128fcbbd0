"""`python -m bench.groups DATA`: photographs are looked for among all scenes of a folder, as with their scene named.

Of each folder some photographs are left out, which are then asked with their scene named, and among all scenes; and
among the scenes of other places only, where none must be localized. Then all references are stored once more, as one
scene, and in many small ones: what a group of so many scenes costs beside one scene of all references.

The engine works in this process, without work in the background, on a store that has all features. Processor time is
that of a query's stages, by turns, after a first query that fills the caches.
"""

import asyncio
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np
import typer

from mapless_server.engine.options import EngineOptions
from mapless_server.engine.query import Caller, Photo, Query, Result, SceneQuestion
from mapless_server.engine.queue_engine import QueueEngine
from mapless_server.method.judge.answer import Localization
from mapless_server.method.options import LocalizeOptions
from mapless_server.scenes import ANYWHERE
from mapless_server.scheduling import Flow
from mapless_server.security import SceneKey
from mapless_server.serve.assembly import engine_over
from mapless_server.serve.features import make_tiers
from mapless_server.settings import load_settings
from mapless_server.store import NewReference, SceneAttributes, Store
from mapless_tools.dataset import IMAGE_ENDINGS, Frame
from mapless_tools.evaluate.metrics import pose_error
from mapless_tools.usage import failures_end_command
from research.all_features import describe_all
from research.places import Scenes, is_right, spread

LIMIT_S = 600.0
ALL = SceneKey("all")
APART = 10_000.0
"""Distance of the folders' worlds in the one scene of all references."""
SMALL = 4
"""References of a scene of the many small ones."""


@dataclass(frozen=True, eq=False)
class Folder:
    """A folder's references, photographs that are none, and folders of the same place."""

    scene: SceneKey
    metric: bool
    references: Sequence[Frame]
    photographs: Sequence[Frame]
    same_place: frozenset[SceneKey]


@dataclass
class Counts:
    """Answers to the photographs of a folder: `same` is the number whose answers were the same bits."""

    asked: int = 0
    named: int = 0
    among: int = 0
    right_named: int = 0
    right_among: int = 0
    same: int = 0
    wrong_scene: int = 0
    named_s: float = 0.0
    among_s: float = 0.0
    outside: int = 0
    accepted_outside: int = 0
    notes: list[str] = field(default_factory=list)

    def line(self, name: str) -> str:
        """The row of a table."""
        ratio = self.among_s / self.named_s if self.named_s else 0.0
        numbers = self.asked, self.named, self.right_named, self.among, self.right_among, self.wrong_scene, self.same
        shown = " | ".join(str(it) for it in numbers)
        return f"| {name} | {shown} | {ratio:.2f} | {self.accepted_outside} of {self.outside} |"


HEADER = (
    "| folder | photographs | named: localized | right | among all: localized | right | in a wrong scene "
    "| the same answer | processor time, ratio | among other places: localized |",
    "|---" * 10 + "|",
)


class Asked:
    """An engine that is asked in this process."""

    def __init__(self, engine: QueueEngine, loop: asyncio.AbstractEventLoop) -> None:
        self._engine, self._loop = engine, loop

    def ask(self, frame: Frame, *scenes: SceneKey) -> tuple[Result, float]:
        """The answer in one scene, or among several, and its processor time in seconds."""
        photo = Photo(frame.image_path.read_bytes(), frame.camera, "image")
        query = Query(scenes[0], (), photo, ANYWHERE, 10, LocalizeOptions())
        if len(scenes) > 1:
            questions = [SceneQuestion(it, ANYWHERE) for it in scenes]
            query = Query(scenes[0], (), photo, ANYWHERE, 10, LocalizeOptions(), scenes=questions)
        job = self._engine.query_job(query, Caller(Flow("", "bench"), time.monotonic() + LIMIT_S))
        result = self._loop.run_until_complete(self._engine.run(job))
        return result, sum(it.processor_s for it in job.records)


def folders_of(scenes: Scenes, most: int, photographs: int) -> Iterator[Folder]:
    """The folders of enough photographs, of which some, evenly spread, are left out."""
    keys = {name: SceneKey(name.replace("/", "-")) for name in scenes.names}
    for name in scenes.names:
        dataset = scenes.dataset(name)
        frames = spread([it for it in dataset.frames if it.image_path.suffix.lower() in IMAGE_ENDINGS], most)
        asked = spread(frames[1:-1], min(photographs, len(frames) // 3))
        same_place = frozenset(keys[it] for it in set(scenes.names) - set(scenes.others(name)))
        references = [it for it in frames if it not in asked]
        if asked:
            yield Folder(keys[name], dataset.metric, references, asked, same_place)


def store_all(store: Store, engine: QueueEngine, folders: Sequence[Folder]) -> None:
    """Stores each folder's references as a scene; all of them as one; and as many small ones."""
    store.create_scene(ALL, SceneAttributes(arbitrary_unit=True))
    for number, folder in enumerate(folders):
        store.create_scene(folder.scene, SceneAttributes(arbitrary_unit=not folder.metric))
        for i, frame in enumerate(folder.references):
            photo = Photo(frame.image_path.read_bytes(), frame.camera, "image")
            (found,) = describe_all(engine, [photo])
            small = SceneKey(f"small-{number}-{i // SMALL}")
            if i % SMALL == 0:
                store.create_scene(small, SceneAttributes(arbitrary_unit=not folder.metric))
            pose = frame.world_from_camera
            away = pose.shifted(np.array([APART * number, 0.0, 0.0]))
            for scene, name, at in (
                (folder.scene, f"r{i}", pose),
                (small, f"r{i}", pose),
                (ALL, f"r{number}-{i}", away),
            ):
                new = NewReference(name, photo.image, photo.camera, at, found.views, found.descriptors)
                store.add_references(scene, [new])
        print(f"stored {folder.scene}: {len(folder.references)} references", flush=True)


def same(first: Result, second: Result) -> bool:
    """Whether two answers have the same bits."""
    one, other = first.answer.outcome, second.answer.outcome
    if not isinstance(one, Localization) or not isinstance(other, Localization):
        return type(one) is type(other) and first.scene_key == second.scene_key
    matrices = one.world_from_camera.matrix(), other.world_from_camera.matrix()
    return first.scene_key == second.scene_key and bool(np.array_equal(*matrices)) and one.trust == other.trust


def measure(asked: Asked, folder: Folder, everything: Sequence[Folder], outside: int) -> Counts:
    """Asks the photographs of a folder in its scene, among all scenes, and among those of other places."""
    counts, others = Counts(), [it.scene for it in everything if it.scene not in folder.same_place]
    all_scenes = [folder.scene, *others]  # folders of one place count as one
    for frame in folder.photographs:
        asked.ask(frame, *all_scenes)
        named, named_s = asked.ask(frame, folder.scene)
        among, among_s = asked.ask(frame, *all_scenes)
        counts.asked += 1
        counts.named += (is_named := isinstance(named.answer.outcome, Localization))
        counts.among += (is_among := isinstance(among.answer.outcome, Localization))
        counts.right_named += is_named and is_right_answer(named, frame, folder)
        counts.right_among += is_among and is_right_answer(among, frame, folder)
        counts.same += (is_same := same(named, among))
        counts.wrong_scene += is_among and among.scene_key != folder.scene
        counts.named_s += named_s
        counts.among_s += among_s
        if not is_same:
            print(f"  {frame.name}: named {said(named)}; among all {said(among)}", flush=True)
    for frame in spread(folder.references, outside):
        found, _ = asked.ask(frame, *others)
        counts.outside += 1
        counts.accepted_outside += (is_accepted := isinstance(found.answer.outcome, Localization))
        if is_accepted:
            print(f"  {frame.name}: among other places {said(found)}", flush=True)
    return counts


def is_right_answer(result: Result, frame: Frame, folder: Folder) -> bool:
    """Whether the pose is right."""
    outcome, support = result.answer.outcome, result.answer.support
    if not isinstance(outcome, Localization) or result.scene_key != folder.scene:
        return False
    off, off_deg = pose_error(frame.world_from_camera, outcome.world_from_camera)
    return is_right(off, off_deg, getattr(support, "distance_m", float)(), folder.metric)


def said(result: Result) -> str:
    """An answer in one line."""
    outcome = result.answer.outcome
    tried = ", ".join(
        f"{it.scene_key} {it.reference_count} refs {it.similarity:.3f} {it.match_count} matches{'*' * it.attempted}"
        for it in result.scenes
    )
    rungs = " ".join(f"{it.rung}:{it.outcome}" for it in result.attempts)
    what = f"localized with {outcome.inlier_count}" if isinstance(outcome, Localization) else outcome.message
    return f"{result.scene_key} {what} [{tried}] [{rungs}]"


def measure_many(asked: Asked, store: Store, folders: Sequence[Folder], count: int) -> Iterator[str]:
    """What photographs cost among many small scenes, and in one scene of all references."""
    small = [it.scene_key for it in store.list_scenes("default", 100_000) if it.scene_key.startswith("small-")]
    frames = [it.photographs[0] for it in folders][:count]
    times = []
    for frame in frames:
        asked.ask(frame, ALL)
        asked.ask(frame, *small)
        one, many, again, last = (asked.ask(frame, *scenes)[1] for scenes in ([ALL], small, small, [ALL]))
        times.append((one + last, many + again))
        print(
            f"  {frame.image_path.parent.parent.name}: {500 * (one + last):.0f} ms, {500 * (many + again):.0f}",
            flush=True,
        )
    one_s, many_s = np.sum(times, axis=0) / 2 / len(times)
    yield f"one scene of all references: {1e3 * one_s:.0f} ms a photograph"
    yield f"{len(small)} scenes: {1e3 * many_s:.0f} ms, {many_s / one_s:.2f} times"


def main(
    data: Annotated[Path, typer.Argument(help="Folder of the scenes' folders.")],
    photographs: Annotated[int, typer.Option(min=1, help="Photographs of each folder that are left out.")] = 8,
    references: Annotated[int, typer.Option(min=2, help="Photographs of each folder at most.")] = 60,
    outside: Annotated[int, typer.Option(min=0, help="Of each folder, asked among other places.")] = 10,
    tiers: Annotated[int, typer.Option(min=1, help="Kinds of features that are used, the cheapest first.")] = 3,
    folder: Annotated[Path | None, typer.Option(help="Where the store is kept for another time.")] = None,
) -> None:
    """Compare answers among all scenes with those of the scene named."""
    with failures_end_command(), TemporaryDirectory() as temporary:
        where = folder or Path(temporary)
        where.mkdir(exist_ok=True)
        is_made = any(where.iterdir())
        loop, folders = asyncio.new_event_loop(), list(folders_of(Scenes(data), references, photographs))
        made = make_tiers(load_settings({"data_dir": str(where)}).settings)
        with closing(loop), Store.open(where) as store:
            engine = engine_over(store, made[:tiers], EngineOptions(workers=1))
            if not is_made:
                store_all(store, engine, folders)
            asked, total = Asked(engine, loop), Counts()
            print("\n".join(HEADER), flush=True)
            for it in folders:
                counts = measure(asked, it, folders, outside)
                print(counts.line(it.scene), flush=True)
                for name in vars(total):
                    setattr(total, name, getattr(total, name) + getattr(counts, name))
            print(total.line("all"), flush=True)
            for line in measure_many(asked, store, folders, len(folders)):
                print(line, flush=True)
            loop.run_until_complete(engine.close())


if __name__ == "__main__":
    typer.run(main)
