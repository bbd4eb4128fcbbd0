"""7-Scenes (Shotton et al. 2013): a scene's folder with seq-01/frame-000000.color.png, .pose.txt and so on.

The pose is a 4x4 world_from_camera of the Kinect's depth camera, found by KinectFusion; frames that it lost have no
finite pose. The split is in TrainSplit.txt and TestSplit.txt, a line "sequence1" for each.

The layout has no intrinsics. The data set's page gives 585 px, which is the depth camera's; photographs have about
525 px (what the field uses, and what bundle adjustment finds: 525.5 for the red kitchen), principal point (320, 240).
With SfM pseudo ground truth the focal length comes with the poses.
"""

import re
from collections.abc import Iterator
from pathlib import Path

from mapless.geometry import RigidTransform
from mapless_tools.dataset import Dataset, finite_numbers

from .collecting import Collector, read_text, size_of
from .options import Intrinsics, ReadOptions
from .pseudo_ground_truth import GROUND_TRUTH, PosesBySplit, find_ground_truth

COLOUR = Intrinsics(525.0, 525.0, 320.0, 240.0)
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
    collector = Collector(path)
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
            f"poses are KinectFusion's, of the depth camera; {_intrinsics_note(options.intrinsics)}; with "
            "--ground-truth they are those of the photographs"
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
        pose = read_pose(image.with_name(re.sub(r"\.color\.\w+$", _POSE, image.name)))
    collector.add(relative, camera, pose, split, name)


def read_pose(file: Path) -> RigidTransform:
    """Reads the pose in a text file of 4x4 numbers; ValueError if there is none, as where tracking was lost."""
    if not file.is_file():
        raise ValueError(f"pose: there is no file {file}")
    try:
        return RigidTransform.from_matrix(finite_numbers(read_text(file).split(), "pose", (16,)).reshape(4, 4))
    except ValueError as error:
        raise ValueError(f"pose: {file.name}: {error}") from error


def _splits(path: Path) -> dict[str, str]:
    """Split by sequence folder; empty if there are no split files."""
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
    for number, line in enumerate(read_text(file).splitlines(), 1):
        if line.strip():
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
