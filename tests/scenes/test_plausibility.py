"""A scene's datum, down and unit against the poses of its references: planted mistakes are named, and no others."""

import numpy as np
import pytest

from mapless.geodesy import Datum, enu_from_y_up, enu_from_z_up
from mapless.geometry import Array, RigidTransform, rotation_from_vector
from mapless.scenes import unit_vector
from mapless_server.scenes.plausibility import contradictions, typical_down
from mapless_server.store import SceneAttributes

Y_DOWN = (0.0, 1.0, 0.0)


def cameras(
    headings_deg: float, pitch_deg: float = 0.0, roll_deg: float = 4.0, sideways: bool = False, count: int = 40
) -> list[RigidTransform]:
    """Hand-held cameras of a world whose y is down, 5 m about the origin, with headings spread over so many degrees."""
    generator = np.random.default_rng(7)
    poses = []
    for heading in np.radians(np.linspace(-headings_deg / 2, headings_deg / 2, count)):
        roll = np.radians(generator.normal(90 if sideways else 0, roll_deg))
        pitch = np.radians(generator.normal(pitch_deg, 8))
        rotation = (
            rotation_from_vector(np.array([0, heading, 0]))
            @ rotation_from_vector(np.array([-pitch, 0, 0]))
            @ rotation_from_vector(np.array([0, 0, roll]))
        )
        poses.append(RigidTransform(rotation, generator.uniform(-5, 5, 3)))
    return poses


def moved(poses: list[RigidTransform], factor: float, offset_m: float = 0.0) -> list[RigidTransform]:
    """Poses in another unit, or elsewhere."""
    return [RigidTransform(it.rotation, factor * it.translation + offset_m) for it in poses]


def test_a_few_added_references_are_examined_alone() -> None:
    """Ten among a hundred change no median: in millimetres, upside down, or far from a datum's origin."""
    stored, upright = cameras(360, count=100), SceneAttributes(down_in_world=Y_DOWN)
    added = cameras(200, count=10)
    assert contradictions(stored, upright, added) == contradictions(stored, upright, added[:1]) == []
    (text,) = contradictions(stored, upright, moved(added, 1000))
    assert "are they in another unit" in text
    upside_down = [RigidTransform(it.rotation @ np.diag([-1.0, -1, 1]), it.translation) for it in added]
    (text,) = contradictions(stored, upright, upside_down)
    assert "degrees off the down of 10 reference cameras" in text
    datum = SceneAttributes(Datum(47, 8, 400, enu_from_y_up(0)))
    upright_in_it = [RigidTransform(np.diag([1.0, -1, -1]) @ it.rotation, it.translation) for it in stored]
    (text,) = contradictions(upright_in_it, datum, moved(upright_in_it[:1], 1, 50_000))
    assert "km from the world's origin" in text


def test_photographs_of_one_place_are_no_contradiction() -> None:
    """A burst is the first thing that many a scene gets."""
    burst = at(np.zeros((4, 3)) + np.arange(4)[:, None] * 1e-3)
    assert contradictions([], SceneAttributes(), burst) == contradictions(burst, SceneAttributes()) == []


def at(positions: Array) -> list[RigidTransform]:
    """Upright cameras at positions (N, 3)."""
    return [RigidTransform(np.eye(3), position) for position in positions]


WALKS = {
    "all around": cameras(360),
    "all around, looking down by 40 degrees": cameras(360, 40),
    "one wall": cameras(10),
    "one wall, looking down by 30 degrees": cameras(10, 30),
    "a right angle": cameras(90),
}


@pytest.mark.parametrize("walk", WALKS)
def test_a_right_down_is_accepted_and_others_are_named(walk: str) -> None:
    poses = WALKS[walk]
    assert contradictions(poses, SceneAttributes(down_in_world=unit_vector(0.05, 1, -0.1))) == []
    (text,) = contradictions(poses, SceneAttributes(down_in_world=(0.0, -1.0, 0.0)))
    assert "down_in_world (0, -1, 0)" in text
    assert "is it up?" in text
    (text,) = contradictions(poses, SceneAttributes(down_in_world=(0.0, 0.0, -1.0)))
    assert "degrees off the down of 40 reference cameras" in text


def test_headings_show_down_to_a_few_degrees() -> None:
    found = typical_down(cameras(360, 30))
    assert found is not None
    assert found.direction @ Y_DOWN > np.cos(np.radians(3))
    tilted = unit_vector(0, np.cos(np.radians(30)), np.sin(np.radians(30)))
    (text,) = contradictions(cameras(360, 30), SceneAttributes(down_in_world=tilted))
    assert "(at most 20 are plausible)" in text


@pytest.mark.parametrize("headings_deg", [10, 360])
def test_cameras_on_their_side_agree_with_down(headings_deg: float) -> None:
    poses = cameras(headings_deg, sideways=True)
    assert contradictions(poses, SceneAttributes(down_in_world=Y_DOWN)) == []
    assert contradictions(poses, SceneAttributes(down_in_world=(0.0, 0.0, 1.0)))


def test_too_few_or_tumbling_cameras_contradict_nothing() -> None:
    generator = np.random.default_rng(3)
    tumbling = [RigidTransform(rotation_from_vector(generator.normal(0, 2, 3)), np.zeros(3)) for _ in range(60)]
    assert typical_down(tumbling) is None
    assert typical_down(WALKS["one wall"][:2]) is None
    upside_down = SceneAttributes(down_in_world=(0.0, -1.0, 0.0), arbitrary_unit=True)
    assert contradictions(tumbling, upside_down) == contradictions(WALKS["one wall"][:2], upside_down) == []
    assert contradictions([], upside_down) == []


def test_a_datum_that_takes_z_for_up_is_named() -> None:
    poses = WALKS["all around"]
    upside_down = Datum(47, 8, 400, enu_from_y_up(20))
    assert "the datum's down" in contradictions(poses, SceneAttributes(upside_down))[0]
    assert "degrees off" in contradictions(poses, SceneAttributes(Datum(47, 8, 400, enu_from_z_up(20))))[0]


def test_coordinates_of_a_map_projection_are_far_from_a_datum() -> None:
    utm = np.array([465_000.0, 5_247_000.0, 410.0])
    poses = at(utm + np.random.default_rng(1).uniform(-20, 20, (10, 3)))
    assert contradictions(poses, SceneAttributes()) == []
    far, high = SceneAttributes(Datum(47, 8, 0)), SceneAttributes(Datum(47, 8, 60_000))
    assert any("km from the world's origin" in text for text in contradictions(poses, far))
    near = at(np.random.default_rng(1).uniform(-20, 20, (10, 3)))
    assert any("m above the ellipsoid" in text for text in contradictions(near, high))
    assert not any("origin" in text or "ellipsoid" in text for text in contradictions(near, far))


@pytest.mark.parametrize(("factor", "expected"), [(1.0, ""), (1e4, "millimetres?"), (1e-4, "kilometres")])
def test_impossible_units_are_named_unless_the_unit_is_arbitrary(factor: float, expected: str) -> None:
    poses = moved(cameras(360), factor)
    found = contradictions(poses, SceneAttributes())
    assert (expected in found[0]) if expected else (found == [])
    assert contradictions(poses, SceneAttributes(arbitrary_unit=True)) == []


@pytest.mark.parametrize("noise_m", [0.0, 1e-6, 0.001, 0.005])
def test_a_robot_that_stands_still_is_not_asked_for_its_unit(noise_m: float) -> None:
    generator = np.random.default_rng(2)
    standing = [
        RigidTransform(rotation_from_vector(generator.normal(0, 0.002, 3)), position)
        for position in [3.0, 2.0, 1.0] + generator.normal(0, noise_m, (30, 3))
    ]
    assert contradictions(standing, SceneAttributes()) == []
    assert contradictions(cameras(360), SceneAttributes(), standing) == []
    assert contradictions(standing, SceneAttributes(), cameras(360)) == []


def test_a_straight_drive_in_kilometres_is_named() -> None:
    along = np.linspace(0, 0.015, 30)[:, None] * [1.0, 0, 0]
    generator = np.random.default_rng(2)
    poses = at(along + generator.normal(0, 2e-5, along.shape))
    assert "kilometres" in contradictions(poses, SceneAttributes())[0]


def test_latitudes_and_longitudes_are_named() -> None:
    walked_m = np.random.default_rng(1).uniform(-30, 30, (20, 3)) * [1, 1, 0.05]
    degrees = np.array([47.3769, 8.5417, 455]) + walked_m * [9e-6, 1.3e-5, 1]
    for order in ([0, 1, 2], [1, 0, 2], [2, 0, 1]):
        (text,) = contradictions(at(degrees[:, order]), SceneAttributes())
        assert "latitudes and longitudes in degrees" in text
    assert contradictions(at(np.array([47.3769, 8.5417, 455]) + walked_m), SceneAttributes()) == []
