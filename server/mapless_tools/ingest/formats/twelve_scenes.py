"""12-Scenes (Valentin et al. 2016): info.txt, split.txt and data/frame-000000.color.jpg, .pose.txt in a room's folder.

`split.txt` has a line "sequence0 [frames=357]  [start=0 ; end=356]" for each sequence; the first is the queries', the
rest the references'. `info.txt` has lines "key = value", among them m_colorWidth, m_colorHeight and
m_calibrationColorIntrinsic (4x4, row by row). The pose is a 4x4 world_from_camera, not finite where tracking was lost.

frame-000000.depth.png has millimetres, 0 where there is none, of the depth camera: m_depthWidth, m_depthHeight,
m_calibrationDepthIntrinsic, and m_calibrationDepthExtrinsic, which is camera_from_depth_camera, or the inverse of
m_calibrationColorExtrinsic if that is the identity: VoxelHashing, which wrote these files, calls an extrinsic "the
mapping to the other sensor".
"""

import re
from dataclasses import replace
from pathlib import Path

from mapless.depth import DepthSensor
from mapless.geometry import Array, RigidTransform
from mapless_tools.dataset import Dataset, DepthFile, finite_numbers, named

from .collecting import Collector, Intrinsics, ReadOptions, check_camera, filled_lines, size_of
from .seven_scenes import GROUND_TRUTH, find_ground_truth, read_pose

_LINE = re.compile(r"sequence\d+\s+\[frames=\d+\]\s+\[start=(\d+)\s*;\s*end=(\d+)\]")
_IMAGE_END = ".color.jpg"


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    return (path / "info.txt").is_file() and (path / "data").is_dir()


def read(path: Path, options: ReadOptions) -> Dataset:
    """Reads the folder; see `read_dataset`."""
    collector = Collector(path, options.depths)
    info = _Info(path / "info.txt")
    size, found = info.size("color"), _given(info.matrix("ColorIntrinsic"))
    depth = _depth_camera(collector, info)
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
            name = image.name.removesuffix(_IMAGE_END)
            found_depth = _depth(collector, f"data/{name}.depth.png", depth, (camera.width_px, camera.height_px))
            collector.add(relative, camera, pose, split if queries else "", name, depth=found_depth)
    ground_truth = GROUND_TRUTH if truth is not None else "VoxelHashing (original)"
    return collector.dataset(scene, "12scenes", metric=True, source="12-Scenes", ground_truth=ground_truth)


class _Info:
    """The fields of info.txt; ValueError names one that is missing or wrong."""

    def __init__(self, file: Path) -> None:
        self.file = file
        lines = (line.partition("=") for _, line in filled_lines(file))
        self._values = {key.strip(): value.split() for key, _, value in lines}

    def matrix(self, name: str) -> Array:
        """A calibration, (4, 4)."""
        field = f"m_calibration{name}"
        with named(str(self.file)):
            return finite_numbers(self._words(field), field, (16,)).reshape(4, 4)

    def pose(self, name: str) -> RigidTransform:
        """A calibration that is a motion."""
        matrix = self.matrix(name)
        with named(f"{self.file}: m_calibration{name}"):
            return RigidTransform.from_matrix(matrix)

    def size(self, name: str) -> tuple[int, int]:
        """Width and height of images, pixels."""
        fields = [f"m_{name}{side}" for side in ("Width", "Height")]
        with named(str(self.file)):
            width, height = (int(finite_numbers(self._words(it), it, (1,))[0]) for it in fields)
        return width, height

    def _words(self, field: str) -> list[str]:
        if field not in self._values:
            raise ValueError(f"{field} is missing")
        return self._values[field]


def _given(k: Array) -> Intrinsics:
    return Intrinsics(*k[[0, 1, 0, 1], [0, 1, 2, 2]].tolist())


def _depth_camera(collector: Collector, info: _Info) -> DepthFile | None:
    """All that the depths of a room have in common; None, and a note, if info.txt does not have their camera."""
    if collector.depths.no_depth or next((collector.folder / "data").glob("*.depth.png"), None) is None:
        return None
    try:
        camera = _given(info.matrix("DepthIntrinsic")).camera(*info.size("depth"))
        pose, inverse = info.pose("DepthExtrinsic"), info.pose("ColorExtrinsic")
    except ValueError as error:
        collector.leave_out_depth("all", error)
        return None
    return DepthFile(Path(), 0.001, DepthSensor.STRUCTURED_LIGHT, camera, inverse.inverse().compose(pose))


def _depth(collector: Collector, path: str, of_room: DepthFile | None, size: tuple[int, int]) -> DepthFile | None:
    if of_room is None or not (collector.folder / path).is_file():
        return None
    return collector.depth(replace(of_room, path=Path(path)), size)


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
