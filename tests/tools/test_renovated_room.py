"""The room's generator: what a renovation exchanges, and what it leaves as it was."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from mapless_tools.dataset import Frame
from research.rendered_room import textures as tx
from research.rendered_room.furniture import Quad
from research.rendered_room.photographs import walk
from research.rendered_room.renovation import BUILDING, MOVED_M, STEPS, RenovatedRoom, shape_of
from research.rendered_room.survey_left import SurveyedPoints


def pieces(step: int, seed: int = 0) -> RenovatedRoom:
    """Two things on the floor and one that hangs, after the pieces of the building, painted."""
    room = RenovatedRoom(seed, step)
    for _ in range(BUILDING.stop):
        room.box([0, 0, 0], [0.1, 0.1, 0.1], tx.plain((0.5, 0.5, 0.5)))
    for x in (1.0, 2.0, 3.0):
        room.box([x, 0, 0.9], [0.3, 0.02, 0.4], tx.cover)
    return room


def corners(room: RenovatedRoom) -> list[tuple[Quad, tuple[int, int]]]:
    return list(zip(room.quads, room.versions, strict=True))


@pytest.mark.parametrize("seed", range(4))
def test_what_is_exchanged_moves_no_farther_than_stated(seed: int) -> None:
    before, after = shape_of(seed, 0), shape_of(seed, STEPS)
    assert [index for index, _ in before.versions] == [index for index, _ in after.versions]
    for (was, _), (quad, (_, count)) in zip(corners(before), corners(after), strict=True):
        assert (np.abs(quad.corner - was.corner) <= (MOVED_M + 1e-9 if count else 0)).all()
        np.testing.assert_array_equal([quad.across, quad.down], [was.across, was.down])


def test_what_is_not_exchanged_keeps_its_texels() -> None:
    before, after = pieces(0), pieces(STEPS)
    kept = [was == now for was, now in zip(before.versions, after.versions, strict=True)]
    assert 0 < sum(kept) < len(kept)
    for was, quad, is_kept in zip(before.quads, after.quads, kept, strict=True):
        assert (quad.levels[0].shape == was.levels[0].shape and (quad.levels[0] == was.levels[0]).all()) == is_kept


def test_a_seed_is_a_room() -> None:
    for ours, same, other in zip(pieces(3).quads, pieces(3).quads, pieces(3, seed=1).quads, strict=True):
        np.testing.assert_array_equal(ours.levels[0], same.levels[0])
        assert (ours.levels[0] != other.levels[0]).any()


def test_less_of_the_survey_is_left_after_each_part(tmp_path: Path) -> None:
    frames = []
    for station in walk(0, 4):
        camera, path = station.camera.resized(160, 120), tmp_path / f"{station.name}.png"
        cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 255, (120, 160), np.uint8))
        frames.append(Frame(station.name, path, camera, station.world_from_camera))
    surveyed = SurveyedPoints(0, frames)
    for frame in frames:
        left = [surveyed.left(step, frame) for step in (0, 2, STEPS, STEPS + 1)]
        assert left[0] == 1.0
        assert left[1] > left[2] > left[3]
        assert left[3] < 0.2
