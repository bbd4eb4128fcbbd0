"""Things that an attacker puts into the rendered room: pictures that are moved, and printed photographs."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np

from mapless.geometry import Array, Camera

from ..rendered_room.furniture import Quad, Room
from ..rendered_room.photographs import Station, look_at, shade
from ..rendered_room.textures import Image

WALL_M = 4.0
"""y of the wall that is attacked; along it runs x."""
PICTURE_M = np.array([2.0, 3.975, 1.35]), np.array([2.9, 4.0, 2.0])
"""Corners of its largest picture."""
PICTURES_M = np.array([0.3, 3.975, 1.3]), np.array([3.8, 4.0, 2.2])
"""Corners of a box that has all its pictures."""


def pieces_within(room: Room, low: Array, high: Array) -> list[int]:
    """Indices of the rectangles that lie in a box, its corners (3,) and (3,)."""
    return [
        i
        for i, it in enumerate(room.quads)
        if all(
            ((low - 1e-6 <= corner) & (corner <= high + 1e-6)).all()
            for corner in (it.corner, it.corner + it.across, it.corner + it.down)
        )
    ]


def moved(quads: Sequence[Quad], move_m: Array) -> list[Quad]:
    """The rectangles, moved (3,) in the world."""
    return [replace(it, corner=it.corner + move_m) for it in quads]


def copy_of(room: Room, quads: Sequence[Quad]) -> Room:
    """A room of the same solids with these rectangles."""
    return Room(room.random, list(quads), room.boxes, room.outline)


def with_moved(room: Room, box: tuple[Array, Array], move_m: Array) -> Room:
    """The room with what lies in a box moved."""
    chosen = set(pieces_within(room, *box))
    kept = [it for i, it in enumerate(room.quads) if i not in chosen]
    return copy_of(room, kept + moved([room.quads[i] for i in sorted(chosen)], move_m))


def levels_of(light: Image) -> list[Image]:
    """A texture with its coarser levels, each half of the one before."""
    levels = [light]
    while max(levels[-1].shape[:2]) > 4:
        h, w = levels[-1].shape[:2]
        half = cv2.resize(levels[-1], ((w + 1) // 2, (h + 1) // 2), interpolation=cv2.INTER_AREA)
        levels.append(np.asarray(half, np.float32))
    return levels


def printed(light: Image, corner: Array, across: Array, down: Array) -> Quad:
    """A print of linear light (H, W, 3) as a rectangle in the world; it shines as what it shows."""
    return Quad(corner, across, down, levels_of(light))


def wall_print(room: Room, low: Array, high: Array, texels_per_m: float, move_m: float) -> Quad:
    """A photograph from 1.5 m of the wall between x and z of `low` (2,) and `high` (2,), hung on it, moved along it.

    Furniture before the wall is on it too, so it is flat where the room is not.
    """
    middle = np.array([(low[0] + high[0]) / 2, WALL_M - 1.5, (low[1] + high[1]) / 2])
    width, height = ((high - low) * texels_per_m).round().astype(int).tolist()
    focal = 1.5 * texels_per_m
    camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    light = shade(room, camera, look_at(middle, middle + [0.0, 1.0, 0.0], 0.0))
    corner = np.array([low[0] + move_m, WALL_M - 0.03, high[1]])
    return printed(light, corner, np.array([high[0] - low[0], 0, 0]), np.array([0, 0, low[1] - high[1]]))


def print_before(station: Station, of: Station, room: Room, distance_m: float, share: float) -> Quad:
    """A station's view, printed and held before a camera so that it fills this share of each of its sides."""
    light = shade(room, of.camera.resized(1280, 960), of.world_from_camera)
    pose, camera = station.world_from_camera, station.camera
    corners_px = np.array([[0, 0], [camera.width_px, 0], [0, camera.height_px]], float)
    centre_px = np.array([camera.width_px, camera.height_px]) / 2
    rays = np.linalg.inv(camera.matrix()) @ np.c_[centre_px + share * (corners_px - centre_px), np.ones(3)].T
    corner, right, below = pose.apply(distance_m * rays.T)
    return printed(light, corner, right - corner, below - corner)


def stations(
    name: str, count: int, camera: Camera, seed: int, place: Callable[[np.random.Generator], tuple[Array, Array]]
) -> list[Station]:
    """Stations whose centre and target (3,) are drawn by `place`."""
    random, found = np.random.default_rng([seed, 11]), []
    for i in range(count):
        centre, target = place(random)
        found.append(Station(f"{name}-{i:04d}", camera, look_at(centre, target, random.normal(0, 3))))
    return found
