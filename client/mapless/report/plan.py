"""The scene from above: references, matched points, and the photograph's pose with its ellipse."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..geometry import Array, Camera, RigidTransform
from ..results import Reference
from .markup import length, number, reference_id, text

WIDTH, HEIGHT = 760.0, 520.0
_MARGIN = 46.0
_WEDGE = 26.0
"""Length of a camera's wedge."""
CHI2_95_IN_PLANE = -2 * math.log(0.05)
"""Squared radius of a 95 % ellipse in two dimensions, in standard deviations."""
_SMALL_RADIUS = 9.0
"""A smaller ellipse is drawn enlarged in an inset."""
_INSET = 132.0
_ALIKE = 0.7
"""Least length of the mean of the cameras' y axes for which it is used as the direction of gravity."""


@dataclass(frozen=True, eq=False)
class Plan:
    """A view along the vertical.

    The basis (2, 3) is the world directions to the right and up on the page, `low` (2,) the coordinates of its lower
    left corner along these, metres; the scale is units of the page per metre. `is_guessed` says whether the direction
    of gravity was estimated from the cameras.
    """

    basis: Array
    low: Array
    scale: float
    is_guessed: bool

    def place(self, x_in_world: ArrayLike) -> Array:
        """Points (..., 3) on the page, (..., 2), y downwards."""
        flat = (np.asarray(x_in_world, float) @ self.basis.T - self.low) * self.scale
        return np.stack([_MARGIN + flat[..., 0], HEIGHT - _MARGIN - flat[..., 1]], axis=-1)


def plan_view(
    references: Mapping[str, Reference],
    used: Sequence[str],
    poses: Sequence[tuple[str, RigidTransform]],
    camera: Camera,
    covariance: Array | None,
    points: Array,
    down_in_world: ArrayLike | None,
) -> str:
    """Draws references, the used ones among them, and poses of the photograph; empty without poses.

    There are several poses, with names, if they contradict each other. The covariance and the points (N, 3), which are
    its inliers, are of the first one.
    """
    cameras = [it.world_from_camera for it in references.values()] + [pose for _, pose in poses]
    if not cameras:
        return ""
    plan = _fit(cameras, points, down_in_world)
    drawn = [_points(plan, points)]
    order = sorted(references, key=lambda name: name in used)
    for name in order:
        it = references[name]
        kind = "used" if name in used else "unused"
        drawn.append(_wedge(plan, it.world_from_camera, it.camera, kind, reference_id(name)))
    for number_of_pose, (name, pose) in enumerate(poses):
        drawn.append(_wedge(plan, pose, camera, "pose" if number_of_pose == 0 else "pose other", name, 1.35))
        if len(poses) > 1:
            x, y = plan.place(pose.translation).tolist()
            drawn.append(f'<text class="name" x="{number(x + 8)}" y="{number(y - 8)}">{text(name)}</text>')
    if covariance is not None and len(poses) == 1:
        drawn.append(_ellipse(plan, poses[0][1], covariance))
    drawn.append(_scale_bar(plan))
    drawn.append(_axes(plan))
    how = " (The direction of gravity is estimated from the cameras.)" if plan.is_guessed else ""
    return (
        f'<figure class="plan"><svg viewBox="0 0 {WIDTH:g} {HEIGHT:g}" role="img" aria-label="The scene from above">'
        f"{''.join(drawn)}</svg><figcaption>From above. {_legend(references, used, poses)}{how}</figcaption></figure>"
    )


def _legend(
    references: Mapping[str, Reference], used: Sequence[str], poses: Sequence[tuple[str, RigidTransform]]
) -> str:
    parts = []
    if any(name in references for name in used):
        parts.append('<span class="key used">references compared</span>')
    if any(name not in used for name in references):
        parts.append('<span class="key unused">other references</span>')
    if poses:
        parts.append('<span class="key pose">the photograph</span>')
    return " ".join(parts)


def _fit(cameras: Sequence[RigidTransform], points: Array, down_in_world: ArrayLike | None) -> Plan:
    """A plan that shows all cameras, and the points without outliers."""
    is_guessed = down_in_world is None
    basis = _basis(_guess_down(cameras) if down_in_world is None else np.asarray(down_in_world, float))
    flat = np.stack([it.translation for it in cameras]) @ basis.T
    if len(points):
        flat = np.concatenate([flat, np.quantile(points @ basis.T, (0.04, 0.96), axis=0)])
    low, high = flat.min(axis=0), flat.max(axis=0)
    extent = np.maximum(high - low, 0.05 * max(float((high - low).max()), 1e-3))
    scale = float(min((WIDTH - 2 * _MARGIN) / extent[0], (HEIGHT - 2 * _MARGIN) / extent[1]))
    room = np.array([WIDTH - 2 * _MARGIN, HEIGHT - 2 * _MARGIN]) / scale
    return Plan(basis, (low + high - room) / 2, scale, is_guessed)


def _guess_down(cameras: Sequence[RigidTransform]) -> Array:
    """The mean of the cameras' y axes; if they disagree, the normal of the plane of their centres."""
    mean = np.mean([it.rotation[:, 1] for it in cameras], axis=0)
    if np.linalg.norm(mean) > _ALIKE:
        return np.asarray(mean)
    centres = np.stack([it.translation for it in cameras])
    return np.asarray(np.linalg.svd(centres - centres.mean(axis=0))[2][-1])


def _basis(down: Array) -> Array:
    """Directions to the right and up on the page, seen from above, along horizontal world axes if there are any."""
    up = -down / np.linalg.norm(down)
    flat = np.eye(3) - np.outer(up, up)
    first = flat[int(np.argmax(np.linalg.norm(flat, axis=1) > 0.9))]
    right = first / np.linalg.norm(first)
    return np.stack([right, np.cross(up, right)])


def _wedge(plan: Plan, pose: RigidTransform, camera: Camera, kind: str, name: str, size: float = 1.0) -> str:
    """A camera: its centre and horizontal field of view; a ring if it looks straight up or down."""
    x, y = plan.place(pose.translation).tolist()
    title = f"<title>{text(name)}</title>"
    ahead = plan.basis @ pose.rotation[:, 2]
    if np.linalg.norm(ahead) < 0.25:
        return f'<circle class="{kind}" cx="{number(x)}" cy="{number(y)}" r="{number(6 * size)}">{title}</circle>'
    half = math.atan2(camera.width_px / 2, camera.focal_x_px)
    middle = math.atan2(ahead[1], ahead[0])
    corners = [
        (x + size * _WEDGE * math.cos(middle + turn), y - size * _WEDGE * math.sin(middle + turn))
        for turn in (half, -half)
    ]
    path = f"M{number(x)} {number(y)}" + "".join(f"L{number(u)} {number(v)}" for u, v in corners)
    return f'<path class="{kind}" d="{path}Z">{title}</path>'


def _points(plan: Plan, points: Array) -> str:
    if not len(points):
        return ""
    placed = plan.place(points)
    inside = ((placed > 4) & (placed < np.array([WIDTH, HEIGHT]) - 4)).all(axis=1)
    return f'<path class="points" d="{"".join(f"M{number(x)} {number(y)}h0" for x, y in placed[inside].tolist())}"/>'


def ellipse_in_plane(basis: Array, covariance: Array) -> tuple[Array, float]:
    """Radii (2,) of the 95 % ellipse of the position seen from above, metres, and its rotation, radians."""
    flat = basis @ covariance[:3, :3] @ basis.T
    values, vectors = np.linalg.eigh(flat)
    radii = np.sqrt(np.maximum(values[::-1], 0.0) * CHI2_95_IN_PLANE)
    return radii, math.atan2(vectors[1, 1], vectors[0, 1])


def _ellipse(plan: Plan, pose: RigidTransform, covariance: Array) -> str:
    """The 95 % ellipse of the position, enlarged in an inset if it is too small."""
    radii, turn = ellipse_in_plane(plan.basis, covariance)
    if not np.isfinite(radii).all():
        return ""
    x, y = plan.place(pose.translation).tolist()
    largest = float(radii[0]) * plan.scale
    if largest >= _SMALL_RADIUS:
        return _oval(x, y, radii * plan.scale, turn)
    left = x < WIDTH / 2  # the inset goes to the other side
    cx, cy = (WIDTH - _INSET / 2 - 8 if left else _INSET / 2 + 8), _INSET / 2 + 8
    bar_m = _round_length(float(radii[0]) * 1.1)
    scale = 0.32 * _INSET / max(float(radii[0]), 1e-9)
    reach = _INSET / 2
    bar = f"M{number(cx - bar_m * scale / 2)} {number(cy + 42)}h{number(bar_m * scale)}"
    towards = math.atan2(y - cy, x - cx)
    lead = f"M{number(cx + reach * math.cos(towards))} {number(cy + reach * math.sin(towards))}L{number(x)} {number(y)}"
    return (
        f'<path class="lead" d="{lead}"/><circle class="lens" cx="{number(cx)}" cy="{number(cy)}" r="{number(reach)}"/>'
        + _oval(cx, cy, radii * scale, turn)
        + f'<circle class="centre" cx="{number(cx)}" cy="{number(cy)}" r="2.2"/><path class="bar" d="{bar}"/>'
        f'<text x="{number(cx)}" y="{number(cy + 55)}" text-anchor="middle">{length(bar_m)}</text>'
        f'<text x="{number(cx)}" y="{number(cy - 46)}" text-anchor="middle">95 %</text>'
    )


def _oval(x: float, y: float, radii: Iterable[float], turn: float) -> str:
    a, b = radii
    return (
        f'<ellipse class="ellipse" rx="{number(max(a, 0.6))}" ry="{number(max(b, 0.6))}" '
        f'transform="translate({number(x)} {number(y)}) rotate({number(-math.degrees(turn))})"/>'
    )


def _round_length(metres: float) -> float:
    """The largest of 1, 2, 5, 10, ... that does not exceed a length."""
    power = 10.0 ** math.floor(math.log10(max(metres, 1e-9)))
    return float(max(step * power for step in (1, 2, 5) if step * power <= metres * 1.000001))


def _scale_bar(plan: Plan) -> str:
    metres = _round_length(0.28 * (WIDTH - 2 * _MARGIN) / plan.scale)
    y = HEIGHT - 16
    return (
        f'<path class="bar" d="M{_MARGIN:g} {y:g}h{number(metres * plan.scale)}m0 -4v8M{_MARGIN:g} {y - 4:g}v8"/>'
        f'<text x="{number(_MARGIN + metres * plan.scale + 8)}" y="{y + 4:g}">{length(metres)}</text>'
    )


def _axes(plan: Plan) -> str:
    """World axes that are not nearly vertical."""
    x, y = WIDTH - 60, HEIGHT - 60
    parts = []
    for name, axis in zip("xyz", plan.basis.T, strict=True):
        if np.linalg.norm(axis) > 0.35:
            u, v = x + 26 * axis[0], y - 26 * axis[1]
            parts.append(f'<path class="bar" d="M{x:g} {y:g}L{number(u)} {number(v)}"/>')
            a, b = number(x + 36 * axis[0]), number(y - 36 * axis[1] + 4)
            parts.append(f'<text x="{a}" y="{b}" text-anchor="middle">{name}</text>')
    return "".join(parts)
