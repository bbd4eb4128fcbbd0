"""Parallax of reconstructions: photographs of scenes, and of one place of each, from which the camera only turned.

A turning camera's photographs are made of one photograph: parts of it, seen by a pinhole that is turned within it.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from mapless.geometry import rotation_from_vector
from mapless_tools.dataset import Frame
from mapless_tools.ingest.formats.cameras import read_folder
from mapless_tools.reconstruct.mapping import parallax_deg
from mapless_tools.reconstruct.pictures import Picture, Pictures
from mapless_tools.reconstruct.run import ReconstructOptions, reconstruct
from mapless_tools.reconstruct.turning import share_with_parallax

from ..places import FOUNTAIN, OFFICE
from .page import Measurement, Row

SCENES = (FOUNTAIN, "herz-jesus-P8", OFFICE)
TURNS_DEG = range(-9, 10, 3)
_INSIDE = 0.7
"""Side of a turned photograph over that of the one that it is made of."""
_OPTIONS = ReconstructOptions(features="edgepoint2-l64")


def turned(frame: Frame, folder: Path) -> list[Picture]:
    """Photographs of a camera that turns at the place of a frame."""
    image = np.asarray(cv2.imread(str(frame.image_path)), np.uint8)
    width, height = round(_INSIDE * frame.camera.width_px), round(_INSIDE * frame.camera.height_px)
    k = frame.camera.matrix()
    own = k - [
        [0, 0, (1 - _INSIDE) / 2 * frame.camera.width_px],
        [0, 0, (1 - _INSIDE) / 2 * frame.camera.height_px],
        [0] * 3,
    ]
    pictures = []
    for degrees in TURNS_DEG:
        rotation = rotation_from_vector(np.radians([degrees / 3, degrees, degrees / 2]))
        seen = cv2.warpPerspective(image, own @ rotation @ np.linalg.inv(k), (width, height), flags=cv2.INTER_CUBIC)
        file = folder / f"turned{degrees}.jpg"
        cv2.imwrite(str(file), seen, [cv2.IMWRITE_JPEG_QUALITY, 90])
        pictures.append(Picture(file.stem, file, width, height, file))
    return pictures


def found(pictures: list[Picture], work: Path) -> tuple[str, str]:
    """The share of pairs that no turn explains, and the parallax of the largest model; empty without one."""
    with suppress(ValueError):  # that the camera only turned
        reconstruct(Pictures(tuple(pictures)), work, _OPTIONS, lambda *_: None)
    (database,) = work.glob("database-*")
    models = [pycolmap.Reconstruction(str(it)) for it in next(work.glob("models-*")).iterdir()]
    share = share_with_parallax(database, range(1, len(pictures) + 1))
    largest = max(models, key=lambda it: it.num_reg_images(), default=None)
    return f"{share:.2f}", "" if largest is None else f"{parallax_deg(largest):.1f}"


def rows(scenes: Path) -> Iterator[Row]:
    """A row for each scene."""
    for name in SCENES:
        frames = read_folder(scenes / name).frames
        moved = [
            Picture(it.name, it.image_path, it.camera.width_px, it.camera.height_px, it.image_path) for it in frames
        ]
        with tempfile.TemporaryDirectory() as first, tempfile.TemporaryDirectory() as second:
            share, angle = found(moved, Path(first))
            turned_share, turned_angle = found(turned(frames[len(frames) // 2], Path(second)), Path(second))
        yield {
            "scene": name,
            "moved: pairs that no turn explains": share,
            "parallax, degrees": angle,
            "turned: pairs": turned_share,
            "parallax of the model, degrees": turned_angle,
        }


MEASUREMENTS = {"parallax": Measurement(rows)}
