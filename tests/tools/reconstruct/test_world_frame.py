"""Unit, origin and way up by distances, positions, gravity and GPS: planted ones are found, contradictions named."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps
from support.tags import looking, part_of, posed_without_file

from mapless.geodesy import Datum, geodetic_from_world, world_from_geodetic
from mapless.geometry import Array, Camera, RigidTransform, rotation_from_vector
from mapless_server.images.exif import Exif, GpsPosition
from mapless_tools.ingest.command import DISTANCE_SEPARATOR
from mapless_tools.reconstruct.pictures import Part, WorldFrame
from mapless_tools.reconstruct.world.down import DOWN_OF_ORIENTATION
from mapless_tools.reconstruct.world.flags import WorldFlags
from mapless_tools.reconstruct.world.placing import place

CAMERA = Camera(480, 360, 420.0, 420.0, 239.5, 179.5)
PLACE = Datum(47.37, 8.54, 410.0)
"""The planted world: x east, y north, z up."""


def poses(count: int = 24, radius_m: float = 3.0) -> list[RigidTransform]:
    """An orbit around the origin, upright, at different heights."""
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return [
        looking((radius_m * np.cos(a), radius_m * np.sin(a), radius_m * (0.3 + 0.1 * np.sin(3 * a))), (0, 0, 0.3))
        for a in angles
    ]


def street(count: int = 30, length_m: float = 90.0) -> list[RigidTransform]:
    """A straight way to the north-east, looking in several directions."""
    along = np.linspace(0, length_m, count)
    aside = np.array([np.sin(0.3 * it) for it in along])
    return [
        looking((0.7 * it, 0.7 * it, 1.6), (0.7 * it + 4 * a, 0.7 * it + 5, 1.5))
        for it, a in zip(along, aside, strict=True)
    ]


def part_with(truth: Sequence[RigidTransform], exif: Sequence[Exif] | None = None) -> Part:
    """A reconstruction of these cameras in the planted frame and unit."""
    tags = exif or [Exif()] * len(truth)
    return part_of(
        [
            posed_without_file(Path(f"r{i}.jpg"), CAMERA, pose, it)
            for i, (pose, it) in enumerate(zip(truth, tags, strict=True))
        ]
    )


def gps(truth: Sequence[RigidTransform], noise_m: float, accuracy_m: float | None = None, **exif: Any) -> list[Exif]:
    """EXIF with positions of this noise, heights of three times as much."""
    generator = np.random.default_rng(3)
    found = []
    for pose in truth:
        off_m = noise_m * generator.standard_normal(3) * [1, 1, 3]
        at = geodetic_from_world(pose.translation + off_m, PLACE)
        found.append(Exif(position=GpsPosition(at.latitude_deg, at.longitude_deg, at.height_m, accuracy_m), **exif))
    return found


def placed(part: Part, **flags: Any) -> tuple[Part, WorldFrame]:
    return place(part, WorldFlags(**flags).options(), lambda *_: None)


def distance(first: str, second: str, metres: float) -> str:
    """The values of the flag, as the command joins them."""
    return DISTANCE_SEPARATOR.join((first, second, repr(metres)))


def centres(part: Part) -> Array:
    return np.array([it.world_from_camera.translation for it in part.posed])


def size_ratio(part: Part, truth: Sequence[RigidTransform]) -> float:
    """Spread of the cameras over the true one, whatever the axes."""

    def spread(points: Array) -> float:
        return float(np.linalg.norm(points - points.mean(axis=0)))

    return spread(centres(part)) / spread(np.array([it.translation for it in truth]))


def down_error_deg(part: Part, frame: WorldFrame, truth: Sequence[RigidTransform]) -> float:
    """Angle of the frame's down to the true one, by the first camera."""
    assert frame.down_in_world is not None
    in_camera = part.posed[0].world_from_camera.rotation.T @ frame.down_in_world
    true_in_camera = truth[0].rotation.T @ [0, 0, -1]
    return float(np.degrees(np.arccos(np.clip(in_camera @ true_in_camera, -1, 1))))


def csv_of(file: Path, rows: dict[str, Array]) -> Path:
    file.write_text("".join(f"{name},{','.join(map(repr, it.tolist()))}\n" for name, it in rows.items()))
    return file


def test_without_anything_the_unit_is_arbitrary_and_z_is_up() -> None:
    part, frame = placed(part_with(poses()))
    assert not frame.is_metric
    assert frame.datum is None
    assert size_ratio(part, poses()) == pytest.approx(1 / 0.37)
    np.testing.assert_allclose(frame.down_in_world, (0, 0, -1), atol=1e-6)  # type: ignore[arg-type]
    assert down_error_deg(part, frame, poses()) < 0.5
    np.testing.assert_allclose(centres(part)[0], 0, atol=1e-9)
    assert "--tag" in frame.notes[-1]
    assert "only that of the horizons of 24 cameras" in frame.warnings[-1]


def test_points_move_with_the_cameras() -> None:
    truth = poses()
    points = np.random.default_rng(0).normal(size=(20, 3))
    part = part_of(part_with(truth).posed, points)
    found, _ = placed(part, distance=[distance("r0", "r12", 6.0)])
    for it, pose in zip(found.posed, truth, strict=True):
        seen = CAMERA.project(it.world_from_camera.inverse().apply(found.points_in_world))
        np.testing.assert_allclose(seen, CAMERA.project(pose.inverse().apply(points)), atol=1e-6)


def test_distances_give_the_unit_and_contradictions_are_refused() -> None:
    truth = poses()

    def known(first: int, second: int, factor: float = 1.0) -> str:
        metres = float(np.linalg.norm(truth[first].translation - truth[second].translation))
        return distance(f"r{first}", f"r{second}.jpg", factor * metres)

    part, frame = placed(part_with(truth), distance=[known(0, 12, 1.005), known(3, 9)])
    assert size_ratio(part, truth) == pytest.approx(1, abs=0.005)
    assert 0.002 < frame.scale_sigma < 0.02
    with pytest.raises(ValueError, match="contradict each other"):
        placed(part_with(truth), distance=[known(0, 12), known(3, 9, 1.3)])
    with pytest.raises(ValueError, match="no reference 'r99'"):
        placed(part_with(truth), distance=[distance("r0", "r99", 1.0)])


def test_positions_of_some_photographs_give_unit_frame_and_up(tmp_path: Path) -> None:
    truth = poses()
    generator = np.random.default_rng(1)
    known = {f"r{i}": truth[i].translation + 0.005 * generator.standard_normal(3) for i in range(0, 24, 3)}
    file = csv_of(tmp_path / "known.csv", {**known, "of-another-part": np.zeros(3)})
    part, frame = placed(part_with(truth), positions=file, positions_up="z")
    np.testing.assert_allclose(centres(part), [it.translation for it in truth], atol=0.02)
    np.testing.assert_allclose(frame.down_in_world, (0, 0, -1), atol=1e-6)  # type: ignore[arg-type]
    assert abs(size_ratio(part, truth) - 1) < 3 * frame.scale_sigma
    assert "known.csv: 1 of 9 positions are of other photographs" in frame.notes
    with pytest.raises(ValueError, match=r"contradicts itself.*by distances: .*; known\.csv: "):
        placed(part_with(truth), positions=file, distance=[distance("r0", "r12", 7.0)])


def test_poses_of_arkit_give_metres_and_gravity(tmp_path: Path) -> None:
    """A folder of 3D Scanner App, whose world has y up; its photographs are those of the reconstruction."""
    truth = poses()
    y_up_from_world = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    for i, pose in enumerate(truth):
        name = f"frame_{i:05d}"
        cv2.imwrite(str(tmp_path / f"{name}.jpg"), np.zeros((360, 480, 3), np.uint8))
        gl = np.eye(4)
        gl[:3, :3] = y_up_from_world @ pose.rotation @ np.diag([1.0, -1, -1])
        gl[:3, 3] = y_up_from_world @ pose.translation
        content = {"cameraPoseARFrame": gl.ravel().tolist(), "intrinsics": CAMERA.matrix().ravel().tolist()}
        (tmp_path / f"{name}.json").write_text(json.dumps(content))
    posed = [posed_without_file(tmp_path / f"frame_{i:05d}.jpg", CAMERA, it) for i, it in enumerate(truth)]
    part, frame = placed(part_of(posed), positions=tmp_path)
    assert size_ratio(part, truth) == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(frame.down_in_world, (0, -1, 0), atol=1e-6)  # type: ignore[arg-type]
    assert not frame.warnings


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("r0,1,2\n", "line 1: must be name, x, y, z"),
        ("r0,1,2,3\nr1,1,2,x\n", "line 2: x, y, z must be numbers"),
        ("r0,1,2,inf\n", "is not finite"),
        ("nobody,1,2,3\n", "none of its names"),
        ("r0,1,2,3\nr1,2,2,3\n", "has 2 known positions"),
    ],
)
def test_bad_positions_and_gravity_are_named(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "known.csv"
    file.write_text(text)
    with pytest.raises(ValueError, match=message):
        placed(part_with(poses()), positions=file)
    if "positions" not in message:
        with pytest.raises(ValueError, match=message):
            placed(part_with(poses()), gravity=file)
    with pytest.raises(ValueError, match="cannot be read"):
        placed(part_with(poses()), positions=tmp_path / "none.csv")


def test_gravity_of_a_device_is_used_and_horizons_that_contradict_named(tmp_path: Path) -> None:
    """All cameras are rolled by 90 degrees, without EXIF that says so."""
    rolled = [replace(it, rotation=it.rotation @ rotation_from_vector([0, 0, np.pi / 2])) for it in poses()]
    generator = np.random.default_rng(2)
    file = csv_of(
        tmp_path / "gravity.csv",
        {
            f"r{i}": 9.81 * (it.rotation.T @ [0, 0, -1]) + 0.1 * generator.standard_normal(3)
            for i, it in enumerate(rolled)
        },
    )
    part, frame = placed(part_with(rolled), gravity=file)
    assert down_error_deg(part, frame, rolled) < 0.5
    wrong_axes = csv_of(tmp_path / "world.csv", {f"r{i}": np.array([0, 0, -1.0]) for i in range(len(rolled))})
    with pytest.raises(ValueError, match="must be in the camera's axes"):
        placed(part_with(rolled), gravity=wrong_axes)
    upside_down = csv_of(tmp_path / "up.csv", {f"r{i}": it.rotation.T @ [0, 0, 1] for i, it in enumerate(poses())})
    _, frame = placed(part_with(poses()), gravity=upside_down)
    assert "is 180 degrees off that by the horizons" in frame.warnings[0]


def test_rolled_photographs_do_not_move_the_way_down() -> None:
    generator = np.random.default_rng(4)
    rolls = np.where(np.arange(24) % 3 == 0, np.pi / 2, 0.05 * generator.standard_normal(24))
    rolled = [
        replace(it, rotation=it.rotation @ rotation_from_vector([0, 0, roll]))
        for it, roll in zip(poses(), rolls, strict=True)
    ]
    part, frame = placed(part_with(rolled))
    assert down_error_deg(part, frame, rolled) < 2
    assert "8 are rolled" in frame.warnings[-1]


def down_by_pillow(orientation: int) -> tuple[int, int]:
    """Where the second row of the upright raster is from its first, in columns and rows of the stored one."""
    stored = Image.fromarray(np.arange(9, dtype=np.uint8).reshape(3, 3))
    stored.getexif()[0x0112] = orientation
    upright = np.asarray(ImageOps.exif_transpose(stored))
    (row, column), (next_row, next_column) = (divmod(int(upright[i, 0]), 3) for i in (0, 1))
    return next_column - column, next_row - row


@pytest.mark.parametrize("orientation", sorted(DOWN_OF_ORIENTATION))
def test_the_orientation_of_exif_shows_which_way_is_up(orientation: int) -> None:
    x, y = down_by_pillow(orientation)
    assert (x, y) == DOWN_OF_ORIENTATION[orientation]
    roll = np.arctan2(x, y)  # turns the camera so that (x, y) of the raster points down
    turned = [replace(it, rotation=it.rotation @ rotation_from_vector([0, 0, roll])) for it in poses()]
    np.testing.assert_allclose(turned[0].rotation @ [x, y, 0], poses()[0].rotation[:, 1], atol=1e-9)
    part, frame = placed(part_with(turned, [Exif(orientation=orientation)] * 24))
    assert down_error_deg(part, frame, turned) < 0.5


def test_cameras_held_in_all_ways_show_no_way_up() -> None:
    generator = np.random.default_rng(5)
    tumbled = [replace(it, rotation=rotation_from_vector(generator.normal(0, 2, 3))) for it in poses()]
    _, frame = placed(part_with(tumbled))
    assert frame.down_in_world is None
    assert "the way down is not known" in frame.warnings[-1]


@pytest.mark.parametrize("way", [poses(30, 60.0), street()])
def test_gps_over_a_long_way_gives_unit_datum_and_north(way: list[RigidTransform]) -> None:
    part, frame = placed(part_with(way, gps(way, 1.0)))
    assert frame.is_metric
    assert abs(size_ratio(part, way) - 1) < 3 * frame.scale_sigma
    assert frame.scale_sigma < 0.05
    assert frame.datum is not None
    for it, pose in zip(part.posed, way, strict=True):
        at = geodetic_from_world(it.world_from_camera.translation, frame.datum)
        assert np.linalg.norm((world_from_geodetic(at, PLACE) - pose.translation)[:2]) < 3
    assert down_error_deg(part, frame, way) < 3


def test_false_gps_is_named_and_left_out() -> None:
    way = street()
    exif = gps(way, 0.5)
    exif[3] = Exif(position=GpsPosition(0.0, -30.0))
    exif[7] = Exif(position=GpsPosition(47.38, 8.54, 410.0))
    exif[9] = Exif(position=GpsPosition(0.0001, 0.0001))
    for i in range(12, 16):  # a position that is repeated while the camera moves on
        exif[i] = exif[24]
    part, frame = placed(part_with(way, exif))
    assert size_ratio(part, way) == pytest.approx(1, abs=0.03)
    text = "\n".join(frame.warnings)
    assert "GPS of 6 of 29 photographs contradicts that of the others and is not used: r3, r7, r12 and 3 more" in text
    assert "GPS of 1 photographs is 0, 0" in text


def test_gps_of_a_room_gives_no_unit_but_the_place() -> None:
    for exif in (gps(poses(), 3.0, 5.0), [gps(poses(), 3.0)[0]] * 24):
        part, frame = placed(part_with(poses(), exif))
        assert not frame.is_metric
        assert frame.datum is None
        assert size_ratio(part, poses()) == pytest.approx(1 / 0.37)
        text = "\n".join(frame.notes)
        assert "GPS gives no unit" in text
        assert "taken about 47.3" in text
        assert "there is no datum: it needs the unit" in text


def test_compass_and_a_distance_give_a_room_its_datum() -> None:
    truth = poses()
    exif = [
        replace(it, direction_deg=float(np.degrees(np.arctan2(*pose.rotation[:2, 2]))) % 360)
        for it, pose in zip(gps(truth, 3.0, 5.0), truth, strict=True)
    ]
    metres = float(np.linalg.norm(truth[0].translation - truth[12].translation))
    flags = {"distance": [distance("r0", "r12", metres)]}
    part, frame = placed(part_with(truth, exif), **flags)
    assert frame.is_metric
    assert frame.datum is not None
    way = centres(part)[12] - centres(part)[0]
    np.testing.assert_allclose(way, truth[12].translation - truth[0].translation, atol=0.2)
    assert "north is known to 10 degrees (1 sigma) by the compass" in "\n".join(frame.notes)
    _, frame = placed(part_with(truth, gps(truth, 3.0, 5.0)), **flags)
    assert frame.datum is None
    assert "neither the way of the cameras nor a compass shows north" in "\n".join(frame.notes)


def test_gps_that_contradicts_a_distance_is_named() -> None:
    way = street()
    metres = 1.3 * float(np.linalg.norm(way[0].translation - way[20].translation))
    part, frame = placed(part_with(way, gps(way, 0.5)), distance=[distance("r0", "r20", metres)])
    assert size_ratio(part, way) == pytest.approx(1.3, abs=0.01)
    assert "GPS contradicts the unit" in "\n".join(frame.warnings)


def test_two_positions_that_contradict_give_no_datum() -> None:
    zurich, bern = GpsPosition(47.3769, 8.5417, 400.0), GpsPosition(46.9480, 7.4474, 540.0)
    exif = [Exif(position=zurich, direction_deg=10.0), Exif(position=bern), *[Exif()] * 22]
    metres = float(np.linalg.norm(poses()[0].translation - poses()[12].translation))
    _, frame = placed(part_with(poses(), exif), distance=[distance("r0", "r12", metres)])
    assert frame.datum is None
    assert "GPS of 2 photographs is not used" in "\n".join(frame.warnings)


def test_gps_of_a_drone_that_looks_down_gives_up() -> None:
    generator = np.random.default_rng(6)
    down = [
        RigidTransform(
            rotation_from_vector([0, 0, turn]) @ np.diag([1.0, -1, -1]), np.array([x, y, 40 + 10 * generator.random()])
        )
        for x, y, turn in generator.uniform([0, 0, 0], [120, 90, 6.3], (30, 3))
    ]
    part, frame = placed(part_with(down, gps(down, 0.5)))
    assert frame.is_metric
    assert abs(size_ratio(part, down) - 1) < 3 * frame.scale_sigma
    assert down_error_deg(part, frame, down) < 3


def test_gps_can_be_left_out() -> None:
    way = street()
    _, frame = placed(part_with(way, gps(way, 0.5)), gps=False)
    assert not frame.is_metric
    assert "GPS:" not in "\n".join(frame.notes)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ({"positions": Path("a"), "tag": ["36h11:0=1"], "origin": "36h11:0"}, "one of --origin and --positions"),
        ({"positions": Path("a"), "positions_up": "up"}, "positions_up must be one of x, y, z"),
        ({"positions_up": "y"}, "positions, which are not given"),
        ({"distance": [distance("a", "b", 0.0)]}, "--distance a b 0.0: .* must be above 0 m"),
        ({"distance": ["a\0b\0two"]}, "--distance a b two: metres must be numbers"),
    ],
)
def test_flags_that_do_not_fit_together_are_named(flags: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        WorldFlags(**flags).options()
