"""An export: fetches references, writes their images unchanged, then the file that describes them.

It can also rescue a damaged store: undamaged references are written.
"""

from pathlib import Path
from typing import Any

from mapless import Client, DepthImage, Reference
from mapless.masks import FOLDER as MASKS
from mapless.masks import mask_name
from mapless_tools.output_files import whole_file
from mapless_tools.progress import Progress

from .fetching import Export, fetch_all
from .formats.depths import FOLDER as DEPTHS
from .formats.depths import confidence_name, depth_entry, depth_name
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
    datum, down and unit. Masks are written to masks/, under COLMAP's names, and depths to depth/, which the layout
    `cameras` alone describes. A calibration is not exported, since it holds for this server version only; a backup
    keeps it.

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
        _write(place / name, image)
        if reference.mask is not None:
            _write(folder / MASKS / mask_name(name), reference.mask)
        depth = {} if reference.depth is None else _write_depth(folder / DEPTHS, name, reference.depth)
        has_mask = reference.mask is not None
        return PosedImage(name, reference.camera, reference.world_from_camera, has_mask, reference.provenance, depth)

    known = client.get_scene(scene)
    images, damaged = fetch_all(client, scene, take, progress)
    if images:
        for path, text in written.files(images, f"mapless scene {scene}", known).items():
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            with whole_file(folder / path) as file:
                file.write_text(text, encoding="utf-8")
    return Export(len(images), damaged)


def _write_depth(folder: Path, image: str, depth: DepthImage) -> dict[str, Any]:
    """Writes the depth of an image; returns its entries in `cameras.json`."""
    name = depth_name(image, depth)
    _write(folder / name, depth.data)
    if depth.confidence:
        _write(folder / confidence_name(name), depth.confidence)
    return depth_entry(depth, name)


def _write(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as file:
        file.write_bytes(data)
