"""Properties of a scene: calibration, directions, datum, and their messages, which client and server share."""

import math
from dataclasses import dataclass, fields, replace
from datetime import datetime, timezone
from enum import Enum
from typing import Final, Literal

from . import wire
from .geodesy import Datum
from .geometry import Quaternion
from .v1 import geometry_pb2
from .v1 import localization_service_pb2 as localization_pb
from .v1 import reference_service_pb2 as pb
from .wire import FieldError, joined

MIN_FACTOR, MAX_FACTOR = 0.01, 1000.0
"""Bounds of factors: values beyond indicate another fault, not a lack of calibration."""

MAX_TEXT = 128
"""Characters of each text of a calibration."""

FACTORS = ("position_factor_68", "position_factor_95", "rotation_factor_68", "rotation_factor_95")
NOISES = ("reference_noise_m", "reference_noise_deg")
TEXTS = ("features", "backend", "server_version")
_VARIANT: wire.ProtoEnum = localization_pb.Variant

Vector = tuple[float, float, float]


class Unchanged(Enum):
    """The type of `UNCHANGED`."""

    UNCHANGED = "unchanged"


UNCHANGED: Final = Unchanged.UNCHANGED
"""Value of `update_scene` that keeps a property; None deletes it."""

UnchangedType = Literal[Unchanged.UNCHANGED]


@dataclass(frozen=True)
class Calibration:
    """Measured factors of the radii of answers in a scene, from photographs with known poses.

    The radii of answers are multiplied by the factors, so that they contain the truth as often as they state. Answers
    of another method or server version than measured remain uncalibrated. The factor of 68 % is first combined with the
    errors of the references' poses, as the hypotenuse of factor and error / radius; that of 95 % stays in the same
    ratio to it.

    Attributes:
        position_factor_68, position_factor_95: factors of the position's radii at 68 and 95 %, 0.01 to 1000.
        rotation_factor_68, rotation_factor_95: factors of the angle's.
        query_count: number of photographs measured, at least 1.
        features, backend, variant: method of their answers, as in `Diagnostics` ("BEST").
        server_version: version of the measured server.
        create_time: time of storing, by the server's clock; None before.
        reference_noise_m, reference_noise_deg: errors of the references' own poses, not exceeded in 68 % of cases.
        grows_with_gap: whether the factors hold where the nearest reference is at a tenth of the distance to what the
            photograph shows, and grow with the power 0.2 of that share; otherwise they hold anywhere.
    """

    position_factor_68: float
    position_factor_95: float
    rotation_factor_68: float
    rotation_factor_95: float
    query_count: int
    features: str
    backend: str
    variant: str
    server_version: str
    create_time: datetime | None = None
    reference_noise_m: float = 0.0
    reference_noise_deg: float = 0.0
    grows_with_gap: bool = False

    def __post_init__(self) -> None:
        for name in FACTORS:
            factor = getattr(self, name)
            if not MIN_FACTOR <= factor <= MAX_FACTOR:
                raise ValueError(f"{name} must be {MIN_FACTOR:g} to {MAX_FACTOR:g}, is {factor:g}")
        for name in NOISES:
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be at least 0 and finite, is {getattr(self, name):g}")
        if self.query_count < 1:
            raise ValueError(f"query_count must be at least 1, is {self.query_count}")
        for name in (*TEXTS, "variant"):
            if len(getattr(self, name)) > MAX_TEXT:
                raise ValueError(f"{name} must have at most {MAX_TEXT} characters, has {len(getattr(self, name))}")

    def is_of(self, features: str, backend: str, variant: str, server_version: str) -> bool:
        """Whether it was measured with the given method and server version."""
        measured = (self.features, self.backend, self.variant, self.server_version)
        return measured == (features, backend, variant, server_version)


MOST_PER_PLACE, LEAST_SURVEYED_SHARE = 100, 0.1
LEAST_RADIUS_M, LARGEST_RADIUS_M = 1e-6, 10.0
"""Bounds of an adoption policy; of its radius where the unit of length is the metre."""

DEFAULT_RADIUS_M = 0.03
"""The radius of a policy that has none."""


@dataclass(frozen=True)
class AdoptionPolicy:
    """Which localized photographs become references of a scene, of those whose requests allow it.

    Attributes:
        most_per_place: most adopted references at a place, which is what is nearer to one surveyed reference than to
            any other that looks within 60 degrees of the same direction, 1 to 100; the least useful go first.
        min_trust: least trust of an answer, above 0, at most 1.
        max_radius_m: largest 68 % radius of an answer's position: 1e-6 to 10 metres, or above 0 in the scene's
            arbitrary unit, where the server refuses None (InvalidArgument). None is 0.03 m; a server's answer has the
            number.
        min_surveyed_share: least share of what an answer explains that the survey explains alone, 0.1 to 1. Where
            photographs of a place have less, its adopted references are retired until there is a new survey.
    """

    most_per_place: int = 4
    min_trust: float = 0.5
    max_radius_m: float | None = None
    min_surveyed_share: float = 0.3

    def __post_init__(self) -> None:
        given = {name: value for name, value in vars(self).items() if (name, value) != ("max_radius_m", None)}
        wire.set_numbers(pb.AdoptionPolicy(), given)  # TypeError names one of another type
        if not 1 <= self.most_per_place <= MOST_PER_PLACE:
            raise ValueError(f"most_per_place must be 1 to {MOST_PER_PLACE}, is {self.most_per_place}")
        if not 0 < self.min_trust <= 1:  # in a message, 0 is the default
            raise ValueError(f"min_trust must be above 0, at most 1, is {self.min_trust:g}")
        if self.max_radius_m is not None and not 0 < self.max_radius_m < math.inf:
            raise ValueError(f"max_radius_m must be above 0 and finite, is {self.max_radius_m:g}")
        if not LEAST_SURVEYED_SHARE <= self.min_surveyed_share <= 1:
            share = self.min_surveyed_share
            raise ValueError(f"min_surveyed_share must be {LEAST_SURVEYED_SHARE:g} to 1, is {share:g}")

    @property
    def radius_m(self) -> float:
        """`max_radius_m`, or its default where the unit is the metre."""
        return DEFAULT_RADIUS_M if self.max_radius_m is None else self.max_radius_m


def unit_vector(x: float, y: float, z: float) -> Vector:
    """The direction of a vector; ValueError if its length is 0 or not finite."""
    longest = max(abs(x), abs(y), abs(z))
    if not 0 < longest < math.inf or not all(map(math.isfinite, (x, y, z))):
        raise ValueError("must be finite and not zero")
    x, y, z = x / longest, y / longest, z / longest  # against under- and overflow of squares
    length = math.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length


def datum_to_message(datum: Datum) -> pb.Datum:
    """Message of a datum; TypeError for another type."""
    wire.require(datum, Datum, "datum")
    q = datum.enu_from_world
    return pb.Datum(
        latitude_deg=datum.latitude_deg,
        longitude_deg=datum.longitude_deg,
        height_m=datum.height_m,
        enu_from_world=geometry_pb2.Quaternion(x=q.x, y=q.y, z=q.z, w=q.w),
    )


def datum_from_message(message: pb.Datum, field: str) -> Datum:
    """Datum of a message, its quaternion normalized; FieldError if a number is out of range, or its norm is not one."""
    q = message.enu_from_world
    try:
        turned = Quaternion(q.x, q.y, q.z, q.w) if message.HasField("enu_from_world") else Quaternion(0, 0, 0, 1)
        datum = Datum(message.latitude_deg, message.longitude_deg, message.height_m, turned)
        return replace(datum, enu_from_world=turned.normalized())
    except ValueError as error:
        raise _of_field(error, field) from None


def direction_from_message(message: geometry_pb2.Vector3, field: str) -> Vector:
    """The direction as a unit vector; FieldError if it is zero or not finite."""
    try:
        return unit_vector(message.x, message.y, message.z)
    except ValueError as error:
        raise FieldError(field, str(error)) from None


def calibration_to_message(calibration: Calibration) -> pb.SceneCalibration:
    """Message of a calibration; an unknown variant becomes unspecified."""
    numbers = dict(_VARIANT.items())
    message = pb.SceneCalibration(
        **{name: getattr(calibration, name) for name in FACTORS + NOISES + TEXTS},
        grows_with_gap=calibration.grows_with_gap,
        query_count=calibration.query_count,
        variant=numbers.get(wire.enum_prefix(_VARIANT) + calibration.variant, 0),
    )
    if calibration.create_time is not None:
        message.create_time.FromDatetime(calibration.create_time)
    return message


def calibration_from_message(message: pb.SceneCalibration, field: str) -> Calibration:
    """Calibration of a message, with its time; an unknown variant, from a newer program, is its number as text.

    FieldError if a number is out of range, or a text too long.
    """
    try:
        return Calibration(
            **{name: getattr(message, name) for name in (*FACTORS, *NOISES, *TEXTS, "query_count", "grows_with_gap")},
            variant=wire.value_name(_VARIANT.DESCRIPTOR, message.variant),
            create_time=message.create_time.ToDatetime(timezone.utc) if message.HasField("create_time") else None,
        )
    except ValueError as error:
        raise _of_field(error, field) from None


def adoption_to_message(policy: AdoptionPolicy) -> pb.AdoptionPolicy:
    """Message of an adoption policy; TypeError for another type."""
    wire.require(policy, AdoptionPolicy, "adoption")
    return pb.AdoptionPolicy(**vars(policy))


def adoption_from_message(message: pb.AdoptionPolicy, field: str) -> AdoptionPolicy:
    """Adoption policy of a message, whose zeros are defaults; FieldError if a number is out of range."""
    given = {it.name: getattr(message, it.name) for it in fields(AdoptionPolicy)}
    try:
        return AdoptionPolicy(**{name: value for name, value in given.items() if value})
    except ValueError as error:
        raise _of_field(error, field) from None


def _of_field(error: ValueError, field: str) -> FieldError:
    """The error of a message at a path, of that of a dataclass with the same fields, "height_m must be ..."."""
    name, _, fault = str(error).partition(" ")
    return FieldError(joined(field, name.removesuffix(":")), fault)
