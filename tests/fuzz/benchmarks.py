"""Importers: 7-Scenes, 12-Scenes and Cambridge, with their own poses and with pseudo ground truth."""

from __future__ import annotations

from pathlib import Path

from mapless.geometry import RigidTransform
from mapless_tools.ingest.formats import ReadOptions
from mapless_tools.ingest.formats.writing import PosedImage, model_texts

from .importing import CAMERA, TRUTH, Layout, numbers, target

_SEVEN = ("seq-01/frame-000000", "seq-01/frame-000001", "seq-02/frame-000000")
_SEVEN_IMAGES = [f"{it}.color.png" for it in _SEVEN]
_SPLITS = {"TrainSplit.txt": b"sequence1\n", "TestSplit.txt": b"sequence2\n"}
_TWELVE_IMAGES = [f"data/frame-00000{i}.color.jpg" for i in range(3)]
_INFO = b"m_colorWidth = 64\nm_colorHeight = 66\nm_calibrationColorIntrinsic = 60 0 31 0 0 62 34 0 0 0 1 0 0 0 0 1 \n"
_SPLIT = b"sequence0 [frames=1]  [start=0 ; end=0]\nsequence1 [frames=2]  [start=1 ; end=2]\n"
_CAMBRIDGE_IMAGES = [f"seq{i}/frame00001.png" for i in range(3)]
_NVM_K = -0.05


def _rotation(pose: RigidTransform) -> str:
    q = pose.inverse().quaternion()
    return numbers([q.w, q.x, q.y, q.z])


def _poses(images: list[str], ending: str) -> dict[str, bytes]:
    names = [image.removesuffix(ending) + ".pose.txt" for image in images]
    return {name: numbers(pose.matrix()).encode() for name, pose in zip(names, TRUTH.poses, strict=True)}


def _truth_lines(images: list[str]) -> bytes:
    lines = []
    for image, pose in zip(images, TRUTH.poses, strict=True):
        lines.append(f"{image} {_rotation(pose)} {numbers(pose.inverse().translation)} 30.5")
    return "\n".join(lines).encode()


def _truth_model(images: list[str]) -> dict[str, bytes]:
    camera = CAMERA.resized(64, 66)
    posed = [PosedImage(image, camera, pose) for image, pose in zip(images, TRUTH.poses, strict=True)]
    return {f"truth/{name}": text.encode() for name, text in model_texts(posed).items()}


def _cambridge() -> dict[str, bytes]:
    lines, lenses = [], []
    for i, (image, pose) in enumerate(zip(_CAMBRIDGE_IMAGES, TRUTH.poses, strict=True)):
        lines.append(f"{image} {numbers(pose.translation)} {_rotation(pose)}")
        lenses.append(f"{image[:-4]}.jpg\t{30 + i} {_rotation(pose)} {numbers(pose.translation)} {_NVM_K} 0")
    head = "Visual Landmark Dataset V1\nImageFile, Camera Position [X Y Z W P Q R]\n\n"
    return {
        "dataset_train.txt": (head + "\n".join(lines[:2])).encode(),
        "dataset_test.txt": (head + lines[2]).encode(),
        "reconstruction.nvm": ("NVM_V3 \n\n3\n" + "\n".join(lenses) + "\n\n0\n").encode(),
    }


def _with_lines(folder: Path) -> ReadOptions:
    return ReadOptions(ground_truth=folder / "truth.txt")


def _with_model(folder: Path) -> ReadOptions:
    return ReadOptions(ground_truth=folder / "truth")


LAYOUTS = (
    Layout("7scenes", "chess", _SPLITS | _poses(_SEVEN_IMAGES, ".color.png"), _SEVEN_IMAGES),
    Layout("7scenes", "chess", _SPLITS | {"truth.txt": _truth_lines(_SEVEN_IMAGES)}, _SEVEN_IMAGES, _with_lines),
    Layout("7scenes", "chess", _SPLITS | _truth_model(_SEVEN_IMAGES), _SEVEN_IMAGES, _with_model),
    Layout(
        "12scenes",
        "kitchen",
        {"info.txt": _INFO, "split.txt": _SPLIT} | _poses(_TWELVE_IMAGES, ".color.jpg"),
        _TWELVE_IMAGES,
    ),
    Layout("12scenes", "kitchen", {"info.txt": _INFO} | _truth_model(_TWELVE_IMAGES), _TWELVE_IMAGES, _with_model),
    Layout("cambridge", "ShopFacade", _cambridge(), _CAMBRIDGE_IMAGES),
)

TARGET = target(LAYOUTS, (b"NVM_V3", b"sequence1", b"seq-02", b"m_colorWidth = ", b"[start=", b"end=", b"nan", b"-inf"))
