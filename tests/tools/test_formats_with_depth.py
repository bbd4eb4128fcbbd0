"""Depth in the layouts of others: the planted surface comes out in metres, and what is unusable is left out."""

from pathlib import Path

import numpy as np
import pytest
from support.depth_layouts import LAYOUTS, TRUTH
from support.depths import assert_planted, png
from support.layouts import assert_same_pose

from mapless.depth import DepthSensor
from mapless_tools.ingest.depth_options import DepthOptions
from mapless_tools.ingest.formats import ReadOptions, read_dataset

ALL = pytest.mark.parametrize("layout", LAYOUTS)


def depth_file(folder: Path) -> Path:
    """The depth that a written layout has."""
    dataset = read_dataset(folder)
    assert dataset.frames[0].depth is not None
    return dataset.frames[0].depth.path


@ALL
def test_the_planted_surface_comes_out_in_metres(tmp_path: Path, layout: str) -> None:
    dataset = read_dataset(LAYOUTS[layout](tmp_path))
    assert (dataset.format, len(dataset.frames), dataset.refused) == (layout, 2, ())
    first, second = dataset.frames
    assert_planted(first)
    assert second.depth is None
    for frame, pose in zip(dataset.frames, TRUTH.poses, strict=True):
        assert_same_pose(frame.world_from_camera, pose)
    assert "depth: 1 of 2 photographs have one" in dataset.notes


@ALL
@pytest.mark.parametrize("wrong", ["truncated", "8 bits", "another aspect", "no value", "empty", "text"])
def test_unusable_depth_is_left_out_with_a_note(tmp_path: Path, layout: str, wrong: str) -> None:
    folder = LAYOUTS[layout](tmp_path)
    file = depth_file(folder)
    whole = file.read_bytes()
    contents = {
        "truncated": whole[: len(whole) // 2],
        "8 bits": png(np.ones((48, 64), np.uint8)),
        "another aspect": png(np.ones((70, 50), np.uint16)),
        "no value": png(np.zeros((64, 96), np.uint16)),
        "empty": b"",
        "text": b"depth",
    }
    file.write_bytes(contents[wrong])
    dataset = read_dataset(folder)
    assert (len(dataset.frames), dataset.refused) == (2, ())
    assert all(frame.depth is None for frame in dataset.frames)
    assert any(file.name in note and "left out" in note for note in dataset.notes)


@ALL
def test_no_depth_leaves_depth_out_without_a_note(tmp_path: Path, layout: str) -> None:
    dataset = read_dataset(LAYOUTS[layout](tmp_path), options=ReadOptions(depths=DepthOptions(no_depth=True)))
    assert [frame.depth for frame in dataset.frames] == [None, None]
    assert not any("depth" in note and "photographs have" in note for note in dataset.notes)


def test_sensor_and_unit_that_are_given_replace_the_layouts(tmp_path: Path) -> None:
    options = ReadOptions(depths=DepthOptions(depth_sensor="stereo", depth_unit=0.002))
    depth = read_dataset(LAYOUTS["icl"](tmp_path), options=options).frames[0].depth
    assert depth is not None
    assert (depth.sensor, depth.unit_m) == (DepthSensor.STEREO, 0.002)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"depth_sensor": "sonar"}, "phone_lidar"),
        ({"depth_unit": 0.0}, "--depth-unit"),
        ({"no_depth": True, "depth_unit": 0.001}, "one of them"),
    ],
)
def test_wrong_options_of_depth_are_named(options: dict[str, str | float | bool], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        DepthOptions(**options)  # type: ignore[arg-type]


def test_twelve_scenes_without_a_depth_camera_has_no_depth(tmp_path: Path) -> None:
    room = LAYOUTS["12scenes"](tmp_path)
    text = (room / "info.txt").read_text()
    (room / "info.txt").write_text(text.replace("m_calibrationDepthIntrinsic", "m_other"))
    dataset = read_dataset(room)
    assert [frame.depth for frame in dataset.frames] == [None, None]
    assert any("m_calibrationDepthIntrinsic is missing" in note for note in dataset.notes)


def test_twelve_scenes_of_colour_in_depth_is_turned_round(tmp_path: Path) -> None:
    room = LAYOUTS["12scenes"](tmp_path)
    lines = (room / "info.txt").read_text().splitlines()
    at = {line.split(" = ")[0]: i for i, line in enumerate(lines)}
    colour, depth = (at[f"m_calibration{it}Extrinsic"] for it in ("Color", "Depth"))
    matrix = np.array(lines[depth].split(" = ")[1].split(), float).reshape(4, 4)
    inverse = " ".join(map(repr, np.linalg.inv(matrix).ravel().tolist()))
    lines[depth] = lines[colour].replace("Color", "Depth")
    lines[colour] = f"m_calibrationColorExtrinsic = {inverse}"
    (room / "info.txt").write_text("\n".join(lines))
    assert_planted(read_dataset(room).frames[0])


def test_icl_photographs_without_a_pose_are_refused(tmp_path: Path) -> None:
    folder = LAYOUTS["icl"](tmp_path)
    file = folder / "livingRoom0.gt.freiburg"
    file.write_text(file.read_text().splitlines()[0] + "\n")
    dataset = read_dataset(folder)
    assert (len(dataset.frames), len(dataset.refused)) == (1, 1)
