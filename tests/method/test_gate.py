"""The gate: rejects poses that chance could support; the expected number of such poses."""

import math
from dataclasses import replace

import numpy as np
import pytest
from support.pnp_problems import POSE, Problem, planted
from support.scenes import CAMERA, random_for

from mapless.geometry import RigidTransform
from mapless_server.method.pnp import PnpOptions, solve_pose
from mapless_server.method.rejection import Rejection, RejectionReason
from mapless_server.method.results import PointMatches, PoseEstimate
from mapless_server.method.trust.gate import (
    GateOptions,
    false_alarms,
    format_false_alarms,
    gate_failure,
    log10_false_alarms,
)

INLIER_PX = PnpOptions().inlier_px


def failure_of(problem: Problem, initial: RigidTransform = POSE, options: GateOptions | None = None) -> str:
    """Why the solver's pose fails the gate, or the solver's rejection; empty if the pose passes."""
    estimate = solve_pose(*problem, initial, PnpOptions())
    if isinstance(estimate, Rejection):
        assert estimate.reason is RejectionReason.PNP_FAILED
        return estimate.message
    return said(problem, estimate, options or GateOptions())


def said(problem: Problem, estimate: PoseEstimate, options: GateOptions) -> str:
    query, _, matches = problem
    return gate_failure(query.camera, matches, estimate.inliers, INLIER_PX, options) or ""


@pytest.mark.parametrize("outlier_share", [0.0, 0.5])
def test_a_planted_pose_passes_the_gate(outlier_share: float) -> None:
    for seed in range(5):
        assert not failure_of(planted(random_for("good", outlier_share, seed), 100, 0.5, outlier_share))


def test_random_matches_fail_the_gate() -> None:
    """Random matches have no true pose."""
    for seed in range(50):
        random = random_for("no pose", seed)
        assert failure_of(planted(random, int(random.integers(6, 120)), outlier_share=1.0)), seed


def test_guided_matches_around_a_wrong_pose_fail_the_gate() -> None:
    """A search of 20 px finds some keypoint near every projection, which is no evidence for the pose."""
    for seed in range(20):
        random = random_for("guided", seed)
        view, structure, matches = planted(random, 80, 0.0)
        within = 20 * np.sqrt(random.random(80)) * np.exp(1j * random.uniform(0, 2 * np.pi, 80))
        keypoints = view.features.keypoints + np.stack([within.real, within.imag], axis=1).astype(np.float32)
        searched = PointMatches(matches.point, matches.keypoint, np.ones(80, bool), radius_px=20.0)
        query = replace(view, features=replace(view.features, keypoints=keypoints))
        assert failure_of((query, structure, searched)), seed


# False alarms


def test_false_alarms_equal_the_formula() -> None:
    for n in (4, 5, 10, 60):
        for k in range(4, n + 1):
            for p in (1e-4, 0.01, 0.3):
                expected = math.log10((n - 3) * math.comb(n, k) * math.comb(k, 3) * p ** (k - 3))
                assert false_alarms(n, k, p) == pytest.approx(expected, abs=1e-8)


def test_three_matches_agree_with_a_pose_by_construction() -> None:
    for k in range(4):
        assert false_alarms(50, k, 1e-6) == math.inf
    assert false_alarms(50, 20, 1.0) == math.inf
    assert format_false_alarms(math.inf) == "any number of such poses expected"
    assert format_false_alarms(2.34) == "10^2.3 such poses expected"


def test_false_alarms_fall_with_inliers_and_rise_with_matches() -> None:
    of_inliers = [false_alarms(100, k, 1e-3) for k in range(4, 101)]
    assert np.all(np.diff(of_inliers) < 0)
    assert np.all(np.diff([false_alarms(n, 10, 1e-3) for n in range(10, 2000, 50)]) > 0)
    assert np.all(np.diff([false_alarms(100, 10, p) for p in np.geomspace(1e-5, 0.9, 20)]) > 0)


def test_guided_and_other_matches_have_their_own_chance() -> None:
    inliers = np.arange(100) < 40
    disc = INLIER_PX**2
    index = np.arange(100)
    free = PointMatches(index, index, np.zeros(100, bool), 0.0)
    share = math.pi * disc / (CAMERA.width_px * CAMERA.height_px)
    assert log10_false_alarms(CAMERA, free, inliers, INLIER_PX) == pytest.approx(false_alarms(100, 40, share))
    guided = PointMatches(index, index, np.ones(100, bool), 20.0)
    assert log10_false_alarms(CAMERA, guided, inliers, INLIER_PX) == pytest.approx(false_alarms(100, 40, disc / 400))
    both = PointMatches(index, index, index % 2 == 0, 20.0)
    assert log10_false_alarms(CAMERA, both, inliers, INLIER_PX) == pytest.approx(
        min(false_alarms(50, 20, share), false_alarms(50, 20, disc / 400))
    )
