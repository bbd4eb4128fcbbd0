"""Cambridge Landmarks (Kendall et al. 2015): dataset_train.txt, dataset_test.txt, reconstruction.nvm and seq1/*.png.

A line of the first two is an image's path, the camera's centre X Y Z and a quaternion W P Q R, which is the rotation of
camera_from_world, after three lines of header. VisualSFM's reconstruction.nvm, which the poses come from, has the focal
length and radial distortion of each image; its paths end in .jpg, the files in .png. The principal point is the
image's centre.
"""

from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from mapless.geometry import Camera, RigidTransform
from mapless.lenses import RadialTangential
from mapless_tools.dataset import Dataset, finite_numbers

from .collecting import Collector, ReadOptions, filled_lines, from_corner, natural_order, rotation_of, size_of

SPLIT_FILES = {"train": "dataset_train.txt", "test": "dataset_test.txt"}
RECONSTRUCTION = "reconstruction.nvm"
_HEADER_LINES = 3


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    return all((path / file).is_file() for file in SPLIT_FILES.values())


def read(path: Path, options: ReadOptions) -> Dataset:
    """Reads the folder; see `read_dataset`."""
    collector = Collector(path, options.depths)
    lenses = _lenses(path / RECONSTRUCTION) if options.intrinsics is None else {}
    lines = [(words[0], words[1:], split) for split, file in SPLIT_FILES.items() for words in _pose_lines(path / file)]
    for image, words, split in sorted(lines, key=lambda line: natural_order(line[0])):
        with collector.attempt(image):
            pose = _world_from_camera(words)
            size = size_of(collector.image(image))
            if options.intrinsics is not None:
                camera = options.intrinsics.camera(*size)
            elif _stem(image) in lenses:
                camera = _camera(size, *lenses[_stem(image)])
            else:
                raise ValueError(f"focal length: {RECONSTRUCTION} has no such image")
            collector.add(image, camera, pose, split)
    about = {"source": "Cambridge Landmarks", "ground_truth": "SfM (VisualSFM, original)"}
    return collector.dataset(path.resolve().name, "cambridge", metric=True, **about)


def _camera(size: tuple[int, int], focal_px: float, k: float) -> Camera:
    """The camera of VisualSFM's lens: a pixel at r focal lengths is seen where an ideal camera sees r (1 + k r^2).

    Its distortion is the inverse of that: u = d + k d^3 solved for d = u - k u^3 + 3 k^2 u^5 - 12 k^3 u^7 + ...
    """
    distortion = RadialTangential(k1=-k, k2=3 * k * k, k3=-12 * k * k * k) if k else None
    return from_corner(Camera(*size, focal_px, focal_px, size[0] / 2, size[1] / 2, distortion))


def _stem(image: str) -> str:
    """A path without its ending, which is the same in both files."""
    return str(PurePosixPath(image.replace("\\", "/")).with_suffix(""))


def _pose_lines(file: Path) -> Iterator[list[str]]:
    for number, line in filled_lines(file):
        # Files that people write may have no header.
        if number > _HEADER_LINES or _is_pose(line.split()):
            yield line.split()


def _is_pose(words: list[str]) -> bool:
    try:
        finite_numbers(words[1:], "pose", (7,))
    except ValueError:
        return False
    return True


def _world_from_camera(words: list[str]) -> RigidTransform:
    values = finite_numbers(words, "pose", (7,))
    return RigidTransform(rotation_of(values[3:], "pose").T, values[:3])


def _lenses(file: Path) -> dict[str, tuple[float, float]]:
    """Focal length and radial distortion k of each image."""
    filled = filled_lines(file)
    number, first = next(filled, (1, ""))
    if not first.startswith("NVM_V3"):
        raise ValueError(f"{file}:{number}: expected NVM_V3, found {first[:60]!r}")
    number, line = next(filled, (0, ""))
    try:
        count = int(line)
    except ValueError as error:
        raise ValueError(f"{file}:{number}: expected the number of cameras, found {line[:60]!r}") from error
    lenses = {}
    for _ in range(count):
        number, line = next(filled, (number + 1, ""))
        words = line.rsplit(maxsplit=10)  # a name may have spaces
        try:
            values = finite_numbers(words[1:], "focal length, quaternion, centre, distortion and a zero", (10,))
            if not values[0] > 0:
                raise ValueError("the focal length must be above 0")
        except ValueError as error:
            raise ValueError(f"{file}:{number}: {error}; {count} cameras are announced") from error
        lenses[_stem(words[0])] = float(values[0]), float(values[8])
    number, line = next(filled, (number, ""))
    if len(line.split()) > 10:  # cameras are followed by a number of points
        raise ValueError(f"{file}:{number}: another camera, {count} are announced")
    return lenses
