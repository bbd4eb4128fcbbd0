"""An export from end to end: references are fetched, their images written as stored, then what describes them."""

from __future__ import annotations

import hashlib
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

from mapless import Client, Reference

from ..formats.colmap.writing import PosedImage
from ..formats.writing import IMAGES, LAYOUTS, image_name, write_file
from ..progress import Progress

PARALLEL = 4


class Damaged(Exception):
    """An image is not what was stored."""


def check_target(folder: Path, layout: str) -> None:
    """Raises ValueError unless the folder is empty or not there, and the layout is one that is written."""
    if layout not in LAYOUTS:
        raise ValueError(f"format must be {' or '.join(LAYOUTS)}, not {layout!r}")
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is not a folder")
    if folder.is_dir() and any(folder.iterdir()):
        raise ValueError(f"{folder} is not empty; an export does not write over anything")


def export_scene(client: Client, scene: str, folder: Path, layout: str, progress: Progress) -> int:
    """Writes a scene's references into a folder; the number of them.

    The layout `cameras` says the scene's datum and down, too. A calibration is of these references on a server of this
    version, and is measured anew elsewhere; a backup keeps it.

    The description comes last, so that a folder without it is an export that was cut off.

    Raises:
        ValueError: as `check_target`, or the scene is empty.
        OSError: a file cannot be written.
        Damaged: what came is not what was stored.
        MaplessError: a call failed.
    """
    check_target(folder, layout)
    known = client.get_scene(scene)
    references = list(client.list_references(scene, page_size=1000))
    if not references:
        raise ValueError(f"scene {scene} has no references")
    (folder / IMAGES).mkdir(parents=True, exist_ok=True)
    progress("writing images", 0, len(references))
    images: list[PosedImage] = []
    threads = ThreadPoolExecutor(PARALLEL, "export")
    try:
        for image in threads.map(partial(_write_image, client, folder), references):
            images.append(image)
            progress("writing images", len(images), len(references))
    finally:
        threads.shutdown(wait=True, cancel_futures=True)
    for path, text in LAYOUTS[layout](images, f"mapless scene {scene}", known).items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        write_file(folder / path, text.encode())
    return len(images)


def _write_image(client: Client, folder: Path, listed: Reference) -> PosedImage:
    """Fetches an image and writes it, bit by bit as it was stored."""
    reference = client.get_reference(listed.scene_id, listed.reference_id, include_image=True)
    image = reference.image or b""
    if hashlib.sha256(image).hexdigest() != listed.image_sha256:
        raise Damaged(f"reference {listed.reference_id}: its image is not the one that was listed")
    name = image_name(listed.reference_id, image)
    write_file(folder / IMAGES / name, image)
    return PosedImage(name, reference.camera, reference.world_from_camera)
