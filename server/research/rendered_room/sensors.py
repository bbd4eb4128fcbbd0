"""Depth images as sensors would measure them where the exact depth is known.

Each model begins with exact depths. All in an image have one factor, as wrong as its kind of sensor is (`common` of
`mapless.depth.NOISE`), and less of it that varies over the image. Every image has a factor of its own, as if it were of
another device, so that radii are tried with many. Then come the errors that are typical of the kind:

* structured light (Kinect v1, Xtion; Nguyen, Izadi and Lovell 2012; Khoshelham and Elberink 2012): noise that grows
  with the square of the depth and at grazing angles, edges uncertain by 0.8 pixels, steps of an eighth of a pixel of
  disparity, no depth in the projector's shadow, at grazing angles, or outside 0.5 to 5 m;
* time of flight: a bias that varies slowly over the image, noise by the returned light, pixels between the two surfaces
  of an edge;
* stereo (Grunnet-Jepsen et al., Tuning depth cameras for best performance): errors of disparity that neighbours share,
  foregrounds too large by two pixels, no depth where one camera sees nothing, a few blocks that are matched wrongly;
* LiDAR of a phone: a grid of few true depths, made dense: smooth errors, edges that bleed over one to two pixels, a
  value everywhere.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.depth import NOISE, DepthSensor
from mapless.geometry import Array, Camera, RigidTransform

from .furniture import Room
from .photographs import cast

BEND_SHARE = 0.3
"""Standard deviation of what varies over an image, as a share of the factor's. Chosen."""
MAX_GRAZING_DEG = 78.0
"""Structured light beyond it does not come back."""
SHADOW_PX = 1.5
"""Disparity by which another surface must be nearer to hide a pixel from the second eye."""
WRONG_BLOCKS, BLOCK_PX = 0.003, 8
"""Share of stereo's blocks that are matched wrongly, and their side. Chosen."""


@dataclass(frozen=True, eq=False)
class Scan:
    """Exact depths as a camera sees them.

    Attributes:
        camera: pinhole camera.
        depth_m: (H, W) along the viewing direction.
        incidence_deg: (H, W) angle between the ray and the normal of the surface.
        is_surface: (H, W) whether there is something that light comes back from; the sky is nothing.
    """

    camera: Camera
    depth_m: Array
    incidence_deg: Array
    is_surface: NDArray[np.bool_]

    @staticmethod
    def of(room: Room, camera: Camera, world_from_camera: RigidTransform) -> "Scan":
        """The room as a camera sees it."""
        inverse_depth, quad = cast(room, camera, world_from_camera)
        pixels = np.indices(quad.shape)[::-1].reshape(2, -1).T.astype(float)
        rays = camera.rays(pixels) @ world_from_camera.rotation.T
        normals = np.array([it.normal() for it in room.quads])[quad.ravel()]
        cosine = np.abs((rays * normals).sum(axis=1)) / np.linalg.norm(rays, axis=1)
        is_sky = np.array([it.corner[0] < -1 for it in room.quads])
        angle = np.degrees(np.arccos(np.minimum(cosine, 1.0))).reshape(quad.shape)
        return Scan(camera, 1 / inverse_depth.astype(float), angle, (quad >= 0) & ~is_sky[quad])


def measured(sensor: DepthSensor, scan: Scan, random: np.random.Generator) -> NDArray[np.uint16]:
    """The values (H, W) that a sensor gives, millimetres, 0 for none."""
    depth_m = MODELS[sensor](scan, random)
    usable = np.isfinite(depth_m) & (depth_m > 0) & (depth_m < 65.0)
    return np.asarray(np.rint(1000 * np.where(usable, depth_m, 0.0)), np.uint16)


def structured_light(scan: Scan, random: np.random.Generator, baseline_m: float = 0.075) -> Array:
    """Depths (H, W) of a Kinect v1 or Xtion, NaN for none; its projector is to the left of the camera."""
    near_m, far_m, step_px, lateral_px = 0.5, 5.0, 1 / 8, 0.8
    depth, angle = scan.depth_m, np.radians(scan.incidence_deg)
    is_seen = scan.is_surface & ~_is_hidden(scan, -baseline_m) & (scan.incidence_deg < MAX_GRAZING_DEG)
    shifts = np.rint(random.normal(0.0, lateral_px, (2, *depth.shape))).astype(int)
    rows, columns = np.indices(depth.shape) + shifts
    beside = rows.clip(0, depth.shape[0] - 1), columns.clip(0, depth.shape[1] - 1)
    z, is_seen, angle = depth[beside], is_seen & is_seen[beside], angle[beside]
    grazing = np.minimum(angle, np.radians(MAX_GRAZING_DEG))
    sigma = 0.0012 + 0.0019 * (z - 0.4) ** 2 + 0.0001 / np.sqrt(z) * (grazing / (np.pi / 2 - grazing)) ** 2
    z = z * _factors(DepthSensor.STRUCTURED_LIGHT, z.shape, random) + sigma * random.standard_normal(z.shape)
    disparity_px = np.rint(scan.camera.focal_x_px * baseline_m / z / step_px) * step_px
    z = scan.camera.focal_x_px * baseline_m / np.maximum(disparity_px, step_px)
    return np.asarray(np.where(is_seen & (z > near_m) & (z < far_m), z, np.nan))


def time_of_flight(scan: Scan, random: np.random.Generator) -> Array:
    """Depths (H, W) of a camera with modulated light, NaN for none."""
    far_m, bias_m, mixed_px, max_deg = 5.5, 0.005, 0.5, 85.0
    z = _blurred(scan.depth_m, mixed_px)
    cosine = np.cos(np.radians(np.minimum(scan.incidence_deg, max_deg)))
    sigma = 0.0015 + 0.001 * z**2 / np.sqrt(cosine)
    bias = bias_m * _smooth(z.shape, (6, 8), random)
    z = z * _factors(DepthSensor.TIME_OF_FLIGHT, z.shape, random) + bias + sigma * random.standard_normal(z.shape)
    return np.asarray(np.where(scan.is_surface & (scan.incidence_deg < max_deg) & (z < far_m), z, np.nan))


def stereo(scan: Scan, random: np.random.Generator, baseline_m: float = 0.05) -> Array:
    """Depths (H, W) of a pair of cameras, the second to the right, NaN for none."""
    window_px, step_px, shared_px = 5, 1 / 32, 2.0
    focal_m = scan.camera.focal_x_px * baseline_m
    disparity_px = np.asarray(cv2.dilate(focal_m / scan.depth_m, np.ones((window_px, window_px))), np.float64)
    sigma_px = NOISE[DepthSensor.STEREO].quadratic_per_m * focal_m
    white = _blurred(random.standard_normal(disparity_px.shape), shared_px)
    disparity_px = disparity_px + sigma_px * white / white.std()
    height, width = disparity_px.shape
    blocks = random.random((-(-height // BLOCK_PX), -(-width // BLOCK_PX))) < WRONG_BLOCKS
    is_wrong = np.kron(blocks, np.ones((BLOCK_PX, BLOCK_PX), bool))[:height, :width]
    disparity_px[is_wrong] = random.uniform(1.0, 60.0, int(is_wrong.sum()))
    disparity_px = np.rint(disparity_px / step_px) * step_px
    is_beside = np.arange(width) < disparity_px
    z = focal_m / np.maximum(disparity_px, step_px) * _factors(DepthSensor.STEREO, disparity_px.shape, random)
    return np.asarray(np.where(scan.is_surface & ~is_beside & ~_is_hidden(scan, baseline_m), z, np.nan))


def phone_lidar(scan: Scan, random: np.random.Generator) -> Array:
    """Depths (H, W) of a phone, which have no gap."""
    bleeding_px, dots = 0.8, (18, 24)
    noise = NOISE[DepthSensor.PHONE_LIDAR]
    z = _blurred(scan.depth_m, bleeding_px)
    z = z * _factors(DepthSensor.PHONE_LIDAR, z.shape, random)
    return np.asarray(z + noise.sigma_m(z) * _smooth(z.shape, dots, random))


def rendered(scan: Scan, random: np.random.Generator) -> Array:
    """The exact depths (H, W)."""
    return scan.depth_m


MODELS: Mapping[DepthSensor, Callable[[Scan, np.random.Generator], Array]] = {
    DepthSensor.RENDERED: rendered,
    DepthSensor.STRUCTURED_LIGHT: structured_light,
    DepthSensor.TIME_OF_FLIGHT: time_of_flight,
    DepthSensor.STEREO: stereo,
    DepthSensor.PHONE_LIDAR: phone_lidar,
}


def _factors(sensor: DepthSensor, shape: tuple[int, ...], random: np.random.Generator) -> Array:
    """Factors (H, W) on the depths of an image."""
    common = NOISE[sensor].common
    return np.asarray(np.exp(common * (random.standard_normal() + BEND_SHARE * _smooth(shape, (3, 4), random))))


def _smooth(shape: tuple[int, ...], grid: tuple[int, int], random: np.random.Generator) -> Array:
    """Noise (H, W) of unit deviation at the nodes of a grid, which varies smoothly between them."""
    height, width = shape
    return np.asarray(cv2.resize(random.standard_normal(grid), (width, height), interpolation=cv2.INTER_CUBIC))


def _blurred(values: Array, sigma_px: float) -> Array:
    return np.asarray(cv2.GaussianBlur(values, (0, 0), sigma_px), np.float64)


def _is_hidden(scan: Scan, baseline_m: float) -> NDArray[np.bool_]:
    """Mask (H, W) of pixels that something nearer hides from a second eye, to the right of the camera if positive."""
    height, width = scan.depth_m.shape
    disparity_px = scan.camera.focal_x_px * baseline_m / scan.depth_m
    column = np.rint(np.arange(width) - disparity_px).astype(int)
    first = int(column.min())
    nearest = np.zeros((height, int(column.max()) - first + 1))
    rows = np.broadcast_to(np.arange(height)[:, None], column.shape)
    np.maximum.at(nearest, (rows, column - first), np.abs(disparity_px))
    return np.asarray(np.abs(disparity_px) < nearest[rows, column - first] - SHADOW_PX)
