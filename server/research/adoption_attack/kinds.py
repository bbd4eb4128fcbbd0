"""The kinds of attack: for each, photographs with the camera that the attacker states, and where they were taken."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera

from ..rendered_room.furniture import Room
from ..rendered_room.photographs import QUERY_CAMERA, Floats, Station, exposed, phone_settings, photograph, shade
from ..rendered_room.renovation import SIZE_PX, Renovation, survey, visit
from .prints import PICTURE_M, PICTURES_M, pieces_within, print_before, stations, wall_print, with_moved

CAMERA = QUERY_CAMERA.resized(*SIZE_PX)
DEVELOPED = 5
"""Photographs of each station: the attacker's phone exposes them differently."""
DAYS = 20
"""Days of the slow attack; on each the pictures hang 2 cm further."""
TILE_PX = 64
Pixels = NDArray[np.uint8]


class Fake(NamedTuple):
    """An attacker's photograph: where it was taken, what renders it, (H, W, 3) sRGB, the camera stated, and the day."""

    station: Station
    render: Callable[[], Pixels]
    stated: Camera
    day: int = 0


class Rooms:
    """The surveyed room, and another one that nobody has surveyed."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.surveyed: Room = Renovation(seed).at(0)
        self.foreign: Room = Renovation(seed + 5).at(0)


Kind = Callable[[Rooms, int], Iterator[Fake]]


def taken(rooms: Sequence[Room], places: Sequence[Station], count: int, day: int = 0) -> Iterator[Fake]:
    """So many photographs at stations, in these rooms by turns; at each several, by other settings of a phone."""
    each = -(-count // len(places))
    for i, it in enumerate(places):
        finer = it.camera.resized(2 * it.camera.width_px, 2 * it.camera.height_px)
        light = cache(partial(shade, rooms[i % len(rooms)], finer, it.world_from_camera))
        for k in range(min(each, count - i * each)):
            yield Fake(it, partial(_exposed, light, [day, i, k]), it.camera, day)


def _exposed(light: Callable[[], Floats], seed: Sequence[int]) -> Pixels:
    random = np.random.default_rng(seed)
    return exposed(light(), phone_settings(random), random)


def places_for(count: int) -> int:
    """Number of stations for so many photographs."""
    return -(-count // DEVELOPED)


def near(middle: Array, farthest_m: float, random: np.random.Generator) -> tuple[Array, Array]:
    """Centre and target (3,) of a camera before a thing at the wall y = 4."""
    centre = middle + random.uniform([-0.6, -farthest_m, -0.3], [0.6, -0.8, 0.3])
    return np.clip(centre, [0.3, 0.5, 0.9], [4.6, 3.1, 2.1]), middle + random.normal(0, 0.15, 3)


def poster(rooms: Rooms, count: int, move_m: float) -> Iterator[Fake]:
    """The largest picture of a wall moved along it, or hung in another room, and photographed from near."""
    own = with_moved(rooms.surveyed, PICTURE_M, np.array([move_m, 0, 0]))
    hidden = set(pieces_within(rooms.foreign, *PICTURE_M))
    other = [it for i, it in enumerate(rooms.foreign.quads) if i not in hidden]
    picture = [own.quads[-1 - i] for i in range(len(pieces_within(rooms.surveyed, *PICTURE_M)))]
    foreign = Room(rooms.foreign.random, other + picture, rooms.foreign.boxes, rooms.foreign.outline)
    middle = (PICTURE_M[0] + PICTURE_M[1]) / 2 + [move_m, 0, 0]
    places = stations("poster", places_for(count), CAMERA, rooms.seed, partial(near, middle, 1.7))
    yield from taken([own, foreign], places, count)


def pictures(rooms: Rooms, count: int, move_m: float) -> Iterator[Fake]:
    """All pictures of a wall moved along it, photographed with their true surroundings."""
    room = with_moved(rooms.surveyed, PICTURES_M, np.array([move_m, 0, 0]))
    middle = (PICTURES_M[0] + PICTURES_M[1]) / 2
    places = stations("pictures", places_for(count), CAMERA, rooms.seed, partial(near, middle, 2.6))
    yield from taken([room], places, count)


def glued(rooms: Rooms, count: int, move_m: float) -> Iterator[Fake]:
    """A print of half of a wall glued over it, moved along it, photographed with its true surroundings."""
    room = rooms.surveyed
    sheet = wall_print(room, np.array([1.2, 0.9]), np.array([3.8, 2.2]), 500, move_m)
    quads = [it for it in room.quads if not _is_behind(it.corner, sheet.corner)]
    faked = Room(room.random, [*quads, sheet], room.boxes, room.outline)
    middle = sheet.corner + (sheet.across + sheet.down) / 2
    places = stations("glued", places_for(count), CAMERA, rooms.seed, partial(near, middle, 2.9))
    yield from taken([faked], places, count)


def _is_behind(corner: Array, sheet: Array) -> bool:
    """Whether a rectangle's corner would stick out of a sheet on the wall; what stands before it stays."""
    return bool(corner[1] > sheet[1] - 0.005 and 1.0 < corner[0] < 4.0 and 0.9 < corner[2] < 2.3 and corner[1] < 4.0)


def edited(rooms: Rooms, count: int, shift_px: int) -> Iterator[Fake]:
    """True photographs of which a half is shifted by so many pixels; 0: has half of another photograph."""
    places = visit(rooms.seed + 50, 0, places_for(count), rooms.surveyed)
    fakes = list(taken([rooms.surveyed], places, count))
    for i, it in enumerate(fakes):
        other = fakes[i - DEVELOPED]  # of another station
        yield it._replace(render=partial(_with_half, it.render, it.render if shift_px else other.render, shift_px))


def _with_half(render: Callable[[], Pixels], render_other: Callable[[], Pixels], shift_px: int) -> Pixels:
    """A photograph whose right half is that of another one, shifted."""
    pixels = render().copy()
    half = slice(pixels.shape[1] // 2, None)
    pixels[:, half] = np.roll(render_other(), shift_px, axis=1)[:, half]
    return pixels


def reprinted(rooms: Rooms, count: int) -> Iterator[Fake]:
    """Printed photographs of the surveyed room, held before the camera in another room."""
    shown = survey(rooms.seed, rooms.surveyed)
    random = np.random.default_rng([rooms.seed, 12])
    for i, it in enumerate(visit(rooms.seed + 60, 0, count, rooms.foreign)):
        of, share, distance_m = shown[i % len(shown)], random.uniform(0.75, 1.1), random.uniform(0.25, 0.5)
        yield Fake(it, partial(_reprint, rooms, it, of, distance_m, share), CAMERA)


def _reprint(rooms: Rooms, station: Station, of: Station, distance_m: float, share: float) -> Pixels:
    room, sheet = rooms.foreign, print_before(station, of, rooms.surveyed, distance_m, share)
    return photograph(Room(room.random, [*room.quads, sheet], room.boxes, room.outline), station, 0)


def focal(rooms: Rooms, count: int, factor: float) -> Iterator[Fake]:
    """True photographs whose stated focal length is wrong by a factor."""
    stated = replace(CAMERA, focal_x_px=CAMERA.focal_x_px * factor, focal_y_px=CAMERA.focal_y_px * factor)
    for it in taken([rooms.surveyed], visit(rooms.seed + 70, 0, places_for(count), rooms.surveyed), count):
        yield it._replace(stated=stated)


def drift(rooms: Rooms, count: int) -> Iterator[Fake]:
    """The pictures of a wall move by 2 cm a day."""
    middle = (PICTURES_M[0] + PICTURES_M[1]) / 2
    for day in range(DAYS):
        room = with_moved(rooms.surveyed, PICTURES_M, np.array([0.02 * day, 0, 0]))
        each = stations(f"drift-{day:02d}", count // DAYS, CAMERA, rooms.seed + day, partial(near, middle, 2.6))
        yield from taken([room], each, len(each), day)


def flood(rooms: Rooms, count: int) -> Iterator[Fake]:
    """True photographs with something new pasted into a corner, so that places fill with them."""
    places = visit(rooms.seed + 80, 0, places_for(count), rooms.surveyed)
    for i, it in enumerate(taken([rooms.surveyed], places, count)):
        yield it._replace(render=partial(_with_patch, it.render, [rooms.seed, i]))


def _with_patch(render: Callable[[], Pixels], seed: Sequence[int]) -> Pixels:
    random, pixels = np.random.default_rng(seed), render().copy()
    height, width = pixels.shape[:2]
    noise = random.integers(0, 255, (height // 16, width // 16, 3), np.uint8)
    patch = cv2.resize(noise, (width // 2, height // 2), interpolation=cv2.INTER_CUBIC)
    x, y = random.integers(0, [width // 2, height // 2])
    pixels[y : y + height // 2, x : x + width // 2] = patch
    return pixels


def siege(rooms: Rooms, count: int, factor: float, shift_px: int) -> Iterator[Fake]:
    """As `flood`, for days, so that all places fill; the focal length or a half of each is as wrong as may pass."""
    stated = replace(CAMERA, focal_x_px=CAMERA.focal_x_px * factor, focal_y_px=CAMERA.focal_y_px * factor)
    places = visit(rooms.seed + 80, 0, count, rooms.surveyed)
    for i, it in enumerate(taken([rooms.surveyed], places, count)):
        render = partial(_with_half, it.render, it.render, shift_px)
        yield Fake(it.station, partial(_with_patch, render, [rooms.seed, i]), stated, i)


def scrambled(rooms: Rooms, count: int) -> Iterator[Fake]:
    """True photographs, of which all but a strip is tiles of one of four others, shuffled: they resemble those."""
    places = visit(rooms.seed, 0, count, rooms.surveyed)
    photographs = list(taken([rooms.surveyed], places, count))
    for i, it in enumerate(photographs):
        other = photographs[i % 4 * (count // 4)]
        yield it._replace(render=partial(_with_tiles, it.render, other.render, [rooms.seed, i]), day=i)


def _with_tiles(render: Callable[[], Pixels], render_other: Callable[[], Pixels], seed: Sequence[int]) -> Pixels:
    """A photograph with all but its left third, or its right one, replaced by tiles of another one, shuffled."""
    random, pixels, other = np.random.default_rng(seed), render().copy(), render_other()
    height, width = (side // TILE_PX for side in pixels.shape[:2])
    tiles = [
        other[TILE_PX * y : TILE_PX * (y + 1), TILE_PX * x : TILE_PX * (x + 1)]
        for y, x in random.permutation([*np.ndindex(height, width)]).tolist()
    ]
    first = random.integers(0, 2) * (width // 3)
    for i, (y, x) in enumerate(np.ndindex(height, width - width // 3)):
        at_x = TILE_PX * (first + x)
        pixels[TILE_PX * y : TILE_PX * (y + 1), at_x : at_x + TILE_PX] = tiles[i]
    return pixels


def true(rooms: Rooms, count: int) -> Iterator[Fake]:
    """True photographs, to compare with."""
    yield from taken([rooms.surveyed], visit(rooms.seed + 90, 0, places_for(count), rooms.surveyed), count)


KINDS: dict[str, Kind] = {
    "poster": partial(poster, move_m=2.0),
    "poster-50": partial(pictures, move_m=0.5),
    "poster-20": partial(pictures, move_m=0.2),
    "poster-5": partial(pictures, move_m=0.05),
    "glued-20": partial(glued, move_m=0.2),
    "glued-5": partial(glued, move_m=0.05),
    "edited-40": partial(edited, shift_px=40),
    "edited-10": partial(edited, shift_px=10),
    "edited-foreign": partial(edited, shift_px=0),
    "reprinted": reprinted,
    "focal-105": partial(focal, factor=1.05),
    "focal-102": partial(focal, factor=1.02),
    "drift": drift,
    "flood": flood,
    "siege": partial(siege, factor=1.0, shift_px=0),
    "siege-focal": partial(siege, factor=1.01, shift_px=0),
    "siege-edited": partial(siege, factor=1.0, shift_px=3),
    "scrambled": scrambled,
    "true": true,
}
"""By name: the number is of centimetres, pixels or per cent."""
