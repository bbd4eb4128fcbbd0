"""TUM RGB-D (Sturm et al. 2012): a sequence's folder with rgb.txt, groundtruth.txt and the images.

Lines of rgb.txt are a time in seconds and an image's path; of groundtruth.txt a time and tx ty tz qx qy qz qw of
world_from_camera, from motion capture at 100 Hz. A frame's pose is interpolated between the two before and after it.

Lines of depth.txt, if there is one, are as of rgb.txt: PNGs of 16 bits, 5000 per metre, registered to the photographs.
A photograph's depth is the nearest in time; one that cannot be used is left out with a note.

The layout has no intrinsics: they are those published for the camera of freiburg1, 2 or 3, by the folder's
name, or given. Images of freiburg3 are undistorted already.
"""

import re
from pathlib import Path

import numpy as np

from mapless.depth import DepthSensor
from mapless.geometry import Array, Camera
from mapless.lenses import RadialTangential
from mapless_tools.bags.trajectory import Trajectory
from mapless_tools.dataset import Dataset, DepthFile, finite_numbers, named

from .collecting import Collector, ReadOptions, filled_lines, size_of

MAX_GAP_S = 0.02
"""A frame without a pose this near, before and after, is refused: a hand-held camera moves centimetres in that time.
Likewise the depth of a frame."""
DEPTH_UNIT_M = 1 / 5000

_LENSES = {
    "1": ((517.306408, 516.469215, 318.643040, 255.313989), (0.262383, -0.953104, -0.005358, 0.002628, 1.163314)),
    "2": ((520.908620, 521.007327, 325.141442, 249.701764), (0.231222, -0.784899, -0.003257, -0.000105, 0.917205)),
    "3": ((535.4, 539.2, 320.1, 247.6), None),
}
_SIZE = (640, 480)


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    return (path / "rgb.txt").is_file() and (path / "groundtruth.txt").is_file()


def read(path: Path, options: ReadOptions) -> Dataset:
    """Reads the folder; see `read_dataset`."""
    collector = Collector(path, options.depths)
    lens = _lens(path) if options.intrinsics is None else None
    file = path / "groundtruth.txt"
    rows = [pose_row(file, number, words) for number, words in numbered_words(file)]
    try:
        trajectory = Trajectory(rows, MAX_GAP_S)
    except ValueError as error:
        raise ValueError(f"{file} {error}") from error
    depths = _Depths(collector)
    for number, words in numbered_words(path / "rgb.txt"):
        with collector.attempt(f"rgb.txt:{number} ({words[-1]})"):
            if len(words) != 2:
                raise ValueError(f"expected a time and a path, found {len(words)} words")
            time_s = float(finite_numbers(words[0], "time"))
            file = collector.image(words[1])
            size = size_of(file)
            if options.intrinsics is not None:
                camera = options.intrinsics.camera(*size)
            elif lens is not None and size == _SIZE:
                camera = lens
            else:
                raise ValueError(f"image: is {size[0]}x{size[1]}, the known intrinsics are of 640x480")
            collector.add(words[1], camera, trajectory.at(time_s), name=file.stem, depth=depths.at(time_s, size))
    return collector.dataset(path.resolve().name, "tum", metric=True, source="TUM RGB-D", ground_truth="motion capture")


class _Depths:
    """Depths of a sequence by their times; none without a depth.txt."""

    def __init__(self, collector: Collector) -> None:
        file = collector.folder / "depth.txt"
        self._collector = collector
        self._times_s: list[float] = []
        self._paths: list[str] = []
        for number, words in numbered_words(file) if file.is_file() else []:
            self._add(f"{file.name}:{number}", words)

    def _add(self, line: str, words: list[str]) -> None:
        with self._collector.attempt_depth(line):
            if len(words) != 2:
                raise ValueError(f"expected a time and a path, found {len(words)} words")
            self._times_s.append(float(finite_numbers(words[0], "time")))
            self._paths.append(words[1])

    def at(self, time_s: float, photo: tuple[int, int]) -> DepthFile | None:
        """The depth nearest to a time, of a photograph of this size; None if none within `MAX_GAP_S` can be used."""
        if not self._paths:
            return None
        nearest = int(np.argmin(np.abs(np.array(self._times_s) - time_s)))
        if abs(self._times_s[nearest] - time_s) > MAX_GAP_S:
            return None
        depth = DepthFile(Path(self._paths[nearest]), DEPTH_UNIT_M, DepthSensor.STRUCTURED_LIGHT)
        return self._collector.depth(depth, photo)


def _lens(path: Path) -> Camera:
    found = re.search(r"(?:freiburg|fr)([123])", path.resolve().name, re.IGNORECASE)
    if found is None:
        raise ValueError(
            f"{path}: its name does not state which camera it is (freiburg1, 2 or 3); give the intrinsics with "
            "--intrinsics"
        )
    k, distortion = _LENSES[found[1]]
    return Camera(*_SIZE, *k, RadialTangential(*distortion) if distortion else None)


def numbered_words(file: Path) -> list[tuple[int, list[str]]]:
    """Words of the lines of a table, with their numbers."""
    return [(number, line.split()) for number, line in filled_lines(file)]


def pose_row(file: Path, number: int, words: list[str]) -> Array:
    """A time, position and quaternion x y z w; ValueError names the line if it is none."""
    with named(f"{file}:{number}"):
        row = finite_numbers(words, "time, position and quaternion", (8,))
        if not abs(np.linalg.norm(row[4:]) - 1) < 1e-2:
            raise ValueError("the quaternion must have norm 1")
    return row
