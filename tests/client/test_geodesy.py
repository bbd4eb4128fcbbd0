"""Places on the Earth against published pairs, and GeoPoses against what was derived by hand."""

import json
import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapless.geodesy import (
    Datum,
    GeoPose,
    GeoPosition,
    ecef_from_enu_at,
    ecef_from_geodetic,
    enu_from_y_up,
    enu_from_z_up,
    geodetic_from_ecef,
    geodetic_from_world,
    geopose,
    pose_from_geopose,
    world_from_enu_at,
    world_from_geodetic,
    world_from_other_world,
)
from mapless.geometry import Array, Quaternion, RigidTransform, rotation_from_vector

H = math.sqrt(0.5)
EQUATOR_M, POLE_M = 6378137.0, 6356752.314245
"""WGS84's semi-axes as published."""

PUBLISHED = {
    # By definition: on the equator a from the centre, at the poles b, heights along the normal.
    (0.0, 0.0, 0.0): ((EQUATOR_M, 0, 0), 1e-9),
    (0.0, 90.0, 100.0): ((0, EQUATOR_M + 100, 0), 1e-9),
    (0.0, 180.0, 0.0): ((-EQUATOR_M, 0, 0), 1e-9),
    (0.0, -90.0, -50.0): ((0, -EQUATOR_M + 50, 0), 1e-9),
    (90.0, 0.0, 0.0): ((0, 0, POLE_M), 1e-6),
    (-90.0, 0.0, 2800.0): ((0, 0, -POLE_M - 2800), 1e-6),
    # GeographicLib, CartConvert(1), to a centimetre.
    (33.3, 44.4, 6000.0): ((3816209.60, 3737108.55, 3485109.57), 0.006),
    # The documentation of brahe's geodetic transformations, to a millimetre.
    (37.7749, -122.4194, 16.0): ((-2706181.627, -4261070.165, 3885735.291), 0.0006),
}
"""Latitude, longitude and height; ECEF, and to what it is known, metres."""

latitude, longitude = st.floats(-90, 90), st.floats(-180, 180)
place = st.builds(GeoPosition, latitude, longitude, st.floats(-11_000, 50_000))
vector = st.tuples(*[st.floats(-3.0, 3.0)] * 3).map(np.array)
turn = vector.map(lambda w: RigidTransform(rotation_from_vector(w), np.zeros(3)).quaternion())
datum = st.builds(Datum, latitude, longitude, st.floats(-400, 9000), turn)
distance = st.floats(-10_000.0, 10_000.0)
offset = st.tuples(distance, distance, st.floats(-1000.0, 1000.0)).map(np.array)


@pytest.mark.parametrize("geodetic", PUBLISHED)
def test_places_are_where_they_are_published_to_be(geodetic: tuple[float, float, float]) -> None:
    expected, tolerance_m = PUBLISHED[geodetic]
    np.testing.assert_allclose(ecef_from_geodetic(GeoPosition(*geodetic)), expected, atol=tolerance_m)
    back = geodetic_from_ecef(expected)
    np.testing.assert_allclose(ecef_from_geodetic(back), expected, atol=1e-6)
    assert back.latitude_deg == pytest.approx(geodetic[0], abs=math.degrees(2 * tolerance_m / POLE_M))
    assert back.height_m == pytest.approx(geodetic[2], abs=2 * tolerance_m)
    if abs(geodetic[0]) < 90:
        assert back.longitude_deg == pytest.approx(geodetic[1], abs=1e-6)


def test_a_place_far_from_the_datum_matches_the_published_one() -> None:
    """GeographicLib: CartConvert(1) with -l 33 44 20, and LocalCartesian's example of Calais seen from Paris."""
    near = world_from_geodetic(GeoPosition(33.3, 44.4, 6000), Datum(33, 44, 20))
    np.testing.assert_allclose(near, (37288.97, 33374.29, 5783.64), atol=0.011)  # the last digit there is cut off
    calais = world_from_geodetic(GeoPosition(50.9, 1.8, 0), Datum(48 + 50 / 60, 2 + 20 / 60, 0))
    np.testing.assert_allclose(calais, (-37518.64, 229949.65, -4260.43), atol=0.006)


@given(place)
def test_there_and_back_is_the_same_place(it: GeoPosition) -> None:
    x_in_ecef = ecef_from_geodetic(it)
    back = geodetic_from_ecef(x_in_ecef)
    assert np.linalg.norm(ecef_from_geodetic(back) - x_in_ecef) < 1e-6
    assert back.height_m == pytest.approx(it.height_m, abs=1e-6)


@given(datum, offset)
def test_the_world_and_its_up_are_the_same_within_10_km(it: Datum, x_in_world: Array) -> None:
    there = geodetic_from_world(x_in_world, it)
    assert np.linalg.norm(world_from_geodetic(there, it) - x_in_world) < 1e-6
    higher = GeoPosition(there.latitude_deg, there.longitude_deg, there.height_m + 100)
    up = world_from_enu_at(there, it).rotation[:, 2]
    np.testing.assert_allclose(world_from_geodetic(higher, it) - x_in_world, 100 * up, atol=1e-5)


@given(place)
def test_east_north_and_up_point_where_coordinates_rise(it: GeoPosition) -> None:
    """The frame's axes against differences of `ecef_from_geodetic`, a metre or so in each direction."""
    if abs(it.latitude_deg) > 89:
        return
    step_deg = 1e-5
    axes = ecef_from_enu_at(it).rotation.T
    for axis, (latitude_deg, longitude_deg, height_m) in enumerate([(0, step_deg, 0), (step_deg, 0, 0), (0, 0, 1)]):
        if abs(it.longitude_deg) > 179.9:
            return
        one, other = (
            ecef_from_geodetic(
                GeoPosition(
                    it.latitude_deg + sign * latitude_deg,
                    it.longitude_deg + sign * longitude_deg,
                    it.height_m + sign * height_m,
                )
            )
            for sign in (-1, 1)
        )
        np.testing.assert_allclose((other - one) / np.linalg.norm(other - one), axes[axis], atol=1e-6)


@pytest.mark.parametrize(("latitude_deg", "longitude_deg"), [(0, 180), (60, 180), (0, 0), (90, 0), (-90, 0)])
def test_longitude_at_signed_zero_is_the_one_given(latitude_deg: float, longitude_deg: float) -> None:
    found = geodetic_from_ecef(ecef_from_geodetic(GeoPosition(latitude_deg, longitude_deg, 7.0)))
    assert found.longitude_deg == longitude_deg
    assert found.latitude_deg == pytest.approx(latitude_deg, abs=1e-12)


def test_the_antimeridian_is_crossed() -> None:
    """100 m on the equator are 100 / 6378137 rad = 0.000898315 degrees."""
    east = geodetic_from_world((100, 0, 0), Datum(0, 179.9999, 0))
    assert (east.latitude_deg, east.longitude_deg) == pytest.approx((0, -179.999201685), abs=1e-9)
    west = geodetic_from_world((-100, 0, 0), Datum(0, -179.9999, 0))
    assert (west.latitude_deg, west.longitude_deg) == pytest.approx((0, 179.999201685), abs=1e-9)
    np.testing.assert_allclose(world_from_geodetic(east, Datum(0, 179.9999, 0)), (100, 0, 0), atol=1e-6)


# GeoPose. A camera's axes are the columns of its pose: right, down, forward.

LOOKS_EAST = [(0, -1, 0), (0, 0, -1), (1, 0, 0)]
LOOKS_NORTH = [(1, 0, 0), (0, 0, -1), (0, 1, 0)]
LOOKS_DOWN_TOP_NORTH = [(1, 0, 0), (0, -1, 0), (0, 0, -1)]


def camera(axes: Sequence[tuple[float, ...]], position: tuple[float, ...] = (0, 0, 0)) -> RigidTransform:
    return RigidTransform(np.column_stack(axes).astype(float), np.array(position, float))


@pytest.mark.parametrize(
    ("axes", "expected"),
    [
        # Forward east, left north, up up: the axes of east, north, up themselves.
        (LOOKS_EAST, (0, 0, 0, 1)),
        # A quarter turn to the left, about up.
        (LOOKS_NORTH, (0, 0, H, H)),
        # Forward is down, left is west, the image's up is north: x -> -z, y -> -x, z -> y. The trace is 0, so w is 1/2;
        # x = (R21 - R12) / 4w = (0 - 1) / 2, y = (R02 - R20) / 4w = (0 + 1) / 2, z = (R10 - R01) / 4w = (0 + 1) / 2.
        (LOOKS_DOWN_TOP_NORTH, (-0.5, 0.5, 0.5, 0.5)),
    ],
)
def test_at_the_datum_a_geopose_is_what_was_derived_by_hand(
    axes: Sequence[tuple[float, ...]], expected: tuple[float, ...]
) -> None:
    found = geopose(camera(axes), Datum(47.5, 8.25, 400))
    assert tuple(vars(found.quaternion).values()) == pytest.approx(expected, abs=1e-9)
    assert (found.lat, found.lon, found.h) == pytest.approx((47.5, 8.25, 400), abs=1e-9)


def test_a_world_with_y_up_is_turned_by_its_datum() -> None:
    """The world has x east, y up, z south. A camera that looks along -z, upright, looks north."""
    it = Datum(47.5, 8.25, 400, enu_from_y_up(0))
    found = geopose(camera([(1, 0, 0), (0, -1, 0), (0, 0, -1)]), it)
    assert tuple(vars(found.quaternion).values()) == pytest.approx((0, 0, H, H), abs=1e-9)
    np.testing.assert_allclose(it.down_in_world(), (0, -1, 0), atol=1e-12)
    np.testing.assert_allclose(Datum(47.5, 8.25, 400).down_in_world(), (0, 0, -1), atol=0)
    higher = geodetic_from_world((0, 10, 0), it)
    assert tuple(vars(higher).values()) == pytest.approx((47.5, 8.25, 410), abs=1e-9)
    assert geodetic_from_world((0, 0, 10), it).latitude_deg < 47.5
    assert geodetic_from_world((10, 0, 0), it).longitude_deg > 8.25


@pytest.mark.parametrize(
    ("heading_deg", "ahead", "right"),
    # Ahead, then right of it, which is 90 degrees clockwise: east, north, up.
    [
        (0, (0, 1, 0), (1, 0, 0)),
        (90, (1, 0, 0), (0, -1, 0)),
        (-45, (-H, H, 0), (H, H, 0)),
        (270, (-1, 0, 0), (0, 1, 0)),
    ],
)
def test_a_world_is_turned_by_a_compass(heading_deg: float, ahead: tuple[float, ...], right: tuple[float, ...]) -> None:
    """Headsets: -z is ahead, x right, y up. Robots: x is ahead, y left, z up."""
    headset, robot = enu_from_y_up(heading_deg), enu_from_z_up(heading_deg)
    up = np.array([0, 0, 1])
    np.testing.assert_allclose(headset.matrix(), np.column_stack([right, up, -np.array(ahead)]), atol=1e-12)
    np.testing.assert_allclose(robot.matrix(), np.column_stack([ahead, -np.array(right), up]), atol=1e-12)
    assert headset.w >= 0
    assert robot.w >= 0
    assert enu_from_z_up(90) == Quaternion(0, 0, 0, 1)


def test_the_tangent_plane_is_at_the_pose_and_not_at_the_datum() -> None:
    """10 km straight east from the equator, along the tangent, the ground has turned away by atan(10 km / a).

    A camera that looks on along the tangent has its nose up by that angle, which about its left, north, is negative. It
    is sqrt(a^2 + 10 km^2) - a = 7.839 m above the ellipsoid.
    """
    angle = math.atan(10_000 / EQUATOR_M)
    found = geopose(camera(LOOKS_EAST, (10_000, 0, 0)), Datum(0, 20, 0))
    expected = (0, -math.sin(angle / 2), 0, math.cos(angle / 2))
    assert tuple(vars(found.quaternion).values()) == pytest.approx(expected, abs=1e-9)
    assert (found.lat, found.lon, found.h) == pytest.approx((0, 20 + math.degrees(angle), 7.8393), abs=1e-4)


def test_beside_a_pole_north_is_towards_it() -> None:
    """At the pole, east is ECEF's y if the datum's longitude is 0.

    100 m that way is on the meridian of 90 degrees, where looking on is looking south, a quarter turn right of east.
    """
    found = geopose(camera(LOOKS_EAST, (100, 0, 0)), Datum(90, 0, 0))
    assert tuple(vars(found.quaternion).values()) == pytest.approx((0, 0, -H, H), abs=2e-5)
    assert found.lon == pytest.approx(90, abs=1e-9)
    assert (90 - found.lat) * 111_694 == pytest.approx(100, abs=0.01)  # metres a degree at the pole


@given(datum, offset, vector)
def test_a_geopose_there_and_back_is_the_same_pose(it: Datum, position: Array, w: Array) -> None:
    pose = RigidTransform(rotation_from_vector(w), position)
    back = pose_from_geopose(GeoPose.from_json(json.loads(json.dumps(geopose(pose, it).to_json()))), it)
    assert np.linalg.norm(back.translation - pose.translation) < 1e-6
    np.testing.assert_allclose(back.rotation, pose.rotation, atol=1e-9)


# Values that are none


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ((90.1, 0, 0), "latitude_deg"),
        ((math.nan, 0, 0), "latitude_deg"),
        ((0, -180.1, 0), "longitude_deg"),
        ((0, 0, math.inf), "height_m"),
        ((0, 0, 1.1e5), "height_m"),
        ((0, 0, 0, Quaternion(0, 0, 0, 0)), "enu_from_world"),
        ((0, 0, 0, Quaternion(math.nan, 0, 0, 1)), "enu_from_world"),
    ],
)
def test_a_datum_that_is_none_is_refused_by_name(values: tuple[float, ...], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Datum(*values)  # type: ignore[arg-type]


def test_a_datum_there_and_back_through_json() -> None:
    for it in (Datum(1, -2, 3), Datum(0.1, 0.2, 0.3, enu_from_y_up(33))):
        assert Datum.from_json(json.loads(json.dumps(it.to_json()))) == it
    assert Datum.from_json({"latitude_deg": 1, "longitude_deg": -2, "height_m": 3}) == Datum(1, -2, 3)
    good = Datum(1, -2, 3).to_json()
    for content, said in (
        (None, "latitude_deg must be a number"),
        (good | {"height_m": "3"}, "height_m must be a number"),
        (good | {"latitude_deg": 91}, "latitude_deg must be -90 to 90"),
        (good | {"enu_from_world": 1}, "enu_from_world.x must be a number"),
        (good | {"enu_from_world": {"x": 0, "y": 0, "z": 0, "w": 2}}, "enu_from_world: quaternion"),
    ):
        with pytest.raises(ValueError, match=said):
            Datum.from_json(content)


def test_json_has_the_standards_members_and_no_others() -> None:
    content = GeoPose(1, -2, 3, Quaternion(0, 0, 0, 1)).to_json()
    assert content == {"position": {"lat": 1, "lon": -2, "h": 3}, "quaternion": {"x": 0, "y": 0, "z": 0, "w": 1}}
    assert all(type(number) is float for part in content.values() for number in part.values())


@pytest.mark.parametrize(
    ("part", "name", "value"),
    [
        ("position", "lat", 91),
        ("position", "lon", "8"),
        ("position", "h", None),
        ("position", "h", True),
        ("position", "h", 10**400),
        ("quaternion", "w", 2),
        ("quaternion", "x", math.nan),
    ],
)
def test_json_that_is_no_geopose_is_refused(part: str, name: str, value: object) -> None:
    content = GeoPose(1, -2, 3, Quaternion(0, 0, 0, 1)).to_json()
    assert GeoPose.from_json(content | {"accuracy": 1}) == GeoPose.from_json(content)
    with pytest.raises(ValueError, match=r"number|must"):
        GeoPose.from_json({**content, part: {**content[part], name: value}})
    with pytest.raises(ValueError, match=f"{part}.{name} must be a number"):
        GeoPose.from_json({**content, part: {it: number for it, number in content[part].items() if it != name}})


@pytest.mark.parametrize("content", [None, [], {}, {"position": 1}, "text", 1])
def test_what_is_not_even_an_object_is_refused(content: object) -> None:
    with pytest.raises(ValueError, match="must be a number"):
        GeoPose.from_json(content)


@given(datum, datum, offset)
def test_one_world_in_another_is_where_the_earth_has_it(here: Datum, there: Datum, x_in_there: Array) -> None:
    place = geodetic_from_world(x_in_there, there)
    moved = world_from_other_world(here, there).apply(x_in_there)
    np.testing.assert_allclose(moved, world_from_geodetic(place, here), atol=1e-5)
