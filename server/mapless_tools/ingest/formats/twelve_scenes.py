"""12-Scenes (Valentin et al. 2016): info.txt, split.txt and data/frame-000000.color.jpg, .pose.txt in a room's folder.

`split.txt` has a line "sequence0 [frames=357]  [start=0 ; end=356]" for each sequence; the first is the queries', the
rest the references'. `info.txt` has lines "key = value", among them m_colorWidth, m_colorHeight and
m_calibrationColorIntrinsic (4x4, row by row). The pose is a 4x4 world_from_camera, not finite where tracking was lost.
"""

import re
from pathlib import Path

from mapless_tools.dataset import Dataset, finite_numbers, named

from .collecting import Collector, Intrinsics, ReadOptions, check_camera, filled_lines, size_of
from .seven_scenes import GROUND_TRUTH, find_ground_truth, read_pose

_LINE = re.compile(r"sequence\d+\s+\[frames=\d+\]\s+\[start=(\d+)\s*;\s*end=(\d+)\]")
_IMAGE_END = ".color.jpg"


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    return (path / "info.txt").is_file() and (path / "data").is_dir()


def read(path: Path, options: ReadOptions) -> Dataset:
    """Reads the folder; see `read_dataset`."""
    collector = Collector(path)
    size, found = _intrinsics(path / "info.txt")
    queries = _queries(path / "split.txt")
    scene = "_".join(path.resolve().parts[-2:])
    truth = find_ground_truth(options.ground_truth, scene) if options.ground_truth else None
    for image in sorted((path / "data").glob(f"frame-*{_IMAGE_END}")):
        relative = f"data/{image.name}"
        with collector.attempt(relative):
            number = re.fullmatch(rf"frame-(\d+){re.escape(_IMAGE_END)}", image.name)
            if number is None:
                raise ValueError("image: its name has no frame number")
            if truth is not None:
                # Sizes differ where the images were reduced; the focal length is the original's.
                camera, pose = truth.camera_and_pose(relative, size, options.intrinsics)
            else:
                camera = (options.intrinsics or found).camera(*size)
                pose = read_pose(image.with_name(image.name.removesuffix(_IMAGE_END) + ".pose.txt"))
            check_camera(camera)  # before it is divided by its size
            if size_of(image) != size:
                camera = camera.resized(*size_of(image))
            split = "test" if int(number[1]) in queries else "train"
            collector.add(relative, camera, pose, split if queries else "", image.name.removesuffix(_IMAGE_END))
    ground_truth = GROUND_TRUTH if truth is not None else "VoxelHashing (original)"
    return collector.dataset(scene, "12scenes", metric=True, source="12-Scenes", ground_truth=ground_truth)


def _intrinsics(file: Path) -> tuple[tuple[int, int], Intrinsics]:
    lines = (line.partition("=") for _, line in filled_lines(file))
    values = {key.strip(): value for key, _, value in lines}
    fields = ("m_colorWidth", "m_colorHeight", "m_calibrationColorIntrinsic")
    for field in fields:
        if field not in values:
            raise ValueError(f"{file}: {field} is missing")
    width, height, matrix = (values[field].split() for field in fields)
    with named(str(file)):
        k = finite_numbers(matrix, fields[2], (16,))
        size = (int(finite_numbers(width, fields[0], (1,))[0]), int(finite_numbers(height, fields[1], (1,))[0]))
        return size, Intrinsics(*k[[0, 5, 2, 6]].tolist())


def _queries(file: Path) -> range:
    """Numbers of the frames of the first sequence; empty if there is no split."""
    if not file.is_file():
        return range(0)
    number, first = next(filled_lines(file), (1, ""))
    found = _LINE.match(first.strip())
    if found is None:
        raise ValueError(
            f"{file}:{number}: expected sequence0 [frames=N] [start=A ; end=B], found {first.strip()[:80]!r}"
        )
    return range(int(found[1]), int(found[2]) + 1)
