"""Photographs among the scenes of all folders, of which some are there twice: in how many scenes one is looked for."""

import asyncio
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from mapless_server.engine import scene_group
from mapless_server.engine.options import EngineOptions
from mapless_server.method.judge.answer import Localization
from mapless_server.method.rejection import Rejection, RejectionReason
from mapless_server.security import SceneKey
from mapless_server.serve.assembly import engine_over
from mapless_server.serve.features import make_tiers
from mapless_server.settings import load_settings
from mapless_server.store import Store
from research.groups import Asked, Folder, folders_of, is_right_answer, store_folders

from ..places import Scenes
from .page import Measurement, Row

FRAMES, ASKED = 12, 3
"""Photographs of each folder, of which so many are asked and the others are references: few, so that scenes are in
doubt."""
TRIED = (1, 2, 3)


def _tried(data: Path) -> Iterator[Row]:
    folders, loop = list(folders_of(Scenes(data), FRAMES, ASKED)), asyncio.new_event_loop()
    with TemporaryDirectory() as temporary, closing(loop), Store.open(Path(temporary)) as store:
        tiers = make_tiers(load_settings({"data_dir": temporary, "features": "sift"}).settings)
        engine = engine_over(store, tiers, EngineOptions(workers=1))
        store_folders(store, engine, folders)
        store_folders(store, engine, [replace(it, scene=twin_of(it)) for it in folders])
        before = scene_group.SCENES
        try:
            for count in TRIED:
                scene_group.SCENES = count
                yield {"scenes tried": count, **_answers(Asked(engine, loop), folders)}
        finally:
            scene_group.SCENES = before
            loop.run_until_complete(engine.close())


def twin_of(folder: Folder) -> SceneKey:
    """A further scene with the references of a folder, as of a floor that looks like another one."""
    return SceneKey(f"{folder.scene}-twin")


def _answers(asked: Asked, folders: list[Folder]) -> dict[str, object]:
    """The answers among the scenes of all folders, with a twin of their own beside it, and without it."""
    found, seconds = Counter[str](), 0.0
    for folder in folders:
        others = [it.scene for it in folders if it.scene not in folder.same_place]
        for frame in folder.photographs:
            result, took_s = asked.ask(frame, folder.scene, *others)
            seconds += took_s
            outcome = result.answer.outcome
            found["photographs"] += 1
            found["right"] += is_right_answer(result, frame, folder)
            found["in another scene"] += isinstance(outcome, Localization) and result.scene_key != folder.scene
            found["ambiguous"] += isinstance(outcome, Rejection) and outcome.reason is RejectionReason.AMBIGUOUS
            among_twins, elsewhere = (asked.ask(frame, *it)[0] for it in ((folder.scene, twin_of(folder)), others))
            found["beside a twin: localized"] += isinstance(among_twins.answer.outcome, Localization)
            found["elsewhere: localized"] += isinstance(elsewhere.answer.outcome, Localization)
    titles = (
        *("photographs", "right", "in another scene", "ambiguous"),
        *("beside a twin: localized", "elsewhere: localized"),
    )
    return {**{it: found[it] for it in titles}, "processor time": f"{seconds / found['photographs']:.2f} s"}


MEASUREMENTS = {"scenes-tried": Measurement(_tried)}
