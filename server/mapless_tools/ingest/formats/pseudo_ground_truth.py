"""SfM pseudo ground truth of 7-Scenes and 12-Scenes (Brachmann et al. 2021), in both published forms.

Text files, one a split (`redkitchen_train.txt`, `apt1_kitchen_test.txt`): lines of the image's path, qw qx qy qz tx ty
tz of camera_from_world, and the focal length. The principal point is the image's centre, as COLMAP's models of these
have it.

COLMAP models, as hloc has them: `7scenes_sfm_triangulated/<scene>/triangulated`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from mapless.geometry import Camera, RigidTransform
from mapless_tools.dataset import finite_numbers

from .collecting import check_camera, from_corner, read_text, rotation_of
from .colmap.model import Model, find_model, read_model
from .options import Intrinsics

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
        for number, line in enumerate(read_text(file).splitlines(), 1):
            words = line.split()
            if not words:
                continue
            if len(words) != 9:
                raise ValueError(
                    f"{file}:{number}: expected a path, qw qx qy qz tx ty tz and a focal length, found {len(words)} "
                    "words"
                )
            if words[0] in lines:
                raise ValueError(f"{file}:{number}: {words[0]} occurs twice")
            lines[words[0]] = tuple(words[1:])
    return lines
