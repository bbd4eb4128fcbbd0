"""Positions on the Earth: WGS84, the datum of a scene, and OGC GeoPose 1.0.

Three frames, all right-handed, metric and float64, which resolves a nanometre at the Earth's radius:

* ECEF: origin at the Earth's centre, z through the north pole, x through latitude 0, longitude 0.
* ENU at a place: origin there, x east, y north, z up along the ellipsoid's normal.
* the world of a scene, related by its `Datum` to ENU at the world's origin.

ENU at another place is rotated against that of the datum, by 0.0001 to 0.2 degrees over 10 m to 10 km. A GeoPose is
given in ENU at the place of the pose, so it includes that rotation.

Heights are above the ellipsoid, as satellite receivers give them, not above the sea: the two differ by up to 107 m.
"""

import math
import sys
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .axes import CV_FROM_CAMERA, Axes
from .geometry import Array, Quaternion, RigidTransform

SEMI_MAJOR_M = 6378137.0
FLATTENING = 1 / 298.257223563
SEMI_MINOR_M = SEMI_MAJOR_M * (1 - FLATTENING)
_E2 = FLATTENING * (2 - FLATTENING)
_SECOND_E2 = _E2 / (1 - _E2)

MIN_HEIGHT_M, MAX_HEIGHT_M = -12_000.0, 100_000.0
"""Bounds of a datum's height: below the deepest sea, above the atmosphere."""

_DATUM_NUMBERS = ("latitude_deg", "longitude_deg", "height_m")


def enu_from_y_up(heading_deg: float) -> Quaternion:
    """`Datum.enu_from_world` of a world with y up, as on headsets.

    Args:
        heading_deg: direction of its -z, a headset's forward at the start of its session: clockwise from north.
    """
    half = math.radians(heading_deg) / 2
    cosine, sine = math.sqrt(0.5) * math.cos(half), math.sqrt(0.5) * math.sin(half)
    return Quaternion(cosine, -sine, -sine, cosine).normalized()


def enu_from_z_up(heading_deg: float) -> Quaternion:
    """`Datum.enu_from_world` of a world with z up, as on robots.

    Args:
        heading_deg: direction of its x: clockwise from north, so 90 if x is east, as in REP 103.
    """
    half = math.radians(90 - heading_deg) / 2
    return Quaternion(0.0, 0.0, math.sin(half), math.cos(half)).normalized()


@dataclass(frozen=True)
class GeoPosition:
    """A place: WGS84 latitude (-90 to 90) and longitude (-180 to 180), degrees, and height above the ellipsoid."""

    latitude_deg: float
    longitude_deg: float
    height_m: float

    def __post_init__(self) -> None:
        if not -90 <= self.latitude_deg <= 90:
            raise ValueError(f"latitude_deg must be -90 to 90, is {self.latitude_deg:g}")
        if not -180 <= self.longitude_deg <= 180:
            raise ValueError(f"longitude_deg must be -180 to 180, is {self.longitude_deg:g}")
        if not math.isfinite(self.height_m):
            raise ValueError(f"height_m must be finite, is {self.height_m}")


@dataclass(frozen=True)
class Datum:
    """Position and orientation of a scene's world on the Earth.

    Attributes:
        latitude_deg, longitude_deg, height_m: position of the world's origin, WGS84, height above the ellipsoid.
        enu_from_world: rotation of the world's axes to east, north and up at its origin; by default the identity.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float
    enu_from_world: Quaternion = field(default=Quaternion(0.0, 0.0, 0.0, 1.0))

    def __post_init__(self) -> None:
        height_m = self.origin.height_m
        if not MIN_HEIGHT_M <= height_m <= MAX_HEIGHT_M:
            raise ValueError(f"height_m must be {MIN_HEIGHT_M:g} to {MAX_HEIGHT_M:g}, is {height_m:g}")
        try:
            self.enu_from_world.matrix()
        except ValueError as error:
            raise ValueError(f"enu_from_world: {error}") from None

    @property
    def origin(self) -> GeoPosition:
        """The place of the world's origin."""
        return GeoPosition(self.latitude_deg, self.longitude_deg, self.height_m)

    def ecef_from_world(self) -> RigidTransform:
        """The pose of the world in ECEF."""
        ecef_from_enu = ecef_from_enu_at(self.origin)
        return ecef_from_enu.compose(RigidTransform(self.enu_from_world.matrix(), np.zeros(3)))

    def to_json(self) -> dict[str, Any]:
        """Converts it to a JSON object with the attributes' names."""
        return asdict(self)

    @staticmethod
    def from_json(content: object) -> "Datum":
        """Reads it from a JSON object; enu_from_world is optional.

        ValueError if a member is missing, is no number or out of bounds.
        """
        latitude_deg, longitude_deg, height_m = (_number(content, name) for name in _DATUM_NUMBERS)
        turned = content.get("enu_from_world") if isinstance(content, dict) else None
        if turned is None:
            return Datum(latitude_deg, longitude_deg, height_m)
        x, y, z, w = (_number(turned, name, "enu_from_world.") for name in "xyzw")
        return Datum(latitude_deg, longitude_deg, height_m, Quaternion(x, y, z, w))

    def down_in_world(self) -> Array:
        """Unit vector (3,) down along the ellipsoid's normal, within some hundredths of a degree of gravity."""
        up: Array = self.enu_from_world.matrix()[2]
        return -up


@dataclass(frozen=True)
class GeoPose:
    """OGC GeoPose 1.0, Basic-Quaternion; the names are the standard's.

    Attributes:
        lat, lon: position of the body, WGS84, degrees.
        h: its height above the ellipsoid, metres.
        quaternion: rotation of the body's axes to east, north and up at the body's position. The standard does not
            define the body's axes; here x is forward, y left and z up, so an upright camera that looks east has the
            identity.
    """

    lat: float
    lon: float
    h: float
    quaternion: Quaternion

    def __post_init__(self) -> None:
        GeoPosition(self.lat, self.lon, self.h)
        self.quaternion.matrix()

    @property
    def position(self) -> GeoPosition:
        """Position of the body."""
        return GeoPosition(self.lat, self.lon, self.h)

    def to_json(self) -> dict[str, dict[str, float]]:
        """Converts it to a JSON object with exactly the standard's members."""
        position = {"lat": self.lat, "lon": self.lon, "h": self.h}
        return {
            part: {name: float(number) for name, number in numbers.items()}
            for part, numbers in (("position", position), ("quaternion", asdict(self.quaternion)))
        }

    @staticmethod
    def from_json(content: object) -> "GeoPose":
        """Reads it from a JSON object; members that the standard does not define are ignored.

        ValueError if a member is missing, is no number or out of bounds.
        """
        position, quaternion = (
            content.get(it) if isinstance(content, dict) else None for it in ("position", "quaternion")
        )
        lat, lon, h = (_number(position, name, "position.") for name in ("lat", "lon", "h"))
        x, y, z, w = (_number(quaternion, name, "quaternion.") for name in "xyzw")
        return GeoPose(lat, lon, h, Quaternion(x, y, z, w))


def ecef_from_geodetic(place: GeoPosition) -> Array:
    """A place in ECEF, (3,) metres."""
    return _point_in_ecef(_sine_and_cosine(place.latitude_deg), _sine_and_cosine(place.longitude_deg), place.height_m)


def _point_in_ecef(latitude: tuple[float, float], longitude: tuple[float, float], height_m: float) -> Array:
    """The point (3,), metres, by the sines and cosines of the angles."""
    (sin_lat, cos_lat), (sin_lon, cos_lon) = latitude, longitude
    normal_m = SEMI_MAJOR_M / math.sqrt(1 - _E2 * sin_lat**2)  # from the surface to the axis, along the normal
    from_axis_m = (normal_m + height_m) * cos_lat
    return np.array([from_axis_m * cos_lon, from_axis_m * sin_lon, (normal_m * (1 - _E2) + height_m) * sin_lat])


def geodetic_from_ecef(x_in_ecef: ArrayLike) -> GeoPosition:
    """The place of a point (3,) in ECEF; on the Earth's axis the longitude is 0.

    Bowring 1976, iterated: two iterations give a nanometre on the ground and in orbit. Within 50 km of the Earth's
    centre, where normals of the ellipsoid intersect, the result is not unique.
    """
    x, y, z = np.asarray(x_in_ecef, float).tolist()
    from_axis_m = math.hypot(x, y)
    latitude = math.atan2(z, from_axis_m * (1 - _E2))
    for _ in range(4):
        reduced = math.atan2((1 - FLATTENING) * math.sin(latitude), math.cos(latitude))
        latitude = math.atan2(
            z + _SECOND_E2 * SEMI_MINOR_M * math.sin(reduced) ** 3,
            max(from_axis_m - _E2 * SEMI_MAJOR_M * math.cos(reduced) ** 3, 0.0),
        )
    sine, cosine = math.sin(latitude), math.cos(latitude)
    # Unlike the usual p / cos(lat) - N, this is as exact at the poles.
    height_m = from_axis_m * cosine + z * sine - SEMI_MAJOR_M * math.sqrt(1 - _E2 * sine**2)
    return GeoPosition(math.degrees(latitude), math.degrees(math.atan2(y, x)), height_m)


def ecef_from_enu_at(place: GeoPosition) -> RigidTransform:
    """The frame east, north, up at a place. At a pole the longitude defines east."""
    latitude, longitude = _sine_and_cosine(place.latitude_deg), _sine_and_cosine(place.longitude_deg)
    (sin_lat, cos_lat), (sin_lon, cos_lon) = latitude, longitude
    # In columns: east, north, up.
    rotation = np.array(
        [
            (-sin_lon, -sin_lat * cos_lon, cos_lat * cos_lon),
            (cos_lon, -sin_lat * sin_lon, cos_lat * sin_lon),
            (0.0, cos_lat, sin_lat),
        ]
    )
    return RigidTransform(rotation, _point_in_ecef(latitude, longitude, place.height_m))


def geodetic_from_world(x_in_world: ArrayLike, datum: Datum) -> GeoPosition:
    """The place of a point (3,) of a scene's world."""
    return geodetic_from_ecef(datum.ecef_from_world().apply(x_in_world))


def world_from_geodetic(place: GeoPosition, datum: Datum) -> Array:
    """A place in a scene's world, (3,) metres."""
    return world_from_enu_at(place, datum).translation


def world_from_enu_at(place: GeoPosition, datum: Datum) -> RigidTransform:
    """The frame east, north, up at a place, as a pose in a scene's world.

    The covariance C of a receiver's east, north and up is R C R^T in the world, with R the rotation.
    """
    return datum.ecef_from_world().inverse().compose(ecef_from_enu_at(place))


def world_from_other_world(datum: Datum, other: Datum) -> RigidTransform:
    """The pose of another scene's world in a scene's world, both placed on the Earth by their datums.

    world_from_other = (ecef_from_world)^-1 ecef_from_other. It is as exact as the datums are, about the metres of a
    satellite receiver and the degrees of a compass, unless both were surveyed.
    """
    return datum.ecef_from_world().inverse().compose(other.ecef_from_world())


def geopose(world_from_camera: RigidTransform, datum: Datum) -> GeoPose:
    """The GeoPose of a camera (OpenCV's axes) in a scene's world."""
    place = geodetic_from_world(world_from_camera.translation, datum)
    enu_from_camera = world_from_enu_at(place, datum).rotation.T @ world_from_camera.rotation
    quaternion = Quaternion.from_matrix(enu_from_camera @ CV_FROM_CAMERA[Axes.ROS])
    return GeoPose(place.latitude_deg, place.longitude_deg, place.height_m, quaternion)


def pose_from_geopose(pose: GeoPose, datum: Datum) -> RigidTransform:
    """The inverse of `geopose`: `world_from_camera`, OpenCV's axes."""
    world_from_enu = world_from_enu_at(pose.position, datum)
    rotation = world_from_enu.rotation @ pose.quaternion.matrix() @ CV_FROM_CAMERA[Axes.ROS].T
    return RigidTransform(rotation, world_from_enu.translation)


def _sine_and_cosine(angle_deg: float) -> tuple[float, float]:
    """Exact at multiples of 90 degrees: the cosine of 90 degrees is 0, not 6e-17."""
    rest_deg = math.remainder(angle_deg, 90)
    sine, cosine = math.sin(math.radians(rest_deg)), math.cos(math.radians(rest_deg))
    quarter = round((angle_deg - rest_deg) / 90) % 4
    sine, cosine = ((sine, cosine), (cosine, -sine), (-sine, -cosine), (-cosine, sine))[quarter]
    return sine + 0.0, cosine + 0.0  # a zero without a sign: with one, longitude 180 would come back as -180


def _number(members: object, name: str, path: str = "") -> float:
    value = members.get(name) if isinstance(members, dict) else None
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= sys.float_info.max:
        raise ValueError(f"{path}{name} must be a number")
    return float(value)
