"""Photographs placed in scenes without their poses and intrinsics: `python -m research.extend FOLDER_OF_SCENES`.

Every second photograph of a scene is a reference; the others are placed among these by `mapless-server extend`, with
their cameras unknown, and with those of the references (`--lens`). Prints Markdown: how many are placed, how far off,
how many radii hold, and the processor time. Then photographs of the kitchen that are neither are localized against the
references alone, and together with those that were placed, whose accuracy is stated or not.
"""

import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap

from mapless import Client, NewReference, Provenance, Rejected
from mapless.provenance import GIVEN_POSE, PLACED
from mapless_tools.child import temporary_server
from mapless_tools.dataset import Frame
from mapless_tools.evaluate.metrics import pose_error
from mapless_tools.evaluate.run import await_features
from mapless_tools.extend.existing import KnownPicture
from mapless_tools.extend.options import ExtendOptions
from mapless_tools.extend.placing import Placed
from mapless_tools.extend.run import placed_among
from mapless_tools.output_files import markdown_table
from mapless_tools.reconstruct.cameras import LensOptions
from mapless_tools.reconstruct.pictures import Picture
from mapless_tools.reconstruct.run import ReconstructOptions

from .places import FOUNTAIN, KITCHEN, MEETING, OFFICE, Scenes

SCENES = {FOUNTAIN: 1, "herz-jesus-P8": 1, OFFICE: 1, KITCHEN: 20, MEETING: 1, "fox-portrait": 1}
"""Scenes, and that every so many-th photograph is taken."""
HEAD = "scene | cameras | placed | median | largest | within 68 % | within 95 % | rotations within 95 % | CPU s"


def picture(frame: Frame) -> Picture:
    """A frame without its pose and camera."""
    return Picture(frame.name, frame.image_path, frame.camera.width_px, frame.camera.height_px, frame.image_path)


def placed(references: Sequence[Frame], new: Sequence[Frame], lens: LensOptions, work: Path) -> Sequence[Placed]:
    """The new photographs that are placed among references."""
    known = [KnownPicture(picture(it), it.camera, it.world_from_camera, GIVEN_POSE) for it in references]
    options = ExtendOptions(ReconstructOptions(lens=lens))
    return placed_among(known, [picture(it) for it in new], {}, work, options, lambda *_: None).placed


def row(name: str, kind: str, found: Sequence[Placed], new: Sequence[Frame], metric: bool, cpu_s: float) -> list[str]:
    """A row of the table."""
    true = {it.name: it.world_from_camera for it in new}
    errors = [(pose_error(true[it.name], it.world_from_camera), it.accuracy) for it in found]
    off = np.array([it[0] for it, _ in errors])
    held = [
        [it[0] <= radii.position_68_m, it[0] <= radii.position_95_m, it[1] <= radii.rotation_95_deg]
        for it, radii in errors
    ]
    lengths = [f"{100 * it:.2f} cm" if metric else f"{it:.4f}" for it in (np.median(off), off.max())]
    shares = [str(sum(it)) for it in zip(*held, strict=True)]
    return [name, kind, f"{len(found)} of {len(new)}", *lengths, *shares, f"{cpu_s:.0f}"]


def localized(client: Client, scene: str, queries: Sequence[Frame], names: Sequence[str]) -> list[str]:
    """How many photographs are localized against some references, with the median errors and what radii hold."""
    found = []
    for it in queries:
        answer = client.localize(it.image_path, it.camera, scene, names, rerank_references=True, timeout_s=300)
        if not isinstance(answer, Rejected) and answer.accuracy is not None:
            error = pose_error(it.world_from_camera, answer.world_from_camera)
            found.append((*error, error[0] <= answer.accuracy.position_95_m))
    off, off_deg, held = np.array(found).T
    errors = f"{100 * np.median(off):.2f} cm", f"{np.median(off_deg):.3f} deg", f"{100 * off.max():.1f} cm"
    return [f"{len(found)} of {len(queries)}", *errors, f"{int(held.sum())}"]


def compared(scenes: Scenes, found: Sequence[Placed]) -> list[str]:
    """Photographs of the kitchen localized without those that were placed, and with them."""
    frames = scenes.dataset(KITCHEN).frames
    references, queries = frames[::40], frames[10::20]
    images = {it.name: it.image_path for it in frames}
    given = [NewReference(it.name, it.image_path, it.camera, it.world_from_camera) for it in references]
    new = [
        NewReference(
            it.name, images[it.name], it.camera, it.world_from_camera, provenance=Provenance(PLACED, it.accuracy)
        )
        for it in found
    ]
    unaware = [NewReference(it.reference_id, it.image, it.camera, it.world_from_camera) for it in new]
    rows = []
    with temporary_server() as client:
        for name, its in (("references", given), ("with placed", [*given, *new]), ("unaware", [*given, *unaware])):
            scene = name.replace(" ", "-")
            client.create_scene(scene)
            client.add_references(scene, its)
            await_features(client, scene)
            rows.append([name, *localized(client, scene, queries, [it.reference_id for it in its])])
    return markdown_table("scene | localized | median | rotation | largest | within 95 %", rows)


def main() -> None:
    """Prints the tables."""
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    scenes, rows = Scenes(Path(sys.argv[1])), []
    of_kitchen: Sequence[Placed] = ()
    for name, stride in scenes.present([*SCENES.items()]):
        dataset = scenes.dataset(name)
        frames = dataset.frames[::stride]
        references, new = frames[::2], frames[1::2]
        with tempfile.TemporaryDirectory() as work:
            sizes = {(it.camera.width_px, it.camera.height_px) for it in frames}
            lenses = {"unknown": LensOptions()}
            if len(sizes) == 1:
                lenses["known"] = LensOptions(known=(references[0].camera,))
            for kind, lens in lenses.items():
                start_s = time.process_time()
                found = placed(references, new, lens, Path(work))
                rows.append(row(name, kind, found, new, dataset.metric, time.process_time() - start_s))
                print(rows[-1], file=sys.stderr, flush=True)
                if name == KITCHEN and kind == "unknown":
                    of_kitchen = found
    print("\n".join([*markdown_table(HEAD, rows), "", *(compared(scenes, of_kitchen) if of_kitchen else [])]))


if __name__ == "__main__":
    main()
