"""Where the cameras stand, and what they do to the light."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, RigidTransform, rotation_from_vector

from .furniture import Room, furnish
from .rendering import Surface, cast, light_room, shade

REFERENCE_CAMERA = Camera(960, 720, 816.0, 816.0, 482.6, 357.1)
QUERY_CAMERA = Camera(960, 720, 774.0, 774.0, 476.2, 361.8)
"""Another phone than the references': about as wide, but not the same."""


class Station(NamedTuple):
    """Where a photograph is taken; its name is also a legal reference id."""

    name: str
    camera: Camera
    world_from_camera: RigidTransform


def lit_room(seed: int) -> tuple[Room, list[Surface]]:
    """The furnished and lit room."""
    room = furnish(np.random.default_rng([seed, 0]))
    return room, light_room(room)


def walk(seed: int, count: int) -> list[Station]:
    """Stations around the table at eye height, looking across it and a little ahead; 16 are about 0.55 m apart."""
    random = np.random.default_rng([seed, 2])
    stations = []
    for i, angle in enumerate(np.arange(count) * 2 * np.pi / count):
        centre = np.array([2.45 + 1.65 * np.cos(angle), 2.0 + 1.25 * np.sin(angle), 1.5]) + random.normal(0, 0.04, 3)
        ahead = angle + np.radians(25)
        target = np.array([2.45 - 1.5 * np.cos(ahead), 2.0 - 1.2 * np.sin(ahead), 1.0]) + random.normal(0, 0.1, 3)
        stations.append(Station(f"reference-{i:02d}", REFERENCE_CAMERA, look_at(centre, target, random.normal(0, 2))))
    return stations


def scatter(seed: int, count: int, room: Room) -> list[Station]:
    """Stations anywhere in the room that is free, with something to see: nothing close fills the picture."""
    random = np.random.default_rng([seed, 3])
    stations: list[Station] = []
    while len(stations) < count:
        centre = random.uniform([0.5, 0.5, 0.9], [4.4, 3.5, 2.0])
        local = [np.abs((centre - box.centre) @ box.world_from_box()) - box.size / 2 for box in room.boxes]
        if any(np.linalg.norm(np.maximum(it, 0)) < 0.25 for it in local):  # would touch the furniture
            continue
        target = random.uniform([1.2, 1.0, 0.5], [3.8, 3.2, 1.5])
        if np.linalg.norm(target - centre) < 1.0:
            continue
        pose = look_at(centre, target, random.normal(0, 10))
        inverse_depth, _ = cast(room.quads, QUERY_CAMERA.resized(96, 72), pose)
        if (inverse_depth > 1 / 0.8).mean() < 0.05 and np.median(inverse_depth) < 1 / 1.8:
            stations.append(Station(f"query-{len(stations):02d}", QUERY_CAMERA, pose))
    return stations


def look_at(centre: Array, target: Array, roll_deg: float) -> RigidTransform:
    """``world_from_camera`` in a world whose z axis points up; positive roll turns the camera clockwise."""
    ahead = target - centre
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    level = np.stack([right, np.cross(ahead, right), ahead], axis=-1)
    return RigidTransform(level @ rotation_from_vector([0.0, 0.0, np.radians(roll_deg)]), centre)


def photograph(surfaces: Sequence[Surface], station: Station, seed: int) -> NDArray[np.uint8]:
    """(H, W, 3) sRGB, four rays a pixel, with what a phone does to the light: blur, exposure, vignetting, noise."""
    w, h = station.camera.width_px, station.camera.height_px
    random = np.random.default_rng([seed, 1, *station.name.encode()])
    radiance = shade(surfaces, station.camera.resized(2 * w, 2 * h), station.world_from_camera)
    radiance = np.asarray(cv2.resize(radiance, (w, h), interpolation=cv2.INTER_AREA), np.float32)
    light = np.asarray(cv2.GaussianBlur(radiance, (0, 0), random.uniform(0.5, 1.0)), np.float32)
    gain = 0.24 / float(np.mean(np.minimum(light, 0.8))) * 2 ** random.normal(0, 0.45)
    gains = gain * np.array([1 + random.normal(0, 0.08), 1, 1 + random.normal(0, 0.08)])  # white balance
    y, x = np.linspace(-1, 1, h, dtype=np.float32), np.linspace(-1, 1, w, dtype=np.float32)
    lost = 0.15 * (x[None, :] ** 2 + y[:, None] ** 2)
    light = light * (1 - lost[..., None]).astype(np.float32) * gains.astype(np.float32)
    deviation = np.sqrt(0.03**2 * np.clip(light, 0, 1) + 0.006**2)
    light = np.clip(light + random.standard_normal(light.shape, np.float32) * deviation, 0, 1)
    screen = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.asarray(screen * 255 + 0.5, np.uint8)


def visible_edges(room: Room, station: Station) -> list[Array]:
    """Those parts (2, 3) of the outline that nothing hides from a camera, by pieces of 2 cm."""
    camera, pose = station.camera, station.world_from_camera
    inverse_depth, _ = cast(room.quads, camera, pose)
    last_px = [camera.width_px - 1, camera.height_px - 1]
    parts = []
    for a, b in room.outline:
        cuts = np.linspace(a, b, max(int(np.ceil(np.linalg.norm(b - a) / 0.02)), 1) + 1)
        middle = pose.inverse().apply((cuts[:-1] + cuts[1:]) / 2)
        pixels = camera.project(middle)
        inside = np.asarray(((pixels >= 0) & (pixels <= last_px)).all(axis=-1))
        columns, rows = np.where(inside[:, None], np.round(pixels), 0).astype(int).T
        seen = inverse_depth[rows, columns]
        # An edge lies on the border between what it belongs to and what is behind: 2 cm and 1 % forgive the wrong side.
        visible = inside & (1 / middle[:, 2] > seen * 0.99 - 0.02 * seen**2)
        changes = np.flatnonzero(np.diff(np.pad(visible.astype(int), 1)))
        parts += [cuts[[start, end]] for start, end in changes.reshape(-1, 2)]
    return parts
