"""Mappers of a reconstruction beside each other: `python -m research.mappers FOLDER_OF_SCENES` prints Markdown.

Photographs of scenes with known poses are matched once, without poses and intrinsics, and mapped by pycolmap's
incremental mapper and by its global one. Positions are compared after the similarity that fits them best; processor
time is that of the mapper alone.
"""

import argparse
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import pycolmap

from mapless_tools.dataset import Dataset
from mapless_tools.ingest.formats.cameras import read_folder
from mapless_tools.output_files import markdown_table
from mapless_tools.reconstruct.mapping import map_globally, map_incrementally
from mapless_tools.reconstruct.pictures import Picture, Pictures
from mapless_tools.reconstruct.run import ReconstructOptions, reconstruct

from .reconstruct import SCENES, measured

MAPPERS: Mapping[str, Callable[[Path, Path], None]] = {
    "incremental": lambda database, folder: map_incrementally(database, folder, (), 1),
    "global": lambda database, folder: map_globally(database, folder, 1),
}
HEAD = ["scene", "photographs", *(f"{it}: {name}" for it in MAPPERS for name in ("posed", "median", "CPU s"))]


def by_mapper(
    run: Callable[[Path, Path], None], dataset: Dataset, stride: int, database: Path, folder: Path
) -> list[str]:
    """Cells of a table: photographs with a pose in the largest model, their median error, processor time."""
    start_s = time.process_time()
    folder.mkdir()
    run(database, folder)
    models = [pycolmap.Reconstruction(str(it)) for it in folder.iterdir()]
    largest = max(models, key=lambda it: it.num_reg_images(), default=pycolmap.Reconstruction())
    centres = {it.name: it.projection_center() for it in largest.images.values() if it.has_pose}
    return measured(dataset.frames[::stride], centres, start_s).cells(dataset.metric)


def row(data: Path, scene: str, options: ReconstructOptions) -> list[str]:
    """The row of a scene."""
    dataset, stride = read_folder(data / scene), SCENES.get(scene, 1)
    pictures = tuple(
        Picture(it.name, it.image_path, it.camera.width_px, it.camera.height_px, it.image_path)
        for it in dataset.frames[::stride]
    )
    with tempfile.TemporaryDirectory(prefix="mapless-mappers-") as name:
        work = Path(name)
        reconstruct(Pictures(pictures), work, options, lambda *_: None)
        (database,) = work.glob("database-*")
        found = [by_mapper(run, dataset, stride, database, work / kind) for kind, run in MAPPERS.items()]
    return [scene, str(len(pictures)), *(cell for cells in found for cell in cells)]


def main(arguments: Sequence[str] | None = None) -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path, help="folder of the scenes' folders")
    parser.add_argument("--only", action="append", help="scenes; all if not given")
    parser.add_argument("--features", default="edgepoint2-l64", help="local features")
    given = parser.parse_args(arguments)
    options = ReconstructOptions(features=given.features)
    rows = []
    for scene in given.only or SCENES:
        rows.append(row(given.data, scene, options))
        print(" | ".join(rows[-1]), flush=True)
    print("\n".join(markdown_table(" | ".join(HEAD), rows)))


if __name__ == "__main__":
    main()
