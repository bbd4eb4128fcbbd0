"""`python -m research.groups DATA`: photographs are looked for among all scenes of a folder, as with their scene named.

Of each folder some photographs are left out, which are then asked with their scene named, and among all scenes; and
among the scenes of other places only, where none must be localized. Of 200 scenes, those of the folders and others
with flipped photographs of these, the cost is compared with that of one scene of all references.

The engine works in this process, without work in the background, on a store that has all features. Processor time is
that of a query's stages, by turns, after a first query that fills the caches.
"""

import asyncio
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import cv2
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
SCENES, SMALL = 200, 2
"""Scenes of the group whose cost is measured, and references of those with flipped photographs."""


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


def store_folders(store: Store, engine: QueueEngine, folders: Sequence[Folder]) -> None:
    """Stores each folder's references as a scene."""
    for folder in folders:
        store.create_scene(folder.scene, SceneAttributes(arbitrary_unit=not folder.metric))
        store.add_references(folder.scene, [described(engine, it, f"r{i}") for i, it in enumerate(folder.references)])
        print(f"stored {folder.scene}: {len(folder.references)} references", flush=True)


def described(engine: QueueEngine, frame: Frame, name: str, is_flipped: bool = False) -> NewReference:
    """A reference with all features, of a photograph or of what is above in it below."""
    image = frame.image_path.read_bytes()
    if is_flipped:
        pixels = cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        assert pixels is not None, frame.image_path
        image = cv2.imencode(".jpg", cv2.flip(pixels, 0))[1].tobytes()
    (found,) = describe_all(engine, [Photo(image, frame.camera, "image")])
    return NewReference(name, image, frame.camera, frame.world_from_camera, found.views, found.descriptors)


def store_many(store: Store, engine: QueueEngine, folders: Sequence[Folder]) -> list[SceneKey]:
    """Stores many scenes, and one of all their references; returns the many, those of the folders first."""
    scenes = {folder.scene: [described(engine, it, "") for it in folder.references] for folder in folders}
    flipped = [described(engine, it, "", is_flipped=True) for folder in folders for it in folder.references]
    for k in range(SCENES - len(folders)):
        scenes[SceneKey(f"flipped-{k}")] = [flipped[(k * SMALL + i) % len(flipped)] for i in range(SMALL)]
    store.create_scene(ALL)
    for number, (scene, references) in enumerate(scenes.items()):
        store.create_scene(scene)
        store.add_references(scene, [replace(it, reference_id=f"r{i}") for i, it in enumerate(references)])
        away = np.array([APART * number, 0.0, 0.0])
        moved = ((it, it.world_from_camera.shifted(away)) for it in references)
        named = [replace(it, reference_id=f"r{number}-{i}", world_from_camera=at) for i, (it, at) in enumerate(moved)]
        store.add_references(ALL, named)
    print(f"stored {len(scenes)} scenes of {sum(map(len, scenes.values()))} references, and these as one", flush=True)
    return list(scenes)


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


def measure_many(asked: Asked, folders: Sequence[Folder], scenes: Sequence[SceneKey]) -> Iterator[str]:
    """Cost of photographs among many scenes, and in one of all references, by turns (A B B A)."""
    times, found = [], Counter[str]()
    for folder in folders:
        frame = folder.photographs[0]
        first = [asked.ask(frame, ALL)[0], asked.ask(frame, *scenes)[0]]
        one, many, again, last = (asked.ask(frame, *some)[1] for some in ([ALL], scenes, scenes, [ALL]))
        times.append((one + last, many + again))
        found.update(["all"] * isinstance(first[0].answer.outcome, Localization))
        found.update(["many"] * isinstance(first[1].answer.outcome, Localization))
        print(
            f"  {folder.scene}: {500 * (one + last):.0f} ms, {500 * (many + again):.0f}; {said(first[1])}", flush=True
        )
    one_s, many_s = np.sum(times, axis=0) / 2 / len(times)
    yield f"one scene of all references: {1e3 * one_s:.0f} ms a photograph, {found['all']} of {len(folders)} localized"
    yield f"{len(scenes)} scenes: {1e3 * many_s:.0f} ms, {many_s / one_s:.2f} times, {found['many']} localized"


def measure_folders(asked: Asked, folders: Sequence[Folder], outside: int) -> Iterator[str]:
    """A row for each folder, and their sum."""
    yield from HEADER
    total = Counts()
    for it in folders:
        counts = measure(asked, it, folders, outside)
        yield counts.line(it.scene)
        for name in vars(total):
            setattr(total, name, getattr(total, name) + getattr(counts, name))
    yield total.line("all")


def of_other_places(folders: Sequence[Folder]) -> list[Folder]:
    """One folder of each place."""
    chosen: list[Folder] = []
    for it in folders:
        if not any(other.scene in it.same_place for other in chosen):
            chosen.append(it)
    return chosen


def main(
    data: Annotated[Path, typer.Argument(help="Folder of the scenes' folders.")],
    photographs: Annotated[int, typer.Option(min=1, help="Photographs of each folder that are left out.")] = 8,
    references: Annotated[int, typer.Option(min=3, help="Photographs of each folder at most.")] = 60,
    outside: Annotated[int, typer.Option(min=0, help="Of each folder, asked among other places.")] = 10,
    tiers: Annotated[int, typer.Option(min=1, help="Kinds of features that are used, the cheapest first.")] = 3,
    many: Annotated[bool, typer.Option(help="Measure the cost of many scenes instead.")] = False,
) -> None:
    """Compare answers among all scenes with those of the scene named; settings are those of the environment."""
    with failures_end_command(), TemporaryDirectory() as temporary:
        loop, folders = asyncio.new_event_loop(), list(folders_of(Scenes(data), references, photographs))
        made = make_tiers(load_settings({"data_dir": temporary}).settings)
        with closing(loop), Store.open(Path(temporary)) as store:
            engine = engine_over(store, made[:tiers], EngineOptions(workers=1))
            asked = Asked(engine, loop)
            if many:
                chosen = of_other_places(folders)
                lines = measure_many(asked, chosen, store_many(store, engine, chosen))
            else:
                store_folders(store, engine, folders)
                lines = measure_folders(asked, folders, outside)
            for line in lines:
                print(line, flush=True)
            loop.run_until_complete(engine.close())


if __name__ == "__main__":
    typer.run(main)
