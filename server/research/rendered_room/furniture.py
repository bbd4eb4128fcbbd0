"""What stands in the room, 5 x 4 x 2.6 m: placed by hand, varied by the seed.

World axes: x along the long walls, y across, z up, metres; the origin is a corner of the floor. The window is in the
wall x = 0, the bookshelf stands at x = 5, the door is in the wall y = 0, the cupboard stands at y = 4.
"""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapless.geometry import Array

from . import textures as tx
from .textures import Image, Random, Shape

ROOM_M = np.array([5.0, 4.0, 2.6])
OAK, WALNUT, PINE = (0.62, 0.44, 0.27), (0.36, 0.23, 0.15), (0.78, 0.62, 0.40)
BLACK, WHITE, PAPER = (0.12, 0.10, 0.09), (0.88, 0.87, 0.84), (0.85, 0.82, 0.73)

Texture = tuple[Any, ...]
"""A function of a source of randomness and a shape, and its further arguments."""

FACES = {
    "front": ((0, 0, 1), (1, 0, 0), (0, 0, -1)),
    "right": ((1, 0, 1), (0, 1, 0), (0, 0, -1)),
    "back": ((1, 1, 1), (-1, 0, 0), (0, 0, -1)),
    "left": ((0, 1, 1), (0, -1, 0), (0, 0, -1)),
    "top": ((0, 1, 1), (1, 0, 0), (0, -1, 0)),
    "bottom": ((0, 0, 0), (1, 0, 0), (0, 1, 0)),
}
"""Where the texture of a box's face begins, and its rows and columns, as shares of the box; the front looks to -y."""


class Quad(NamedTuple):
    """A rectangle with a texture, visible from its front only: x(u, v) = corner + u across + v down, world, metres."""

    corner: Array
    across: Array
    down: Array
    texture: Image
    is_round: bool = False  # only the inscribed ellipse exists
    glows: bool = False  # takes no light and no shadow
    owner: int = -1  # index of the box it belongs to

    def normal(self) -> Array:
        """(3,) unit length, to the front."""
        n = np.cross(self.down, self.across)
        return np.asarray(n / np.linalg.norm(n), float)


class Box(NamedTuple):
    """An upright solid: its middle (3,) world and size (3,), metres, and its rotation about z, radians."""

    centre: Array
    size: Array
    yaw: float = 0.0

    def world_from_box(self) -> Array:
        """Its axes as columns, (3, 3)."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def edges(self) -> list[Array]:
        """Twelve (2, 3), world: corners whose signs differ once."""
        signs = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
        corners = self.centre + (signs * self.size) @ self.world_from_box().T
        return [corners[[i, i | bit]] for i in range(8) for bit in (1, 2, 4) if not i & bit]


def texels(down: ArrayLike, across: ArrayLike, texels_per_m: float) -> Shape:
    """Size of a texture for a rectangle."""
    h, w = (int(np.clip(round(float(np.linalg.norm(edge)) * texels_per_m), 6, 2400)) for edge in (down, across))
    return h, w


@dataclass(eq=False)
class Room:
    """All rectangles; all solids, for light and to keep cameras out; and the edges (2, 3) worth drawing."""

    random: Random
    quads: list[Quad] = field(default_factory=list)
    boxes: list[Box] = field(default_factory=list)
    outline: list[Array] = field(default_factory=list)

    def box(
        self,
        low: ArrayLike,
        size: ArrayLike,
        texture: Texture,
        *,
        faces: Mapping[str, Texture | None] | None = None,
        yaw_deg: float = 0.0,
        about: ArrayLike | None = None,
        texels_per_m: float = 650,
        draw: bool = False,
    ) -> None:
        """Put an upright box with its low corner (3,) at `low`, then turned about `about` (x, y) or its own middle.

        `faces` have another texture than the rest, or None where they are never seen.
        """
        low, size = np.asarray(low, float), np.asarray(size, float)
        turn = Box(np.zeros(3), size, np.radians(yaw_deg)).world_from_box()
        pivot = low + size / 2 if about is None else np.append(np.asarray(about, float), 0.0)
        for face, (corner, columns, rows) in FACES.items():
            make = (faces or {}).get(face, texture)
            if make is None or (face == "bottom" and low[2] < 0.85):  # no camera is lower
                continue
            across, down = turn @ (size * columns), turn @ (size * rows)
            image = make[0](self.random, texels(down, across, texels_per_m), *make[1:])
            start = pivot + turn @ (low + size * corner - pivot)
            self.quads.append(Quad(start, across, down, image, owner=len(self.boxes)))
        self.boxes.append(Box(pivot + turn @ (low + size / 2 - pivot), size, np.radians(yaw_deg)))
        if draw:
            self.outline.extend(self.boxes[-1].edges())

    def prism(self, base: ArrayLike, radius: float, height: float, side: Image, top: Image, sides: int = 14) -> None:
        """Put an upright prism, nearly a cylinder, on `base` (3,); `side` is wrapped around it."""
        x, y, z = np.asarray(base, float)
        angles = np.linspace(0, 2 * np.pi, sides + 1)
        height_z = np.full(sides + 1, z + height)
        ring = np.stack([x + radius * np.cos(angles), y + radius * np.sin(angles), height_z], axis=-1)
        cuts = np.linspace(0, side.shape[1], sides + 1).astype(int)
        owner = len(self.boxes)
        for i in range(sides):
            strip = np.ascontiguousarray(side[:, cuts[i] : cuts[i + 1]])
            self.quads.append(Quad(ring[i], ring[i + 1] - ring[i], np.array([0.0, 0.0, -height]), strip, owner=owner))
        across, down = np.array([2 * radius, 0, 0]), np.array([0, -2 * radius, 0.0])
        corner = np.array([x - radius, y + radius, z + height])
        self.quads.append(Quad(corner, across, down, top, is_round=True, owner=owner))
        self.boxes.append(Box(np.array([x, y, z + height / 2]), np.array([1.8 * radius, 1.8 * radius, height])))

    def panel(
        self,
        corner: ArrayLike,
        across: ArrayLike,
        down: ArrayLike,
        texture: Image,
        is_round: bool = False,
        glows: bool = False,
    ) -> None:
        """Put a single rectangle, or the ellipse in it."""
        corner, across, down = (np.asarray(a, float) for a in (corner, across, down))
        self.quads.append(Quad(corner, across, down, texture, is_round, glows))


def furnish(random: Random) -> Room:
    """The whole room."""
    room = Room(random)
    for part in (shell, window, door, table, bookshelf, sideboard, corners, wall_pictures, ceiling_lamp):
        part(room)
    return room


def shell(room: Room) -> None:
    """Floor, ceiling, tx.rug, skirting boards and three walls; the wall with the window is `window`'s."""
    x, y, z = np.diag(ROOM_M)
    random, density = room.random, 420
    room.panel(y, x, -y, tx.floor_boards(random, texels(y, x, density), int(0.14 * density)))
    room.panel(z, x, y, tx.plaster(random, texels(y, x, 200), (0.93, 0.93, 0.91)))
    brick_px = (int(0.075 * density), int(0.24 * density))
    room.panel(y + z, x, -z, tx.bricks(random, texels(z, x, density), brick_px))
    room.panel(x + z, -x, -z, tx.wallpaper(random, texels(z, x, density), (0.80, 0.76, 0.62)))
    room.panel(x + y + z, -y, -z, tx.plaster(random, texels(z, y, density), (0.60, 0.68, 0.66)))
    room.outline.extend(Box(ROOM_M / 2, ROOM_M).edges())
    fringe, size = (tx.fabric, (0.3, 0.2, 0.2)), [2.3, 1.6, 0.012]
    room.box([1.35, 1.2, 0], size, fringe, faces={"top": (tx.rug,)}, yaw_deg=4, texels_per_m=450, draw=True)
    room.box([0, 3.985, 0], [5, 0.015, 0.09], (tx.wood, WHITE), texels_per_m=300)
    room.box([1.3, 0, 0], [3.7, 0.015, 0.09], (tx.wood, WHITE), texels_per_m=300)


def window(room: Room) -> None:
    """The wall x = 0 around a window, its frame, sill, pots and curtains, and the country outside."""
    y0, y1, z0, z1, reveal = 1.1, 2.8, 0.9, 2.25, 0.16
    depth, height, density = ROOM_M[1], ROOM_M[2], 420
    wall = tx.plaster(room.random, texels(height, depth, density), (0.82, 0.80, 0.77))
    for a, b, top, bottom in ((0, y0, height, 0), (y1, depth, height, 0), (y0, y1, height, z1), (y0, y1, z0, 0)):
        rows = slice(int((height - top) * density), int((height - bottom) * density))
        part = np.ascontiguousarray(wall[rows, int(a * density) : int(b * density)])
        room.panel([0, a, top], [0, b - a, 0], [0, 0, bottom - top], part)
    white = (tx.wood, WHITE)
    room.box([-reveal, y0 - 0.02, z0 - 0.03], [reveal + 0.12, y1 - y0 + 0.04, 0.03], white, draw=True)
    room.box([-reveal, y0 - 0.05, z1], [reveal, y1 - y0 + 0.1, 0.03], white)
    for y in (y0 - 0.05, y1):
        room.box([-reveal, y, z0], [reveal - 0.001, 0.05, z1 - z0], white)
    for y in (y0, (y0 + y1) / 2 - 0.03, y1 - 0.06):
        room.box([-reveal, y, z0], [0.05, 0.06, z1 - z0], white)
    for z in (z0, (z0 + z1) / 2 + 0.2, z1 - 0.06):
        room.box([-reveal, y0, z], [0.05, y1 - y0, 0.06], white)
    room.panel([-7, -9, 7.5], [0, 22, 0], [0, 0, -10], tx.landscape(room.random, (900, 2000)), glows=True)

    curtain = (tx.fabric, tx.some_colour(room.random, (0.3, 0.6), (0.4, 0.7)))
    for y, fold in itertools.product((y0 - 0.32, y1 - 0.06), range(5)):
        low, yaw_deg = [0.05, y + 0.075 * fold, 0.35], 35 * (-1) ** fold
        room.box(low, [0.012, 0.085, 2.0], curtain, yaw_deg=yaw_deg, texels_per_m=350)
    room.box([0.05, y0 - 0.4, 2.36], [0.03, y1 - y0 + 0.8, 0.03], (tx.wood, WALNUT))
    for y in (1.35, 1.75, 2.35):
        potted_plant(room, [0.02, y, z0], 0.055, 0.11)


def potted_plant(room: Room, base: ArrayLike, radius: float, height: float) -> None:
    """A glazed pot with something green in it."""
    random, shape = room.random, (int(650 * height), int(650 * 2 * np.pi * radius))
    glaze = tx.tinted(tx.shapes(random, shape, 30), tx.noise(random, shape, (20, 20), 5), 0.06)
    soil = tx.tinted(tx.plain((64, 64), (0.2, 0.14, 0.1)), tx.noise(random, (64, 64), (8, 8), 3), 0.3)
    room.prism(base, radius, height, glaze, soil)
    leaves(room, np.add(base, [0, 0, height]), int(10 + 60 * radius), 1.6 * radius, 3.5 * radius)


def leaves(room: Room, base: NDArray[np.floating], count: int, spread_m: float, rise_m: float) -> None:
    """Leaves, ellipses with a vein that are seen from both sides, around and above a place (3,)."""
    random = room.random
    for _ in range(count):
        offset = random.normal(0, 1, 3) * [spread_m, spread_m, 0.3 * rise_m]
        centre = np.add(base, offset) + np.array([0, 0, 0.6 * rise_m])
        centre[2] = max(centre[2], base[2] + 0.01)
        centre[:2] = np.clip(centre[:2], 0.06, ROOM_M[:2] - 0.06)
        frame: Array = np.linalg.qr(random.standard_normal((3, 3)))[0]
        length = random.uniform(0.6, 1.2) * spread_m
        across, down = frame[0] * length, frame[1] * length * 0.4
        green = (random.uniform(0.12, 0.3), random.uniform(0.35, 0.55), random.uniform(0.1, 0.2))
        leaf = tx.tinted(tx.plain((40, 100), green), tx.noise(random, (40, 100), (20, 8), 3), 0.2)
        leaf[19:21] *= 1.5
        corner = centre - across / 2 - down / 2
        room.panel(corner, across, down, leaf, is_round=True)
        room.panel(corner + across, -across, down, np.ascontiguousarray(leaf[:, ::-1]), is_round=True)


def door(room: Room) -> None:
    """A door with its frame in the wall y = 0."""
    front = (tx.panelled, (0.70, 0.55, 0.38), (3, 2))
    room.box([0.35, 0, 0], [0.85, 0.03, 2.02], (tx.wood, PINE), faces={"back": front}, texels_per_m=420, draw=True)
    for low, size in (
        ([0.27, 0, 0], [0.08, 0.045, 2.1]),
        ([1.2, 0, 0], [0.08, 0.045, 2.1]),
        ([0.35, 0, 2.02], [0.85, 0.045, 0.08]),
    ):
        room.box(low, size, (tx.wood, WHITE), texels_per_m=420)


def table(room: Room) -> None:
    """A table in the middle, chairs around it, things on it."""
    oak, z = (tx.wood, OAK), 0.74
    room.box([1.8, 1.6, z - 0.03], [1.4, 0.8, 0.03], oak, draw=True)
    for x, y in itertools.product((1.85, 3.09), (1.65, 2.29)):
        room.box([x, y, 0], [0.06, 0.06, z - 0.03], oak)
    for x, y, yaw_deg in ((2.1, 1.28, 8), (2.85, 1.3, -14), (2.2, 2.72, 170), (2.95, 2.7, 196)):
        chair(room, x, y, yaw_deg)

    book_pile(room, [1.92, 1.68, z], 4, 20)
    book_pile(room, [2.85, 2.08, z], 3, -35)
    room.box([2.35, 2.1, z], [0.19, 0.065, 0.29], (tx.cover,), yaw_deg=25, draw=True)
    room.box([2.62, 1.72, z], [0.14, 0.05, 0.21], (tx.cover,), yaw_deg=-40, draw=True)
    room.box([2.98, 1.72, z], [0.10, 0.10, 0.13], (tx.cover,), yaw_deg=10, draw=True)
    lid = (tx.fabric, (0.16, 0.16, 0.18))
    room.box([2.38, 1.68, z], [0.16, 0.23, 0.018], lid, faces={"top": (tx.painting,)}, yaw_deg=70)
    for x, y in ((2.2, 2.15), (2.75, 2.2)):
        room.prism([x, y, z], 0.042, 0.1, tx.shapes(room.random, (80, 210), 24), tx.plain((40, 40), (0.2, 0.12, 0.07)))
    down, across = np.mgrid[-100:100, -100:100].astype(np.float32)
    plate = tx.tinted(tx.plain((200, 200), WHITE), np.sin(np.hypot(across, down) / 4), 0.08)
    room.prism([2.62, 2.02, z], 0.12, 0.012, tx.plain((10, 300), WHITE), plate)


def chair(room: Room, x: float, y: float, yaw_deg: float) -> None:
    """A chair whose back is towards -y before it is turned about its seat's middle."""
    turned: dict[str, Any] = {"yaw_deg": yaw_deg, "about": (x, y)}
    cloth = (tx.fabric, tx.some_colour(room.random, (0.4, 0.7), (0.3, 0.6)))
    room.box([x - 0.21, y - 0.21, 0.43], [0.42, 0.42, 0.05], cloth, **turned, draw=True)
    for side in (x - 0.21, x + 0.17):
        room.box([side, y + 0.17, 0], [0.04, 0.04, 0.43], (tx.wood, WALNUT), **turned)
        room.box([side, y - 0.21, 0], [0.04, 0.04, 0.92], (tx.wood, WALNUT), **turned)
    for z in (0.58, 0.70, 0.82):
        room.box([x - 0.17, y - 0.2, z], [0.34, 0.022, 0.07], (tx.wood, WALNUT), **turned, draw=z > 0.8)


def book_pile(room: Room, low: ArrayLike, count: int, yaw_deg: float) -> None:
    """Books lying on one another, spines towards -y before the pile is turned."""
    place = np.array(low, float)
    for _ in range(count):
        size = room.random.uniform([0.19, 0.13, 0.02], [0.26, 0.18, 0.045])
        turn_deg = yaw_deg + room.random.normal(0, 8)
        faces = {"front": (tx.book_spine,), "top": (tx.cover,)}
        room.box(place, size, (tx.wood, PAPER), faces=faces, yaw_deg=turn_deg, texels_per_m=900)
        place[2] += size[2]


def bookshelf(room: Room) -> None:
    """A bookshelf at the wall x = 5, two columns of five boards, filled."""
    x0, y0, width, depth, height = 4.68, 1.0, 2.0, 0.3, 2.05
    pine, boards = (tx.wood, PINE), np.linspace(0.06, height - 0.03, 6)
    room.box([x0 + depth, y0, 0], [0.015, width, height], pine, faces={"right": None}, texels_per_m=250)
    for y in (y0 - 0.03, y0 + width / 2 - 0.015, y0 + width):
        room.box([x0, y, 0], [depth, 0.03, height], pine, texels_per_m=450, draw=True)
    for z in boards:
        room.box([x0, y0, z - 0.03], [depth, width, 0.03], pine, texels_per_m=450)
    for z, y in itertools.product(boards[:-1], (y0 + 0.02, y0 + width / 2 + 0.03)):
        shelf_row(room, x0, y, y + width / 2 - 0.07, z, boards[1] - boards[0] - 0.05)


def shelf_row(room: Room, x0: float, y: float, y_end: float, z: float, clear_m: float) -> None:
    """Books on one board, spines towards -x, and a box where they end early."""
    random = room.random
    last = y_end - random.uniform(0.0, 0.25)
    while y < last:
        width = min(random.uniform(0.018, 0.06), y_end - y)
        size = [random.uniform(0.15, 0.22), width - 0.002, clear_m * random.uniform(0.62, 0.97)]
        board = (tx.fabric, tx.some_colour(random, (0.2, 0.7), (0.2, 0.7)))
        faces = {"left": (tx.standing_spine,), "front": board, "back": board, "right": None}
        low = [x0 + random.uniform(0.005, 0.04), y, z]
        room.box(low, size, (tx.wood, PAPER), faces=faces, texels_per_m=700)
        y += width
    if y_end - y > 0.1:
        room.box([x0 + 0.05, y + 0.015, z], [0.16, y_end - y - 0.03, clear_m * 0.6], (tx.cover,), yaw_deg=5)


def sideboard(room: Room) -> None:
    """A cupboard at the wall y = 4 with things on it, and a clock on the wall."""
    walnut, z = (tx.wood, WALNUT), 0.86
    faces = {"front": (tx.panelled, WALNUT, (2, 4)), "back": None}
    room.box([1.7, 3.55, 0.08], [1.9, 0.44, 0.78], walnut, faces=faces, texels_per_m=550, draw=True)
    room.box([1.75, 3.6, 0], [1.8, 0.36, 0.08], walnut, texels_per_m=250)
    for x, width, height in ((1.82, 0.2, 0.26), (2.1, 0.15, 0.2), (3.25, 0.22, 0.3)):
        photo, yaw_deg = {"front": (tx.framed, tx.painting, OAK, 14)}, room.random.normal(0, 12)
        room.box([x, 3.8, z], [width, 0.02, height], walnut, faces=photo, yaw_deg=yaw_deg, draw=True)
    book_pile(room, [2.62, 3.66, z], 5, 4)
    potted_plant(room, [2.45, 3.75, z], 0.07, 0.16)
    room.box([2.98, 3.68, z], [0.2, 0.14, 0.12], (tx.cover,), yaw_deg=-15)
    room.panel([4.2, 3.975, 2.15], [0.34, 0, 0], [0, 0, -0.34], tx.clock_face((300, 300)), is_round=True)


def corners(room: Room) -> None:
    """An armchair at (0, 4), a large plant at (5, 4), boxes at (5, 0)."""
    cloth, about = (tx.fabric, (0.34, 0.42, 0.52)), (0.62, 3.38)
    for low, size in (
        ([0.27, 3.08, 0.1], [0.7, 0.6, 0.32]),
        ([0.22, 3.62, 0.1], [0.8, 0.14, 0.78]),
        ([0.16, 3.08, 0.1], [0.13, 0.6, 0.5]),
        ([0.92, 3.08, 0.1], [0.13, 0.6, 0.5]),
    ):
        room.box(low, size, cloth, yaw_deg=-38, about=about, texels_per_m=450, draw=True)
    room.box([0.42, 3.5, 0.42], [0.4, 0.11, 0.36], (tx.rug,), yaw_deg=-38, about=about)
    room.box([4.2, 0.2, 0], [0.5, 0.4, 0.34], (tx.carton,), yaw_deg=12, texels_per_m=500, draw=True)
    room.box([4.28, 0.24, 0.34], [0.36, 0.3, 0.26], (tx.carton,), yaw_deg=-9, draw=True)
    potted_plant(room, [4.6, 3.65, 0], 0.17, 0.34)
    leaves(room, np.array([4.6, 3.65, 0.5]), 50, 0.2, 0.8)


def wall_pictures(room: Room) -> None:
    """Pictures on all walls, by the face that looks into the room."""
    pictures = {
        "front": [(0.35, 1.35, 0.6, 0.8), (1.25, 1.5, 0.36, 0.46), (2.0, 1.35, 0.9, 0.65), (3.2, 1.4, 0.5, 0.62)],
        "back": [(1.6, 1.2, 0.7, 0.95), (2.55, 1.45, 0.45, 0.35), (2.6, 0.95, 0.34, 0.42), (3.3, 1.15, 0.85, 0.6)],
        "left": [(0.25, 1.3, 0.5, 0.66), (3.3, 1.2, 0.5, 0.75)],
        "right": [(3.1, 1.3, 0.6, 0.5), (0.25, 1.35, 0.5, 0.7)],
    }
    t = 0.025
    for face, places in pictures.items():
        for along, z, width, height in places:
            art = tx.painting if room.random.random() < 0.6 else tx.cover
            frame = BLACK if room.random.random() < 0.5 else OAK
            faces = {face: (tx.framed, art, frame, int(40 * min(width, height)))}
            if face in ("front", "back"):
                low, size = [along, ROOM_M[1] - t if face == "front" else 0, z], [width, t, height]
            else:
                low, size = [ROOM_M[0] - t if face == "left" else 0, along, z], [t, width, height]
            room.box(low, size, (tx.wood, BLACK), faces=faces, texels_per_m=600, draw=True)


def ceiling_lamp(room: Room) -> None:
    """A lamp over the table: a cord and a striped shade."""
    room.box([2.44, 1.99, 1.95], [0.02, 0.02, 0.65], (tx.fabric, BLACK), texels_per_m=200)
    shade = tx.fabric(room.random, (180, 1000), (0.85, 0.75, 0.55))
    shade[:, np.arange(1000) % 90 < 30] *= 0.6
    room.prism([2.45, 2.0, 1.74], 0.2, 0.22, shade, tx.plain((50, 50), (0.7, 0.65, 0.5)), sides=18)
