"""An export from end to end: references are fetched, their images written as stored, then what describes them.

It is also how a store is rescued of which a disk has damaged something: the references that are whole are written.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from mapless import Client, DataLoss
from mapless_tools.progress import Progress

from .formats.writing import IMAGES, LAYOUTS, PosedImage, image_name, write_file

PARALLEL = 4


@dataclass(frozen=True)
class Export:
    """What became of a scene's references.

    Attributes:
        written: how many lie in the folder.
        damaged: the server's messages about the others, by their ids, in their order.
    """

    written: int
    damaged: Mapping[str, str]

    @property
    def total(self) -> int:
        """How many the scene has."""
        return self.written + len(self.damaged)


def check_target(folder: Path, layout: str) -> None:
    """Raises ValueError unless the folder is empty or not there, and the layout is one that is written."""
    if layout not in LAYOUTS:
        raise ValueError(f"format must be {' or '.join(LAYOUTS)}, not {layout!r}")
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is not a folder")
    if folder.is_dir() and any(folder.iterdir()):
        raise ValueError(f"{folder} is not empty; an export does not write over anything")


def export_scene(client: Client, scene: str, folder: Path, layout: str, progress: Progress) -> Export:
    """Writes a scene's references into a folder, but for those that are damaged.

    The layout `cameras` has the scene's datum, down and unit, too. A calibration is of these references on a server of
    this version, and is measured anew elsewhere; a backup keeps it.

    The description is written last, so that a folder without it is an interrupted export. Where every reference is
    damaged, nothing is left in the folder.

    Raises:
        ValueError: as `check_target`, or the scene is empty.
        OSError: a file cannot be written.
        MaplessError: a call failed.
    """
    check_target(folder, layout)
    known = client.get_scene(scene)
    references = _reference_ids(client, scene)
    if not references:
        raise ValueError(f"scene {scene} has no references")
    (folder / IMAGES).mkdir(parents=True, exist_ok=True)
    progress("writing images", 0, len(references))
    images: list[PosedImage] = []
    damaged: dict[str, str] = {}
    threads = ThreadPoolExecutor(PARALLEL, "export")
    try:
        found = threads.map(partial(_write_image, client, folder, scene), references)
        for reference_id, image in zip(references, found, strict=True):
            if isinstance(image, PosedImage):
                images.append(image)
            else:
                damaged[reference_id] = image
            progress("writing images", len(images) + len(damaged), len(references))
    finally:
        threads.shutdown(wait=True, cancel_futures=True)
    if images:
        for path, text in LAYOUTS[layout](images, f"mapless scene {scene}", known).items():
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            write_file(folder / path, text.encode())
    else:
        (folder / IMAGES).rmdir()
    return Export(len(images), damaged)


def _reference_ids(client: Client, scene: str) -> list[str]:
    """Of all references, damaged ones too."""
    with suppress(DataLoss):
        return [reference.reference_id for reference in client.list_references(scene, page_size=1000)]
    # A list ends at a reference whose pose is damaged; an audit names it and continues, but examines each reference.
    return [audit.name.rpartition("/")[2] for audit in client.audit_scene(scene)]


def _write_image(client: Client, folder: Path, scene: str, reference_id: str) -> PosedImage | str:
    """Fetches an image and writes it, bit by bit as it was stored; or what is damaged."""
    try:
        reference = client.get_reference(scene, reference_id, include_image=True)
    except DataLoss as error:
        return error.message
    image = reference.image or b""
    if hashlib.sha256(image).hexdigest() != reference.image_sha256:
        return f"reference {reference_id!r}: the image received is not the one that was stored"
    name = image_name(reference_id, image)
    write_file(folder / IMAGES / name, image)
    return PosedImage(name, reference.camera, reference.world_from_camera)
