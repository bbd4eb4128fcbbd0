"""Priors of a photograph's message: hard limits and soft ones, converted to a scene's world.

A geographic position becomes a position in the world here; no other module handles latitudes.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mapless.geodesy import MAX_HEIGHT_M, MIN_HEIGHT_M, Datum, GeoPosition, world_from_enu_at
from mapless.geometry import MAX_COORDINATE_M, Array
from mapless.v1 import geometry_pb2
from mapless.v1 import localization_service_pb2 as pb
from mapless.wire import FieldError, transform_from_message, vector_from_message
from mapless_server.method.bundle.priors import (
    NO_PRIORS,
    GravityPrior,
    HeadingPrior,
    PosePrior,
    PositionPrior,
    Priors,
    check_covariance,
)
from mapless_server.scenes import ANYWHERE, Cone, Narrowing, Sphere
from mapless_server.store import SceneAttributes

UNKNOWN_HEIGHT_SIGMA_M = 1000.0
"""Standard deviation for a receiver without a height: all buildings are within three of these above or below the
datum."""

MIN_SIGMA_M, MAX_SIGMA_M = 1e-4, 1e6
"""Range for a position: finer than any survey, wider than any scene."""

SETS_DATUM = "(UpdateScene sets one: mapless scene update --datum)"

MIN_SIGMA_RATIO = 1e-5
"""Least ratio for two directions of a position: rotated to the scene's axes, a smaller one would be lost to rounding.
So without a height, positions are certain to 1 cm at most."""

MIN_SIGMA_DEG, MAX_SIGMA_DEG = 1e-3, 90.0
"""Range for a direction; beyond 90 degrees a prior has no effect."""


def needs_attributes(request: Any) -> bool:
    """Whether the request's priors can be converted only with the scene's datum or down direction."""
    if _has(request, "geo_position_prior"):
        return True
    return _has(request, "gravity_prior") and not request.gravity_prior.HasField("down_in_world")


def priors_from_message(request: Any, attributes: SceneAttributes) -> tuple[Narrowing, Priors]:
    """Reads the priors of a request: limits on the references to choose from, and priors on the pose.

    The request has some of the fields position_prior, geo_position_prior, gravity_prior, heading_prior and pose_prior.
    FieldError if a value is out of range; or a geo position is given together with a position or for a scene without a
    datum, or gravity although neither the request nor the scene has a down direction in the world.
    """
    limits: dict[str, Any] = {}
    soft: dict[str, Any] = {}
    check_positions(request)
    if _has(request, "position_prior"):
        limits["position"], soft["position"] = _position(request.position_prior, "position_prior")
    if _has(request, "geo_position_prior"):
        soft["position"] = _geo_position(request.geo_position_prior, attributes, "geo_position_prior")
    if _has(request, "heading_prior"):
        limits["heading"], soft["heading"] = _heading(request.heading_prior, "heading_prior")
    if _has(request, "gravity_prior"):
        soft["gravity"] = _gravity(request.gravity_prior, attributes, "gravity_prior")
    if _has(request, "pose_prior"):
        soft["pose"] = _pose(request.pose_prior, "pose_prior")
    if not limits and not soft:
        return ANYWHERE, NO_PRIORS
    priors = Priors(**soft)
    return replace(Narrowing.of(priors), **limits), priors


def check_positions(request: Any) -> None:
    """Raises FieldError for a request with two position priors."""
    if _has(request, "geo_position_prior") and _has(request, "position_prior"):
        raise FieldError("geo_position_prior", "must not be given together with position_prior")


def _has(request: Any, field: str) -> bool:
    return field in request.DESCRIPTOR.fields_by_name and request.HasField(field)


def _position(message: pb.PositionPrior, field: str) -> tuple[Sphere | None, PositionPrior | None]:
    if not message.HasField("position_m"):
        raise FieldError(f"{field}.position_m", "is required")
    position = vector_from_message(message.position_m, f"{field}.position_m", MAX_COORDINATE_M)
    if not 0 <= message.radius_m < math.inf:
        raise FieldError(f"{field}.radius_m", f"must be finite and above 0, or 0 for none, is {message.radius_m:g}")
    if not message.radius_m and not message.covariance_m2:
        raise FieldError(f"{field}.radius_m", "or covariance_m2 is required")
    sphere = Sphere(position, message.radius_m) if message.radius_m else None
    if not message.covariance_m2:
        return sphere, None
    covariance = _covariance(message.covariance_m2, 3, f"{field}.covariance_m2")
    return sphere, PositionPrior(position, covariance)


def _geo_position(message: pb.GeoPositionPrior, attributes: SceneAttributes, field: str) -> PositionPrior:
    """Converts a geographic position to the world; its covariance is given in east, north and up at the position."""
    datum = attributes.datum
    if datum is None:
        raise FieldError(field, f"needs a scene with a datum {SETS_DATUM}")
    _check_geo_position(message, field)
    height_m, vertical_sigma_m = datum.height_m, UNKNOWN_HEIGHT_SIGMA_M
    if message.HasField("height_m"):
        height_m, vertical_sigma_m = message.height_m, message.vertical_sigma_m
    place = GeoPosition(message.latitude_deg, message.longitude_deg, height_m)
    world_from_enu = world_from_enu_at(place, datum)
    rotation = world_from_enu.rotation
    covariance = rotation @ _enu_covariance(message.horizontal_sigma_m, vertical_sigma_m) @ rotation.T
    return PositionPrior(world_from_enu.translation, (covariance + covariance.T) / 2)


def _enu_covariance(horizontal_sigma_m: float, vertical_sigma_m: float) -> Array:
    """Covariance (3, 3) in east, north and up, square metres; see `MIN_SIGMA_RATIO`."""
    sigmas_m = np.array([horizontal_sigma_m, horizontal_sigma_m, vertical_sigma_m])
    return np.diag(sigmas_m.clip(min=MIN_SIGMA_RATIO * sigmas_m.max()) ** 2)


def _check_geo_position(message: pb.GeoPositionPrior, field: str) -> None:
    _check_within(message.latitude_deg, -90, 90, f"{field}.latitude_deg")
    _check_within(message.longitude_deg, -180, 180, f"{field}.longitude_deg")
    _check_within(message.horizontal_sigma_m, MIN_SIGMA_M, MAX_SIGMA_M, f"{field}.horizontal_sigma_m")
    if message.HasField("height_m"):
        _check_within(message.height_m, MIN_HEIGHT_M, MAX_HEIGHT_M, f"{field}.height_m")
        _check_within(message.vertical_sigma_m, MIN_SIGMA_M, MAX_SIGMA_M, f"{field}.vertical_sigma_m")
    elif message.vertical_sigma_m:
        raise FieldError(f"{field}.height_m", "is required with vertical_sigma_m")


def narrowing_at_place(message: pb.GeoPositionPrior, field: str) -> tuple[Narrowing, Datum]:
    """The likely position by a geographic one, in the frame east, north, up at that place, and the frame as a datum.

    Without a height every one is likely, and that of the frame is 0. FieldError if a value is out of range.
    """
    _check_geo_position(message, field)
    if message.HasField("height_m"):
        covariance = _enu_covariance(message.horizontal_sigma_m, message.vertical_sigma_m)
    else:
        covariance = _enu_covariance(message.horizontal_sigma_m, UNKNOWN_HEIGHT_SIGMA_M)
        covariance[2, 2] = MAX_SIGMA_M**2
    likely = Narrowing.of(Priors(position=PositionPrior(np.zeros(3), covariance)))
    return likely, Datum(message.latitude_deg, message.longitude_deg, message.height_m)


def _heading(message: pb.HeadingPrior, field: str) -> tuple[Cone | None, HeadingPrior | None]:
    direction = _direction(message, "direction", field)
    if not 0 <= message.max_angle_deg <= 180:
        raise FieldError(f"{field}.max_angle_deg", f"must be at most 180, or 0 for none, is {message.max_angle_deg:g}")
    if not message.max_angle_deg and not message.sigma_deg:
        raise FieldError(f"{field}.max_angle_deg", "or sigma_deg is required")
    cone = Cone(direction, message.max_angle_deg) if message.max_angle_deg else None
    if not message.sigma_deg:
        return cone, None
    _check_within(message.sigma_deg, MIN_SIGMA_DEG, MAX_SIGMA_DEG, f"{field}.sigma_deg")
    return cone, HeadingPrior.looking(direction, message.sigma_deg)


def _gravity(message: pb.GravityPrior, attributes: SceneAttributes, field: str) -> GravityPrior:
    in_camera = _direction(message, "down_in_camera", field)
    _check_within(message.sigma_deg, MIN_SIGMA_DEG, MAX_SIGMA_DEG, f"{field}.sigma_deg")
    in_world = _direction(message, "down_in_world", field) if message.HasField("down_in_world") else attributes.down()
    if in_world is None:
        raise FieldError(
            f"{field}.down_in_world",
            "is required, since the scene has neither it nor a datum (UpdateScene sets them: mapless scene update "
            "--down or --datum)",
        )
    return GravityPrior(in_camera, in_world, message.sigma_deg)


def _pose(message: pb.PosePrior, field: str) -> PosePrior:
    if not message.HasField("world_from_camera"):
        raise FieldError(f"{field}.world_from_camera", "is required")
    if not message.HasField("covariance"):
        raise FieldError(f"{field}.covariance", "is required")
    world_from_camera = transform_from_message(
        message.world_from_camera, f"{field}.world_from_camera", MAX_COORDINATE_M
    )
    covariance = _covariance(message.covariance.row_major, 6, f"{field}.covariance.row_major")
    return PosePrior(world_from_camera, covariance)


def _direction(message: Any, name: str, field: str) -> Array:
    """Reads a vector (3,) of the message and normalizes it."""
    if not message.HasField(name):
        raise FieldError(f"{field}.{name}", "is required")
    vector: geometry_pb2.Vector3 = getattr(message, name)
    direction = vector_from_message(vector, f"{field}.{name}")
    length = math.hypot(*direction)
    if not 0 < length < math.inf:
        raise FieldError(f"{field}.{name}", "must have a finite length above 0")
    # In two steps, since the squares of very small components lose digits.
    direction = direction / np.abs(direction).max()
    return np.asarray(direction / np.linalg.norm(direction))


def _covariance(values: Sequence[float], size: int, field: str) -> Array:
    if len(values) != size * size:
        raise FieldError(field, f"must have {size * size} numbers, has {len(values)}")
    covariance = np.array(values).reshape(size, size)
    try:
        check_covariance(covariance, size)
    except ValueError as error:
        raise FieldError(field, str(error)) from None
    deviations = np.sqrt(np.diag(covariance))
    if not MIN_SIGMA_M <= deviations[:3].min() <= deviations[:3].max() <= MAX_SIGMA_M:
        message = f"must have standard deviations of {MIN_SIGMA_M:g} to {MAX_SIGMA_M:g} m"
        raise FieldError(field, f"{message}, has {deviations[:3].min():g} to {deviations[:3].max():g}")
    if size == 6 and not math.radians(MIN_SIGMA_DEG) <= deviations[3:].min() <= deviations[3:].max() <= 2 * math.pi:
        message = f"must have standard deviations of {math.radians(MIN_SIGMA_DEG):.2g} to {2 * math.pi:.3g} radians"
        raise FieldError(field, f"{message}, has {deviations[3:].min():g} to {deviations[3:].max():g}")
    return np.asarray((covariance + covariance.T) / 2)


def _check_within(value: float, least: float, most: float, field: str) -> None:
    if not least <= value <= most:
        raise FieldError(field, f"must be {least:g} to {most:g}, is {value:g}")
