"""Importers: folders in a layout, in memory, whose text or binary files are fuzzed.

Laws: a folder is read or refused with a ValueError that can be printed; each frame of what was read has a legal id of
its own, an image within the folder, a camera that can be one and a finite rigid pose, and is the same frame after it is
written in our own layout, and its camera after it is written as COLMAP's.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from random import Random
from zlib import crc32

import numpy as np
from support.layouts import truth

from mapless.geometry import Camera
from mapless.names import check_id
from mapless_server.images import ImageLimits, decode_depth
from mapless_tools.dataset import SPLITS, Dataset
from mapless_tools.ingest.depth_options import DepthOptions
from mapless_tools.ingest.formats import ReadOptions, read_dataset, recognize
from mapless_tools.ingest.formats.cameras import add_frame
from mapless_tools.ingest.formats.collecting import Collector, check_camera
from mapless_tools.ingest.formats.colmap.cameras import from_camera
from mapless_tools.ingest.formats.writing import PosedImage, cameras_files

from . import folders
from .images import seeds as image_seeds
from .laws import check_pose
from .target import MutateBytes, Target

CAMERA = Camera(32, 33, 30.0, 31.0, 15.25, 16.75)
TRUTH = truth(3, CAMERA)
_THOROUGH_EVERY = 8
MAX_TEXT = 2000
"""Characters of a reason, which may hold a path or two."""


def _no_options(folder: Path) -> ReadOptions:
    return ReadOptions()


@dataclass(frozen=True, eq=False)
class Layout:
    """A layout and a folder that has it.

    Attributes:
        format: for `read_dataset`.
        folder: its name.
        files: contents that inputs stand for, by path.
        images: paths of images, which inputs leave alone.
        options: of reading, given the folder.
    """

    format: str
    folder: str
    files: Mapping[str, bytes]
    images: Sequence[str]
    options: Callable[[Path], ReadOptions] = _no_options


def target(layouts: Sequence[Layout], words: tuple[bytes, ...] = ()) -> Target:
    """The target that reads folders of these layouts."""

    @cache
    def folder(number: int) -> folders.Folder:
        made = folders.Folder(layouts[number].folder)
        for i, image in enumerate(layouts[number].images):
            file = made.path / image
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(image_of(Path(image).suffix, i))
        return made

    def check(data: bytes) -> bool:
        number, contents = folders.split(data)
        layout = layouts[number % len(layouts)]
        written = folder(number % len(layouts))
        written.write(tuple(layout.files), contents)
        return check_folder(written.path, layout, is_thorough=crc32(data) % _THOROUGH_EVERY == 0)

    def seeds() -> list[bytes]:
        return [folders.joined(i, tuple(layout.files.values())) for i, layout in enumerate(layouts)]

    def mutate(data: bytes, random: Random, mutate_bytes: MutateBytes) -> bytes:
        return folders.mutate(data, random, mutate_bytes)

    return Target(seeds, check, mutate, max_bytes=8192, words=(folders.SEPARATOR, *words))


def image_of(ending: str, number: int) -> bytes:
    """A small photograph in a file of this ending."""
    start = b"\x89PNG" if ending == ".png" else b"\xff\xd8"
    files = [it for it in image_seeds() if it.startswith(start)]
    return files[number % 2]


def numbers(values: Sequence[float] | np.ndarray) -> str:
    """Numbers as text, to be read back exactly."""
    return " ".join(repr(float(value)) for value in np.ravel(values))


def check_folder(folder: Path, layout: Layout, is_thorough: bool = True) -> bool:
    """Whether it can be read; see the module for the laws, of which the slower ones are checked if it is thorough."""
    if is_thorough:
        _allowed(lambda: recognize(folder))
    dataset = _allowed(lambda: read_dataset(folder, layout.format, layout.options(folder)))
    if dataset is None:
        return False
    assert dataset.format == layout.format
    assert dataset.frames
    ids = [check_id(frame.name) for frame in dataset.frames]
    assert len(set(ids)) == len(ids)
    for refusal in dataset.refused:
        check_text(refusal.frame)
        check_text(refusal.reason)
    for note in (*dataset.notes, dataset.source, dataset.ground_truth):
        check_text(note)
    for frame in dataset.frames:
        assert frame.split in SPLITS
        assert frame.image_path.is_relative_to(folder)
        assert ".." not in frame.image_path.parts
        check_camera(frame.camera)
        if frame.depth is not None and layout.format != "cameras":  # where a wrong depth refuses its frame later
            decode_depth(frame.depth.read(), (frame.camera.width_px, frame.camera.height_px), ImageLimits())
        assert np.isfinite(frame.world_from_camera.matrix()).all()
    check_pose(dataset.frames[-1].world_from_camera)
    if is_thorough:
        _check_written(dataset, folder)
    return True


def check_text(text: str) -> None:
    """It can be printed: no half characters, nothing that moves a terminal's cursor, no book."""
    assert all(line.isprintable() for line in text.split("\n")), ascii(text)
    assert len(text) <= MAX_TEXT, len(text)


def _allowed(read: Callable[[], Dataset | str]) -> Dataset | None:
    try:
        found = read()
    except ValueError as error:
        assert type(error) is ValueError, repr(error)
        check_text(str(error))
        return None
    return found if isinstance(found, Dataset) else None


def _check_written(dataset: Dataset, folder: Path) -> None:
    frame = dataset.frames[0]
    name = frame.image_path.relative_to(folder).as_posix()
    (text,) = cameras_files([PosedImage(name, frame.camera, frame.world_from_camera)], "").values()
    (entry,) = json.loads(text)["frames"]
    collector = Collector(folder, DepthOptions())
    add_frame(collector, entry | {"image": name, "split": frame.split})
    (again,) = collector.frames
    assert again.camera == frame.camera, (again.camera, frame.camera)
    assert np.abs(again.world_from_camera.matrix() - frame.world_from_camera.matrix()).max() < 1e-9
    colmap = from_camera(1, frame.camera).camera()
    np.testing.assert_allclose(colmap.matrix(), frame.camera.matrix(), rtol=1e-12, atol=1e-12)
    assert colmap.distortion == frame.camera.distortion
