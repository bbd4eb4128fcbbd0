"""Photographs localized against computed poses and against given ones: `python -m research.computed_poses SCENES`.

Every fourth photograph of a scene with known poses is held out. The others are references of two scenes of one server:
with the given poses and intrinsics, and with those that `mapless-server reconstruct` computes, moved by the similarity
that fits their positions best. The held-out photographs are localized in both, each time with the intrinsics that the
references have. Prints Markdown.
"""

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap

from mapless import Client, NewReference, Rejected
from mapless.geometry import Camera
from mapless_tools.child import temporary_server
from mapless_tools.dataset import Frame
from mapless_tools.evaluate.metrics import pose_error
from mapless_tools.evaluate.run import await_features
from mapless_tools.ingest.formats.cameras import read_folder
from mapless_tools.ingest.metres import umeyama
from mapless_tools.output_files import markdown_table
from mapless_tools.reconstruct.pictures import Picture, Pictures
from mapless_tools.reconstruct.run import ReconstructOptions, reconstruct

from .places import FOUNTAIN, KITCHEN, MEETING, OFFICE
from .reconstruct import SCENES

CHOSEN = (FOUNTAIN, OFFICE, KITCHEN, MEETING, "fox-portrait")
HELD_OUT = 4
"""Every so many-th photograph is held out, from the second on."""


@dataclass(frozen=True)
class Localized:
    """Errors of the held-out photographs, in the scene's unit and in degrees, by their names; without the rejected."""

    errors: dict[str, tuple[float, float]]

    def median(self, names: Sequence[str]) -> tuple[float, float]:
        """Median errors of some photographs."""
        position, angle = np.median([self.errors[it] for it in names], axis=0)
        return float(position), float(angle)


def computed(frames: Sequence[Frame]) -> list[Frame]:
    """The frames that get a pose, with computed cameras and poses, in the unit and frame of the given ones."""
    pictures = tuple(
        Picture(it.name, it.image_path, it.camera.width_px, it.camera.height_px, it.image_path) for it in frames
    )
    with tempfile.TemporaryDirectory(prefix="mapless-reconstruct-") as work:
        part = reconstruct(Pictures(pictures), Path(work), ReconstructOptions(), lambda *_: None).part
    by_name = {it.name: it for it in frames}
    true = np.array([by_name[it.picture.name].world_from_camera.translation for it in part.posed])
    fitted = umeyama(np.array([it.world_from_camera.translation for it in part.posed]), true)
    return [
        replace(
            by_name[it.picture.name], camera=it.camera, world_from_camera=fitted.transform_pose(it.world_from_camera)
        )
        for it in part.posed
    ]


def localized(
    client: Client, scene: str, metric: bool, references: Sequence[Frame], queries: Sequence[tuple[Frame, Camera]]
) -> Localized:
    """Stores references, and localizes photographs with these cameras."""
    client.create_scene(scene, arbitrary_unit=not metric)
    new = [NewReference(it.name, it.image_path, it.camera, it.world_from_camera) for it in references]
    client.add_references(scene, new)
    await_features(client, scene)
    errors = {}
    for frame, camera in queries:
        answer = client.localize(frame.image_path.read_bytes(), camera, scene)
        if not isinstance(answer, Rejected):
            errors[frame.name] = pose_error(frame.world_from_camera, answer.world_from_camera)
    return Localized(errors)


def row(client: Client, data: Path, scene: str) -> list[str]:
    """Measures a scene: a row of the table."""
    dataset = read_folder(data / scene)
    frames = dataset.frames[:: SCENES[scene]]
    held_out = frames[1::HELD_OUT]
    given = [it for it in frames if it not in held_out]
    posed = computed(given)
    camera_of = {(it.camera.width_px, it.camera.height_px): it.camera for it in posed}
    own = [(it, it.camera) for it in held_out]
    same = [(it, camera_of[it.camera.width_px, it.camera.height_px]) for it in held_out]
    by_given = localized(client, f"{scene}-given", dataset.metric, given, own)
    by_computed = localized(client, f"{scene}-computed", dataset.metric, posed, same)
    both = [it for it in by_given.errors if it in by_computed.errors]
    cells = [scene, f"{len(posed)} of {len(given)}"]
    for it in (by_given, by_computed):
        position, angle = it.median(both)
        shown = f"{100 * position:.2f} cm" if dataset.metric else f"{position:.5f}"
        cells += [f"{len(it.errors)} of {len(held_out)}", f"{shown}, {angle:.3f} degrees"]
    return [*cells, f"{by_computed.median(both)[0] / by_given.median(both)[0]:.2f}"]


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path, help="folder of the scenes' folders")
    parser.add_argument("--only", action="append", choices=SCENES, help="scenes; five if not given")
    arguments = parser.parse_args()
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    rows = []
    with temporary_server() as client:
        for scene in arguments.only or CHOSEN:
            rows.append(row(client, arguments.data, scene))
            print(" | ".join(rows[-1]), flush=True)
    head = "scene | references with a computed pose | given: localized | median | computed: localized | median | ratio"
    print("\n".join(markdown_table(head, rows)))


if __name__ == "__main__":
    main()
