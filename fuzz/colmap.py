"""Importers: COLMAP models, text and binary."""

import struct
from pathlib import Path

from mapless.geometry import RigidTransform
from mapless_tools.ingest.formats import ReadOptions
from mapless_tools.ingest.formats.colmap.cameras import MODEL_NAMES
from mapless_tools.ingest.formats.writing import PosedImage, model_texts

from .importing import CAMERA, TRUTH, Layout, target

IMAGES = [f"images/cam0/{i}.png" for i in range(3)]
_NAMES = [image.removeprefix("images/") for image in IMAGES]


def _texts() -> dict[str, bytes]:
    images = [PosedImage(name, CAMERA, pose) for name, pose in zip(_NAMES, TRUTH.poses, strict=True)]
    return {name: text.encode() for name, text in model_texts(images).items()}


def _cameras() -> bytes:
    pinhole = struct.pack("<IiQQ4d", 1, 1, 32, 33, 30.0, 31.0, 15.75, 17.25)
    fisheye = struct.pack("<IiQQ8d", 7, 5, 32, 33, 30.0, 31.0, 15.75, 17.25, 0.1, 0.0, -0.1, 0.0)
    return struct.pack("<Q", 2) + pinhole + fisheye


def _image(number: int, pose: RigidTransform, name: str) -> bytes:
    camera_from_world = pose.inverse()
    q = camera_from_world.quaternion()
    camera_id = 7 if number else 1
    head = struct.pack("<I7dI", number, q.w, q.x, q.y, q.z, *camera_from_world.translation, camera_id)
    return head + name.encode() + b"\0" + struct.pack("<Q", number) + struct.pack("<ddq", 1.5, 2.5, -1) * number


def _images() -> bytes:
    records = [_image(i, pose, name) for i, (pose, name) in enumerate(zip(TRUTH.poses, _NAMES, strict=True))]
    return struct.pack("<Q", len(records)) + b"".join(records)


def _with_images(folder: Path) -> ReadOptions:
    return ReadOptions(images=folder / "images")


_TEXTS = _texts()
_LENSES = b"\n".join(
    f"{i + 1} {model} 32 33 30 {'31 ' if 'OPENCV' in model else ''}15.75 17.25 {zeros}".encode()
    for i, (model, zeros) in enumerate(
        {"SIMPLE_RADIAL": "0.1", "OPENCV": "0.1 -0.2 0.01 0.02", "FULL_OPENCV": "0.1 0.2 0 0 0.3 0 0 0"}.items()
    )
)
LAYOUTS = (
    Layout("colmap", "text", _TEXTS | {"list_test.txt": _NAMES[0].encode()}, IMAGES),
    Layout("colmap", "binary", {"sparse/0/cameras.bin": _cameras(), "sparse/0/images.bin": _images()}, IMAGES),
    Layout("colmap", "lenses", {"cameras.txt": _LENSES, "images.txt": _TEXTS["images.txt"]}, IMAGES, _with_images),
)

TARGET = target(LAYOUTS, tuple(model.encode() for model in MODEL_NAMES))
