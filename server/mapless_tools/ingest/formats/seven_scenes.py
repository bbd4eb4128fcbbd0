"""7-Scenes (Shotton et al. 2013): a scene's folder with seq-01/frame-000000.color.png, .pose.txt and so on.

The pose is a 4x4 world_from_camera of the Kinect's depth camera, found by KinectFusion; frames that it lost have no
finite pose. The split is in TrainSplit.txt and TestSplit.txt, a line "sequence1" for each.

The layout has no intrinsics. The data set's page gives 585 px, which is the depth camera's; photographs have about
525 px (what the field uses, and what bundle adjustment finds: 525.5 for the red kitchen), principal point (320, 240).
With SfM pseudo ground truth the focal length comes with the poses.

frame-000000.depth.png has millimetres, 65535 where there is none, as the depth camera saw them. Where that camera is
beside the photograph's is not published either: it was fitted to edges of depth in 15 photographs of the red kitchen.
Poses of the layout are moved by it to the photograph's camera.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapless.depth import DepthSensor
from mapless.geometry import Camera, RigidTransform
from mapless_tools.dataset import Dataset, DepthFile, finite_numbers, named

from .collecting import (
    Collector,
    Intrinsics,
    ReadOptions,
    check_camera,
    filled_lines,
    from_corner,
    read_words,
    rotation_of,
    size_of,
)
from .colmap import Model, find_model, read_model

GROUND_TRUTH = "SfM pseudo ground truth (COLMAP)"


@dataclass(frozen=True, eq=False)
class PosesBySplit:
    """Poses by image path, from a COLMAP model or from text files, whose words they are; `source` is for messages."""

    source: Path
    lines: Mapping[str, tuple[str, ...]]
    model: Model | None

    def camera_and_pose(
        self, image: str, size: tuple[int, int], intrinsics: Intrinsics | None
    ) -> tuple[Camera, RigidTransform]:
        """Camera and pose of an image of this size; given intrinsics replace the file's. ValueError without a pose."""
        if self.model is not None:
            camera, pose = self.model.camera_and_pose(image)
            check_camera(camera)  # before it is divided by its size
            if (camera.width_px, camera.height_px) != size:
                camera = camera.resized(*size)
        else:
            camera, pose = self._from_line(image, size)
        return (intrinsics.camera(*size) if intrinsics else camera), pose

    def _from_line(self, image: str, size: tuple[int, int]) -> tuple[Camera, RigidTransform]:
        if image not in self.lines:
            raise ValueError(f"ground truth: {self.source} has no pose of {image}")
        values = finite_numbers(self.lines[image], "ground truth", (8,))
        camera_from_world = RigidTransform(rotation_of(values[:4], "ground truth"), values[4:7])
        focal_px = float(values[7])
        camera = Camera(*size, focal_px, focal_px, size[0] / 2, size[1] / 2)
        return from_corner(camera), camera_from_world.inverse()


def find_ground_truth(path: Path, scene: str) -> PosesBySplit:
    """Finds the poses of a scene, "redkitchen" or "apt1_kitchen"; ValueError if there are none, or a file is malformed.

    The path is a text file; a folder with the scene's text files, at any depth of the original repository; a COLMAP
    model; or a folder with a model of the scene.
    """
    if path.is_file():
        return PosesBySplit(path, _read_lines([path]), None)
    for folder in (path / scene / "triangulated", path / "triangulated", path / scene, path):
        if find_model(folder) is not None:
            return PosesBySplit(folder, {}, read_model(folder))
    names = [f"{scene}{end}.txt" for end in ("_train", "_test", "")] + [f"pgt_7scenes_{scene}.txt"]
    for folder in (path, path / "7scenes", path / "12scenes", path / "sfm" / "7scenes", path / "sfm" / "12scenes"):
        files = [folder / name for name in names if (folder / name).is_file()]
        if files:
            return PosesBySplit(folder, _read_lines(files), None)
    raise ValueError(f"{path} holds no ground truth of {scene}: neither {names[0]} nor a COLMAP model")


def _read_lines(files: list[Path]) -> dict[str, tuple[str, ...]]:
    lines: dict[str, tuple[str, ...]] = {}
    for file in files:
        for number, line in filled_lines(file):
            words = line.split()
            if len(words) != 9:
                raise ValueError(
                    f"{file}:{number}: expected a path, qw qx qy qz tx ty tz and a focal length, found {len(words)} "
                    "words"
                )
            if words[0] in lines:
                raise ValueError(f"{file}:{number}: {words[0]} occurs twice")
            lines[words[0]] = tuple(words[1:])
    return lines


COLOUR = Intrinsics(525.0, 525.0, 320.0, 240.0)
DEPTH_CAMERA = Camera(640, 480, 585.0, 585.0, 320.0, 240.0)
CAMERA_FROM_DEPTH_CAMERA = RigidTransform(np.eye(3), np.array([-0.0225, -0.005, 0.0]))
SPLIT_FILES = {"train": "TrainSplit.txt", "test": "TestSplit.txt"}
_POSE = ".pose.txt"
_IMAGE_ENDS = (".color.png", ".color.jpg")


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    sequences = list(path.glob("seq-*"))
    return bool(sequences) and (
        any((path / name).is_file() for name in SPLIT_FILES.values())
        or any(next(sequence.glob(f"frame-*{_POSE}"), None) for sequence in sequences)
    )


def read(path: Path, options: ReadOptions) -> Dataset:
    """Reads the folder; see `read_dataset`."""
    collector = Collector(path, options.depths)
    splits = _splits(path)
    truth = find_ground_truth(options.ground_truth, path.resolve().name) if options.ground_truth else None
    folders = sorted(folder for folder in path.glob("seq-*") if folder.is_dir())
    for name in sorted(set(splits) - {folder.name for folder in folders}):
        with collector.attempt(name):
            raise ValueError(f"a split file names it, and there is no folder {path / name}; is it still packed?")
    for folder in folders:
        for image in sorted(f for f in folder.iterdir() if f.name.endswith(_IMAGE_ENDS)):
            relative = f"{folder.name}/{image.name}"
            with collector.attempt(relative):
                _add(collector, image, relative, splits.get(folder.name, ""), truth, options)
    if truth is None:
        collector.notes.append(
            f"poses are KinectFusion's, moved from the depth camera to the photograph's; "
            f"{_intrinsics_note(options.intrinsics)}; with --ground-truth they are those of the photographs"
        )
    ground_truth = GROUND_TRUTH if truth is not None else "KinectFusion (original)"
    return collector.dataset(path.resolve().name, "7scenes", metric=True, source="7-Scenes", ground_truth=ground_truth)


def _add(
    collector: Collector, image: Path, relative: str, split: str, truth: PosesBySplit | None, options: ReadOptions
) -> None:
    name = relative.removesuffix(".png").removesuffix(".jpg").removesuffix(".color")
    size = size_of(image)
    if truth is not None:
        camera, pose = truth.camera_and_pose(relative, size, options.intrinsics)
    else:
        camera = (options.intrinsics or COLOUR).camera(*size)
        world_from_depth_camera = read_pose(collector.folder / f"{name}{_POSE}")
        pose = world_from_depth_camera.compose(CAMERA_FROM_DEPTH_CAMERA.inverse())
    collector.add(relative, camera, pose, split, name, depth=_depth(collector, name, size))


def _depth(collector: Collector, name: str, size: tuple[int, int]) -> DepthFile | None:
    path = Path(f"{name}.depth.png")
    if not (collector.folder / path).is_file():
        return None
    sensor = DepthSensor.STRUCTURED_LIGHT
    return collector.depth(DepthFile(path, 0.001, sensor, DEPTH_CAMERA, CAMERA_FROM_DEPTH_CAMERA), size)


def read_pose(file: Path) -> RigidTransform:
    """Reads the pose in a text file of 4x4 numbers; ValueError if there is none, as where tracking was lost."""
    if not file.is_file():
        raise ValueError(f"pose: there is no file {file}")
    with named(f"pose: {file.name}"):
        return RigidTransform.from_matrix(finite_numbers(read_words(file), "pose", (16,)).reshape(4, 4))


def _splits(path: Path) -> dict[str, str]:
    splits: dict[str, str] = {}
    for split, file_name in SPLIT_FILES.items():
        file = path / file_name
        if not file.is_file():
            continue
        for sequence in _sequences(file):
            if splits.setdefault(sequence, split) != split:
                raise ValueError(f"{file}: {sequence} is in both splits")
    return splits


def _sequences(file: Path) -> Iterator[str]:
    for number, line in filled_lines(file):
        found = re.fullmatch(r"seq(?:uence)?[-_ ]?(\d+)", line.strip(), re.IGNORECASE)
        if found is None:
            raise ValueError(f"{file}:{number}: expected a line like sequence1, found {line.strip()[:60]!r}")
        yield f"seq-{int(found[1]):02d}"


def _intrinsics_note(given: Intrinsics | None) -> str:
    k = given or COLOUR
    return (
        f"intrinsics are {'those given' if given else 'the usual ones of the colour camera'}: focal length "
        f"{k.focal_x_px:g} px, principal point ({k.principal_x_px:g}, {k.principal_y_px:g})"
    )
