"""A picture that shows whether a pose is right.

Left: the photograph with the matched points of the references projected by the found pose. Right: the reference that
shows most of them. Below: the numbers and a plan of the place.
"""

import io
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, RigidTransform, resized_pixel

from .photographs import Outline, Photograph

Canvas = NDArray[np.uint8]

SIZE_PX = (1600, 840)
STRIP = 240 / 840
"""Share of the height below the photographs."""
MAGNIFICATION = 10

INK, DIM, FAINT, BACKGROUND = "#ebebeb", "#cdcdcd", "#969696", "#181a1e"
GREEN, RED, AMBER = "#46dc78", "#ff5046", "#ffbe3c"


@dataclass(frozen=True, eq=False)
class Shot:
    """A decoded photograph (H, W, 3) uint8 RGB with its pose, its camera in the image's pixels, and matched points.

    The points (N, 3), world, are those that the answer rests on, at the keypoints (N, 2) of `image`.
    """

    name: str
    image: Canvas
    camera: Camera
    world_from_camera: RigidTransform
    points: Array = field(default_factory=lambda: np.empty((0, 3)))
    keypoints: Array = field(default_factory=lambda: np.empty((0, 2)))

    @staticmethod
    def of(photograph: Photograph, max_side_px: int) -> "Shot":
        """Decodes a photograph, reduced if it is large, without EXIF orientation; ValueError if it cannot be read."""
        flags = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION
        image = cv2.imdecode(np.frombuffer(photograph.data, np.uint8), flags)
        if image is None:
            raise ValueError(f"{photograph.name} is not an image that can be read")
        scale = min(1.0, max_side_px / max(image.shape[:2]))
        size = (round(image.shape[1] * scale), round(image.shape[0] * scale))
        drawn = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
        return Shot(photograph.name, drawn, photograph.camera.resized(*size), photograph.world_from_camera)

    def with_points(self, points: Array, pixels: Array, camera: Camera) -> "Shot":
        """The same with points (N, 3), world, at pixels (N, 2) of the photograph as `camera` has it."""
        scale = self.camera.width_px / camera.width_px, self.camera.height_px / camera.height_px
        keypoints = np.stack([resized_pixel(pixels[:, i], scale[i]) for i in (0, 1)], axis=-1)
        return replace(self, points=points, keypoints=keypoints)

    def project(self, x_in_world: Array) -> Array:
        """Pixels (N, 2) of points (N, 3); NaN behind the camera."""
        return self.camera.project(self.world_from_camera.inverse().apply(x_in_world))


def draw(
    query: Shot,
    world_from_query: RigidTransform | None,
    nearest: Shot,
    references: Sequence[Shot],
    outline: Outline | None,
    caption: Sequence[str],
) -> Canvas:
    """Draws the picture (H, W, 3) uint8 RGB of one answer; the first line of the caption is its heading.

    Nothing is drawn on a photograph that was rejected. `nearest` is the reference that the answer rests on most; the
    plan has all.
    """
    figure = Figure((SIZE_PX[0] / 100, SIZE_PX[1] / 100), dpi=100, facecolor=BACKGROUND)
    left, right = (figure.add_axes((x, STRIP, 0.5, 1 - STRIP)) for x in (0.0, 0.5))
    lines = list(caption)
    if world_from_query is None:
        _show(left, query.image, f"{query.name}: not localized")
    else:
        found = replace(query, world_from_camera=world_from_query)
        _show(left, (query.image * 0.72).astype(np.uint8), f"{query.name}: drawn with the found pose")
        if outline is not None:
            _add_lines(left, found.project(outline.visible_edges[query.name]), color=AMBER, linewidth=2.2)
        lines.append(_add_points(left, found))
    _show(right, (nearest.image * 0.72).astype(np.uint8), f"{nearest.name}: the reference that agrees most")
    _add_points(right, nearest)
    plan = figure.add_axes((0.6, 0.01, 0.28, STRIP - 0.02))
    edges = np.empty((0, 2, 3)) if outline is None else outline.edges
    _draw_plan(plan, query, world_from_query, references, edges)
    figure.legend(*plan.get_legend_handles_labels(), loc=(0.885, 0.1), frameon=False, labelcolor=INK, fontsize=10)
    for i, line in enumerate(lines):
        y = STRIP - (0.06 + 0.042 * i)
        figure.text(0.015, y, line, color=DIM if i else INK, fontsize=11.5 if i else 17)
    pixels = io.BytesIO()
    figure.savefig(pixels, format="rgba", dpi=100)
    return np.frombuffer(pixels.getvalue(), np.uint8).reshape(SIZE_PX[1], SIZE_PX[0], 4)[..., :3]


def contact_sheet(pictures: Sequence[Canvas]) -> Canvas:
    """Pictures of one size, two in a row, each at half its size."""
    small = [np.asarray(cv2.resize(p, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8) for p in pictures]
    small += [np.zeros_like(small[0])] * (len(small) % 2)
    rows = [np.concatenate(small[i : i + 2], axis=1) for i in range(0, len(small), 2)]
    return np.concatenate(rows)


def png(picture: Canvas) -> bytes:
    """The bytes of a PNG file of a picture."""
    return bytes(cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]))[1])


def _show(axes: Axes, image: Canvas, title: str) -> None:
    """Shows the image in its own pixels, with limits that further drawing does not change."""
    axes.imshow(image, interpolation="antialiased")
    axes.autoscale(False)
    axes.set_axis_off()
    label = {"facecolor": "black", "alpha": 0.6, "edgecolor": "none"}
    axes.text(0.012, 0.985, title, transform=axes.transAxes, va="top", color=INK, fontsize=11, bbox=label)


def _add_lines(axes: Axes, ends: Array, **style: Any) -> None:
    """Draws segments (S, 2, 2), without those that have an end behind the camera."""
    axes.add_collection(LineCollection(list(ends[np.isfinite(ends).all(axis=(1, 2))]), **style))


def _add_points(axes: Axes, shot: Shot) -> str:
    """Draws the points projected by the shot's pose, near red, far blue; returns a text on how well they fit."""
    if not len(shot.points):
        return "no points were matched"
    pixels = shot.project(shot.points)
    depth = shot.world_from_camera.inverse().apply(shot.points)[:, 2]
    rank = np.argsort(np.argsort(-depth))  # not the depth itself: every step of it shall be seen
    x, y = pixels.T
    axes.scatter(x, y, c=rank, cmap="turbo", vmin=-0.18 * len(x), vmax=1.05 * len(x), s=20, linewidths=0)
    offsets = shot.keypoints - pixels
    _add_lines(axes, np.stack([pixels, pixels + MAGNIFICATION * offsets], axis=1), color="white", linewidth=0.8)
    middle = float(np.median(np.linalg.norm(offsets, axis=-1)))
    return (
        f"{len(offsets)} matched points, {middle:.2f} px (median) from where the pose puts them; "
        f"white: that offset x {MAGNIFICATION}"
    )


def _draw_plan(axes: Axes, query: Shot, found: RigidTransform | None, references: Sequence[Shot], edges: Array) -> None:
    """Draws the place from above: matched points, edges, references, the true position and the found one."""
    poses, true = [reference.world_from_camera for reference in references], query.world_from_camera
    ground = _ground_axes(poses)
    points = query.points @ ground.T
    _add_lines(axes, edges @ ground.T, color="#50545c", linewidth=0.8)
    axes.scatter(points[:, 0], points[:, 1], color="#6e7887", s=0.4)
    around = np.concatenate([edges.reshape(-1, 3), [pose.translation for pose in [*poses, true]]]) @ ground.T
    if len(points) and not len(edges):
        around = np.concatenate([around, np.quantile(points, [0.03, 0.97], axis=0)])
    low, high = around.min(axis=0), around.max(axis=0)
    length = 0.07 * float((high - low).max())
    found_poses = [] if found is None else [found]
    for label, group, colour, scale in (
        ("references", poses, FAINT, 1.0),
        ("found position", found_poses, RED, 2.2),
        ("true position", [true], GREEN, 1.6),
    ):
        if group:
            centres = np.array([pose.translation for pose in group]) @ ground.T
            ahead = centres + scale * length * np.array([pose.rotation[:, 2] for pose in group]) @ ground.T
            _add_lines(axes, np.stack([centres, ahead], axis=1), color=colour, linewidth=1.6)
            size, fill = (90, "none") if label == "found position" else (14, colour)
            axes.scatter(centres[:, 0], centres[:, 1], s=size, edgecolors=colour, color=fill, label=label)
    margin = 0.04 * (high - low).max()
    axes.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin), aspect="equal")
    axes.set_axis_off()


def _ground_axes(poses: Sequence[RigidTransform]) -> Array:
    """Two horizontal directions (2, 3); the mean of the cameras' y axes is taken as down."""
    down = np.mean([pose.rotation[:, 1] for pose in poses], axis=0)
    down /= np.linalg.norm(down)
    start = np.eye(3)[int(np.argmin(np.abs(down)))]
    right = start - down * float(start @ down)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(right, down)])
