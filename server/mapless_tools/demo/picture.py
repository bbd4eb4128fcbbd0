"""A picture that tells at a glance whether a pose is right.

Left the photograph with known structure drawn where the found pose puts it, right the nearest reference with the same
structure, below the numbers and a plan of the place.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform

from .structure import Shot, SparsePoints, find_in

Canvas = NDArray[np.uint8]
Colour = tuple[int, int, int]

PANEL_PX = (800, 600)
STRIP_PX = 240
MAGNIFICATION = 10
MAX_OFFSET_PX = 20.0
"""Observations farther from a drawn point than this are taken for wrong matches, not for a wrong pose."""

INK: Colour = (235, 235, 235)
FAINT: Colour = (150, 150, 150)
GREEN: Colour = (70, 220, 120)
RED: Colour = (255, 80, 70)
AMBER: Colour = (255, 190, 60)
BACKGROUND: Colour = (24, 26, 30)


@dataclass(frozen=True, eq=False)
class Scenery:
    """What is known of the place, for drawing.

    Attributes:
        points: triangulated from references.
        outline: (E, 2, 3) edges, world; none for a real place.
        visible_outline: (S, 2, 3) the parts of edges that nothing hides from the photograph.
    """

    points: SparsePoints
    outline: Array = field(default_factory=lambda: np.empty((0, 2, 3)))
    visible_outline: Array = field(default_factory=lambda: np.empty((0, 2, 3)))


def draw(
    query: Shot,
    world_from_query: RigidTransform | None,
    nearest: Shot,
    references: Sequence[Shot],
    scenery: Scenery,
    caption: Sequence[str],
) -> Canvas:
    """The picture of one answer, (H, W, 3) uint8 RGB.

    Args:
        query: the photograph with its true pose.
        world_from_query: the found pose; None when the photograph was rejected: then nothing is drawn on it.
        nearest: the reference that the answer rests on most.
        references: all, for the plan.
        scenery: what to draw.
        caption: lines; the first one is the heading.
    """
    found = None if world_from_query is None else replace(query, world_from_camera=world_from_query)
    left = _panel(query.image)
    lines = list(caption)
    if found is not None:
        left, agreement = _overlay(found, scenery, with_outline=True)
        lines.append(agreement)
    right, _ = _overlay(nearest, scenery, with_outline=False)
    for panel, title in (
        (left, f"{query.name}: drawn with the found pose"),
        (right, f"{nearest.name}: the reference that agrees most"),
    ):
        _label(panel, title if found is not None or panel is right else f"{query.name}: not localized")
    strip = np.full((STRIP_PX, 2 * PANEL_PX[0], 3), BACKGROUND, np.uint8)
    plan = _plan(query.world_from_camera, world_from_query, references, scenery, (560, STRIP_PX))
    strip[:, -plan.shape[1] :] = plan
    for i, line in enumerate(lines):
        _write(
            strip,
            line,
            (24, 46 if i == 0 else 52 + 34 * i),
            1.0 if i == 0 else 0.66,
            INK if i == 0 else (205, 205, 205),
        )
    return np.concatenate([np.concatenate([left, right], axis=1), strip])


def contact_sheet(pictures: Sequence[Canvas], columns: int = 2) -> Canvas:
    """Pictures of one size in a grid, each at half its size."""
    small = [np.asarray(cv2.resize(p, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8) for p in pictures]
    small += [np.zeros_like(small[0])] * (-len(small) % columns)
    rows = [np.concatenate(small[i : i + columns], axis=1) for i in range(0, len(small), columns)]
    return np.concatenate(rows)


def png(picture: Canvas) -> bytes:
    """The bytes of a PNG file of a picture."""
    return bytes(cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]))[1])


def _panel(image: Canvas) -> Canvas:
    """The image in the middle of a panel, as large as fits."""
    h, w = image.shape[:2]
    scale = min(PANEL_PX[0] / w, PANEL_PX[1] / h)
    size = (round(w * scale), round(h * scale))
    panel = np.full((PANEL_PX[1], PANEL_PX[0], 3), BACKGROUND, np.uint8)
    left, top = (PANEL_PX[0] - size[0]) // 2, (PANEL_PX[1] - size[1]) // 2
    panel[top : top + size[1], left : left + size[0]] = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return panel


def _in_panel(shot: Shot, pixels: Array) -> Array:
    """Pixels (..., 2) of a shot to pixels of its panel."""
    h, w = shot.image.shape[:2]
    scale = min(PANEL_PX[0] / w, PANEL_PX[1] / h)
    margin = [(PANEL_PX[0] - round(w * scale)) // 2, (PANEL_PX[1] - round(h * scale)) // 2]
    return np.asarray((pixels + 0.5) * scale - 0.5 + margin)


def _overlay(shot: Shot, scenery: Scenery, with_outline: bool) -> tuple[Canvas, str]:
    """The shot with the structure drawn where its pose puts it, and in words how well that fits."""
    panel = (_panel(shot.image) * np.float32(0.72)).astype(np.uint8)
    camera_from_world = shot.world_from_camera.inverse()
    if with_outline and len(scenery.visible_outline):
        ends = _in_panel(shot, shot.camera.project(camera_from_world.apply(scenery.visible_outline)))
        for a, b in ends[np.isfinite(ends).all(axis=(1, 2))]:
            _line(panel, a, b, AMBER, 2)

    x_in_camera = camera_from_world.apply(scenery.points.x_in_world)
    pixels = shot.camera.project(x_in_camera)
    inside = ((pixels >= 0) & (pixels <= [shot.camera.width_px - 1, shot.camera.height_px - 1])).all(axis=-1)
    places = _in_panel(shot, pixels)
    for place, paint in zip(places[inside], _depth_colours(x_in_camera[inside, 2]), strict=True):
        _dot(panel, place, 3, paint)

    indices, observed = find_in(scenery.points, shot, MAX_OFFSET_PX)
    offsets = observed - pixels[indices]
    for start, offset in zip(places[indices], offsets, strict=True):
        _line(panel, start, start + MAGNIFICATION * offset, (255, 255, 255), 1)
    if len(indices) == 0:
        return panel, "no drawn point was recognized in the photograph"
    middle = float(np.median(np.linalg.norm(offsets, axis=-1)))
    return panel, (
        f"{len(indices)} drawn points recognized, {middle:.2f} px (median) from where the pose puts them; "
        f"white: that offset x {MAGNIFICATION}"
    )


def _depth_colours(depth: Array) -> list[Colour]:
    """Near red, far blue, by rank so that every depth is told apart."""
    if len(depth) == 0:
        return []
    rank = np.argsort(np.argsort(-depth)) / max(len(depth) - 1, 1)
    table = cv2.applyColorMap((40 + 200 * rank).astype(np.uint8)[:, None], cv2.COLORMAP_TURBO)[:, 0, ::-1]
    return [(int(r), int(g), int(b)) for r, g, b in table]


def _plan(
    true: RigidTransform,
    found: RigidTransform | None,
    references: Sequence[Shot],
    scenery: Scenery,
    size: tuple[int, int],
) -> Canvas:
    """The place seen from above: structure, references, the true position (green) and the found one (red)."""
    canvas = np.full((size[1], size[0], 3), BACKGROUND, np.uint8)
    poses = [reference.world_from_camera for reference in references]
    axes = _ground_axes(poses)
    centres = np.array([pose.translation for pose in [*poses, true]]) @ axes.T
    around = np.concatenate([centres, scenery.outline.reshape(-1, 3) @ axes.T])
    points = scenery.points.x_in_world @ axes.T
    if len(points) and not len(scenery.outline):
        around = np.concatenate([around, np.quantile(points, [0.03, 0.97], axis=0)])
    low, high = around.min(axis=0), around.max(axis=0)
    area = np.array([size[0] - 210, size[1] - 30])
    scale = float((area / np.maximum(high - low, 1e-9)).min())

    def place(x_in_world: Array) -> Array:
        flat = (x_in_world @ axes.T - (low + high) / 2) * scale
        return np.asarray(flat * [1, -1] + [15 + area[0] / 2, size[1] / 2])

    for a, b in place(scenery.outline) if len(scenery.outline) else ():
        _line(canvas, a, b, (80, 84, 92), 1)
    for point in place(scenery.points.x_in_world[::2]):
        _dot(canvas, point, 0.8, (110, 120, 135))
    for pose in poses:
        _arrow(canvas, place, pose, FAINT, 14 / scale)
    if found is not None:
        _arrow(canvas, place, found, RED, 30 / scale)
        cv2.circle(canvas, _pixel(place(found.translation)), 9, RED, 2, cv2.LINE_AA)
    _arrow(canvas, place, true, GREEN, 22 / scale)
    for i, (text, colour) in enumerate((("references", FAINT), ("true position", GREEN), ("found position", RED))):
        _dot(canvas, np.array([size[0] - 180, 34 + 32 * i]), 5, colour)
        _write(canvas, text, (size[0] - 164, 40 + 32 * i), 0.6, INK)
    return canvas


def _ground_axes(poses: Sequence[RigidTransform]) -> Array:
    """Two level directions (2, 3), taking the cameras' mean down direction for down."""
    down = np.mean([pose.rotation[:, 1] for pose in poses], axis=0)
    down /= np.linalg.norm(down)
    start = np.eye(3)[int(np.argmin(np.abs(down)))]
    right = start - down * float(start @ down)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(right, down)])


def _arrow(
    canvas: Canvas, place: Callable[[Array], Array], pose: RigidTransform, colour: Colour, length: float
) -> None:
    start, end = place(pose.translation), place(pose.translation + length * pose.rotation[:, 2])
    _line(canvas, start, end, colour, 2)
    _dot(canvas, start, 3.5, colour)


def _label(panel: Canvas, text: str) -> None:
    panel[:36] = (panel[:36] * np.float32(0.35)).astype(np.uint8)
    _write(panel, text, (14, 25), 0.66, INK)


def _write(canvas: Canvas, text: str, origin: tuple[int, int], scale: float, colour: Colour) -> None:
    cv2.putText(canvas, text, origin, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, 1, cv2.LINE_AA)


def _pixel(place: Array) -> tuple[int, int]:
    return round(float(place[0])), round(float(place[1]))


def _line(canvas: Canvas, a: Array, b: Array, colour: Colour, width: int) -> None:
    """A line between two places with fractions of a pixel."""
    start, end = ((int(16 * p[0]), int(16 * p[1])) for p in np.clip([a, b], -4000, 4000))
    cv2.line(canvas, start, end, colour, width, cv2.LINE_AA, shift=4)


def _dot(canvas: Canvas, place: Array, radius: float, colour: Colour) -> None:
    centre = (int(16 * place[0]), int(16 * place[1]))
    cv2.circle(canvas, centre, int(16 * radius), colour, -1, cv2.LINE_AA, shift=4)
