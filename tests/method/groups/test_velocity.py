"""Motions during a read-out, from the poses that a device tracked."""

from dataclasses import replace

import numpy as np
import pytest

from mapless.geometry import RigidTransform
from mapless_server.method.bundle.readout import RollingShutter
from mapless_server.method.groups.velocity import LEAST_LEFT, tracked_motions
from mapless_server.method.optim.optimize import perturbed

SHUTTER = RollingShutter(0.03)
MOTION = np.array([0.3, -0.1, 1.2, 0.2, -0.5, 0.1])
"""A second's, as a left perturbation of camera_from_session; short steps of it are nearly of constant velocity."""


def poses_at(times_s: list[float]) -> list[RigidTransform]:
    start = RigidTransform.identity().inverse()
    return [perturbed(start, time * MOTION).inverse() for time in times_s]


def test_a_constant_velocity_is_the_motion_of_each_read_out() -> None:
    times = [0.0, 0.02, 0.04]
    for found in tracked_motions(poses_at(times), times, [SHUTTER] * 3, False):
        assert found is not None
        np.testing.assert_allclose(found.mean, 0.03 * MOTION, atol=0.03 * 0.05)
        assert found.left_shift == found.left_turn < 0.4


def test_an_unknown_unit_leaves_the_shift_unknown() -> None:
    times = [0.0, 0.05]
    found, _ = tracked_motions(poses_at(times), times, [SHUTTER] * 2, True)
    assert found is not None
    assert found.mean[:3] == (0, 0, 0)
    assert found.left_shift == 1 > found.left_turn
    np.testing.assert_allclose(found.mean[3:], 0.03 * MOTION[3:], atol=0.03 * 0.05)


@pytest.mark.parametrize("gap_s", [0.01, 0.2, 1.0, 4.0])
def test_velocities_of_long_steps_say_less(gap_s: float) -> None:
    found, _ = tracked_motions(poses_at([0.0, gap_s]), [0.0, gap_s], [SHUTTER] * 2, False)
    assert found is not None
    known = np.exp(-gap_s)  # the step's middle is half a step away, and velocities are correlated over half a second
    assert found.left_turn == pytest.approx(max(LEAST_LEFT, np.sqrt(1 - known**2)), rel=1e-6)
    np.testing.assert_allclose(found.mean[3:], known * 0.03 * MOTION[3:], rtol=1e-6)


def test_without_times_or_a_shutter_nothing_is_tracked() -> None:
    poses = poses_at([0.0, 0.1])
    assert tracked_motions(poses, [np.nan, 0.1], [SHUTTER] * 2, False) == [None, None]
    assert tracked_motions(poses, [0.1, 0.1], [SHUTTER] * 2, False) == [None, None]
    other, found = tracked_motions(poses, [0.0, 0.1], [None, replace(SHUTTER, readout_s=0.1)], False)
    assert other is None
    assert found is not None
