"""Masks of folders: found under COLMAP's names, named by cameras.json and transforms.json, or given for all."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.images import encode, textured
from support.scenes import CAMERA

from mapless.geometry import RigidTransform
from mapless_tools.dataset import Dataset
from mapless_tools.ingest.formats import ReadOptions, read_dataset
from mapless_tools.ingest.formats.writing import PosedImage, cameras_files, colmap_files

NAMES = ("a/1.png", "b/1.png", "b/2.png")
MASK = encode(".png", np.full((CAMERA.height_px, CAMERA.width_px, 3), 255, np.uint8))


def write(path: Path, data: bytes = MASK) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path


def folder(path: Path, layout: str) -> Path:
    """Three posed photographs in two folders."""
    images = [PosedImage(name, replace(CAMERA), RigidTransform.identity()) for name in NAMES]
    for i, name in enumerate(NAMES):
        write(path / "images" / name, encode(".png", textured(CAMERA.width_px, CAMERA.height_px, seed=i)))
    describe = colmap_files if layout == "colmap" else cameras_files
    for name, text in describe(images, "test").items():
        write(path / name, text.encode())
    return path


def masks_of(dataset: Dataset, root: Path) -> dict[str, str | None]:
    """Paths of the masks by those of the photographs."""
    return {
        it.image_path.relative_to(root / "images").as_posix(): (
            None if it.mask_path is None else it.mask_path.relative_to(root).as_posix()
        )
        for it in dataset.frames
    }


def test_a_folder_of_colmap_has_its_masks_beside_the_images(tmp_path: Path) -> None:
    root = folder(tmp_path / "model", "colmap")
    write(root / "masks" / "b" / "1.png.png")
    dataset = read_dataset(root)
    assert masks_of(dataset, root) == {"a/1.png": None, "b/1.png": "masks/b/1.png.png", "b/2.png": None}
    assert any(note.startswith("masks: 1 of 3 photographs") for note in dataset.notes)


def test_masks_of_other_names_beside_the_images_are_not_taken(tmp_path: Path) -> None:
    root = folder(tmp_path / "model", "colmap")
    write(root / "masks" / "b" / "1.png")
    assert set(masks_of(read_dataset(root), root).values()) == {None}


@pytest.mark.parametrize("name", ["b/2.png.png", "b/2.png", "2.png.png", "images/b/2.png.png"])
def test_given_masks_are_found_by_path_or_by_a_unique_name(tmp_path: Path, name: str) -> None:
    root = folder(tmp_path / "mine", "cameras")
    write(root / "given" / name)
    found = masks_of(read_dataset(root, options=ReadOptions(masks=root / "given")), root)
    assert found == {"a/1.png": None, "b/1.png": None, "b/2.png": f"given/{name}"}


def test_a_name_that_two_photographs_have_is_no_mask_of_either(tmp_path: Path) -> None:
    root = folder(tmp_path / "mine", "cameras")
    write(root / "given" / "1.png.png")
    with pytest.raises(ValueError, match=r"has a mask of none of the photographs: 1\.png\.png"):
        read_dataset(root, options=ReadOptions(masks=root / "given"))


def test_one_file_is_the_mask_of_all(tmp_path: Path) -> None:
    root = folder(tmp_path / "mine", "cameras")
    mask = write(root / "bonnet.png")
    assert set(masks_of(read_dataset(root, options=ReadOptions(masks=mask)), root).values()) == {"bonnet.png"}


def test_masks_that_are_not_there_are_an_error(tmp_path: Path) -> None:
    root = folder(tmp_path / "mine", "cameras")
    with pytest.raises(ValueError, match="neither a mask nor a folder of masks"):
        read_dataset(root, options=ReadOptions(masks=root / "nowhere"))


def test_cameras_json_names_masks(tmp_path: Path) -> None:
    root = folder(tmp_path / "mine", "cameras")
    write(root / "m" / "x.png")
    content = json.loads((root / "cameras.json").read_text())
    content["frames"][1]["mask"] = "m/x.png"
    content["frames"][2]["mask"] = "m/missing.png"
    (root / "cameras.json").write_text(json.dumps(content))
    dataset = read_dataset(root)
    assert masks_of(dataset, root) == {"a/1.png": None, "b/1.png": "m/x.png"}
    assert "mask: there is no file" in dataset.refused[0].reason


def test_transforms_json_names_masks(tmp_path: Path) -> None:
    root = tmp_path / "nerf"
    write(root / "images" / "1.png", encode(".png", textured(64, 48)))
    write(root / "masks" / "1.png")
    frame = {"file_path": "images/1.png", "mask_path": "masks\\1.png", "transform_matrix": np.eye(4).tolist()}
    text = json.dumps({"fl_x": 50, "w": 64, "h": 48, "frames": [frame]})
    write(root / "transforms.json", text.encode())
    assert masks_of(read_dataset(root), root) == {"1.png": "masks/1.png"}
