"""The photograph's depth as evidence for its pose, and what it adds: planted depths, wrong ones and planted errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.scenes import random_for

from mapless.geometry import Array, Camera, RigidTransform, rotation_from_vector
from mapless_server.method.bundle.estimate import PosedSupport, PoseEstimate, PoseStage
from mapless_server.method.features.tracks import Tracks
from mapless_server.method.features.views import DepthSource, Features, KeypointDepths, PosedView, View
from mapless_server.method.optim.optimize import moved
from mapless_server.method.pose.own_depth import checked, improved
from mapless_server.method.structure.model import PointMatches, Structure
from mapless_server.method.structure.observations import FIRST_GUESS

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)
COUNT = 120
COMMON = 0.01
WIDE = np.diag([0.3, 0.3, 0.3, 0.02, 0.02, 0.02]) ** 2
NARROW = np.diag([1e-3] * 6) ** 2


def view_at(pixels: Array) -> View:
    shape = len(pixels)
    features = Features(pixels.astype(np.float32), np.zeros((shape, 4), np.float32), np.full(shape, 4, np.float32))
    return View(CAMERA, features)


def posed(seed: int, factor: float = 1.0, covariance: Array = NARROW, error: Array | None = None) -> PosedSupport:
    """A pose with an error (6,), its inliers on points that two references see, and depths longer by a factor."""
    random = random_for(seed)
    pixels = random.uniform(10, [310, 230], (COUNT, 2))
    rays = CAMERA.rays(pixels)
    depth = random.uniform(2, 6, COUNT)
    true_pose = RigidTransform(rotation_from_vector(random.normal(0, 1, 3)), random.normal(0, 5, 3))
    x_in_world = true_pose.apply(rays / rays[:, 2:] * depth[:, None])
    references = tuple(
        PosedView(f"k{i}", f"r{i}", view_at(CAMERA.project(pose.inverse().apply(x_in_world))), pose)
        for i, pose in enumerate(true_pose.compose(RigidTransform(np.eye(3), np.array([x, 0.0, 0.0]))) for x in (-1, 1))
    )
    measured = depth * factor * np.exp(0.01 * random.normal(size=COUNT))
    sigma = np.full(COUNT, 0.01, np.float32)
    depths = KeypointDepths(measured.astype(np.float32), sigma, COMMON, DepthSource.MEASURED)
    rows = np.arange(COUNT)
    tracks = Tracks(np.repeat(rows, 2), np.tile([0, 1], COUNT), np.repeat(rows, 2))
    matches = PointMatches(rows, rows, np.zeros(COUNT, bool), 0.0)
    pose = true_pose if error is None else moved(true_pose, error)
    estimate = PoseEstimate(pose, PoseStage.REFINED, np.ones(COUNT, bool), np.zeros(COUNT), covariance)
    query = replace(view_at(pixels), depths=depths)
    structure = Structure(x_in_world, tracks, FIRST_GUESS)
    return PosedSupport(query, references, structure, matches, np.zeros(3), estimate=estimate)


def off_m(support: PosedSupport, seed: int) -> float:
    return float(np.linalg.norm(support.estimate.world_from_camera.translation - truth(seed).translation))


def truth(seed: int) -> RigidTransform:
    return posed(seed).estimate.world_from_camera


def test_depths_that_agree_are_evidence() -> None:
    estimate = checked(posed(0)).estimate
    assert estimate.depth_check is not None
    assert estimate.depth_check.agreeing_count > 0.95 * COUNT
    assert estimate.depth_check.factor == pytest.approx(1.0, abs=0.005)
    assert not estimate.depth_check.conflict
    assert estimate.depth_log10_chance < -3


@pytest.mark.parametrize("factor", [1.1, 0.9, 1000.0, 0.001])
def test_a_wrong_unit_is_named_and_moves_nothing(factor: float) -> None:
    given = posed(1, factor, WIDE if factor in (1000.0, 0.001) else NARROW)
    estimate = improved(given).estimate
    assert estimate.depth_check is not None
    assert estimate.depth_check.factor == pytest.approx(factor, rel=0.01)
    assert (estimate.depth_check.conflict, estimate.depth_check.used) == (True, False)
    assert estimate.world_from_camera is given.estimate.world_from_camera
    assert 0 < estimate.depth_log10_chance <= 2


def test_depths_of_another_photograph_contradict() -> None:
    given = posed(2)
    assert given.query.depths is not None
    depths = replace(given.query.depths, depth=given.query.depths.depth[::-1].copy())
    estimate = improved(replace(given, query=replace(given.query, depths=depths))).estimate
    assert estimate.depth_check is not None
    assert (estimate.depth_check.conflict, estimate.depth_check.used) == (True, False)


def test_a_certain_pose_keeps_its_bits() -> None:
    given = posed(3)
    estimate = improved(given).estimate
    assert estimate.depth_check is not None
    assert not estimate.depth_check.used
    assert estimate.world_from_camera is given.estimate.world_from_camera


def test_an_uncertain_pose_gets_its_distance_and_honest_radii() -> None:
    before, after, in_sigma = [], [], []
    for seed in range(30):
        error = np.linalg.cholesky(WIDE) @ random_for(100 + seed).normal(size=6)
        factor = float(np.exp(COMMON * random_for(200 + seed).normal()))
        given = posed(seed, factor, WIDE, error)
        result = improved(given)
        assert result.estimate.depth_check is not None
        assert result.estimate.depth_check.used
        axis = truth(seed).rotation[:, 2]
        off, was = (
            axis @ (it.estimate.world_from_camera.translation - truth(seed).translation) for it in (result, given)
        )
        before.append(abs(was))
        after.append(abs(off))
        in_sigma.append(abs(off) < np.sqrt(axis @ result.estimate.covariance[:3, :3] @ axis))
    assert np.median(after) < 0.4 * np.median(before)
    assert 0.5 <= np.mean(in_sigma) <= 0.9


def test_a_wall_seen_from_the_front_says_little() -> None:
    given = posed(4)
    pose, depths = given.estimate.world_from_camera, given.query.depths
    assert depths is not None
    rays = CAMERA.rays(given.query.features.pixels())
    wall = replace(depths, depth=np.full(COUNT, 3, np.float32))
    flat = replace(given.structure, x_in_world=pose.apply(3 * rays / rays[:, 2:]))
    chance = checked(
        replace(given, structure=flat, query=replace(given.query, depths=wall))
    ).estimate.depth_log10_chance
    assert -2 < chance <= 0
