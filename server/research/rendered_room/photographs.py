"""Where the cameras stand, what they see exactly, and what they do to the light.

For a rectangle in the camera frame, x(u, v) = corner + u across + v down, and a pixel p = (x, y, 1),

    (u, v, 1) / depth = [across | down | corner]^-1 K^-1 p,

so u / depth, v / depth and 1 / depth are linear in the pixel, and nothing is approximate but the filtering of textures.
"""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, RigidTransform, rotation_from_vector

from .furniture import Quad, Room

Floats = NDArray[np.float32]
REFERENCE_CAMERA = Camera(960, 720, 816.0, 816.0, 482.6, 357.1)
QUERY_CAMERA = Camera(960, 720, 774.0, 774.0, 476.2, 361.8)
"""Another phone than the references': about as wide, but not the same."""
NEAR_M = 0.02
"""Surfaces closer than this are not drawn."""


class Station(NamedTuple):
    """Where a photograph is taken; its name is also a legal reference id."""

    name: str
    camera: Camera
    world_from_camera: RigidTransform


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
        target = random.uniform([1.2, 1.0, 0.5], [3.8, 3.2, 1.5])
        if np.linalg.norm(target - centre) < 1.0 or any(box.gap_m(centre) < 0.25 for box in room.boxes):
            continue
        pose = look_at(centre, target, random.normal(0, 10))
        inverse_depth, _ = cast(room, QUERY_CAMERA.resized(96, 72), pose)
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


def cast(room: Room, camera: Camera, world_from_camera: RigidTransform) -> tuple[Floats, NDArray[np.int16]]:
    """For every pixel centre, (H, W): 1 / depth in metres, and the index of the nearest rectangle."""
    inverse_depth = np.zeros((camera.height_px, camera.width_px), np.float32)
    nearest = np.full(inverse_depth.shape, -1, np.int16)
    for index, quad in enumerate(room.quads):
        if quad.normal() @ (world_from_camera.translation - quad.corner) < 1e-4:  # from behind, or edge-on
            continue
        window = _window(quad, camera, world_from_camera)
        y, x = (it.astype(np.float32) for it in np.ogrid[window])
        matrix = uvw_from_pixel(quad, camera, world_from_camera).astype(np.float32)
        u, v, w = (row[0] * x + (row[1] * y + row[2]) for row in matrix)
        nearer = (w > inverse_depth[window]) & (w < 1 / NEAR_M) & (u >= 0) & (u <= w) & (v >= 0) & (v <= w)
        np.copyto(inverse_depth[window], w, where=nearer)
        nearest[window][nearer] = index
    return inverse_depth, nearest


def _window(quad: Quad, camera: Camera, world_from_camera: RigidTransform) -> tuple[slice, slice]:
    """Rows and columns in which the rectangle may be seen."""
    size = np.array([camera.width_px, camera.height_px])
    ends = quad.corner + np.array([0 * quad.down, quad.down, quad.across, quad.down + quad.across])
    ends = world_from_camera.inverse().apply(ends)
    if ends[:, 2].min() < NEAR_M:  # it may be anywhere
        return slice(0, int(size[1])), slice(0, int(size[0]))
    pixels = camera.project(ends)
    low, high = np.floor(pixels.min(axis=0)).clip(0, size), np.ceil(pixels.max(axis=0) + 1).clip(0, size)
    return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))


def uvw_from_pixel(quad: Quad, camera: Camera, world_from_camera: RigidTransform) -> Array:
    """Matrix (3, 3) from pixels (x, y, 1) to (u, v, 1) / depth."""
    parts = np.stack([quad.across, quad.down, quad.corner - world_from_camera.translation], axis=-1)
    return np.asarray(np.linalg.inv(camera.matrix() @ world_from_camera.rotation.T @ parts), float)


def shade(room: Room, camera: Camera, world_from_camera: RigidTransform) -> Floats:
    """Radiance (H, W, 3) at every pixel centre, linear, 0 to 1; of each texture the level that suits the distance."""
    _, nearest = cast(room, camera, world_from_camera)
    image = np.zeros((*nearest.shape, 3), np.float32)
    order = np.argsort(nearest, axis=None, kind="stable")  # pixels of one rectangle together
    found, starts = np.unique(nearest.ravel()[order], return_index=True)
    for index, pixels in zip(found.tolist(), np.split(order, starts[1:]), strict=True):
        if index < 0:  # beyond the sky outside the window
            continue
        quad = room.quads[index]
        y, x = np.divmod(pixels, camera.width_px)
        matrix = uvw_from_pixel(quad, camera, world_from_camera)
        u, v, w = (row[0] * x + (row[1] * y + row[2]) for row in matrix)
        # The Jacobian of a homography has determinant det(M) / w^3: texels per pixel, as an area.
        texels = abs(float(np.linalg.det(matrix))) * quad.levels[0].shape[0] * quad.levels[0].shape[1] / w**3
        level = np.clip(np.rint(0.5 * np.log2(texels)), 0, len(quad.levels) - 1)
        for k in np.unique(level).astype(int).tolist():
            at = np.flatnonzero(level == k)
            h, width = quad.levels[k].shape[:2]
            # (0, 0) is the corner of the texture, and a texel's centre lies half a texel inside.
            shape = (-(-len(at) // 1024), 1024)  # remap wants images, not lists
            column = np.resize(u[at] / w[at] * width - 0.5, shape).astype(np.float32)
            line = np.resize(v[at] / w[at] * h - 0.5, shape).astype(np.float32)
            colours = cv2.remap(quad.levels[k], column, line, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            image[y[at], x[at]] = colours.reshape(-1, 3)[: len(at)]
    return image


class Settings(NamedTuple):
    """A phone's effects on light: blur in pixels, exposure in stops, gains of red and blue, factor of noise."""

    blur_px: float
    stops: float
    red: float
    blue: float
    noise: float = 1.0


def phone_settings(random: np.random.Generator) -> Settings:
    """Random settings of a phone."""
    return Settings(
        random.uniform(0.5, 1.0), random.normal(0, 0.45), 1 + random.normal(0, 0.08), 1 + random.normal(0, 0.08)
    )


def photograph(room: Room, station: Station, seed: int) -> NDArray[np.uint8]:
    """(H, W, 3) sRGB, four rays a pixel, with random settings of a phone."""
    random = np.random.default_rng([seed, 1, *station.name.encode()])
    settings = phone_settings(random)
    return developed(room, station, settings, random)


def developed(room: Room, station: Station, settings: Settings, random: np.random.Generator) -> NDArray[np.uint8]:
    """(H, W, 3) sRGB, four rays a pixel, with what a phone does to the light."""
    camera = station.camera.resized(2 * station.camera.width_px, 2 * station.camera.height_px)
    return exposed(shade(room, camera, station.world_from_camera), settings, random)


def exposed(radiance: Floats, settings: Settings, random: np.random.Generator) -> NDArray[np.uint8]:
    """(H, W, 3) sRGB of radiance at four rays a pixel (2 H, 2 W, 3): blur, exposure, vignetting, noise."""
    h, w = radiance.shape[0] // 2, radiance.shape[1] // 2
    radiance = np.asarray(cv2.resize(radiance, (w, h), interpolation=cv2.INTER_AREA), np.float32)
    light = np.asarray(cv2.GaussianBlur(radiance, (0, 0), settings.blur_px), np.float32)
    gain = 0.24 / float(np.mean(np.minimum(light, 0.8))) * 2**settings.stops
    gains = gain * np.array([settings.red, 1, settings.blue])  # white balance
    y, x = np.linspace(-1, 1, h, dtype=np.float32), np.linspace(-1, 1, w, dtype=np.float32)
    lost = 0.15 * (x[None, :] ** 2 + y[:, None] ** 2)
    light = light * (1 - lost[..., None]).astype(np.float32) * gains.astype(np.float32)
    deviation = settings.noise * np.sqrt(0.03**2 * np.clip(light, 0, 1) + 0.006**2)
    light = np.clip(light + random.standard_normal(light.shape, np.float32) * deviation, 0, 1)
    screen = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.asarray(screen * 255 + 0.5, np.uint8)


def visible_edges(room: Room, station: Station) -> list[Array]:
    """Those parts (2, 3) of the outline that nothing hides from a camera, by pieces of 2 cm."""
    camera, pose = station.camera, station.world_from_camera
    inverse_depth, _ = cast(room, camera, pose)
    last_px = [camera.width_px - 1, camera.height_px - 1]
    parts = []
    for a, b in room.outline:
        cuts = np.linspace(a, b, max(int(np.ceil(np.linalg.norm(b - a) / 0.02)), 1) + 1)
        middle = pose.inverse().apply((cuts[:-1] + cuts[1:]) / 2)
        pixels = camera.project(middle)
        inside = np.asarray(((pixels >= 0) & (pixels <= last_px)).all(axis=-1))
        columns, lines = np.where(inside[:, None], np.round(pixels), 0).astype(int).T
        seen = inverse_depth[lines, columns]
        # An edge lies on the border between what it belongs to and what is behind: 2 cm and 1 % forgive the wrong side.
        visible = inside & (1 / middle[:, 2] > seen * 0.99 - 0.02 * seen**2)
        changes = np.flatnonzero(np.diff(np.pad(visible.astype(int), 1)))
        parts += [cuts[[start, end]] for start, end in changes.reshape(-1, 2)]
    return parts
