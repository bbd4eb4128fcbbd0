"""A place from above: cameras, points, edges, and the ellipse of a position."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse
from numpy.typing import ArrayLike

from mapless import Scene
from mapless.geometry import Array, Camera, RigidTransform

from .matches import add_lines

CHI2_95_IN_PLANE = -2 * math.log(0.05)
"""Squared radius of a 95 % ellipse in two dimensions, in standard deviations."""
REFERENCE, OTHER, FOUND = "#4a7fd6", "#97999c", "#e0561f"
"""Colours of references, of others that matter less, and of the photograph's pose."""
_ALIKE = 0.7
"""Least length of the mean of the cameras' y axes for which it is used as the direction of gravity."""
_WEDGE_SHARE = 0.05
"""Length of a camera's wedge, relative to the extent of the plan."""
_ALONG = 1e-3
"""A direction is that of a world axis if its other parts are smaller: positions differ by 1 mm in 1 m at most."""
_LEVEL = 0.25
"""A camera whose optical axis has a shorter horizontal part looks up or down."""


@dataclass(frozen=True, eq=False)
class Cameras:
    """Cameras that are drawn alike, as wedges of their horizontal field of view."""

    label: str
    colour: str
    cameras: Sequence[tuple[RigidTransform, Camera]]
    size: float = 1.0


def down_of(scene: Scene | None, poses: Sequence[RigidTransform]) -> Array:
    """The direction of gravity (3,) of the scene or its datum; without, as the cameras (at least one) suggest."""
    return vertical_of(scene, poses)[0]


def vertical_of(scene: Scene | None, poses: Sequence[RigidTransform]) -> tuple[Array, str]:
    """The direction of gravity (3,), world, and how it is known, in words.

    It is that of the scene or its datum, else the mean of the y axes of cameras (at least one) or, if these disagree,
    the normal of the plane of their centres.
    """
    if scene is not None and scene.down_in_world is not None:
        return np.asarray(scene.down_in_world, float), "along the scene's direction of gravity"
    if scene is not None and scene.datum is not None:
        return np.asarray(-scene.datum.enu_from_world.matrix()[2]), "along the vertical of the scene's datum"
    mean = np.mean([it.rotation[:, 1] for it in poses], axis=0)
    length = float(np.linalg.norm(mean))
    if length > _ALIKE:
        return np.asarray(mean / length), "along the mean vertical of the cameras, since the scene has no gravity"
    centres = np.stack([it.translation for it in poses])
    normal = np.linalg.svd(centres - centres.mean(axis=0))[2][-1]
    known = "along the direction in which references are spread least, since the scene has no gravity"
    return np.asarray(normal if normal @ mean >= 0 else -normal), known


def basis_from_above(down_in_world: ArrayLike) -> Array:
    """World directions (2, 3) to the right and up on the page, along horizontal world axes if there are any."""
    down = np.asarray(down_in_world, float)
    up = -down / np.linalg.norm(down)
    flat = np.eye(3) - np.outer(up, up)
    first = flat[int(np.argmax(np.linalg.norm(flat, axis=1) > 0.9))]
    right = first / np.linalg.norm(first)
    return np.stack([right, np.cross(up, right)])


def draw_plan(
    axes: Axes, basis: Array, groups: Sequence[Cameras], points: Array, edges: Array | None = None, unit: str = "m"
) -> None:
    """Draws cameras, points (N, 3) and edges (E, 2, 3) of the world, as seen along the normal of the basis (2, 3).

    The axes show all cameras and edges, and the points without outliers; there must be a camera.
    """
    poses = [pose for group in groups for pose, _ in group.cameras]
    around = np.stack([pose.translation for pose in poses]) @ basis.T
    flat = points @ basis.T
    if edges is not None:
        add_lines(axes, edges @ basis.T, color="#50545c", linewidth=0.8)
        around = np.concatenate([around, edges.reshape(-1, 3) @ basis.T])
    elif len(flat):
        around = np.concatenate([around, np.quantile(flat, (0.04, 0.96), axis=0)])
    low, high = around.min(axis=0), around.max(axis=0)
    extent = max(float((high - low).max()), 1e-3)
    axes.scatter(flat[:, 0], flat[:, 1], color=OTHER, s=1.5, linewidths=0, alpha=0.7)
    for group in groups:
        for index, (pose, camera) in enumerate(group.cameras):
            label = "_" if index else group.label
            outline = _wedge(basis, pose, camera, group.size * _WEDGE_SHARE * extent)
            (wedge,) = axes.fill(*outline.T, label=label, linestyle="-", linewidth=1.2)
            wedge.set(facecolor=(group.colour, 0.3), edgecolor=group.colour)
    margin = 1.5 * _WEDGE_SHARE * extent
    axes.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin))
    axes.set_aspect("equal", adjustable="box")
    axes.set(xlabel=axis_label(basis[0], unit), ylabel=axis_label(basis[1], unit))


def _wedge(basis: Array, pose: RigidTransform, camera: Camera, length: float) -> Array:
    """Corners (C, 2) of a camera's field of view; of a ring if it looks straight up or down."""
    centre, ahead = basis @ pose.translation, heading_of(basis, pose.rotation[:, 2])
    if ahead is None:
        turns = np.linspace(0, 2 * np.pi, 17)
        return np.asarray(centre + 0.3 * length * np.stack([np.cos(turns), np.sin(turns)], axis=1))
    half = math.atan2(camera.width_px / 2, camera.focal_x_px)
    turns = math.atan2(ahead[1], ahead[0]) + np.array([half, -half])
    return np.concatenate([centre[None], centre + length * np.stack([np.cos(turns), np.sin(turns)], axis=1)])


def heading_of(basis: Array, forward: ArrayLike) -> Array | None:
    """The direction (2,) on the page of a viewing direction (3,), unit length; None if it looks up or down."""
    ahead = basis @ np.asarray(forward, float)
    length = float(np.linalg.norm(ahead))
    return None if length < _LEVEL else np.asarray(ahead / length)


def axis_label(direction: Array, unit: str) -> str:
    """The name of the world axis along a direction, and the unit; where none is, numbers are of the plan alone."""
    largest = int(np.argmax(np.abs(direction)))
    sign = "-" if direction[largest] < 0 else ""
    is_along = float(np.linalg.norm(np.delete(direction, largest))) < _ALONG
    return f"{sign}{'xyz'[largest]}, {unit}" if is_along else f"along the plan, {unit}"


def ellipse_in_plane(basis: Array, covariance: Array) -> tuple[Array, float]:
    """Radii (2,) of the 95 % ellipse of the position seen from above, metres, and its rotation, radians."""
    flat = basis @ covariance[:3, :3] @ basis.T
    values, vectors = np.linalg.eigh(flat)
    radii = np.sqrt(np.maximum(values[::-1], 0.0) * CHI2_95_IN_PLANE)
    return radii, math.atan2(vectors[1, 1], vectors[0, 1])


def draw_ellipse(axes: Axes, basis: Array, covariance: Array, unit: str = "m") -> None:
    """Draws the 95 % ellipse of a position around zero, in the plane of `draw_plan`; the covariance is finite."""
    (long, short), turn = ellipse_in_plane(basis, covariance)
    scale, name = (1.0, unit) if unit != "m" or long >= 1 else (100.0, "cm") if long >= 0.01 else (1000.0, "mm")
    long, short = max(scale * long, 1e-9), scale * short
    axes.add_patch(
        Ellipse((0, 0), 2 * long, 2 * short, angle=math.degrees(turn), facecolor=(FOUND, 0.2), edgecolor=FOUND)
    )
    axes.plot(0, 0, marker="+", color=FOUND, linestyle="none")
    axes.set(xlim=(-1.3 * long, 1.3 * long), ylim=(-1.3 * long, 1.3 * long))
    axes.set_aspect("equal", adjustable="box")
    axes.set(xlabel=axis_label(basis[0], name), ylabel=axis_label(basis[1], name))
