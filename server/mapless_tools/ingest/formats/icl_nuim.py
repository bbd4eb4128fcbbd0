"""ICL-NUIM (Handa et al. 2014), in the layout of TUM RGB-D: associations.txt, rgb/, depth/ and a *.gt.freiburg.

Lines of associations.txt are a number and the path of a depth, then a number and the path of a photograph, or the
reverse; of *.gt.freiburg the number of a photograph and tx ty tz qx qy qz qw of world_from_camera. Depths are PNGs of
16 bits, 5000 per metre, of the photograph's camera, and rendered; the variants with a Kinect's noise need
--depth-sensor structured_light.

The published focal lengths are 481.2 and -480: y of the camera is upward, so camera and world are left-handed. Both are
reflected here, y to -y.
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mapless.depth import DepthSensor
from mapless.geometry import Array, RigidTransform
from mapless_tools.dataset import Dataset, DepthFile, finite_numbers

from .collecting import Collector, Intrinsics, ReadOptions, natural_order, size_of
from .tum import DEPTH_UNIT_M, numbered_words, pose_row

ASSOCIATIONS = "associations.txt"
CAMERA = Intrinsics(481.2, 480.0, 319.5, 239.5)
_REFLECTION = np.diag([1.0, -1.0, 1.0])


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    return (path / ASSOCIATIONS).is_file() and next(path.glob("*.gt.freiburg"), None) is not None


def read(path: Path, options: ReadOptions) -> Dataset:
    """Reads the folder; see `read_dataset`."""
    collector = Collector(path, options.depths)
    poses = _poses(path)
    for number, words in numbered_words(path / ASSOCIATIONS):
        with collector.attempt(f"{ASSOCIATIONS}:{number}"):
            if len(words) != 4:
                raise ValueError(f"expected two numbers with a path each, found {len(words)} words")
            (time, image), depth = (words[2:], words[1]) if words[1].startswith("depth") else (words[:2], words[3])
            row = poses.get(float(finite_numbers(time, "number", ())))
            if row is None:
                raise ValueError(f"pose: there is none of {time}")
            size = size_of(collector.image(image))
            camera = (options.intrinsics or CAMERA).camera(*size)
            its_depth = collector.depth(DepthFile(Path(depth), DEPTH_UNIT_M, DepthSensor.RENDERED), size)
            collector.add(image, camera, _reflected(row), depth=its_depth)
    collector.notes.append("the layout is mirrored: world and cameras are reflected, y to -y")
    collector.frames.sort(key=lambda it: natural_order(it.name))
    return collector.dataset(path.resolve().name, "icl", metric=True, source="ICL-NUIM", ground_truth="rendered")


def _poses(path: Path) -> dict[float, Array]:
    """Rows of position and quaternion by the number of their photograph; ValueError unless there is one file."""
    files = sorted(path.glob("*.gt.freiburg"))
    if len(files) != 1:
        raise ValueError(f"{path} must have one *.gt.freiburg, has {len(files)}")
    rows = [pose_row(files[0], number, words) for number, words in numbered_words(files[0])]
    return {float(row[0]): row[1:] for row in rows}


def _reflected(row: Array) -> RigidTransform:
    rotation = Rotation.from_quat(row[3:]).as_matrix()  # of any norm, which the files round
    return RigidTransform(_REFLECTION @ rotation @ _REFLECTION, _REFLECTION @ row[:3])
