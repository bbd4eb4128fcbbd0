"""A scene's references as a folder of files: images, and what says their cameras and poses."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from mapless import Scene
from mapless.geometry import Fisheye
from mapless_tools.dataset import FILE_NAME

from .colmap.writing import PosedImage, model_texts

IMAGES = "images"


def image_name(reference_id: str, image: bytes) -> str:
    """File name of a reference's image: its id, and the ending of what it is."""
    if image.startswith(b"\x89PNG"):
        return f"{reference_id}.png"
    return f"{reference_id}.webp" if image.startswith(b"RIFF") else f"{reference_id}.jpg"


def write_file(file: Path, content: bytes) -> None:
    """Writes a file that is there whole or not at all."""
    unfinished = file.with_name(f".{file.name}.unfinished")
    try:
        with unfinished.open("wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        unfinished.replace(file)
    except BaseException:
        unfinished.unlink(missing_ok=True)
        raise


def cameras_files(images: Sequence[PosedImage], source: str, scene: Scene | None = None) -> dict[str, str]:
    """Contents of `cameras.json` by its path, with the scene's datum and down; images lie in the folder IMAGES."""
    content: dict[str, Any] = {"source": source, "metric": True, "units": "metre"}
    if scene is not None and scene.datum is not None:
        content["datum"] = scene.datum.to_json()
    if scene is not None and scene.down_in_world is not None:
        content["down_in_world"] = scene.down_in_world
    content["frames"] = [_entry(image) for image in images]
    return {FILE_NAME: json.dumps(content, indent=1, allow_nan=False) + "\n"}


def colmap_files(images: Sequence[PosedImage], source: str, scene: Scene | None = None) -> dict[str, str]:
    """Contents of a COLMAP text model's files by their paths; images lie in the folder IMAGES."""
    return {f"sparse/0/{name}": f"# {source}\n{text}" for name, text in model_texts(images).items()}


class Layout(Protocol):
    """How a scene is written."""

    def __call__(self, images: Sequence[PosedImage], source: str, scene: Scene | None = None) -> dict[str, str]:
        """Contents of files by their paths.

        Args:
            images: what is described; they lie in the folder IMAGES.
            source: where they come from, for a person.
            scene: what is known of it as a whole, for layouts that have a place for it.
        """
        ...


LAYOUTS: Mapping[str, Layout] = {
    "cameras": cameras_files,
    "colmap": colmap_files,
}
"""Layouts that are written, by name."""


def _entry(image: PosedImage) -> dict[str, Any]:
    camera, lens = image.camera, image.camera.distortion
    entry: dict[str, Any] = {
        "image": f"{IMAGES}/{image.name}",
        "width": camera.width_px,
        "height": camera.height_px,
        "K": camera.matrix().tolist(),
        "dist": None if lens is None else list(vars(lens).values()),
        "world_from_camera": image.world_from_camera.matrix().tolist(),
    }
    return entry | {"lens": "fisheye"} if isinstance(lens, Fisheye) else entry
