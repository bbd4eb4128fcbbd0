"""Record3D's export "EXR + RGB": metadata.json, rgb/0.jpg and depth/0.exr, or both folders in EXR_RGBD/.

metadata.json has `poses`, for each number qx qy qz qw tx ty tz of world_from_camera with OpenGL's camera axes, the size
`w`, `h` and `K`, column by column, of the image as it is stored, and in newer exports `perFrameIntrinsicCoeffs`, for
each number fx fy cx cy. Numbers of photographs may be missing. A depth is metres in one channel, with fewer pixels; it
has a value everywhere, so that measured and filled-in values look alike. Principal points count from
the corner of the top-left pixel, as Apple's. (From an export; Record3D has no document of it.)

Not read are .r3d files, whose depths are compressed by LZFSE: export "EXR + RGB" from the app.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mapless.depth import DepthSensor
from mapless.geometry import Camera, RigidTransform
from mapless_tools.dataset import Dataset, DepthFile, finite_numbers, named, read_json

from .collecting import Collector, ReadOptions, from_corner, from_opengl, natural_order, rotation_of, size_of
from .depth_files import decode_exr

METADATA = "metadata.json"
_IMAGE_ENDS = (".jpg", ".jpeg", ".png")


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    return (path / METADATA).is_file() and (_root(path) / "rgb").is_dir()


def read(path: Path, options: ReadOptions) -> Dataset:
    """Reads the folder; see `read_dataset`."""
    collector = Collector(_root(path), options.depths)
    file = path / METADATA
    content = read_json(file)
    if not isinstance(content, dict) or not isinstance(content.get("poses"), list):
        raise ValueError(f"{file}: poses must be a list")
    images = [it for it in (collector.folder / "rgb").iterdir() if it.suffix.lower() in _IMAGE_ENDS]
    for image in sorted(images, key=lambda it: natural_order(it.name)):
        with collector.attempt(f"rgb/{image.name}"):
            if not re.fullmatch(r"\d{1,9}", image.stem):
                raise ValueError("image: its name is no number")
            size, number = size_of(image), int(image.stem)
            with named(METADATA):
                camera, pose = _camera(content, number, size), _pose(content["poses"], number)
            depth = _depth(collector, image.stem, size)
            collector.add(f"rgb/{image.name}", camera, pose, name=image.stem, depth=depth)
    collector.notes.append("these are the phone's own poses, which drift")
    return collector.dataset(
        path.resolve().name, "record3d", metric=True, source="Record3D", ground_truth="device tracking"
    )


def _root(path: Path) -> Path:
    return path / "EXR_RGBD" if (path / "EXR_RGBD").is_dir() else path


def _pose(poses: list[Any], number: int) -> RigidTransform:
    if number >= len(poses):
        raise ValueError(f"poses has {len(poses)}, none of {number}")
    row = finite_numbers(poses[number], f"poses[{number}]", (7,))
    return from_opengl(RigidTransform(rotation_of(row[[3, 0, 1, 2]], f"poses[{number}]"), row[4:]))


def _camera(content: Mapping[str, Any], number: int, size: tuple[int, int]) -> Camera:
    said = tuple(finite_numbers([content.get("w"), content.get("h")], "w and h", (2,)).tolist())
    if said != size:
        raise ValueError(f"w and h are {said[0]:g}x{said[1]:g}, the image is {size[0]}x{size[1]}")
    coefficients = content.get("perFrameIntrinsicCoeffs")
    if isinstance(coefficients, list) and number < len(coefficients):
        k = finite_numbers(coefficients[number], f"perFrameIntrinsicCoeffs[{number}]", (4,))
    else:
        k = finite_numbers(content.get("K"), "K", (9,))[[0, 4, 6, 7]]
    return from_corner(Camera(*size, *k.tolist()))


def _depth(collector: Collector, number: str, size: tuple[int, int]) -> DepthFile | None:
    path = Path("depth") / f"{number}.exr"
    if not (collector.folder / path).is_file():
        return None
    return collector.depth(DepthFile(path, 1.0, DepthSensor.PHONE_LIDAR, decode=decode_exr), size)
