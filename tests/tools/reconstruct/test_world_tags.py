"""The unit and the origin by tags: planted sizes are found, and tags that lie are named."""

import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.tags import PrintedTag, looking, part_of, photographed, posed_picture

from mapless.geometry import Array, Camera, RigidTransform, rotation_from_vector
from mapless.lenses import RadialTangential
from mapless_tools.reconstruct.pictures import Part, WorldFrame
from mapless_tools.reconstruct.world.corners import LIGHT
from mapless_tools.reconstruct.world.flags import WorldFlags
from mapless_tools.reconstruct.world.options import FAMILIES
from mapless_tools.reconstruct.world.placing import place

WALK = Path(__file__).parents[3] / "server" / "research" / "rendered_room" / "walk.mp4"
CAMERA = Camera(480, 360, 420.0, 420.0, 239.5, 179.5)
APRIL, ARUCO = cv2.aruco.DICT_APRILTAG_36h11, cv2.aruco.DICT_4X4_50
ON_WALL = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""Axes of a tag on a wall that is seen along +y: x right, y down, z into the wall."""
EYES = [(-0.5, -1.0, 1.2), (-0.2, -1.1, 1.4), (0.1, -0.9, 1.1), (0.4, -1.0, 1.3), (0.6, -1.2, 1.5)]


def on_wall(x: float, number: int = 0, edge_m: float = 0.16, dictionary: int = APRIL) -> PrintedTag:
    return PrintedTag(dictionary, number, edge_m, RigidTransform(ON_WALL, np.array([x, 0.0, 1.3])))


def walk(count: int = 5) -> list[RigidTransform]:
    return [looking(eye, (0.0, 0.0, 1.3)) for eye in EYES[:count]]


def placed(part: Part, *tags: str, origin: str = "") -> tuple[Part, WorldFrame]:
    return place(part, WorldFlags(tag=[*tags], origin=origin).options(), lambda *_: None)


def length_ratio(part: Part, truth: Sequence[RigidTransform]) -> float:
    """The length of the way of the cameras in the world over the true one."""

    def way(centres: Array) -> float:
        return float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum())

    return way(np.array([it.world_from_camera.translation for it in part.posed])) / way(
        np.array([it.translation for it in truth])
    )


def warnings_of(frame: WorldFrame) -> str:
    return "\n".join(frame.warnings)


@pytest.mark.parametrize(("text", "dictionary"), [("36h11:0=0.16", APRIL), ("4x4_50:0=0.16", ARUCO)])
def test_a_tag_gives_metres_origin_and_axes(tmp_path: Path, text: str, dictionary: int) -> None:
    tag = on_wall(0.0, dictionary=dictionary)
    part, frame = placed(photographed(tmp_path, CAMERA, walk(), [tag]), text, origin=text.partition("=")[0])
    assert frame.is_metric
    assert not [it for it in frame.warnings if it.startswith("tag")]
    assert length_ratio(part, walk()) == pytest.approx(1, abs=0.005)
    assert abs(length_ratio(part, walk()) - 1) < 3 * frame.scale_sigma
    for it, pose in zip(part.posed, walk(), strict=True):
        expected = tag.world_from_tag.inverse().compose(pose).matrix()
        np.testing.assert_allclose(it.world_from_camera.matrix(), expected, atol=0.01)
    np.testing.assert_allclose(frame.down_in_world, (0, 1, 0), atol=0.1)  # type: ignore[arg-type]


def test_a_lens_is_undistorted(tmp_path: Path) -> None:
    """Photographs of a pinhole, resampled to what the lens shows."""
    lens = Camera(480, 360, 300.0, 300.0, 239.5, 179.5, RadialTangential(-0.25, 0.06))
    part = photographed(tmp_path, lens.pinhole(), walk(), [on_wall(0.25)])
    columns, rows = np.meshgrid(np.arange(480.0), np.arange(360.0))
    shown = np.stack([columns, rows], -1).reshape(-1, 1, 2)
    d = lens.distortion
    assert isinstance(d, RadialTangential)
    ideal = cv2.undistortPoints(shown, lens.matrix(), np.array([d.k1, d.k2, d.p1, d.p2]), P=lens.matrix())
    at = ideal.reshape(360, 480, 2).astype(np.float32)
    posed = []
    for i, pose in enumerate(walk()):
        image = cv2.imread(str(part.posed[i].picture.path))
        assert image is not None
        bent = cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_CUBIC)
        posed.append(posed_picture(tmp_path, f"bent-{i}", np.asarray(bent, np.uint8), lens, pose))
    found, frame = placed(part_of(posed), "36h11:0=0.16")
    assert frame.is_metric
    assert length_ratio(found, walk()) == pytest.approx(1, abs=0.01)


def test_the_rendered_room_has_metres_by_a_tag(tmp_path: Path) -> None:
    """Frames of the video of `make demo-video`: blurred, overexposed and compressed as a camera does."""
    av = pytest.importorskip("av", reason="needs the extra reconstruct")
    truth = json.loads(WALK.with_suffix(".json").read_text())
    k = np.array(truth["K"])
    camera = Camera(640, 480, k[0, 0], k[1, 1], k[0, 2], k[1, 2])
    chosen = range(72, 128, 5)
    with av.open(str(WALK)) as video:
        frames = {i: it.to_ndarray(format="bgr24") for i, it in enumerate(video.decode(video=0)) if i in chosen}
    poses = {i: RigidTransform.from_matrix(truth["world_from_camera"][i]) for i in chosen}
    posed = [posed_picture(tmp_path, f"frame-{i}", it, camera, poses[i]) for i, it in frames.items()]
    found, frame = placed(part_of(posed), "36h11:0=0.16")
    ratio = length_ratio(found, [*poses.values()])
    assert ratio == pytest.approx(1, abs=0.01)
    assert abs(ratio - 1) < 2 * frame.scale_sigma


def test_two_tags_agree_and_a_wrong_size_is_named_by_three(tmp_path: Path) -> None:
    tags = [on_wall(-0.25, 0), on_wall(0.0, 1), on_wall(0.25, 2, edge_m=0.10)]
    part = photographed(tmp_path, CAMERA, walk(), tags)
    both, frame = placed(part, "36h11:0=0.16", "36h11:1=0.16")
    assert length_ratio(both, walk()) == pytest.approx(1, abs=0.005)
    assert not [it for it in frame.warnings if it.startswith("tag")]
    found, frame = placed(part, "36h11:0=0.16", "36h11:1=0.16", "36h11:2=0.16")
    assert length_ratio(found, walk()) == pytest.approx(1, abs=0.005)
    assert "tag 36h11:2 is not used: by it lengths are 1.6" in warnings_of(frame)
    with pytest.raises(ValueError, match=r"contradicts itself: .* by tag 36h11:0: 0\.37\d* m .*tag 36h11:2: 0\.5"):
        placed(part, "36h11:0=0.16", "36h11:2=0.16")


def test_a_tag_twice_in_the_scene_is_named(tmp_path: Path) -> None:
    part = photographed(tmp_path, CAMERA, walk(), [on_wall(-0.2), on_wall(0.2)])
    found, frame = placed(part, "36h11:0=0.16")
    assert length_ratio(found, walk()) == pytest.approx(1, abs=0.005)
    assert "tag 36h11:0 is at 2 places, twice in photo-0" in warnings_of(frame)
    with pytest.raises(ValueError, match="36h11:0 is at 2 places; name a tag that is at one"):
        placed(part, "36h11:0=0.16", origin="36h11:0")


def test_the_same_tag_in_two_sizes_contradicts_itself(tmp_path: Path) -> None:
    part = photographed(tmp_path, CAMERA, walk(), [on_wall(-0.2), on_wall(0.2, edge_m=0.1)])
    with pytest.raises(ValueError, match="contradicts itself"):
        placed(part, "36h11:0=0.16")


def test_a_moved_tag_is_named_and_a_false_one_left_out(tmp_path: Path) -> None:
    before = photographed(tmp_path, CAMERA, walk(), [on_wall(-0.2)])
    (tmp_path / "later").mkdir()
    after = photographed(tmp_path / "later", CAMERA, walk(3), [on_wall(0.25)], seed=1)
    found, frame = placed(part_of(before.posed + after.posed), "36h11:0=0.16")
    assert "is at 2 places, in the scene twice, or was moved: the first is in 5" in warnings_of(frame)
    assert length_ratio(found, walk() + walk(3)) == pytest.approx(1, abs=0.005)
    found, frame = placed(part_of(before.posed + after.posed[:1]), "36h11:0=0.16")
    assert "1 detections are of something else (photo-0)" in warnings_of(frame)
    assert length_ratio(found, walk() + walk(1)) == pytest.approx(1, abs=0.005)


def test_three_photographs_are_needed_and_they_must_agree(tmp_path: Path) -> None:
    part = photographed(tmp_path, CAMERA, walk(), [on_wall(0.0)])
    two = part_of(part.posed[:2])
    _, frame = placed(two, "36h11:0=0.16")
    assert not frame.is_metric
    assert "tag 36h11:0 is in 2 of 2 photographs (photo-0, photo-1): it gives no unit, 3" in warnings_of(frame)
    _, frame = placed(part, "36h11:1=0.16")
    assert "tag 36h11:1 is in 0 of 5 photographs" in warnings_of(frame)
    assert "tags that were not given: 36h11:0 in 5" in warnings_of(frame)
    assert "the unit of length is arbitrary: a printed tag" in "\n".join(frame.notes)
    # Every photograph has the pose of another: rays do not meet.
    turned = rotation_from_vector([0.0, 0.0, 0.5])
    wrong = [
        posed_picture(
            tmp_path,
            f"wrong-{i}",
            np.asarray(cv2.imread(str(it.picture.path)), np.uint8),
            CAMERA,
            RigidTransform(pose.rotation @ np.linalg.matrix_power(turned, i), pose.translation),
        )
        for i, (it, pose) in enumerate(zip(part.posed, walk(), strict=True))
    ]
    _, frame = placed(part_of(wrong), "36h11:0=0.16")
    assert not frame.is_metric
    assert "no 3 of its 5 photographs agree on its place" in warnings_of(frame)


def test_a_camera_that_only_turns_gives_no_unit(tmp_path: Path) -> None:
    turning = [looking((0.0, -1.0, 1.3), (x, 0.0, 1.3)) for x in (-0.2, -0.1, 0.0, 0.1)]
    _, frame = placed(photographed(tmp_path, CAMERA, turning, [on_wall(0.0)]), "36h11:0=0.16")
    assert not frame.is_metric
    assert "photographs from one place" in warnings_of(frame)


@pytest.mark.parametrize(
    ("tags", "origin", "message"),
    [
        (["36h11:0"], "", "must be FAMILY:NUMBER=METRES"),
        (["36h11=0.1"], "", "must be FAMILY:NUMBER; 36h11:0=0.16 is"),
        (["36h11:0=0"], "", "its edge must be above 0 m, is 0"),
        (["36h11:0=-0.16"], "", "its edge must be above 0 m, is -0.16"),
        (["36h11:0=nan"], "", "its edge must be above 0 m, is nan"),
        (["37h11:0=0.16"], "", "37h11:0: unknown family; known are 36h11"),
        (["36h11:587=0.16"], "", "36h11 has tags 0 to 586"),
        (["4x4_50:-1=0.1"], "", "must be FAMILY:NUMBER"),
        (["36h11:0=0.16", "tag36h11:0=0.1"], "", "36h11:0 is given 2 times"),
        (["36h11:0=0.16"], "36h11:1", "origin: tag 36h11:1 needs its size, --tag 36h11:1=METRES"),
    ],
)
def test_wrong_flags_are_named(tags: list[str], origin: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        WorldFlags(tag=tags, origin=origin).options()


def test_a_blurred_tag_is_as_large_as_a_sharp_one(tmp_path: Path) -> None:
    """Blur is of light, not of the file's values; a detector's corners are 2 % off here."""
    part = photographed(tmp_path, CAMERA, walk(), [on_wall(0.0)])
    posed = []
    for i, pose in enumerate(walk()):
        image = cv2.imread(str(part.posed[i].picture.path))
        assert image is not None
        blurred = cv2.GaussianBlur(LIGHT[image], (0, 0), 1.0)
        values = np.searchsorted(LIGHT, blurred).clip(0, 255).astype(np.uint8)
        posed.append(posed_picture(tmp_path, f"blurred-{i}", values, CAMERA, pose))
    found, frame = placed(part_of(posed), "36h11:0=0.16")
    assert frame.is_metric
    assert length_ratio(found, walk()) == pytest.approx(1, abs=0.006)


def test_families_are_those_of_opencv() -> None:
    for name, count in FAMILIES.values():
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
        assert len(dictionary.bytesList) == count
