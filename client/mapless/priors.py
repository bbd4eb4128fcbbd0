"""Priors: knowledge of a camera's pose before its photograph is used.

A hard prior is a limit: a pose beyond it is rejected. A soft prior has a value and a covariance: it helps to find the
pose and is compared with it (`PriorCheck`); a soft prior that contradicts the photograph is not used.
"""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from . import wire
from .geometry import Array, RigidTransform


@dataclass(frozen=True, eq=False)
class PositionPrior:
    """Position of the camera, world frame, metres.

    Attributes:
        position_m: (3,).
        radius_m: hard limit of the distance from `position_m`; 0 for no limit.
        covariance_m2: soft, (3, 3); None for no soft prior.
    """

    position_m: Array
    radius_m: float = 0.0
    covariance_m2: Array | None = None


@dataclass(frozen=True)
class GeoPositionPrior:
    """Position from a satellite receiver, soft; only for scenes with a datum.

    Attributes:
        latitude_deg, longitude_deg: WGS84.
        horizontal_sigma_m: standard deviation of north and of east. Phones' "horizontal accuracy" is a 68 % radius:
            divide it by 1.5.
        height_m: above the ellipsoid; None if unknown.
        vertical_sigma_m: standard deviation of the height, if given.
    """

    latitude_deg: float
    longitude_deg: float
    horizontal_sigma_m: float
    height_m: float | None = None
    vertical_sigma_m: float = 0.0


@dataclass(frozen=True, eq=False)
class GravityPrior:
    """Direction of gravity, soft.

    Attributes:
        down_in_camera: (3,) direction of gravity in OpenCV's camera axes: (0, 1, 0) for a camera held upright and
        level.
        sigma_deg: standard deviation about each of two axes.
        down_in_world: (3,); None for the scene's.
    """

    down_in_camera: Array
    sigma_deg: float
    down_in_world: Array | None = None


@dataclass(frozen=True, eq=False)
class HeadingPrior:
    """Viewing direction of the camera, world frame.

    Attributes:
        direction: (3,) of the optical axis, any length above 0.
        max_angle_deg: hard limit of the angle to `direction`; 0 for no limit.
        sigma_deg: soft, standard deviation about each of two axes; 0 for no soft prior.
    """

    direction: Array
    max_angle_deg: float = 0.0
    sigma_deg: float = 0.0


@dataclass(frozen=True, eq=False)
class PosePrior:
    """The full pose, soft: for example the previous answer, moved by the device's own tracking since.

    Attributes:
        world_from_camera: at capture time.
        covariance: (6, 6), order x y z rx ry rz, metres and radians about fixed world axes.
    """

    world_from_camera: RigidTransform
    covariance: Array

    @classmethod
    def from_sigmas(
        cls, world_from_camera: RigidTransform, position_sigma_m: float, rotation_sigma_deg: float
    ) -> "PosePrior":
        """A prior with these standard deviations along, and about, each axis; ValueError if one is not above 0."""
        for name, sigma in (("position_sigma_m", position_sigma_m), ("rotation_sigma_deg", rotation_sigma_deg)):
            if not sigma > 0:
                raise ValueError(f"{name} must be above 0, is {sigma:g}")
        sigmas = [position_sigma_m] * 3 + [np.radians(rotation_sigma_deg)] * 3
        return cls(world_from_camera, np.diag(np.square(sigmas)))


@dataclass(frozen=True, eq=False)
class Priors:
    """The priors of a request; None for a kind without a prior. At most one of `position` and `geo_position`."""

    position: PositionPrior | None = None
    geo_position: GeoPositionPrior | None = None
    gravity: GravityPrior | None = None
    heading: HeadingPrior | None = None
    pose: PosePrior | None = None


def set_priors(request: Any, priors: Priors, path: str = "priors") -> None:
    """Sets the priors of a request; the fields of a prior and of its message have the same names.

    TypeError, with the path, if a single prior was given, ValueError if the request has no field for a prior.
    """
    wire.require(priors, Priors, path, "such as Priors(position=...)")
    for field in fields(priors):
        prior, name = getattr(priors, field.name), f"{field.name}_prior"
        if prior is None:
            continue
        if name not in request.DESCRIPTOR.fields_by_name:
            raise ValueError(f"{request.DESCRIPTOR.name} takes no {name}")
        message = getattr(request, name)
        for part in fields(prior):
            value = getattr(prior, part.name)
            if value is not None:
                _set(message, part.name, value)


def _set(message: Any, name: str, value: Any) -> None:
    if name == "covariance":
        message.covariance.row_major.extend(np.asarray(value, float).ravel().tolist())
    elif name == "covariance_m2":
        message.covariance_m2.extend(np.asarray(value, float).ravel().tolist())
    elif isinstance(value, RigidTransform):
        getattr(message, name).CopyFrom(wire.transform_to_message(value))
    elif np.ndim(value):
        getattr(message, name).CopyFrom(wire.vector_to_message(value, name))
    else:
        setattr(message, name, value)
