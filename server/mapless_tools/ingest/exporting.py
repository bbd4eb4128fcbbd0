"""An export: fetches references, writes their images unchanged, then the file that describes them.

It can also rescue a damaged store: undamaged references are written.
"""

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import numpy as np

from mapless import Client, Reference
from mapless.masks import FOLDER as MASKS
from mapless.masks import mask_name
from mapless_server.images import ANY_SIZE, decode_depth
from mapless_tools.output_files import whole_file
from mapless_tools.progress import Progress

from .fetching import Export, fetch_all
from .formats.depths import FLOAT32, WrittenDepth
from .formats.depths import FOLDER as DEPTHS
from .formats.writing import LAYOUTS, DepthForm, Layout, PosedImage, image_name

FORMATS = (*LAYOUTS, "gltf")


def check_target(folder: Path, layout: str) -> None:
    """Raises ValueError unless the folder is empty or missing, and the layout can be written."""
    if layout not in FORMATS:
        raise ValueError(f"format must be one of {', '.join(FORMATS)}, not {layout!r}")
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is not a folder")
    if folder.is_dir() and any(folder.iterdir()):
        raise ValueError(f"{folder} is not empty; an export does not write over anything")


WITH, WITHOUT, ONLY = "with", "without", "only"
"""Exports of all references, of surveyed ones, and of adopted ones."""


def export_scene(
    client: Client, scene: str, folder: Path, layout: str, progress: Progress, adopted: str = WITH
) -> Export:
    """Writes a scene's references into a folder, except damaged ones; `adopted` says which.

    ValueError as in `check_target`, or without references. The layouts `cameras` and `kapture` also have the scene's
    datum, down and unit, and depths: `cameras` as they came, kapture in metres. A model of COLMAP has none. Masks are
    written to masks/, under COLMAP's names. A calibration is not exported, since it holds for this server version only;
    a backup keeps it.

    The description is written last, so a folder without it is an interrupted export. If every reference is damaged,
    nothing is left in the folder.
    """
    check_target(folder, layout)
    if adopted not in (WITH, WITHOUT, ONLY):
        raise ValueError(f"adopted must be {WITH}, {WITHOUT} or {ONLY}, not {adopted!r}")
    if layout == "gltf" and adopted != WITH:
        raise ValueError("gltf shows all references of a scene; --adopted is for the other formats")
    if layout == "gltf":
        from .gltf import export_gltf

        return export_gltf(client, scene, folder, progress)
    written = LAYOUTS[layout]
    place = folder / written.images
    left_out: list[str] = []

    def take(reference: Reference) -> PosedImage:
        image = reference.image or b""
        name = image_name(reference.reference_id, image)
        _write(place / name, image)
        if reference.mask is not None:
            _write(folder / MASKS / mask_name(name), reference.mask)
        depth, has_mask = _write_depth(folder, written, name, reference), reference.mask is not None
        if depth is None and reference.depth is not None:
            left_out.append(name)
        return PosedImage(name, reference.camera, reference.world_from_camera, has_mask, reference.provenance, depth)

    known = client.get_scene(scene)
    images, damaged = fetch_all(client, scene, take, progress, wanted=_wanted(client, scene, adopted))
    if images:
        for path, text in written.files(images, f"mapless scene {scene}", known).items():
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            with whole_file(folder / path) as file:
                file.write_text(text, encoding="utf-8")
    return Export(len(images), damaged, len(left_out))


def _wanted(client: Client, scene: str, adopted: str) -> Collection[str] | None:
    """Ids of the references to write; None for all. ValueError if there are none."""
    if adopted == WITH:
        return None
    found = [it.reference_id for it in client.list_references(scene, only_adopted=True, page_size=1000)]
    if adopted == WITHOUT:
        found = list({it.reference_id for it in client.list_references(scene, page_size=1000)} - set(found))
    if not found:
        raise ValueError(f"scene {scene} has no {'adopted' if adopted == ONLY else 'surveyed'} references")
    return found


def _write_depth(folder: Path, layout: Layout, image: str, reference: Reference) -> WrittenDepth | None:
    """Writes the depth of a reference, if it has one, in the form that the layout has."""
    depth = reference.depth
    if depth is None or layout.depths is DepthForm.NONE:
        return None
    if layout.depths is DepthForm.METRES:
        path = f"{image}.depth"
        values = decode_depth(depth, (reference.camera.width_px, reference.camera.height_px), ANY_SIZE)
        _write(folder / layout.images / path, np.nan_to_num(values).astype("<f4").tobytes())
        height, width = values.shape
        return WrittenDepth(path, replace(depth, data=b"", unit_m=1.0, size=(width, height), confidence=b""))
    path = f"{DEPTHS}/{image}{'.png' if depth.size is None else FLOAT32}"
    confidence = f"{path}.confidence.png" if depth.confidence else ""
    _write(folder / path, depth.data)
    if confidence:
        _write(folder / confidence, depth.confidence)
    return WrittenDepth(path, replace(depth, data=b"", confidence=b""), confidence)


def _write(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as file:
        file.write_bytes(data)
