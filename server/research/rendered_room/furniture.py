"""Furniture of the room, 5 x 4 x 2.6 m: placed by hand, painted by chance; and the light on it.

World axes: x along the long walls, y across, z up, metres; the origin is a corner of the floor. The window is in the
wall x = 0, the bookshelf stands at x = 5, the door is in the wall y = 0, the cupboard stands at y = 4.
"""

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapless.geometry import Array

from . import textures as tx
from .textures import Image, Random, Texture

ROOM_M = np.array([5.0, 4.0, 2.6])
LOWEST_CAMERA_M = 0.85
"""Furniture that stands lower has no bottom."""
FACES = {
    "front": ((0, 0, 1), (1, 0, 0), (0, 0, -1)),
    "right": ((1, 0, 1), (0, 1, 0), (0, 0, -1)),
    "back": ((1, 1, 1), (-1, 0, 0), (0, 0, -1)),
    "left": ((0, 1, 1), (0, -1, 0), (0, 0, -1)),
    "top": ((0, 1, 1), (1, 0, 0), (0, -1, 0)),
    "bottom": ((0, 0, 0), (1, 0, 0), (0, 1, 0)),
}
"""Where the texture of a box's face begins, and its rows and columns, as shares of the box; the front looks to -y."""
LAMPS = (
    *(((-0.05, y, z), (0.72, 0.75, 0.81), True) for y, z in ((1.3, 1.1), (1.3, 2.0), (2.6, 1.1), (2.6, 2.0))),
    ((2.45, 2.0, 2.0), (0.6, 0.52, 0.4), False),
)
"""Places, RGB power at 1 m, and whether it shines along x only: four parts of the window, and the ceiling lamp."""


@dataclass(frozen=True, eq=False)
class Quad:
    """A rectangle with a texture, visible from its front only: x(u, v) = corner + u across + v down, world, metres.

    The texture is linear light that leaves it once the room is lit; each of `levels` is half of the one before.
    """

    corner: Array
    across: Array
    down: Array
    levels: list[Image]

    def normal(self) -> Array:
        """(3,) unit length, to the front."""
        n = np.cross(self.down, self.across)
        return np.asarray(n / np.linalg.norm(n), float)

    def grid(self) -> Array:
        """Points (rows, columns, 3) on the rectangle, cell centres, 11 cm apart, at which light is computed."""
        columns, lines = (int(np.clip(np.linalg.norm(edge) / 0.11, 2, 48).round()) for edge in (self.across, self.down))
        u, v = (np.arange(columns) + 0.5) / columns, (np.arange(lines) + 0.5) / lines
        return np.asarray(self.corner + v[:, None, None] * self.down + u[None, :, None] * self.across)


@dataclass(frozen=True, eq=False)
class Box:
    """An upright solid: its middle (3,) world and size (3,), metres, and its axes (3, 3) in the world as columns."""

    centre: Array
    size: Array
    world_from_box: Array

    def edges(self) -> list[Array]:
        """Twelve (2, 3), world: corners whose signs differ once."""
        signs = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
        corners = self.centre + (signs * self.size) @ self.world_from_box.T
        return [corners[[i, i | bit]] for i in range(8) for bit in (1, 2, 4) if not i & bit]

    def gap_m(self, points: Array) -> Array:
        """Distances (N,) of points (N, 3) from it; 0 inside."""
        local = np.abs((points - self.centre) @ self.world_from_box) - self.size / 2
        return np.asarray(np.linalg.norm(np.maximum(local, 0), axis=-1))

    def hides(self, points: Array, way: Array) -> NDArray[np.bool_]:
        """Whether it is between points (N, 3) and what lies beyond `way` (N, 3) from them; by slabs."""
        start, step = (points - self.centre) @ self.world_from_box, way @ self.world_from_box
        step = np.where(np.abs(step) < 1e-6, 1e-6, step)
        ends = np.stack([(-self.size / 2 - start) / step, (self.size / 2 - start) / step])
        enter, leave = ends.min(axis=0).max(axis=-1), ends.max(axis=0).min(axis=-1)
        return np.asarray((enter < leave) & (leave > 1e-3) & (enter < 0.98))


@dataclass(eq=False)
class Room:
    """All rectangles; all solids, for light and to keep cameras out; and the edges (2, 3) worth drawing."""

    random: Random
    quads: list[Quad] = field(default_factory=list)
    boxes: list[Box] = field(default_factory=list)
    outline: list[Array] = field(default_factory=list)

    def panel(
        self, corner: ArrayLike, across: ArrayLike, down: ArrayLike, texture: Texture, texels_per_m: float = 420
    ) -> None:
        """Put a single rectangle."""
        corner, across, down = (np.asarray(a, float) for a in (corner, across, down))
        h, w = (int(np.clip(np.linalg.norm(edge) * texels_per_m, 16, 2400)) for edge in (down, across))
        self.quads.append(Quad(corner, across, down, [texture(self.random, (h, w))]))

    def box(
        self,
        low: ArrayLike,
        size: ArrayLike,
        texture: Texture,
        *,
        faces: Mapping[str, Texture] | None = None,
        yaw_deg: float = 0.0,
        about: ArrayLike | None = None,
    ) -> None:
        """Put an upright box with its low corner (3,) at `low`, then turned about `about` (x, y) or its own middle."""
        low, size = np.asarray(low, float), np.asarray(size, float)
        c, s = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        pivot = low + size / 2 if about is None else np.append(np.asarray(about, float), 0.0)
        for face, (corner, columns, lines) in FACES.items():
            if face != "bottom" or low[2] >= LOWEST_CAMERA_M:
                start = pivot + turn @ (low + size * corner - pivot)
                across, down = turn @ (size * columns), turn @ (size * lines)
                self.panel(start, across, down, (faces or {}).get(face, texture), 650)
        self.boxes.append(Box(pivot + turn @ (low + size / 2 - pivot), size, turn))
        if np.sort(size)[1] > 0.12:  # neither a leg nor a frame
            self.outline += self.boxes[-1].edges()


def lit_room(seed: int, *added: Callable[[Room], None]) -> Room:
    """The furnished room, whose textures are the light that leaves them, with what is added to it last."""
    room = furnished(Room(np.random.default_rng([seed, 0])), *added)
    for quad in room.quads:
        light_up(quad, room.boxes)
    return room


def furnished(room: Room, *added: Callable[[Room], None]) -> Room:
    """The room with all that stands in it, and what is added to it last; its textures are colours without light."""
    for part in (shell, table, bookshelf, sideboard, corners, wall_pictures, *added):
        part(room)
    return room


def light_up(quad: Quad, boxes: list[Box]) -> None:
    """Makes the texture of a rectangle the light that leaves it, with its coarser levels."""
    light = np.asarray(cv2.pow(quad.levels[0], 2.2))
    if quad.corner[0] > -1:  # the sky outside has light of its own
        light *= np.asarray(cv2.resize(_irradiance(quad, boxes), light.shape[1::-1]), np.float32)
    quad.levels[:] = [light.clip(0, 1)]
    while max(quad.levels[-1].shape[:2]) > 4:
        h, w = quad.levels[-1].shape[:2]
        half = cv2.resize(quad.levels[-1], ((w + 1) // 2, (h + 1) // 2), interpolation=cv2.INTER_AREA)
        quad.levels.append(np.asarray(half, np.float32))


def _irradiance(quad: Quad, boxes: list[Box]) -> Image:
    """Light (rows, columns, 3) at the rectangle's grid: of the sky, less near walls and solids, and of lamps."""
    grid, normal = quad.grid(), quad.normal()
    points = grid.reshape(-1, 3) + 0.01 * normal
    sky = np.full(len(points), 0.8 + 0.2 * normal[2])
    for axis, wall in itertools.product(np.flatnonzero(np.abs(normal) < 0.5), (0, 1)):
        sky *= 1 - 0.3 * np.exp(-np.abs(points[:, axis] - wall * ROOM_M[axis]) / 0.25)
    for box in boxes:
        gap_m = box.gap_m(points + 0.07 * normal)
        sky *= np.where(gap_m < 0.069, 1 - 0.45 * np.exp(-gap_m / 0.07), 1)  # not by the solid that it belongs to
    light = np.array([0.30, 0.31, 0.33]) * sky[:, None]
    for place, power, is_window in LAMPS:
        way = np.array(place) - points
        distance = np.linalg.norm(way, axis=-1)
        cosine = np.maximum(way @ normal / distance, 0)
        if is_window:
            cosine *= np.maximum(-way[:, 0] / distance, 0)
        for box in boxes:
            if np.sort(box.size)[1] >= 0.18:
                cosine[box.hides(points, way)] = 0
        light += (cosine / (distance**2 + 0.3))[:, None] * power
    return np.asarray(light.reshape(grid.shape), np.float32)


def shell(room: Room) -> None:
    """Floor, rug, ceiling, walls, door, and a window with the sky outside."""
    x, y, z = np.diag(ROOM_M)
    room.panel(y, x, -y, tx.rows(tx.wood(tx.OAK), 60, (300, 700), 0.45))
    room.panel(z, x, y, tx.plain((0.93, 0.93, 0.91)), 200)
    room.panel(y + z, x, -z, tx.rows(tx.brick, 32, (80, 120), 1.5))
    room.panel(x + z, -x, -z, tx.rows(tx.plain((0.80, 0.76, 0.62)), 300, (40, 60), 0.9))
    room.panel(x + y + z, -y, -z, tx.plain((0.60, 0.68, 0.66)))
    room.outline += Box(ROOM_M / 2, ROOM_M, np.eye(3)).edges()
    room.box([1.35, 1.2, 0], [2.3, 1.6, 0.012], tx.plain((0.3, 0.2, 0.2)), faces={"top": tx.shapes}, yaw_deg=4)
    room.box([0, 3.985, 0], [5, 0.015, 0.09], tx.wood(tx.WHITE))
    room.box([0.35, 0, 0], [0.85, 0.03, 2.02], tx.wood(tx.PINE), faces={"back": tx.panelled})
    y0, y1, z0, z1 = 1.1, 2.8, 0.9, 2.25
    for a, b, top, bottom in ((0, y0, 2.6, 0), (y1, 4, 2.6, 0), (y0, y1, 2.6, z1), (y0, y1, z0, 0)):
        room.panel([0, a, top], [0, b - a, 0], [0, 0, bottom - top], tx.plain((0.82, 0.80, 0.77)))
    for side in (y0, (y0 + y1) / 2, y1 - 0.06):
        room.box([-0.1, side, z0], [0.11, 0.06, z1 - z0], tx.wood(tx.WHITE))
    for height in (z0, z1 - 0.06):
        room.box([-0.1, y0, height], [0.12, y1 - y0, 0.06], tx.wood(tx.WHITE))
    room.panel([-7, -9, 7.5], [0, 22, 0], [0, 0, -10], tx.plain((0.6, 0.76, 0.95)), 100)


def table(room: Room) -> None:
    """A table in the middle, chairs around it, a lamp over it, things on it."""
    room.box([1.8, 1.6, 0.71], [1.4, 0.8, 0.03], tx.wood(tx.OAK))
    for x, y in itertools.product((1.85, 3.09), (1.65, 2.29)):
        room.box([x, y, 0], [0.06, 0.06, 0.71], tx.wood(tx.OAK))
    for x, y, yaw_deg in ((2.1, 1.28, 8), (2.85, 1.3, -14), (2.2, 2.72, 170), (2.95, 2.7, 196)):
        turned: dict[str, Any] = {"yaw_deg": yaw_deg, "about": (x, y)}
        room.box([x - 0.21, y - 0.21, 0.43], [0.42, 0.42, 0.05], tx.plain(tx.some_colour(room.random)), **turned)
        for side in (x - 0.21, x + 0.17):
            room.box([side, y + 0.17, 0], [0.04, 0.04, 0.43], tx.wood(tx.WALNUT), **turned)
            room.box([side, y - 0.21, 0], [0.04, 0.04, 0.92], tx.wood(tx.WALNUT), **turned)
        for z in (0.58, 0.70, 0.82):
            room.box([x - 0.17, y - 0.2, z], [0.34, 0.022, 0.07], tx.wood(tx.WALNUT), **turned)
    room.box([2.44, 1.99, 2.2], [0.02, 0.02, 0.4], tx.plain(tx.WALNUT))
    room.box([2.25, 1.8, 2.02], [0.4, 0.4, 0.2], tx.plain((0.85, 0.75, 0.55)))
    pile(room, 1.92, 1.68, 0.74, 4)
    pile(room, 2.85, 2.08, 0.74, 3)
    pile(room, 2.38, 1.68, 0.74, 1)
    for x, y, *size in ((2.35, 2.1, 0.19, 0.065, 0.29), (2.62, 1.75, 0.14, 0.05, 0.21), (2.98, 1.72, 0.1, 0.1, 0.13)):
        room.box([x, y, 0.74], size, tx.cover, yaw_deg=room.random.uniform(-40, 40))


def pile(room: Room, x: float, y: float, z: float, count: int) -> None:
    """Books lying on one another."""
    for _ in range(count):
        size = room.random.uniform([0.19, 0.13, 0.02], [0.26, 0.18, 0.045])
        paper = tx.plain((0.85, 0.82, 0.73))
        room.box(
            [x, y, z], size, paper, faces={"front": tx.cover, "top": tx.cover}, yaw_deg=room.random.uniform(-30, 30)
        )
        z += size[2]


def bookshelf(room: Room) -> None:
    """A bookshelf at the wall x = 5, filled, in two columns."""
    for y in (1.0, 2.0):
        for board in range(5):
            faces = {"left": tx.rows(tx.book, 230, (12, 38), 0.5)}
            room.box([4.75, y + 0.03, 0.06 + 0.4 * board], [0.25, 0.94, 0.353], tx.wood(tx.PINE), faces=faces)
            room.box([4.68, y, 0.41 + 0.4 * board], [0.32, 1.0, 0.03], tx.wood(tx.PINE))
    for y in (1.0, 1.985, 2.97):
        room.box([4.68, y, 0], [0.32, 0.03, 2.04], tx.wood(tx.PINE))


def sideboard(room: Room) -> None:
    """A cupboard at the wall y = 4 with things on it."""
    room.box([1.7, 3.55, 0], [1.9, 0.44, 0.86], tx.wood(tx.WALNUT), faces={"front": tx.panelled})
    for x, width, height in ((1.82, 0.2, 0.26), (2.1, 0.15, 0.2), (3.25, 0.22, 0.3)):
        room.box([x, 3.8, 0.86], [width, 0.02, height], tx.wood(tx.WALNUT), faces={"front": tx.framed}, yaw_deg=10)
    pile(room, 2.5, 3.66, 0.86, 5)
    room.box([2.98, 3.68, 0.86], [0.2, 0.14, 0.12], tx.cover, yaw_deg=-15)


def corners(room: Room) -> None:
    """An armchair at (0, 4), boxes at (5, 0) and (5, 4)."""
    for low, size in (
        ([0.27, 3.08, 0.1], [0.7, 0.6, 0.32]),
        ([0.22, 3.62, 0.1], [0.8, 0.14, 0.78]),
        ([0.16, 3.08, 0.1], [0.13, 0.6, 0.5]),
        ([0.92, 3.08, 0.1], [0.13, 0.6, 0.5]),
    ):
        room.box(low, size, tx.plain((0.34, 0.42, 0.52)), yaw_deg=-38, about=(0.62, 3.38))
    room.box([4.2, 0.2, 0], [0.5, 0.4, 0.34], tx.cover, yaw_deg=12)
    room.box([4.28, 0.24, 0.34], [0.36, 0.3, 0.26], tx.cover, yaw_deg=-9)
    room.box([4.4, 3.4, 0], [0.42, 0.42, 0.7], tx.cover, yaw_deg=30)


def wall_pictures(room: Room) -> None:
    """Pictures on all walls, by the face that looks into the room: along the wall, z, width, height."""
    pictures = {
        "front": [(0.35, 1.35, 0.6, 0.8), (1.25, 1.5, 0.36, 0.46), (2.0, 1.35, 0.9, 0.65), (3.2, 1.4, 0.5, 0.62)],
        "back": [(1.6, 1.2, 0.7, 0.95), (2.55, 1.45, 0.45, 0.35), (2.6, 0.95, 0.34, 0.42), (3.3, 1.15, 0.85, 0.6)],
        "left": [(0.25, 1.3, 0.5, 0.66), (3.3, 1.2, 0.5, 0.75)],
        "right": [(3.1, 1.3, 0.6, 0.5), (0.25, 1.35, 0.5, 0.7)],
    }
    t = 0.025
    for face, places in pictures.items():
        for along, z, width, height in places:
            low, size = [along, ROOM_M[1] - t if face == "front" else 0, z], [width, t, height]
            if face in ("left", "right"):
                low, size = [ROOM_M[0] - t if face == "left" else 0, along, z], [t, width, height]
            room.box(low, size, tx.wood(tx.WALNUT), faces={face: tx.framed})
