"""The room while it is renovated: at each step some of its pictures, books and furniture are exchanged, by chance.

What is exchanged has another surface, and pictures and things on tables are also moved. Walls, floor, ceiling, door and
window stay until the last step, which exchanges their surfaces.
"""

from collections.abc import Container, Mapping

import numpy as np
from numpy.typing import ArrayLike

from mapless.geometry import Array

from .furniture import LOWEST_CAMERA_M, Quad, Room, furnished, light_up
from .photographs import REFERENCE_CAMERA, Station, scatter, walk
from .textures import Image, Texture

STEPS = 10
"""Steps before that of the building, which comes last."""
EXCHANGED_SHARE = 0.16
"""Share of the pieces that each step exchanges, so that after ten 0.17 of them are as they were surveyed."""
MOVED_M = 0.12
"""Farthest move of a piece that is exchanged and does not stand on the floor, along each side of the room."""
THICK_M = 0.45
"""Pieces with a longer side than this in two directions are furniture, and keep their place."""
BUILDING = range(1, 8)
"""Pieces that `furniture.shell` puts after the rug: skirting, door and window, which stay as walls and floor do."""
SIZE_PX = (640, 480)


class RenovatedRoom(Room):
    """A room whose pieces are each painted by a random stream of their own, so that one can be exchanged alone."""

    def __init__(self, seed: int, step: int, known: Container[object] = ()) -> None:
        """The room after so many steps, still empty; `known` are the `versions` whose textures need not be painted."""
        super().__init__(np.random.default_rng([seed, 0]))
        self._known = known
        self.versions: list[tuple[int, int]] = []
        """Number of each rectangle, and how often it was exchanged."""
        self._seed, self._step = seed, step
        self._piece = 0
        self._in_box = False
        self.exchanged: list[bool] = []
        """Whether each piece has been exchanged since the survey, in the order in which they were put."""

    def panel(
        self, corner: ArrayLike, across: ArrayLike, down: ArrayLike, texture: Texture, texels_per_m: float = 420
    ) -> None:
        """See Room.panel; a panel that is no side of a box is a part of the building."""
        count = self._exchanges(self._piece) if self._in_box else self._building_exchanges
        version = len(self.versions), count
        self.versions.append(version)
        if version in self._known:
            corner, across, down = (np.asarray(it, float) for it in (corner, across, down))
            self.quads.append(Quad(corner, across, down, []))
            return
        layout, self.random = self.random, np.random.default_rng([self._seed, 7, *version])
        super().panel(corner, across, down, texture, texels_per_m)
        self.random = layout

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
        """See Room.box; a box is a piece."""
        count = self._exchanges(self._piece)
        low, size = np.asarray(low, float), np.asarray(size, float)
        if count and np.sort(size)[1] <= THICK_M and low[2] > 0.5 and about is None:
            moved = low + self._moved(size, count)
            if low[2] >= LOWEST_CAMERA_M:  # it keeps its bottom, so that the surfaces after it keep their numbers
                moved[2] = max(moved[2], LOWEST_CAMERA_M)
            low = moved
        self._in_box = True
        super().box(low, size, texture, faces=faces, yaw_deg=yaw_deg, about=about)
        self._in_box = False
        self.exchanged.append(count > 0)
        self._piece += 1

    def _exchanges(self, piece: int) -> int:
        """How often a piece has been exchanged."""
        if piece in BUILDING:
            return self._building_exchanges
        drawn = np.random.default_rng([self._seed, 8, piece]).random(self._step)
        return int((drawn < EXCHANGED_SHARE).sum())

    @property
    def _building_exchanges(self) -> int:
        return int(self._step > STEPS)

    def _moved(self, size: Array, count: int) -> Array:
        """The move (3,) of a piece: along its two longer sides, metres; things lie on what they lay on."""
        move = np.random.default_rng([self._seed, 9, self._piece, count]).uniform(-MOVED_M, MOVED_M, 3)
        hangs = size[2] > 0.3 and min(size[:2]) < 0.03
        return np.where(np.arange(3) == np.argmin(size), 0.0, move) if hangs else move * [0.5, 0.5, 0.0]


class _Everything(Container[object]):
    def __contains__(self, _: object) -> bool:
        return True


def shape_of(seed: int, step: int) -> RenovatedRoom:
    """The room after so many steps, without textures."""
    room = RenovatedRoom(seed, step, _Everything())
    furnished(room)
    return room


class Renovation:
    """The room at each step; what is not exchanged keeps its textures and the light on them."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._lit: dict[tuple[int, int], list[Image]] = {}

    def at(self, step: int) -> RenovatedRoom:
        """The room after so many steps, furnished and lit; 0 is the surveyed one."""
        room = RenovatedRoom(self._seed, step, self._lit.keys())
        furnished(room)
        for key, quad in zip(room.versions, room.quads, strict=True):
            if key not in self._lit:
                light_up(quad, room.boxes)
                self._lit[key] = list(quad.levels)
            quad.levels[:] = self._lit[key]
        return room


def survey(seed: int, room: Room) -> list[Station]:
    """Where the references are taken: 24 around the table, and 16 anywhere."""
    stations = walk(seed, 24) + [
        it._replace(name=f"reference-{24 + i}", camera=REFERENCE_CAMERA)
        for i, it in enumerate(scatter(seed + 1000, 16, room))
    ]
    return [_small(it) for it in stations]


def visit(seed: int, step: int, count: int, room: Room) -> list[Station]:
    """Where the photographs of a step are taken: anywhere, at every step elsewhere."""
    stations = scatter(seed + 2000 + step, count, room)
    return [_small(it._replace(name=f"step-{step:02d}-{i:02d}")) for i, it in enumerate(stations)]


def _small(station: Station) -> Station:
    return station._replace(camera=station.camera.resized(*SIZE_PX))
