"""Metres for folders without: planted similarities are found, and values that contradict or do not suffice refused."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapless.geodesy import Datum
from mapless.geometry import Array, Camera, RigidTransform, Similarity, rotation_from_vector
from mapless_tools.dataset import Dataset, Frame
from mapless_tools.ingest.metres import KnownDistance, MetreOptions, in_metres, read_positions, umeyama

CAMERA = Camera(96, 64, 80.0, 80.0, 47.5, 31.5)
METRES_FROM_UNITS = Similarity(0.37, rotation_from_vector([0.4, -1.1, 0.7]), np.array([30.0, -20.0, 5.0]))


def dataset_of(centres_m: Array) -> Dataset:
    """Upright cameras at known positions, as a model of another frame and unit has them."""
    units_from_metres = METRES_FROM_UNITS.inverse()
    frames = tuple(
        Frame(f"r{i}", Path(f"images/photo {i}.jpg"), CAMERA, units_from_metres.transform_pose(it))
        for i, it in enumerate(poses(centres_m))
    )
    return Dataset("planted", frames, metric=False, source="planted", datum=None)


def poses(centres_m: Array) -> list[RigidTransform]:
    """Looking all around, in a frame whose z is up."""
    upright = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    turns = np.linspace(0, 3, len(centres_m))
    return [
        RigidTransform(rotation_from_vector([0, 0, turn]) @ upright, centre)
        for turn, centre in zip(turns, centres_m, strict=True)
    ]


def centres(count: int = 8, noise_m: float = 0.0) -> Array:
    generator = np.random.default_rng(5)
    exact = generator.uniform(-1, 1, (count, 3)) * [10, 6, 1]
    return np.asarray(exact + noise_m * generator.standard_normal(exact.shape))


def write_positions(file: Path, centres_m: Array, names: Sequence[str] = (), heading: str = "name,x,y,z\n") -> Path:
    rows = [f"{names[i] if names else f'r{i}'},{x!r},{y!r},{z!r}\n" for i, (x, y, z) in enumerate(centres_m.tolist())]
    file.write_text(heading + "".join(rows))
    return file


def assert_poses(dataset: Dataset, expected: Sequence[RigidTransform], tolerance: float = 1e-9) -> None:
    assert dataset.metric
    for frame, pose in zip(dataset.frames, expected, strict=True):
        np.testing.assert_allclose(frame.world_from_camera.matrix(), pose.matrix(), atol=tolerance)


def distance(first: int, second: int, centres_m: Array, factor: float = 1.0) -> KnownDistance:
    return KnownDistance(
        f"r{first}", f"r{second}", factor * float(np.linalg.norm(centres_m[first] - centres_m[second]))
    )


def test_a_scale_multiplies_positions_and_keeps_rotations() -> None:
    datum = Datum(47, 8, 400)
    dataset = replace(dataset_of(centres()), datum=datum, down_in_world=(0.0, 0.6, -0.8))
    found = in_metres(dataset, MetreOptions(scale=2.5))
    expected = [
        RigidTransform(it.world_from_camera.rotation, 2.5 * it.world_from_camera.translation) for it in dataset.frames
    ]
    assert_poses(found, expected)
    assert found.datum == datum
    np.testing.assert_allclose(found.down_in_world, (0, 0.6, -0.8), atol=1e-15)  # type: ignore[arg-type]
    assert "one unit of the folder is 2.5 m" in found.notes[-1]


def test_the_planted_similarity_is_found_and_turns_gravity(tmp_path: Path) -> None:
    down_in_folder = METRES_FROM_UNITS.rotation.T @ [0, 0, -1]
    x, y, z = map(float, down_in_folder)
    dataset = replace(dataset_of(centres()), down_in_world=(x, y, z), datum=Datum(1, 2, 3))
    file = write_positions(tmp_path / "known.csv", centres()[:5])
    found = in_metres(dataset, MetreOptions(positions=file))
    assert_poses(found, poses(centres()), 1e-6)
    np.testing.assert_allclose(found.down_in_world, (0, 0, -1), atol=1e-8)  # type: ignore[arg-type]
    assert found.datum is None
    notes = "\n".join(found.notes)
    assert "known position of r4: 0.000 m off" in notes
    assert "the folder's datum is dropped" in notes
    assert "down is about (0, 0, -1)" in notes


@pytest.mark.parametrize("names", [["photo 0.jpg", "photo 1.jpg", "photo 2.jpg"], ["east-r0", "r1", "east-r2"]])
def test_references_are_named_by_id_prefixed_id_or_file(tmp_path: Path, names: list[str]) -> None:
    file = write_positions(tmp_path / "known.csv", centres()[:3], names, heading="# surveyed\n\n")
    assert_poses(in_metres(dataset_of(centres()), MetreOptions(positions=file), "east-"), poses(centres()), 1e-6)
    with pytest.raises(ValueError, match="no reference 'r99'"):
        in_metres(dataset_of(centres()), MetreOptions(distances=(KnownDistance("r0", "r99", 1.0),)))


def test_umeyama_is_least_squares() -> None:
    """No similarity near the one that was found has a smaller sum of squares, of noisy points."""
    generator = np.random.default_rng(2)
    source = generator.normal(0, 3, (12, 3))
    target = METRES_FROM_UNITS.apply(source) + generator.normal(0, 0.2, source.shape)
    found = umeyama(source, target)

    def cost(it: Similarity) -> float:
        return float(((it.apply(source) - target) ** 2).sum())

    for step in 1e-3 * generator.standard_normal((200, 7)):
        near = Similarity(
            found.scale * (1 + step[0]), rotation_from_vector(step[1:4]) @ found.rotation, found.translation + step[4:]
        )
        assert cost(near) > cost(found)


def test_noise_of_a_survey_is_averaged(tmp_path: Path) -> None:
    file = write_positions(tmp_path / "known.csv", centres(30, noise_m=0.02))
    found = in_metres(dataset_of(centres(30)), MetreOptions(positions=file))
    for frame, pose in zip(found.frames, poses(centres(30)), strict=True):
        assert np.linalg.norm(frame.world_from_camera.translation - pose.translation) < 0.03


def test_one_distance_gives_the_scale_and_several_agree() -> None:
    known = centres()
    for pairs in ([(0, 1)], [(0, 1), (2, 3), (4, 7)]):
        options = MetreOptions(distances=tuple(distance(i, j, known) for i, j in pairs))
        found = in_metres(dataset_of(known), options)
        scales = np.linalg.norm(found.frames[0].world_from_camera.translation) / np.linalg.norm(
            dataset_of(known).frames[0].world_from_camera.translation
        )
        assert scales == pytest.approx(METRES_FROM_UNITS.scale, rel=1e-9)


def test_distances_within_the_bound_are_averaged_others_refused() -> None:
    known = centres()
    good = (distance(0, 1, known, 1.02), distance(2, 3, known, 0.985))
    assert in_metres(dataset_of(known), MetreOptions(distances=good)).metric
    with pytest.raises(ValueError, match=r"contradict each other by more than 3 %") as caught:
        in_metres(dataset_of(known), MetreOptions(distances=(distance(0, 1, known), distance(2, 3, known, 1.2))))
    assert "r0 - r1" in str(caught.value)
    assert "without" not in str(caught.value)


def test_the_one_wrong_distance_is_named() -> None:
    known = centres()
    distances = (distance(0, 1, known), distance(2, 3, known), distance(4, 5, known, 1.3), distance(6, 7, known))
    with pytest.raises(ValueError, match="without r4 - r5 the others fit"):
        in_metres(dataset_of(known), MetreOptions(distances=distances))


def test_a_distance_between_cameras_at_one_place_is_refused() -> None:
    known = centres()
    known[1] = known[0]
    with pytest.raises(ValueError, match="at one place"):
        in_metres(dataset_of(known), MetreOptions(distances=(KnownDistance("r0", "r1", 1.0),)))


def test_the_one_wrong_position_is_named_with_all_residuals(tmp_path: Path) -> None:
    known = centres()
    known[3] += [0, 2.0, 0]
    file = write_positions(tmp_path / "known.csv", known)
    with pytest.raises(ValueError, match="without r3 the others fit") as caught:
        in_metres(dataset_of(centres()), MetreOptions(positions=file))
    assert str(caught.value).count("m off") == len(known)
    assert "at least 5 cm" in str(caught.value)


def test_mirrored_positions_are_named(tmp_path: Path) -> None:
    file = write_positions(tmp_path / "known.csv", centres()[:, [1, 0, 2]])
    with pytest.raises(ValueError, match="they fit if they are mirrored"):
        in_metres(dataset_of(centres()), MetreOptions(positions=file))


@pytest.mark.parametrize(
    ("known", "message"),
    [
        (centres()[:0], "has 0 known positions: three"),
        (centres()[:2], "has 2 known positions: three that are not on one line are needed, or --distance"),
        (np.outer(np.arange(5.0), [1, 2, 0.5]), "are on one line, within"),
        (np.ones((4, 3)), "are all at one place"),
    ],
)
def test_too_few_and_collinear_positions_are_refused(tmp_path: Path, known: Array, message: str) -> None:
    file = write_positions(tmp_path / "known.csv", known)
    everything = np.concatenate([known, centres()[len(known) :]])
    with pytest.raises(ValueError, match=message):
        in_metres(dataset_of(everything), MetreOptions(positions=file))


def test_a_line_bent_by_noise_alone_is_a_line(tmp_path: Path) -> None:
    """The rotation about it would be that of the noise."""
    line = np.outer(np.linspace(-10, 10, 8), [1.0, 0, 0])
    noise = np.random.default_rng(4).normal(0, 0.04, line.shape)
    bent = np.asarray(line + noise)
    file = write_positions(tmp_path / "known.csv", bent)
    with pytest.raises(ValueError, match="on one line"):
        in_metres(dataset_of(line + noise[::-1]), MetreOptions(positions=file))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("r0,1,2\n", "line 1: must be name, x, y, z, has 3 cells"),
        ("name,x,y,z\nr0,1,2,three\n", "line 2: x, y, z must be numbers"),
        ("r0,1,2,nan\n", "line 1: x, y, z is not finite"),
        ("r0,1,2,3\nr0,1,2,3\n", "line 2: r0 occurs twice"),
    ],
)
def test_a_malformed_file_is_named_with_its_line(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "known.csv"
    file.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_positions(file)
    with pytest.raises(ValueError, match="cannot be read"):
        read_positions(tmp_path / "none.csv")
