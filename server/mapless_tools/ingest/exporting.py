"""An export: fetches references, writes their images unchanged, then the file that describes them.

It can also rescue a damaged store: undamaged references are written.
"""

from pathlib import Path

from mapless import Client, Reference
from mapless.masks import FOLDER as MASKS
from mapless.masks import mask_name
from mapless_tools.output_files import whole_file
from mapless_tools.progress import Progress

from .fetching import Export, fetch_all
from .formats.writing import LAYOUTS, PosedImage, image_name

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
    datum, down and unit. Masks are written to masks/, under COLMAP's names. A calibration is not
    exported, since it holds for this server version only; a backup keeps it.

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
        with whole_file(place / name) as file:
            file.write_bytes(image)
        if reference.mask is not None:
            mask = folder / MASKS / mask_name(name)
            mask.parent.mkdir(parents=True, exist_ok=True)
            with whole_file(mask) as file:
                file.write_bytes(reference.mask)
        has_mask = reference.mask is not None
        return PosedImage(name, reference.camera, reference.world_from_camera, has_mask, reference.provenance)

    known = client.get_scene(scene)
    images, damaged = fetch_all(client, scene, take, progress)
    if images:
        for path, text in written.files(images, f"mapless scene {scene}", known).items():
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            with whole_file(folder / path) as file:
                file.write_text(text, encoding="utf-8")
    return Export(len(images), damaged)
