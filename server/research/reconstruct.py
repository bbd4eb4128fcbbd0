"""Reconstruction beside COLMAP's own: `python -m research.reconstruct FOLDER_OF_SCENES` prints Markdown.

Photographs of scenes with known poses are reconstructed without poses and intrinsics, by `mapless-server reconstruct`
and by COLMAP's pipeline with its defaults: SIFT, all pairs, the incremental mapper. Positions are compared after the
similarity that fits them best; processor time is that of everything, decoding included. COLMAP's mapper depends on its
random seed: its figures are medians of `--runs`. It takes minutes a scene: `--skip-colmap` leaves it out.
"""

import argparse
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from mapless.geometry import Array
from mapless_tools.dataset import Frame
from mapless_tools.ingest.formats.cameras import read_folder
from mapless_tools.ingest.metres import umeyama
from mapless_tools.output_files import markdown_table
from mapless_tools.reconstruct.pictures import Picture, Pictures
from mapless_tools.reconstruct.run import ReconstructOptions, reconstruct

from .places import FOUNTAIN, KITCHEN, MEETING, OFFICE

SCENES: Mapping[str, int] = {
    FOUNTAIN: 1,
    "herz-jesus-P8": 1,
    OFFICE: 1,
    KITCHEN: 20,
    MEETING: 1,
    "studio-flat": 1,
    "fox-portrait": 1,
    "euroc-v101-drone": 1,
}
"""Scenes, and that every so many-th photograph is taken."""


@dataclass(frozen=True)
class Measured:
    """Photographs with a pose, the median error of their positions, units of the scene, and processor time."""

    registered: int
    median: float
    processor_s: float

    def cells(self, metric: bool) -> list[str]:
        """Cells of a table."""
        error = f"{100 * self.median:.2f} cm" if metric else f"{self.median:.4f}"
        return [str(self.registered), error, f"{self.processor_s:.0f}"]


def measured(frames: Sequence[Frame], centres: Mapping[str, Array], start_s: float) -> Measured:
    """Compares the centres that were found, by the photographs' names."""
    processor_s = time.process_time() - start_s
    found = [it for it in frames if it.name in centres]
    if len(found) < 3:
        return Measured(len(found), np.nan, processor_s)
    true = np.array([it.world_from_camera.translation for it in found])
    ours = np.array([centres[it.name] for it in found])
    off = np.linalg.norm(umeyama(ours, true).apply(ours) - true, axis=1)
    return Measured(len(found), float(np.median(off)), processor_s)


def by_mapless(frames: Sequence[Frame], work: Path, options: ReconstructOptions) -> Measured:
    """Our reconstruction, by the weights that are present."""
    start_s = time.process_time()
    pictures = tuple(
        Picture(it.name, it.image_path, it.camera.width_px, it.camera.height_px, it.image_path) for it in frames
    )
    part = reconstruct(Pictures(pictures), work, options, lambda *_: None).part
    return measured(frames, {it.picture.name: it.world_from_camera.translation for it in part.posed}, start_s)


def by_colmap(frames: Sequence[Frame], work: Path, seeds: Sequence[int]) -> Measured:
    """COLMAP's own, its largest model: the medians of its mapper's runs with these seeds on the same matches."""
    start_s = time.process_time()
    database, root = work / "database.db", frames[0].image_path.parent
    names = {it.image_path.name: it.name for it in frames}
    extraction = pycolmap.FeatureExtractionOptions(num_threads=1)
    pycolmap.extract_features(database, root, list(names), extraction_options=extraction)
    pycolmap.match_exhaustive(database, pycolmap.FeatureMatchingOptions(num_threads=1))
    before_s = time.process_time() - start_s
    runs = []
    for seed in seeds:
        folder = work / f"models-{seed}"
        folder.mkdir()
        start_s = time.process_time()
        options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=seed)
        models = pycolmap.incremental_mapping(database, root, folder, options)
        largest = max(models.values(), key=lambda it: it.num_reg_images(), default=pycolmap.Reconstruction())
        centres = {names[it.name]: it.projection_center() for it in largest.images.values() if it.has_pose}
        runs.append(measured(frames, centres, start_s))
    registered, error, mapper_s = np.median([(it.registered, it.median, it.processor_s) for it in runs], axis=0)
    return Measured(round(registered), float(error), before_s + float(mapper_s))


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path, help="folder of the scenes' folders")
    parser.add_argument("--only", action="append", help="scenes; all if not given")
    parser.add_argument("--features", default="auto", help="local features of ours")
    parser.add_argument("--skip-colmap", action="store_true", help="measure ours alone")
    parser.add_argument("--runs", type=int, default=5, help="runs of COLMAP's mapper, each with a seed of its own")
    arguments = parser.parse_args()
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    options = ReconstructOptions(features=arguments.features)
    systems = ["mapless"] if arguments.skip_colmap else ["mapless", "COLMAP"]
    head = ["scene", "photographs", *(f"{it}: {name}" for it in systems for name in ("posed", "median", "CPU s"))]
    rows = []
    for scene in arguments.only or SCENES:
        dataset = read_folder(arguments.data / scene)
        frames = dataset.frames[:: SCENES.get(scene, 1)]
        cells = [scene, str(len(frames))]
        with tempfile.TemporaryDirectory(prefix="mapless-reconstruct-") as folder:
            cells += by_mapless(frames, Path(folder), options).cells(dataset.metric)
        if not arguments.skip_colmap:
            with tempfile.TemporaryDirectory(prefix="mapless-reconstruct-") as folder:
                cells += by_colmap(frames, Path(folder), range(arguments.runs)).cells(dataset.metric)
        rows.append(cells)
        print(" | ".join(cells), flush=True)
    print("\n".join(markdown_table(" | ".join(head), rows)))


if __name__ == "__main__":
    main()
