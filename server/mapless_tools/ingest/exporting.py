"""An export from end to end: references are fetched, their images written as stored, then what describes them.

It is also how a store is rescued of which a disk has damaged something: the references that are whole are written.
"""

from __future__ import annotations

from pathlib import Path

from mapless import Client, Reference
from mapless_tools.progress import Progress

from .fetching import Export, fetch_all
from .formats.writing import LAYOUTS, PosedImage, image_name, write_file

FORMATS = (*LAYOUTS, "gltf")


def check_target(folder: Path, layout: str) -> None:
    """Raises ValueError unless the folder is empty or not there, and the layout is one that is written."""
    if layout not in FORMATS:
        raise ValueError(f"format must be one of {', '.join(FORMATS)}, not {layout!r}")
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is not a folder")
    if folder.is_dir() and any(folder.iterdir()):
        raise ValueError(f"{folder} is not empty; an export does not write over anything")


def export_scene(client: Client, scene: str, folder: Path, layout: str, progress: Progress) -> Export:
    """Writes a scene's references into a folder, but for those that are damaged.

    The layouts `cameras` and `kapture` have the scene's datum, down and unit, too. A calibration is of these references
    on a server of this version, and is measured anew elsewhere; a backup keeps it.

    The description is written last, so that a folder without it is an interrupted export. Where every reference is
    damaged, nothing is left in the folder.

    Raises:
        ValueError: as `check_target`, or the scene is empty.
        OSError: a file cannot be written.
        MaplessError: a call failed.
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
