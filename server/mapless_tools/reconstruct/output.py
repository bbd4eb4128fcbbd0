"""The folder of a reconstruction: `cameras.json` and photographs in our own layout, a report, and a picture in 3D."""

from __future__ import annotations

import math
import shutil
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from mapless import Reference
from mapless import Scene as KnownScene
from mapless.cameras import FOLDER_FILE
from mapless.geometry import Camera
from mapless.lenses import lens_model_of
from mapless_server.method.features.views import MAX_INCIDENCE_DEG, undistort_pixels
from mapless_tools.charts import figure_of, inline_svg, new_axes
from mapless_tools.depth_points import ColouredPoints
from mapless_tools.ingest.formats.writing import IMAGES, PosedImage, cameras_files
from mapless_tools.ingest.gltf import PICTURES, View, thumbnail, to_gltf
from mapless_tools.output_files import render
from mapless_tools.plan import REFERENCE, Cameras, basis_from_above, down_of, draw_plan
from mapless_tools.progress import Progress, tracked
from mapless_tools.view.scenery import spread_out

from .pictures import Part, PosedPicture, WorldFrame
from .run import Reconstructed, made_once, remove

REPORT, PICTURE = "report.html", "scene.glb"
POINTS_ON_PLAN = 4000
"""Evenly chosen ones: each takes a hundred bytes of the page."""


def write_folder(result: Reconstructed, work: Path, out: Path, progress: Progress) -> None:
    """Writes the files into `out`, all of them or none: they are made in `work`, which is on the same disk.

    `cameras.json`, which makes it a folder of posed photographs, is removed first and comes last.
    """
    ready = work / "result"
    remove(ready)
    with made_once(ready) as folder:
        assert folder is not None
        _make(result, folder, out.name, progress)
    (out / FOLDER_FILE).unlink(missing_ok=True)
    for name in (IMAGES, REPORT, PICTURE, FOLDER_FILE):
        remove(out / name)
        (ready / name).replace(out / name)
    ready.rmdir()


def _make(result: Reconstructed, folder: Path, name: str, progress: Progress) -> None:
    (folder / IMAGES).mkdir(parents=True)
    posed = result.part.posed
    for it in tracked("photographs", posed, len(posed), progress):
        shutil.copyfile(it.picture.path, folder / IMAGES / file_name(it))
    images = [PosedImage(file_name(it), it.camera, it.world_from_camera) for it in posed]
    scene = _scene(name, result.world, len(posed))
    source = f"mapless-server reconstruct, pycolmap {pycolmap.__version__}"
    for file, text in cameras_files(images, source, scene).items():
        (folder / file).write_text(text, encoding="utf-8")
    (folder / REPORT).write_text(report(result), encoding="utf-8")
    (folder / PICTURE).write_bytes(to_gltf(scene, _views(result.part)))


def file_name(posed: PosedPicture) -> str:
    """The name of a photograph's file in the folder."""
    return f"{posed.picture.name}{posed.picture.path.suffix.lower()}"


def _scene(name: str, world: WorldFrame, count: int) -> KnownScene:
    return KnownScene(
        name,
        0,
        count,
        datetime.now(UTC),
        datum=world.datum,
        down_in_world=world.down_in_world,
        arbitrary_unit=not world.is_metric,
    )


def _views(part: Part) -> list[View]:
    """The photographs as glTF takes them, with the points at the first."""
    centres = np.stack([it.world_from_camera.translation for it in part.posed])
    pictured = set(spread_out(centres, PICTURES).tolist())
    views = []
    for i, it in enumerate(part.posed):
        reference = Reference(
            "", it.picture.name, it.camera, it.world_from_camera, "", it.point_count, datetime.now(UTC)
        )
        picture = _thumbnail(it.picture.path) if i in pictured else None
        if i:
            views.append(View(reference, picture))
        else:
            colours = np.rint(part.colours).astype(np.uint8)
            views.append(View(reference, picture, ColouredPoints(part.points_in_world, colours)))
    return views


def _thumbnail(file: Path) -> bytes:
    image = cv2.imread(str(file), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise ValueError(f"{file} cannot be read any more")
    return thumbnail(np.asarray(image, np.uint8))


def report(result: Reconstructed) -> str:
    """The page of a reconstruction: HTML that loads nothing and runs no scripts."""
    part, world = result.part, result.world
    unit = "m" if world.is_metric else "units"
    poses = [it.world_from_camera for it in part.posed]
    down = down_of(None, poses) if world.down_in_world is None else np.asarray(world.down_in_world)
    points = part.points_in_world[:: 1 + len(part.points_in_world) // POINTS_ON_PLAN]
    axes = new_axes("From above", "", "")
    cameras = [(it.world_from_camera, it.camera) for it in part.posed]
    draw_plan(axes, basis_from_above(down), [Cameras("photographs", REFERENCE, cameras)], points, unit=unit)
    return render(
        "reconstruction.html",
        title=summary(result),
        facts=_facts(result),
        plan=inline_svg(figure_of(axes)),
        warnings=world.warnings,
        notes=(*result.pictures.notes, *world.notes),
        cameras=_cameras(result),
        photographs=[
            [file_name(it), str(it.point_count), ", ".join(f"{v:.3f}" for v in it.world_from_camera.translation)]
            for it in part.posed
        ],
        omitted=[[it.name if it.count == 1 else f"{it.count} of {it.name}", it.reason] for it in result.omitted],
        unit=unit,
    )


def summary(result: Reconstructed) -> str:
    """One line: how many photographs, and frames of videos, have poses."""
    pictures = result.pictures
    used = sum(it.time is not None for it in pictures.chosen)
    posed = sum(it.picture.time is not None for it in result.part.posed)
    texts = []
    if pictures.photographs:
        texts.append(f"{len(result.part.posed) - posed} of {pictures.photographs} photographs have poses")
    if pictures.frames:
        texts.append(f"{used} of {pictures.frames} frames were used; {posed} of them have poses")
    return "; ".join(texts)


def _facts(result: Reconstructed) -> dict[str, str]:
    part, world = result.part, result.world
    extent = np.ptp(np.stack([it.world_from_camera.translation for it in part.posed]), axis=0)
    metric = f"metres, to {100 * world.scale_sigma:.1f} % (one standard deviation)"
    facts = {
        "unit": metric if world.is_metric else "arbitrary: lengths are not in metres",
        "extent of the cameras": " x ".join(f"{it:.3g}" for it in extent) + (" m" if world.is_metric else " units"),
        "points": str(len(part.points_in_world)),
        "reprojection error": f"{part.reprojection_px:.2f} px in the mean",
        "computed by": f"pycolmap {pycolmap.__version__}",
    }
    if len(result.parts) > 1:
        sizes = ", ".join(f"{i}: {count} photographs" for i, count in enumerate(result.parts, 1))
        facts["parts that do not connect"] = f"{sizes}; --part chooses another"
    return facts


def _cameras(result: Reconstructed) -> list[list[str]]:
    """A row for each camera: photographs, size, focal lengths before and after, lens."""
    refined = {it.picture.name: it.camera for it in result.part.posed}
    rows = []
    for start in result.cameras:
        names = [it for it in start.names if it in refined]
        if not names:
            continue
        camera = refined[names[0]]
        lens = "none" if camera.distortion is None else _coefficients(camera.distortion)
        focal = f"{camera.focal_x_px:.1f} px, {_degrees_across(camera)}"
        before = f"{start.camera.focal_x_px:.1f} px: {start.origin}"
        rows.append([str(len(names)), f"{camera.width_px} x {camera.height_px}", before, focal, lens])
    return rows


def _coefficients(lens: object) -> str:
    values = ", ".join(f"{name} {value:.4g}" for name, value in vars(lens).items() if value)
    return f"{lens_model_of(lens)}: {values or 'all zero'}"


def _degrees_across(camera: Camera) -> str:
    """The angle of view from the left border to the right one, its lens undone."""
    middle_px = camera.principal_y_px
    borders = undistort_pixels(np.array([[-0.5, middle_px], [camera.width_px - 0.5, middle_px]]), camera)
    if not np.isfinite(borders).all():
        return f"more than {2 * MAX_INCIDENCE_DEG:.0f} degrees across"
    left, right = camera.rays(borders)
    return f"{math.degrees(math.atan2(right[0], 1) - math.atan2(left[0], 1)):.0f} degrees across"


def printed(result: Reconstructed) -> Sequence[str]:
    """Lines for a terminal."""
    lines = [summary(result), *(f"{name}: {value}" for name, value in _facts(result).items())]
    notes = [f"note: {it}" for it in (*result.pictures.notes, *result.world.notes)]
    return [*lines, *notes, *(f"warning: {it}" for it in result.world.warnings)]
