"""What is known of a camera before the server has looked at its photograph.

Hard limits turn down a pose beyond them. Soft priors say a value and how far it may be off: they help to find the pose,
and how well they fit is answered (`PriorCheck`); one that contradicts the photograph is not used.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from . import wire
from .geometry import Array, RigidTransform
from .v1 import geometry_pb2


@dataclass(frozen=True, eq=False)
class PositionPrior:
    """Where the camera is, world frame, metres.

    Attributes:
        position_m: (3,).
        radius_m: hard: a pose further away is rejected; 0 for no limit.
        covariance_m2: soft: (3, 3); None for no such knowledge.
    """

    position_m: Array
    radius_m: float = 0.0
    covariance_m2: Array | None = None


@dataclass(frozen=True)
class GeoPositionPrior:
    """What a satellite receiver says, soft; only for scenes with a datum.

    Attributes:
        latitude_deg, longitude_deg: WGS84.
        horizontal_sigma_m: standard deviation of north and of east. Phones' "horizontal accuracy" is a 68 % radius:
            divide it by 1.5.
        height_m: above the ellipsoid; None where it is unknown.
        vertical_sigma_m: standard deviation of the height, where there is one.
    """

    latitude_deg: float
    longitude_deg: float
    horizontal_sigma_m: float
    height_m: float | None = None
    vertical_sigma_m: float = 0.0


@dataclass(frozen=True, eq=False)
class GravityPrior:
    """Which way is down, soft.

    Attributes:
        down_in_camera: (3,) the way things fall, in OpenCV's axes: (0, 1, 0) for a camera held upright and level.
        sigma_deg: standard deviation about each of two axes.
        down_in_world: (3,); None: the scene's.
    """

    down_in_camera: Array
    sigma_deg: float
    down_in_world: Array | None = None


@dataclass(frozen=True, eq=False)
class HeadingPrior:
    """Which way the camera looks, world frame.

    Attributes:
        direction: (3,) of the optical axis, of any length but 0.
        max_angle_deg: hard: a pose that looks elsewhere is rejected; 0 for no limit.
        sigma_deg: soft: standard deviation about each of two axes; 0 for no such knowledge.
    """

    direction: Array
    max_angle_deg: float = 0.0
    sigma_deg: float = 0.0


@dataclass(frozen=True, eq=False)
class PosePrior:
    """The whole pose, soft: the previous answer, moved on by what the device tracked since.

    Attributes:
        world_from_camera: at capture time.
        covariance: (6, 6), order x y z rx ry rz, metres and radians about fixed world axes.
    """

    world_from_camera: RigidTransform
    covariance: Array


@dataclass(frozen=True, eq=False)
class Priors:
    """All that is known beforehand; what is None is not known. At most one of `position` and `geo_position`."""

    position: PositionPrior | None = None
    geo_position: GeoPositionPrior | None = None
    gravity: GravityPrior | None = None
    heading: HeadingPrior | None = None
    pose: PosePrior | None = None


def set_priors(request: Any, priors: Priors) -> None:
    """Puts what is known into a request.

    Raises:
        ValueError: the request has no field for it.
    """
    for field in fields(priors):
        prior, name = getattr(priors, field.name), f"{field.name}_prior"
        if prior is None:
            continue
        if name not in request.DESCRIPTOR.fields_by_name:
            raise ValueError(f"{request.DESCRIPTOR.name} takes no {name}")
        _FILLERS[field.name](getattr(request, name), prior)


def _fill_position(message: Any, prior: PositionPrior) -> None:
    message.position_m.CopyFrom(_vector(prior.position_m))
    message.radius_m = prior.radius_m
    if prior.covariance_m2 is not None:
        message.covariance_m2.extend(np.asarray(prior.covariance_m2, float).ravel().tolist())


def _fill_geo_position(message: Any, prior: GeoPositionPrior) -> None:
    message.latitude_deg, message.longitude_deg = prior.latitude_deg, prior.longitude_deg
    message.horizontal_sigma_m, message.vertical_sigma_m = prior.horizontal_sigma_m, prior.vertical_sigma_m
    if prior.height_m is not None:
        message.height_m = prior.height_m


def _fill_gravity(message: Any, prior: GravityPrior) -> None:
    message.down_in_camera.CopyFrom(_vector(prior.down_in_camera))
    message.sigma_deg = prior.sigma_deg
    if prior.down_in_world is not None:
        message.down_in_world.CopyFrom(_vector(prior.down_in_world))


def _fill_heading(message: Any, prior: HeadingPrior) -> None:
    message.direction.CopyFrom(_vector(prior.direction))
    message.max_angle_deg, message.sigma_deg = prior.max_angle_deg, prior.sigma_deg


def _fill_pose(message: Any, prior: PosePrior) -> None:
    message.world_from_camera.CopyFrom(wire.transform_to_message(prior.world_from_camera))
    message.covariance.row_major.extend(np.asarray(prior.covariance, float).ravel().tolist())


_FILLERS: dict[str, Callable[[Any, Any], None]] = {
    "position": _fill_position,
    "geo_position": _fill_geo_position,
    "gravity": _fill_gravity,
    "heading": _fill_heading,
    "pose": _fill_pose,
}


def _vector(xyz: Array) -> geometry_pb2.Vector3:
    x, y, z = map(float, xyz)
    return geometry_pb2.Vector3(x=x, y=y, z=z)
