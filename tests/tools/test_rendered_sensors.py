"""Simulated depth sensors are as wrong as their kind is said to be, and wrong where real ones are."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapless.depth import NOISE, DepthSensor
from mapless.geometry import Array, Camera
from mapless_tools.demo.photographs import ROOM
from research.rendered_room.folders import entry_of, write_cameras
from research.rendered_room.photographs import walk
from research.rendered_room.sensors import MODELS, Scan, measured

CAMERA = Camera(320, 240, 290.0, 290.0, 159.5, 119.5)
WALL = np.s_[40:200, 30:110]


def scan() -> Scan:
    """A wall at 2 m, with a nearer board on its right half."""
    depth = np.full((240, 320), 2.0)
    depth[:, 160:260] = 1.2
    return Scan(CAMERA, depth, np.full(depth.shape, 20.0), np.ones(depth.shape, bool))


def metres(sensor: DepthSensor, seed: int, given: Scan | None = None) -> Array:
    return measured(sensor, given or scan(), np.random.default_rng(seed)) / 1000.0


@pytest.mark.parametrize("sensor", [it for it in MODELS if it is not DepthSensor.RENDERED])
def test_errors_on_a_wall_are_those_of_the_sensor(sensor: DepthSensor) -> None:
    """With their common factor, over 40 devices; a wrong block of stereo is no error of a depth."""
    noise, errors = NOISE[sensor], []
    for seed in range(40):
        seen = metres(sensor, seed)[WALL]
        assert (seen > 0).mean() > 0.9
        errors.append(np.log(np.median(seen[seen > 0]) / 2.0))
        spread = 1.4826 * np.median(np.abs(seen[seen > 0] - np.median(seen[seen > 0])))
        assert spread < 2 * np.hypot(noise.sigma_m(np.array(2.0)), 2 * noise.common)
    assert 0.6 < np.std(errors) / noise.common < 1.6


def test_rendered_depth_is_exact_to_a_millimetre() -> None:
    assert np.abs(metres(DepthSensor.RENDERED, 0) - scan().depth_m).max() <= 0.0005


@pytest.mark.parametrize(("sensor", "side"), [(DepthSensor.STRUCTURED_LIGHT, 262), (DepthSensor.STEREO, 156)])
def test_what_the_other_eye_does_not_see_has_no_depth(sensor: DepthSensor, side: int) -> None:
    """The projector is to the left: its shadow lies to the right of the board; the second camera is to the right."""
    seen = metres(sensor, 3)
    assert (seen[:, side] == 0).mean() > 0.8
    assert (seen[:, 418 - side] == 0).mean() < 0.5


@pytest.mark.parametrize("sensor", [DepthSensor.PHONE_LIDAR, DepthSensor.TIME_OF_FLIGHT])
def test_edges_bleed(sensor: DepthSensor) -> None:
    beside = metres(sensor, 1)[:, 158:162]
    assert ((beside > 1.25) & (beside < 1.95)).any(axis=1).mean() > 0.9


def test_the_sky_sends_no_light_back() -> None:
    sky = replace(scan(), is_surface=np.zeros((240, 320), bool))
    for sensor in (DepthSensor.STRUCTURED_LIGHT, DepthSensor.TIME_OF_FLIGHT, DepthSensor.STEREO):
        assert not metres(sensor, 0, sky).any()
    assert metres(DepthSensor.PHONE_LIDAR, 0, sky).all(), "a value everywhere"


def test_the_demos_cameras_are_written_as_they_are(tmp_path: Path) -> None:
    committed = (ROOM / "cameras.json").read_text("utf-8")
    write_cameras(tmp_path, json.loads(committed)["frames"])
    assert (tmp_path / "cameras.json").read_text("utf-8") == committed
    found, entry = json.loads(committed)["frames"][5], entry_of(walk(0, 16)[5])
    np.testing.assert_allclose(found["world_from_camera"], np.array(entry["world_from_camera"], float), atol=1e-9)
    assert {**found, "world_from_camera": 0} == {**entry, "world_from_camera": 0}
