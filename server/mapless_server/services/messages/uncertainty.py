"""Standard deviations of a photograph's intrinsics, and the read-out of its shutter: from messages to options."""

from dataclasses import replace
from typing import Any

from mapless.v1 import localization_service_pb2 as pb
from mapless.wire import MAX_READOUT_S, MAX_SPEED_M_PER_S, MAX_TURN_DEG_PER_S, FieldError, joined
from mapless_server.engine.query import Photo
from mapless_server.method.bundle.priors import IntrinsicsSigma
from mapless_server.method.bundle.readout import RollingShutter
from mapless_server.method.options import LocalizeOptions

from .enums import enum_from_message

LEAST_SIGMA = 1e-6
"""Least standard deviation of intrinsics, as a share: they are exact, and their inverse squares are finite."""


LEAST_MOTION = 1e-6
"""Least read-out time and speeds other than 0: smaller ones move nothing, and their inverse squares are not finite."""


def uncertain_options(options: LocalizeOptions, message: Any, photo: Photo, path: str) -> LocalizeOptions:
    """The options with what a photograph's message says of its intrinsics and its shutter in `intrinsics_uncertainty`.

    The same options without; FieldError names a wrong field.
    """
    if not message.HasField("intrinsics_uncertainty"):
        return options
    given, field = message.intrinsics_uncertainty, joined(path, "intrinsics_uncertainty")
    shutter = _shutter_from(given, field)
    sigma = None if shutter is not None and not _has_sigma(given) else _sigma_from(given, photo, field)
    return replace(options, intrinsics=sigma, shutter=shutter)


def _has_sigma(message: pb.IntrinsicsUncertainty) -> bool:
    return any((message.focal_sigma_px, message.principal_sigma_px, message.k1_sigma))


def _sigma_from(message: pb.IntrinsicsUncertainty, photo: Photo, field: str) -> IntrinsicsSigma:
    """Reads standard deviations of the intrinsics; FieldError names a wrong field."""
    if photo.exif is not None:
        raise FieldError(field, "is that of intrinsics, and there are none")
    camera, defaults = photo.camera, IntrinsicsSigma()

    def share(name: str, default: float, whole: float) -> float:
        value = getattr(message, name)
        if not 0 <= value <= whole:
            bounds = f"must be above 0 and at most {whole:g}, or 0 for the default, is {value:g}"
            raise FieldError(f"{field}.{name}", bounds)
        return max(value / whole, LEAST_SIGMA) if value else default

    return IntrinsicsSigma(
        share("focal_sigma_px", defaults.focal_share, camera.focal_x_px),
        share("principal_sigma_px", defaults.principal_share, camera.width_px),
        share("k1_sigma", defaults.k1, 1.0),
    )


def _shutter_from(message: pb.IntrinsicsUncertainty, field: str) -> RollingShutter | None:
    """Reads the read-out of a rolling shutter; None without one. FieldError names a wrong field."""

    def number(name: str, most: float, unit: str) -> float:
        value: float = getattr(message, name)
        if not (value == 0 or LEAST_MOTION <= value <= most):
            raise FieldError(f"{field}.{name}", f"must be 0, or {LEAST_MOTION:g} to {most:g} {unit}, is {value:g}")
        if value and not message.readout_s:
            raise FieldError(f"{field}.{name}", "is of a rolling shutter, and readout_s is 0")
        return value

    readout_s = number("readout_s", MAX_READOUT_S, "seconds")
    speeds = (
        number("speed_m_per_s", MAX_SPEED_M_PER_S, "metres a second"),
        number("turn_deg_per_s", MAX_TURN_DEG_PER_S, "degrees a second"),
    )
    default, named = RollingShutter.direction, f"{field}.readout_direction"
    direction = enum_from_message(message.readout_direction, pb.ReadoutDirection, default, named)
    return RollingShutter(readout_s, direction, *speeds) if readout_s else None
