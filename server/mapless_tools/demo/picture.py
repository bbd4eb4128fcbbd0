"""A picture that shows whether a pose is right.

Left: the photograph with its matches, and the edges of the true room at the found pose. Right: the reference that shows
most of them. Below: the numbers and a plan of the place.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mapless.geometry import Array, RigidTransform
from mapless_tools.matches import Picture, Shot, add_lines, draw_matches, rendered, show
from mapless_tools.plan import Cameras, basis_from_above, down_of, draw_plan

from .photographs import Outline, Photograph

SIZE_PX = (1600, 840)
STRIP = 240 / 840
"""Share of the height below the photographs."""

INK, DIM, FAINT, BACKGROUND = "#ebebeb", "#cdcdcd", "#969696", "#181a1e"
GREEN, RED, AMBER = "#46dc78", "#ff5046", "#ffbe3c"


@dataclass(frozen=True, eq=False)
class Posed:
    """A photograph with a pose, and points (N, 3), world, that an answer rests on, at pixels (N, 2) of the image."""

    name: str
    shot: Shot
    world_from_camera: RigidTransform
    points: Array
    keypoints: Array

    @staticmethod
    def of(photograph: Photograph, max_side_px: int) -> "Posed":
        """Decodes a photograph, which has no points yet; InvalidArgument of the server if it cannot be read."""
        shot = Shot.of(photograph.data, photograph.camera, max_side_px)
        return Posed(photograph.name, shot, photograph.world_from_camera, np.empty((0, 3)), np.empty((0, 2)))

    def project(self, x_in_world: Array) -> Array:
        """Pixels (..., 2) of points (..., 3); NaN behind the camera."""
        return self.shot.camera.project(self.world_from_camera.inverse().apply(x_in_world))


def draw(
    query: Posed,
    world_from_query: RigidTransform | None,
    nearest: Posed,
    references: Sequence[Posed],
    outline: Outline | None,
    caption: Sequence[str],
) -> Picture:
    """Draws the picture of one answer; the first line of the caption is its heading.

    Nothing is drawn on a photograph that was rejected. `nearest` is the reference that the answer rests on most; the
    plan has all.
    """
    figure = Figure((SIZE_PX[0] / 100, SIZE_PX[1] / 100), dpi=100, facecolor=BACKGROUND)
    left, right = (figure.add_axes((x, STRIP, 0.5, 1 - STRIP)) for x in (0.0, 0.5))
    lines = list(caption)
    if world_from_query is None:
        _show(left, query.shot.image, f"{query.name}: not localized")
    else:
        found = replace(query, world_from_camera=world_from_query)
        _show(left, (query.shot.image * 0.72).astype(np.uint8), f"{query.name}: drawn with the found pose")
        if outline is not None:
            add_lines(left, found.project(outline.visible_edges[query.name]), color=AMBER, linewidth=2.2)
        lines.append(_draw_points(left, found))
    _show(right, (nearest.shot.image * 0.72).astype(np.uint8), f"{nearest.name}: the reference that agrees most")
    _draw_points(right, nearest)
    plan = figure.add_axes((0.6, 0.01, 0.28, STRIP - 0.02))
    _draw_plan(plan, query, world_from_query, references, None if outline is None else outline.edges)
    figure.legend(*plan.get_legend_handles_labels(), loc=(0.885, 0.1), frameon=False, labelcolor=INK, fontsize=10)
    for i, line in enumerate(lines):
        y = STRIP - (0.06 + 0.042 * i)
        figure.text(0.015, y, line, parse_math=False, color=DIM if i else INK, fontsize=11.5 if i else 17)
    return rendered(figure)


def contact_sheet(pictures: Sequence[Picture]) -> Picture:
    """Pictures of one size, two in a row, each at half its size."""
    small = [np.asarray(cv2.resize(p, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8) for p in pictures]
    small += [np.zeros_like(small[0])] * (len(small) % 2)
    rows = [np.concatenate(small[i : i + 2], axis=1) for i in range(0, len(small), 2)]
    return np.concatenate(rows)


def png(picture: Picture) -> bytes:
    """The bytes of a PNG file of a picture."""
    return bytes(cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]))[1])


def _show(axes: Axes, image: Picture, title: str) -> None:
    show(axes, image)
    label = {"facecolor": "black", "alpha": 0.6, "edgecolor": "none"}
    text = axes.text(0.012, 0.985, title, transform=axes.transAxes, va="top", color=INK, fontsize=11, bbox=label)
    text.set_parse_math(False)  # a name may have a $


def _draw_points(axes: Axes, posed: Posed) -> str:
    """Draws the points at their keypoints, near red, far blue; returns a text on how well they fit."""
    if not len(posed.points):
        return "no points were matched"
    projected = posed.project(posed.points)
    depth = posed.world_from_camera.inverse().apply(posed.points)[:, 2]
    factor = draw_matches(axes, posed.keypoints, projected, np.ones(len(depth), bool), depth)
    middle = float(np.median(np.linalg.norm(posed.keypoints - projected, axis=-1)))
    return (
        f"{len(depth)} matched points, {middle:.2f} px (median) from where the pose puts them; "
        f"magenta: that offset x {factor}"
    )


def _draw_plan(
    axes: Axes, query: Posed, found: RigidTransform | None, references: Sequence[Posed], edges: Array | None
) -> None:
    """Draws the place from above: matched points, edges, references, the true position and the found one."""
    camera = query.shot.camera
    groups = [
        Cameras("references", FAINT, [(it.world_from_camera, it.shot.camera) for it in references]),
        Cameras("found position", RED, [] if found is None else [(found, camera)], 2.2),
        Cameras("true position", GREEN, [(query.world_from_camera, camera)], 1.6),
    ]
    basis = basis_from_above(down_of(None, [it.world_from_camera for it in references]))
    draw_plan(axes, basis, groups, query.points, edges)
    axes.set_axis_off()
