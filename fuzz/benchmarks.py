"""Importers: 7-Scenes, 12-Scenes and Cambridge, with their own poses and with pseudo ground truth."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from support.layouts import write_cambridge, write_seven_scenes, write_twelve_scenes

from mapless.geometry import Camera
from mapless_tools.ingest.formats import ReadOptions
from mapless_tools.ingest.formats.writing import PosedImage, model_texts

from .importing import CAMERA, TRUTH, Layout, numbers, target

_SHOTS = [(np.zeros((2, 2, 3), np.uint8), pose) for pose in TRUTH.poses]


def _written(write: Callable[[Path], Path]) -> tuple[dict[str, bytes], list[str]]:
    """Texts of what is written, and the paths of its photographs."""
    with TemporaryDirectory() as folder:
        scene = write(Path(folder))
        files = {it.relative_to(scene).as_posix(): it.read_bytes() for it in sorted(scene.rglob("*")) if it.is_file()}
    images = [path for path in files if path.endswith((".png", ".jpg"))]
    return {path: content for path, content in files.items() if path not in images}, images


_SEVEN, _SEVEN_IMAGES = _written(lambda it: write_seven_scenes(it, _SHOTS[:2], _SHOTS[2:]))
_KITCHEN = Camera(64, 66, 60.0, 62.0, 31.0, 34.0)
_TWELVE, _TWELVE_IMAGES = _written(lambda it: write_twelve_scenes(it, _KITCHEN, _SHOTS[:1], _SHOTS[1:]))
_CAMBRIDGE, _CAMBRIDGE_IMAGES = _written(lambda it: write_cambridge(it, _SHOTS[:2], _SHOTS[2:], [30, 31, 32], -0.05))
_SPLITS = {path: content for path, content in _SEVEN.items() if path.endswith("Split.txt")}


def _truth_lines(images: list[str]) -> bytes:
    lines = []
    for image, pose in zip(images, TRUTH.poses, strict=True):
        q = pose.inverse().quaternion()
        lines.append(f"{image} {numbers([q.w, q.x, q.y, q.z])} {numbers(pose.inverse().translation)} 30.5")
    return "\n".join(lines).encode()


def _truth_model(images: list[str]) -> dict[str, bytes]:
    camera = CAMERA.resized(64, 66)
    posed = [PosedImage(image, camera, pose) for image, pose in zip(images, TRUTH.poses, strict=True)]
    return {f"truth/{name}": text.encode() for name, text in model_texts(posed).items()}


def _with_lines(folder: Path) -> ReadOptions:
    return ReadOptions(ground_truth=folder / "truth.txt")


def _with_model(folder: Path) -> ReadOptions:
    return ReadOptions(ground_truth=folder / "truth")


LAYOUTS = (
    Layout("7scenes", "chess", _SEVEN, _SEVEN_IMAGES),
    Layout("7scenes", "chess", _SPLITS | {"truth.txt": _truth_lines(_SEVEN_IMAGES)}, _SEVEN_IMAGES, _with_lines),
    Layout("7scenes", "chess", _SPLITS | _truth_model(_SEVEN_IMAGES), _SEVEN_IMAGES, _with_model),
    Layout("12scenes", "kitchen", _TWELVE, _TWELVE_IMAGES),
    Layout(
        "12scenes",
        "kitchen",
        {"info.txt": _TWELVE["info.txt"]} | _truth_model(_TWELVE_IMAGES),
        _TWELVE_IMAGES,
        _with_model,
    ),
    Layout("cambridge", "ShopFacade", _CAMBRIDGE, _CAMBRIDGE_IMAGES),
)

TARGET = target(LAYOUTS, (b"NVM_V3", b"sequence1", b"seq-02", b"m_colorWidth = ", b"[start=", b"end=", b"nan", b"-inf"))
