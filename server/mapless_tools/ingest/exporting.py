"""An export: fetches references concurrently, writes their images unchanged, then the file that describes them.

It can also rescue a damaged store: undamaged references are written.
"""

import hashlib
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from mapless import Client, DataLoss, Reference
from mapless_tools.progress import Progress

from .formats.writing import LAYOUTS, PosedImage, image_name, write_file

PARALLEL = 4

T = TypeVar("T")


@dataclass(frozen=True)
class Export:
    """The number of written references, and the server's messages about damaged ones by their ids, in their order."""

    written: int
    damaged: Mapping[str, str]

    @property
    def total(self) -> int:
        """Number of references of the scene."""
        return self.written + len(self.damaged)


def fetch_all(
    client: Client,
    scene: str,
    take: Callable[[Reference], T],
    progress: Progress,
    pictures: int | None = None,
) -> tuple[list[T], dict[str, str]]:
    """Calls `take`, in threads, for each reference; returns its results in order, and messages about damaged ones.

    So many `pictures`, evenly spread, have their photographs; None for all. ValueError if the scene has no references.
    """
    references = _reference_ids(client, scene)
    if not references:
        raise ValueError(f"scene {scene} has no references")
    step = 1 if pictures is None else -(-len(references) // pictures)

    def fetch(position: int) -> tuple[T | None, str]:
        try:
            with_image = position % step == 0
            reference = client.get_reference(scene, references[position], include_image=with_image)
        except DataLoss as error:
            return None, error.message
        if with_image and hashlib.sha256(reference.image or b"").hexdigest() != reference.image_sha256:
            return None, f"reference {reference.reference_id!r}: the image received is not the one that was stored"
        return take(reference), ""

    progress("references", 0, len(references))
    taken: list[T] = []
    damaged: dict[str, str] = {}
    threads = ThreadPoolExecutor(PARALLEL, "export")
    try:
        for reference_id, (found, message) in zip(references, threads.map(fetch, range(len(references))), strict=True):
            if found is None:
                damaged[reference_id] = message
            else:
                taken.append(found)
            progress("references", len(taken) + len(damaged), len(references))
    finally:
        threads.shutdown(wait=True, cancel_futures=True)
    return taken, damaged


def _reference_ids(client: Client, scene: str) -> list[str]:
    with suppress(DataLoss):
        return [reference.reference_id for reference in client.list_references(scene, page_size=1000)]
    # A list ends at a reference whose pose is damaged; an audit names it and continues, but examines each reference.
    return [audit.name.rpartition("/")[2] for audit in client.audit_scene(scene)]


FORMATS = (*LAYOUTS, "gltf")


def check_target(folder: Path, layout: str) -> None:
    """Raises ValueError unless the folder is empty or missing, and the layout can be written."""
    if layout not in FORMATS:
        raise ValueError(f"format must be one of {', '.join(FORMATS)}, not {layout!r}")
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is not a folder")
    if folder.is_dir() and any(folder.iterdir()):
        raise ValueError(f"{folder} is not empty; an export does not write over anything")


def export_scene(client: Client, scene: str, folder: Path, layout: str, progress: Progress) -> Export:
    """Writes a scene's references into a folder, except damaged ones.

    ValueError as in `check_target`, or without references. The layouts `cameras` and `kapture` also have the scene's
    datum, down and unit. A calibration is not exported, since it holds for this server version only; a backup keeps it.

    The description is written last, so a folder without it is an interrupted export. If every reference is damaged,
    nothing is left in the folder.
    """
    check_target(folder, layout)
    if layout == "gltf":
        from .gltf import export_gltf

        return export_gltf(client, scene, folder, progress)
    written = LAYOUTS[layout]
    place = folder / written.images

    def take(reference: Reference) -> PosedImage:
        image = reference.image or b""
        name = image_name(reference.reference_id, image)
        place.mkdir(parents=True, exist_ok=True)
        write_file(place / name, image)
        return PosedImage(name, reference.camera, reference.world_from_camera)

    known = client.get_scene(scene)
    images, damaged = fetch_all(client, scene, take, progress)
    if images:
        for path, text in written.files(images, f"mapless scene {scene}", known).items():
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            write_file(folder / path, text.encode())
    return Export(len(images), damaged)
