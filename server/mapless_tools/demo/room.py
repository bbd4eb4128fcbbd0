"""Photographs of the rendered room: where the cameras stand, what they do to the light, and what is known exactly."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapless.geometry import Array, Camera, RigidTransform, rotation_from_vector

from .builder import Room
from .furniture import ROOM_M, furnish, lamps
from .light import Box, light_room
from .raycast import Surface, cast, shade

REFERENCE_CAMERA = Camera(960, 720, 816.0, 816.0, 482.6, 357.1)
QUERY_CAMERA = Camera(960, 720, 774.0, 774.0, 476.2, 361.8)
"""Another phone than the references': about as wide, but not the same."""

AMBIENT = np.array([0.30, 0.31, 0.33])
CLEARANCE_M = 0.25
"""Free space around every camera."""


@dataclass(frozen=True, eq=False)
class Photo:
    """A rendered photograph and its truth.

    Attributes:
        name: also a legal reference id.
        image: (H, W, 3) uint8 RGB.
        camera: pinhole.
        world_from_camera: exact.
        depth_m: (H, W) float32 along the optical axis at pixel centres; 0 where nothing is.
    """

    name: str
    image: NDArray[np.uint8]
    camera: Camera
    world_from_camera: RigidTransform
    depth_m: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Station:
    """Where a photograph is to be taken."""

    name: str
    camera: Camera
    world_from_camera: RigidTransform


@dataclass(frozen=True)
class CameraEffects:
    """What a phone does to the light on its way to a JPEG.

    Attributes:
        exposure_stops: spread of the exposure error around the automatic one, standard deviation, powers of two.
        white_balance: spread of the gains of red and blue.
        vignetting: light lost in the corners.
        blur_px: range of the lens blur's standard deviation.
        shot_noise: noise's standard deviation at full white, share of white; it falls with the root of the light.
        read_noise: the same in the dark.
    """

    exposure_stops: float = 0.45
    white_balance: float = 0.08
    vignetting: float = 0.3
    blur_px: tuple[float, float] = (0.5, 1.0)
    shot_noise: float = 0.03
    read_noise: float = 0.006


def render_room(seed: int = 0, reference_count: int = 16, query_count: int = 8) -> tuple[list[Photo], list[Photo]]:
    """References from a walk around the table, and queries from elsewhere in the room.

    Args:
        seed: furniture, textures, queries and noise all follow from it.
        reference_count: photographs along the walk; 16 are about 0.55 m apart.
        query_count: photographs off the walk, at other heights, headings and tilts, with another camera.

    Returns:
        references, queries.
    """
    _, surfaces = _lit_room(seed)
    stations = walk(seed, reference_count) + scatter(seed, query_count)
    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:  # a photograph takes 200 MB while it is made
        photos = list(pool.map(lambda station: take(surfaces, station, seed), stations))
    return photos[:reference_count], photos[reference_count:]


def room_outline(seed: int = 0) -> Array:
    """Edges of the room and its larger furniture, (E, 2, 3) world, metres: the true structure, for drawing."""
    return np.array(_lit_room(seed)[0].outline)


def visible_outline(seed: int, camera: Camera, world_from_camera: RigidTransform, piece_m: float = 0.02) -> Array:
    """Those pieces of the outline, (S, 2, 3), that nothing hides from a camera."""
    edges = room_outline(seed)
    counts = np.maximum(np.ceil(np.linalg.norm(edges[:, 1] - edges[:, 0], axis=-1) / piece_m), 1).astype(int)
    cuts = [np.linspace(a, b, n + 1) for (a, b), n in zip(edges, counts, strict=True)]
    pieces = np.concatenate([np.stack([cut[:-1], cut[1:]], axis=1) for cut in cuts])
    middle = world_from_camera.inverse().apply(pieces.mean(axis=1))
    pixels = camera.project(middle)
    inside = ((pixels >= 0) & (pixels <= [camera.width_px - 1, camera.height_px - 1])).all(axis=-1)
    pieces, depth = pieces[inside], middle[inside, 2]
    columns, rows = np.round(pixels[inside]).astype(int).T
    seen = cast(_lit_room(seed)[0].quads, camera, world_from_camera).inverse_depth[rows, columns]
    # An edge lies on the border between what it belongs to and what is behind: 2 cm and 1 % forgive the wrong side.
    return np.asarray(pieces[1 / depth > seen * 0.99 - 0.02 * seen**2])


@lru_cache(maxsize=1)
def _lit_room(seed: int) -> tuple[Room, list[Surface]]:
    room = furnish(np.random.default_rng([seed, 0]))
    return room, light_room(room.quads, room.boxes, ROOM_M, lamps(), AMBIENT)


def take(surfaces: Sequence[Surface], station: Station, seed: int = 0, effects: CameraEffects | None = None) -> Photo:
    """One photograph: four rays a pixel for the light, one through its centre for the depth."""
    camera, pose = station.camera, station.world_from_camera
    fine = camera.resized(2 * camera.width_px, 2 * camera.height_px)
    quads = [surface.quad for surface in surfaces]
    radiance = shade(surfaces, cast(quads, fine, pose), fine, pose)
    size = (camera.width_px, camera.height_px)
    radiance = np.asarray(cv2.resize(radiance, size, interpolation=cv2.INTER_AREA), np.float32)
    random = np.random.default_rng([seed, 1, *station.name.encode()])
    inverse_depth = cast(quads, camera, pose).inverse_depth
    depth = np.divide(1, inverse_depth, out=np.zeros_like(inverse_depth), where=inverse_depth > 0)
    return Photo(station.name, expose(random, radiance, effects or CameraEffects()), camera, pose, depth)


def expose(random: np.random.Generator, radiance: NDArray[np.float32], effects: CameraEffects) -> NDArray[np.uint8]:
    """Linear radiance (H, W, 3) to an image (H, W, 3) uint8 sRGB, with all that a small camera adds."""
    h, w = radiance.shape[:2]
    light = np.asarray(cv2.GaussianBlur(radiance, (0, 0), random.uniform(*effects.blur_px)), np.float32)
    gain = 0.24 / float(np.mean(np.minimum(light, 0.8))) * 2 ** random.normal(0, effects.exposure_stops)
    gains = gain * np.array(
        [1 + random.normal(0, effects.white_balance), 1, 1 + random.normal(0, effects.white_balance)]
    )
    y, x = np.linspace(-1, 1, h, dtype=np.float32), np.linspace(-1, 1, w, dtype=np.float32)
    corners = effects.vignetting / 2 * (x[None, :] ** 2 + y[:, None] ** 2)
    light = light * (1 - corners[..., None]).astype(np.float32) * gains.astype(np.float32)
    deviation = np.sqrt(effects.shot_noise**2 * np.clip(light, 0, 1) + effects.read_noise**2)
    light = np.clip(light + random.standard_normal(light.shape, np.float32) * deviation, 0, 1)
    screen = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.asarray(screen * 255 + 0.5, np.uint8)


def walk(seed: int, count: int) -> list[Station]:
    """Stations around the table at eye height, looking across it and a little ahead."""
    random = np.random.default_rng([seed, 2])
    stations = []
    for i, angle in enumerate(np.arange(count) * 2 * np.pi / count):
        centre = np.array([2.45 + 1.65 * np.cos(angle), 2.0 + 1.25 * np.sin(angle), 1.5]) + random.normal(0, 0.04, 3)
        ahead = angle + np.radians(25)
        target = np.array([2.45 - 1.5 * np.cos(ahead), 2.0 - 1.2 * np.sin(ahead), 1.0]) + random.normal(0, 0.1, 3)
        stations.append(Station(f"reference-{i:02d}", REFERENCE_CAMERA, look_at(centre, target, random.normal(0, 2))))
    return stations


def scatter(seed: int, count: int) -> list[Station]:
    """Stations anywhere in the room that is free, with something to see: nothing close fills the picture."""
    random = np.random.default_rng([seed, 3])
    room, _ = _lit_room(seed)
    small = QUERY_CAMERA.resized(96, 72)
    stations: list[Station] = []
    while len(stations) < count:
        centre = random.uniform([0.5, 0.5, 0.9], [4.4, 3.5, 2.0])
        if _blocked(centre, room.boxes):
            continue
        target = random.uniform([1.2, 1.0, 0.5], [3.8, 3.2, 1.5])
        if np.linalg.norm(target - centre) < 1.0:
            continue
        pose = look_at(centre, target, random.normal(0, 10))
        inverse_depth = cast(room.quads, small, pose).inverse_depth
        if (inverse_depth > 1 / 0.8).mean() < 0.05 and np.median(inverse_depth) < 1 / 1.8:
            stations.append(Station(f"query-{len(stations):02d}", QUERY_CAMERA, pose))
    return stations


def _blocked(centre: Array, boxes: Sequence[Box]) -> bool:
    """Whether a camera there would touch the furniture."""
    for box in boxes:
        local = np.abs((centre - box.centre) @ box.world_from_box())
        if np.linalg.norm(np.maximum(local - box.size / 2, 0)) < CLEARANCE_M:
            return True
    return False


def look_at(centre: ArrayLike, target: ArrayLike, roll_deg: float = 0.0) -> RigidTransform:
    """``world_from_camera`` in a world whose z axis points up; positive roll turns the camera clockwise."""
    centre = np.asarray(centre, float)
    ahead = np.asarray(target, float) - centre
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    level = np.stack([right, np.cross(ahead, right), ahead], axis=-1)
    return RigidTransform(level @ rotation_from_vector([0.0, 0.0, np.radians(roll_deg)]), centre)


def write_folder(path: Path, photos: Sequence[Photo], source: str, jpeg_quality: int = 92) -> None:
    """Write photographs as ``images/*.jpg`` and ``cameras.json``, the format that `dataset.read_folder` reads."""
    (path / "images").mkdir(parents=True, exist_ok=True)
    frames = []
    for photo in photos:
        (path / "images" / f"{photo.name}.jpg").write_bytes(jpeg(photo.image, jpeg_quality))
        frames.append(
            {
                "image": f"images/{photo.name}.jpg",
                "width": photo.camera.width_px,
                "height": photo.camera.height_px,
                "K": photo.camera.matrix().tolist(),
                "dist": None,
                "world_from_camera": photo.world_from_camera.matrix().tolist(),
            }
        )
    about = {"source": source, "license": "Apache-2.0", "metric": True, "units": "metre"}
    (path / "cameras.json").write_text(json.dumps({**about, "frames": frames}, indent=1))


def jpeg(image: NDArray[np.uint8], quality: int = 92) -> bytes:
    """The bytes of a JPEG file of an RGB image (H, W, 3)."""
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, quality])
    return bytes(data)
