"""New photographs compared with those of a scene: they fit, or are aligned; damaged ones are left out."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import pytest

import mapless_tools.demo
from mapless import DataLoss, InvalidArgument, Reference
from mapless.geometry import Similarity, rotation_from_vector
from mapless_server.method.pairs.readings.alignment import Alignment
from mapless_tools.dataset import Frame
from mapless_tools.ingest.check import SceneVerdict, check_with_scene
from mapless_tools.ingest.formats.cameras import read_folder
from mapless_tools.ingest.report import not_aligned

FRAMES = read_folder(Path(mapless_tools.demo.__file__).parent / "room").frames
STORED, NEW = FRAMES[0:12:2], FRAMES[1:9:2]
WORLD_FROM_SESSION = Similarity(2.5, rotation_from_vector([0.3, -1.0, 0.2]), np.array([4.0, -2.0, 7.0]))


class Scene:
    """A client of a scene with references; of some of its calls the server cannot do."""

    def __init__(self, damaged: str = "", unreadable: str = "", stored: Sequence[Frame] = STORED) -> None:
        self.damaged = damaged
        self.unreadable = unreadable
        self.masks: list[Path | None] = []
        self.references: list[Reference] = [cast(Any, _Stored(it)) for it in stored]

    def retrieve_references(
        self, image: Path, camera: object, scene: str, count: int, *, mask: Path | None
    ) -> Sequence[object]:
        self.masks.append(mask)
        if image.stem == self.unreadable:
            raise InvalidArgument("INVALID_ARGUMENT", "truncated", reason="IMAGE_UNDECODABLE", field="image")
        return self.references[:count]

    def get_reference(self, scene: str, reference_id: str, include_image: bool) -> object:
        if reference_id == self.damaged:
            raise DataLoss("DATA_LOSS", "damaged")
        return next(it for it in self.references if it.reference_id == reference_id)


class _Stored:
    def __init__(self, frame: Frame) -> None:
        self.reference_id, self.name = frame.name, f"scenes/hall/references/{frame.name}"
        self.camera, self.world_from_camera = frame.camera, frame.world_from_camera
        self.image = frame.image_path.read_bytes()
        self.mask = None if frame.mask_path is None else frame.mask_path.read_bytes()


def checked(scene: Scene, frames: Sequence[Frame]) -> SceneVerdict:
    return check_with_scene(cast(Any, scene), "hall", frames, scene.references, lambda *_: None)


def in_session(frame: Frame) -> Frame:
    pose = WORLD_FROM_SESSION.inverse().transform_pose(frame.world_from_camera)
    return replace(frame, world_from_camera=pose)


def test_photographs_of_another_world_are_aligned_with_the_scene() -> None:
    found = checked(Scene(), [in_session(it) for it in NEW])
    assert found.is_wrong
    assert found.alignment is not None
    assert found.alignment.is_unique
    for frame in NEW:
        pose = found.alignment.world_from_other.transform_pose(in_session(frame).world_from_camera)
        assert pose.translation == pytest.approx(frame.world_from_camera.translation, abs=0.02)
        assert pose.rotation == pytest.approx(frame.world_from_camera.rotation, abs=0.01)


def test_how_well_a_similarity_is_known_is_said() -> None:
    text = not_aligned(Alignment(WORLD_FROM_SESSION, 1.0, 0.5, 4, 0.2, 0.1, 0.3))
    assert "50 % of 4 pairs do not fit, the scale is known to 20 %, the rotation to 5.7 degrees" in text
    assert "the position to 30 % of the extent" in text


def test_photographs_that_fit_do_so_beside_damaged_ones() -> None:
    found = checked(Scene(damaged=STORED[0].name, unreadable=NEW[0].image_path.stem), NEW)
    assert not found.is_wrong
    assert set(found.fitting) >= {it.name for it in NEW[1:3]}


def with_passer_by(frame: Frame, number: int, folder: Path) -> Frame:
    """The photograph with something in it that moves from one to the next, and its mask."""
    image = cv2.imread(str(frame.image_path))
    assert image is not None
    height, width = image.shape[:2]
    texture = np.random.default_rng(3).integers(0, 256, (height // 12, width // 16, 3), dtype=np.uint8)
    shown = cv2.resize(texture, None, fx=10, fy=10, interpolation=cv2.INTER_CUBIC)
    top, left = number * 7 % (height - len(shown)), number * 13 % (width - shown.shape[1])
    mask = np.full((height, width), 255, np.uint8)
    covered = slice(top, top + len(shown)), slice(left, left + shown.shape[1])
    image[covered], mask[covered] = shown, 0
    path, mask_path = folder / f"{frame.name}.png", folder / f"{frame.name}.mask.png"
    cv2.imwrite(str(path), image)
    cv2.imwrite(str(mask_path), mask)
    return replace(frame, image_path=path, mask_path=mask_path)


def test_what_masks_ignore_decides_nothing(tmp_path: Path) -> None:
    frames = [with_passer_by(it, i, tmp_path) for i, it in enumerate([*STORED[:2], *NEW[:2]])]
    stored, new = frames[:2], frames[2:]
    unmasked = [replace(it, mask_path=None) for it in new]
    assert checked(Scene(stored=[replace(it, mask_path=None) for it in stored]), unmasked).is_wrong
    scene = Scene(stored=stored)
    assert not checked(scene, unmasked).is_wrong
    assert scene.masks == [None] * len(new)
    scene = Scene(stored=[replace(it, mask_path=None) for it in stored])
    assert not checked(scene, new).is_wrong
    assert scene.masks == [it.mask_path for it in new]
