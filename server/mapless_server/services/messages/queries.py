"""Conversion of a LocalizeRequest to a Query; checks every field that can be checked without the store.

Priors, hard limits and soft ones, are converted to the scene's world. A geographic position becomes a position in the
world here; no other module handles latitudes.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mapless import names, wire
from mapless.depth import depth_from_message
from mapless.geodesy import MAX_HEIGHT_M, MIN_HEIGHT_M, GeoPosition, world_from_enu_at, world_from_geodetic
from mapless.geometry import MAX_COORDINATE_M, Array, Camera
from mapless.lenses import lens_model_of
from mapless.v1 import geometry_pb2
from mapless.v1 import localization_service_pb2 as pb
from mapless.wire import FieldError, camera_from_message, joined, transform_from_message, vector_from_message
from mapless_server.engine.options import EngineOptions
from mapless_server.engine.query import DEFAULT_REFERENCE_COUNT, Photo, Query
from mapless_server.images import ImageLimits, check_depth, check_mask, image_size
from mapless_server.images.exif import read_exif
from mapless_server.method.bundle.priors import (
    NO_PRIORS,
    GravityPrior,
    HeadingPrior,
    PosePrior,
    PositionPrior,
    Priors,
    check_covariance,
)
from mapless_server.method.features.views import seen_share
from mapless_server.method.options import LocalizeOptions
from mapless_server.scenes import ANYWHERE, Cone, Narrowing, Sphere
from mapless_server.security import SceneKey, key_of
from mapless_server.store import SceneAttributes

from .enums import enum_from_message
from .uncertainty import uncertain_options

FIRST_TIME_S, LAST_TIME_S = -62_135_596_800, 253_402_300_799
"""Range of google.protobuf.Timestamp."""


def scene_key_from_name(name: str, field: str, tenant: str) -> SceneKey:
    """The key of a tenant's scene; FieldError if the name is not a scene's name."""
    return key_of(tenant, wire.scene_id_from_name(name, field))


def reference_key_from_name(name: str, field: str, tenant: str) -> tuple[SceneKey, str]:
    """The key of a tenant's scene, and a reference's id within it; FieldError if the name is not a reference's."""
    scene_id, reference_id = wire.reference_ids_from_name(name, field)
    return key_of(tenant, scene_id), reference_id


def reference_ids_from_names(names_given: Sequence[str], scene_id: str, most: int) -> tuple[str, ...]:
    """Ids of the references in a request's `references`, in order.

    FieldError if there are more than `most`, or a name is not a reference's, of another scene, or repeated.
    """
    if len(names_given) > most:
        more = f"; at most {MAX_CANDIDATES} with options.rerank_references (--rerank)" if most == MAX_REFERENCES else ""
        raise FieldError("references", f"must be at most {most}, are {len(names_given)}{more}")
    reference_ids: dict[str, None] = {}
    for i, name in enumerate(names_given):
        field = f"references[{i}]"
        its_scene_id, reference_id = wire.reference_ids_from_name(name, field)
        if its_scene_id != scene_id:
            raise FieldError(field, f"{names.shown(name)} is a reference of another scene than {scene_id!r}")
        if reference_id in reference_ids:
            raise FieldError(field, f"{names.shown(name)} is repeated")
        reference_ids[reference_id] = None
    return tuple(reference_ids)


def photo_from_message(message: Any, path: str, limits: ImageLimits, needs_intrinsics: bool = True) -> Photo:
    """Reads the photograph of a message's `image` and `intrinsics`; reads only the image's header, so it is fast.

    Also reads its `mask`, and its EXIF if there are no intrinsics, which is a FieldError where they are needed.
    FieldError if they are out of range, or of another size than the image; InvalidArgument if the image or the mask is
    refused by its header.
    """
    has_intrinsics = message.HasField("intrinsics")
    if has_intrinsics:
        camera = camera_from_message(message.intrinsics, joined(path, "intrinsics"))
    elif needs_intrinsics:
        raise FieldError(joined(path, "intrinsics"), "is required")
    image = message.image  # every access copies the bytes
    width_px, height_px = image_size(image, limits, joined(path, "image"))
    if not has_intrinsics:
        camera = Camera.centred(width_px, height_px, float(max(width_px, height_px)))
        return Photo(image, camera, joined(path, "image"), _mask_of(message, path, camera, limits), read_exif(image))
    if (camera.width_px, camera.height_px) != (width_px, height_px):
        raise FieldError(
            joined(path, "intrinsics.width_px"),
            f"the intrinsics are for {camera.width_px}x{camera.height_px} pixels, the image has {width_px}x{height_px} "
            "(EXIF orientation is not applied)",
        )
    if camera.distortion is not None and (share := seen_share(camera)) < MIN_SEEN_SHARE:
        model = lens_model_of(camera.distortion)
        coefficients = ", ".join(f"{name} = {value:g}" for name, value in vars(camera.distortion).items())
        raise FieldError(
            joined(path, f"intrinsics.{model}"),
            f"must show the image: with {coefficients} only {100 * share:.0f} % of its pixels have a ray "
            f"({100 * MIN_SEEN_SHARE:.0f} are needed)",
        )
    return Photo(image, camera, joined(path, "image"), _mask_of(message, path, camera, limits))


def _mask_of(message: Any, path: str, camera: Camera, limits: ImageLimits) -> bytes:
    """Reads the mask of a message, empty for none; InvalidArgument if it is refused by its header."""
    if not message.HasField("mask"):
        return b""
    mask: bytes = message.mask
    check_mask(mask, (camera.width_px, camera.height_px), limits, joined(path, "mask"))
    return mask


def with_depth(photo: Photo, message: Any, path: str, limits: ImageLimits) -> Photo:
    """The photograph with the depth of its message, if there is one; reads only its header.

    FieldError if a number is wrong; InvalidArgument if the bytes are refused by their header.
    """
    if not message.HasField("depth"):
        return photo
    field, size = joined(path, "depth"), (photo.camera.width_px, photo.camera.height_px)
    depth = depth_from_message(message.depth, field)
    check_depth(depth, size, limits, field)
    return replace(photo, depth=depth)


MIN_SEEN_SHARE = 0.1
"""Least share of an image that a lens must show: a fisheye's circle shows 0.3 at least; wrong coefficients may show
nothing."""

MAX_REFERENCES = 64
MAX_CANDIDATES = 1000
"""References that a request may name where the server chooses among them."""


def query_from_message(
    request: pb.LocalizeRequest, tenant: str, engine: EngineOptions, attributes: SceneAttributes
) -> Query:
    """Converts a request to a query; FieldError or InvalidArgument names the wrong field.

    `attributes` are the scene's; they may be empty unless `needs_attributes` is true.
    """
    scene_id = wire.scene_id_from_name(request.scene, "scene")
    check_capture_time(request)
    most = MAX_CANDIDATES if request.options.rerank_references else MAX_REFERENCES
    narrowing, priors = priors_from_message(request, attributes)
    photo = photo_from_message(request, "", engine.image_limits, needs_intrinsics=False)
    photo = with_depth(photo, request, "", engine.image_limits)
    return Query(
        scene_key=key_of(tenant, scene_id),
        reference_ids=reference_ids_from_names(request.references, scene_id, most),
        photo=photo,
        narrowing=narrowing,
        reference_count=reference_count_from_message(request.options),
        options=uncertain_options(options_from_message(request.options, engine.coverage), request, photo, ""),
        allow_coarse=request.options.allow_coarse,
        rerank=request.options.rerank_references and bool(request.references),
        priors=priors,
        is_generic=request.options.ignore_calibration,
        attributes=attributes if needs_attributes(request) else None,
    )


def check_capture_time(message: Any) -> None:
    """Raises FieldError if the message's `capture_time` is no time: clients could not read it in the answer."""
    time = message.capture_time
    if not (FIRST_TIME_S <= time.seconds <= LAST_TIME_S and 0 <= time.nanos < 1_000_000_000):
        likely = "; are these milliseconds or nanoseconds?" if time.seconds > LAST_TIME_S else ""
        given = f"is {time.seconds} s and {time.nanos} ns{likely}"
        raise FieldError("capture_time", f"must be a time of the years 1 to 9999, since 1970, {given}")


def reference_count_from_message(message: pb.LocalizeOptions) -> int:
    """Number of references to choose if none is named."""
    count = message.reference_count
    if not 0 <= count <= MAX_REFERENCES:
        raise FieldError("options.reference_count", f"must be 0 to {MAX_REFERENCES}, is {count}")
    return count or DEFAULT_REFERENCE_COUNT


def options_from_message(message: pb.LocalizeOptions, coverage: float) -> LocalizeOptions:
    """Reads the options of the method, with the server's default `coverage`; FieldError names a wrong field."""
    if not 0 <= message.coverage < 1:
        raise FieldError("options.coverage", f"must be above 0 and below 1, or 0, is {message.coverage:g}")
    defaults = LocalizeOptions
    return LocalizeOptions(
        variant=enum_from_message(message.variant, pb.Variant, defaults.variant, "options.variant"),
        scale_strategy=enum_from_message(
            message.scale_strategy, pb.ScaleStrategy, defaults.scale_strategy, "options.scale_strategy"
        ),
        coverage=message.coverage or coverage,
    )


UNKNOWN_HEIGHT_SIGMA_M = 1000.0
"""Standard deviation for a receiver without a height: all buildings are within three of these above or below the
datum."""

MIN_SIGMA_M, MAX_SIGMA_M = 1e-4, 1e6
"""Range for a position: finer than any survey, wider than any scene."""

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
    if _has(request, "position_prior"):
        limits["position"], soft["position"] = _position(request.position_prior, "position_prior")
    if _has(request, "geo_position_prior"):
        if _has(request, "position_prior"):
            raise FieldError("geo_position_prior", "must not be given together with position_prior")
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
        raise FieldError(field, "needs a scene with a datum (UpdateScene sets one: mapless scene update --datum)")
    _check_within(message.latitude_deg, -90, 90, f"{field}.latitude_deg")
    _check_within(message.longitude_deg, -180, 180, f"{field}.longitude_deg")
    _check_within(message.horizontal_sigma_m, MIN_SIGMA_M, MAX_SIGMA_M, f"{field}.horizontal_sigma_m")
    height_m, vertical_sigma_m = datum.height_m, UNKNOWN_HEIGHT_SIGMA_M
    if message.HasField("height_m"):
        _check_within(message.height_m, MIN_HEIGHT_M, MAX_HEIGHT_M, f"{field}.height_m")
        _check_within(message.vertical_sigma_m, MIN_SIGMA_M, MAX_SIGMA_M, f"{field}.vertical_sigma_m")
        height_m, vertical_sigma_m = message.height_m, message.vertical_sigma_m
    elif message.vertical_sigma_m:
        raise FieldError(f"{field}.height_m", "is required with vertical_sigma_m")
    place = GeoPosition(message.latitude_deg, message.longitude_deg, height_m)
    rotation = world_from_enu_at(place, datum).rotation
    sigmas_m = np.array([message.horizontal_sigma_m] * 2 + [vertical_sigma_m])
    covariance = rotation @ np.diag(sigmas_m.clip(min=MIN_SIGMA_RATIO * sigmas_m.max()) ** 2) @ rotation.T
    return PositionPrior(world_from_geodetic(place, datum), (covariance + covariance.T) / 2)


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
