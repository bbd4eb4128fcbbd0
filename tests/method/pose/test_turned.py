"""Poses from the depth of the photograph: planted points, references without depth, and depths with known errors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import pytest
from support.scenes import random_for

from mapless.depth import MAX_NOISE, DepthNoise
from mapless.geometry import Array, Camera, RigidTransform, rotation_from_vector
from mapless_server.method.bundle.estimate import accuracy_from_covariance
from mapless_server.method.features.views import DepthSource, Features, KeypointDepths, Matches, PosedView, View
from mapless_server.method.pairs.stationary import StationaryOptions
from mapless_server.method.pose.by_depths import Found, MatchedDepths, solve_by_depths
from mapless_server.method.pose.own_depth import checked, compare_depths
from mapless_server.method.rejection import Rejection

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)
NEARLY = 1e-6


@dataclass(frozen=True)
class Errors:
    """Errors of a planted sensor: factor of all depths, each depth as a share; keypoints; share of wrong matches."""

    factor: float = 1.0
    common_sigma: float = 0.02
    depth: float = 0.01
    keypoint_px: float = 0.5
    wrong_share: float = 0.2


@dataclass(frozen=True, eq=False)
class Planted:
    """A photograph with depth, references without, their matches and the true pose."""

    query: View
    references: tuple[PosedView, ...]
    matches: tuple[Matches, ...]
    world_from_query: RigidTransform

    def solved(self) -> Found | Rejection:
        unknown = [MatchedDepths(np.full(len(it), np.nan), None, 0.0) for it in self.matches]
        given = self.query, self.references, self.matches, unknown
        return solve_by_depths(*given, None, np.zeros(3), StationaryOptions())

    def off_m(self, found: Found) -> float:
        pose = found.support.estimate.world_from_camera
        return float(np.linalg.norm(pose.translation - self.world_from_query.translation))


def view_at(pixels: Array, depths: KeypointDepths | None = None) -> View:
    keypoints = pixels.astype(np.float32)
    features = Features(keypoints, np.zeros((len(pixels), 4), np.float32), np.full(len(pixels), 4, np.float32))
    return View(CAMERA, features, depths=depths)


def planted(random: np.random.Generator, errors: Errors, count: int = 1, points: int = 150) -> Planted:
    """Points two to six metres before the photograph, and references half a metre to a metre aside."""
    pixels = random.uniform(10, [310, 230], (4 * points, 2))
    rays = CAMERA.rays(pixels)
    x = rays / rays[:, 2:] * random.uniform(2, 6, (len(pixels), 1))
    steps = random.normal(size=(count, 3)) * [1, 0.5, 0.5]
    steps *= random.uniform(0.5, 1.0, (count, 1)) / np.linalg.norm(steps, axis=1, keepdims=True)
    from_references = [RigidTransform(rotation_from_vector(random.normal(0, 0.1, 3)), it) for it in steps]
    seen = [CAMERA.project(it.inverse().apply(x)) for it in from_references]
    inside = np.all([((it > 0) & (it < [319, 239])).all(axis=1) for it in seen], axis=0)
    both = np.flatnonzero(inside)[:points]
    depth = x[both, 2] * errors.factor * np.exp(errors.depth * random.normal(size=len(both)))
    sigma = np.full(len(both), np.hypot(errors.depth, NEARLY), np.float32)
    depths = KeypointDepths(depth.astype(np.float32), sigma, errors.common_sigma, DepthSource.MEASURED)
    noise = [random.normal(0, errors.keypoint_px, (len(both), 2)) for _ in range(count + 1)]
    world_from_query = RigidTransform(rotation_from_vector(random.normal(0, 1, 3)), random.normal(0, 5, 3))
    references, matches = [], []
    for i, (pose, its) in enumerate(zip(from_references, seen, strict=True)):
        view = view_at(its[both] + noise[i + 1])
        references.append(PosedView(f"k{i}", f"r{i}", view, world_from_query.compose(pose)))
        pairs = np.repeat(np.arange(len(both), dtype=np.int32)[:, None], 2, axis=1)
        wrong = random.permutation(len(both))[: round(errors.wrong_share * len(both))]
        pairs[wrong, 1] = np.roll(pairs[wrong, 1], 1)
        matches.append(pairs)
    query = view_at(pixels[both] + noise[0], depths)
    return Planted(query, tuple(references), tuple(matches), world_from_query)


def found(given: Planted) -> Found:
    result = given.solved()
    assert isinstance(result, Found), result
    return result


@pytest.mark.parametrize("count", [1, 2])
def test_the_photographs_depth_is_enough(count: int) -> None:
    for seed in range(4):
        given = planted(random_for(seed), Errors(keypoint_px=0.0, depth=NEARLY, common_sigma=0.0), count)
        assert given.off_m(found(given)) < 1e-3


def test_points_at_the_photographs_depth_count_as_its_use() -> None:
    support = checked(found(planted(random_for(5), Errors())).support)
    check = support.estimate.depth_check
    assert check is not None
    assert (check.used, check.compared_count) == (True, 0)
    assert check.point_count == support.estimate.inliers.sum() > 100


def test_exchanged_with_its_reference_it_has_the_inverse_pose() -> None:
    given = planted(random_for(3), Errors())
    (reference,), (matches,), depths = given.references, given.matches, given.query.depths
    assert depths is not None
    there = RigidTransform.identity()
    with_depth = PosedView("q", "q", replace(given.query, depths=None), there)
    its_depths = MatchedDepths(depths.depth[matches[:, 0]].astype(np.float64), 0.01, depths.common_sigma)
    turned = solve_by_depths(
        reference.view, [with_depth], [matches[:, ::-1]], [its_depths], None, np.zeros(3), StationaryOptions()
    )
    assert isinstance(turned, Found)
    query_from_reference = turned.support.estimate.world_from_camera
    pose = reference.world_from_camera.compose(query_from_reference.inverse())
    same = found(given).support.estimate.world_from_camera
    assert np.allclose(pose.matrix(), same.matrix(), atol=2e-3)


def test_several_references_correct_the_factor() -> None:
    errors = Errors(factor=1.05, common_sigma=0.05)
    off = {count: np.median([_off(errors, seed, count) for seed in range(6)]) for count in (1, 4)}
    assert off[1] > 0.02
    assert off[4] < 0.01


def _off(errors: Errors, seed: int, count: int) -> float:
    given = planted(random_for(seed), errors, count)
    return given.off_m(found(given))


def test_radii_contain_the_factors_error() -> None:
    inside = []
    for seed in range(40):
        random = random_for(seed)
        given = planted(random, Errors(factor=float(np.exp(0.03 * random.normal())), common_sigma=0.03))
        result = found(given)
        radii = accuracy_from_covariance(result.support.estimate.covariance)
        off_m = given.off_m(result)
        inside.append((off_m <= radii.position_68_m, off_m <= radii.position_95_m))
    in_68, in_95 = np.mean(inside, axis=0)
    assert 0.55 <= in_68 <= 0.9
    assert in_95 >= 0.9


@pytest.mark.parametrize("with_depth", [60, 80])
def test_radii_contain_the_factor_of_some_references(with_depth: int) -> None:
    """One of two references at a place has depths, whose factor is much better known than the photograph's own."""
    inside = []
    for seed in range(60):
        random = random_for("some references", seed)
        factor, own_factor = np.exp(0.05 * random.normal()), np.exp(0.3 * random.normal())
        given = planted(random, Errors(factor=float(own_factor), common_sigma=0.3, wrong_share=0.0), 1, 140)
        (there,), (matches,), query = given.references, given.matches, given.query
        assert query.depths is not None
        rays = CAMERA.rays(query.features.pixels())
        x = given.world_from_query.apply(rays / rays[:, 2:] * (query.depths.depth / own_factor)[:, None])
        depth = there.world_from_camera.inverse().apply(x)[:, 2] * factor * np.exp(0.01 * random.normal(size=len(x)))
        parts = np.split(random.permutation(matches), [with_depth])
        known = MatchedDepths(depth[parts[0][:, 1]], 0.01, 0.05)
        unknown = MatchedDepths(np.full(len(parts[1]), np.nan), None, 0.0)
        result = solve_by_depths(query, [there, there], parts, [known, unknown], None, np.zeros(3), StationaryOptions())
        assert isinstance(result, Found)
        radii = accuracy_from_covariance(result.support.estimate.covariance)
        off_m = given.off_m(result)
        inside.append((off_m <= radii.position_68_m, off_m <= radii.position_95_m))
    in_68, in_95 = np.mean(inside, axis=0)
    assert 0.58 <= in_68 <= 0.9
    assert in_95 >= 0.9


def test_wrong_matches_give_no_accepted_pose() -> None:
    result = planted(random_for(1), Errors(wrong_share=1.0)).solved()
    assert isinstance(result, Rejection) or result.score < 3


NOISES = [
    *(it for it in product((0.0, 1e-60, 1000.0), (0.0, 1.0), (0.0, 1000.0), (0.0, 1e-6, 1.0)) if any(it[:3])),
    (1e300, 1e300, 1e300, 1e300),
    (1e-60, 0.0, 0.0, 1e-160),
]
"""Bounds of what is accepted, and numbers that were accepted before: constant, linear, quadratic, common."""


@pytest.mark.parametrize("numbers", NOISES, ids=str)
@pytest.mark.parametrize("of_reference", [False, True], ids=["own", "reference"])
def test_any_noise_gives_a_finite_pose(numbers: tuple[float, ...], of_reference: bool) -> None:
    noise = DepthNoise(*numbers).bounded()
    assert all(value <= MAX_NOISE[name] for name, value in vars(noise).items())
    given = planted(random_for(2), Errors(), 2, 60)
    assert given.query.depths is not None
    depth = given.query.depths.depth.astype(np.float64)
    sigma = np.hypot(noise.relative_sigma(depth), noise.common).astype(np.float32)
    query = replace(given.query, depths=replace(given.query.depths, relative_sigma=sigma, common_sigma=noise.common))
    its, unknown = given.matches[0], np.full(len(given.matches[1]), np.nan)
    seen = given.references[0].world_from_camera.inverse().compose(given.world_from_query)
    rays = CAMERA.rays(query.features.pixels())
    of_first = seen.apply(rays / rays[:, 2:] * depth[:, None])[its[:, 1], 2]
    known = MatchedDepths(of_first if of_reference else unknown, float(np.median(sigma)), noise.common)
    depths = [known, MatchedDepths(unknown, None, 0.0)]
    solved = solve_by_depths(query, given.references, given.matches, depths, None, np.zeros(3), StationaryOptions())
    assert isinstance(solved, Found), solved
    estimate = solved.support.estimate
    assert np.isfinite(estimate.world_from_camera.matrix()).all()
    assert np.isfinite(estimate.covariance).all()
    assert np.linalg.eigvalsh(estimate.covariance)[0] > 0
    comparison = compare_depths(solved.support)
    assert comparison is not None
    check = comparison.check(estimate.covariance)
    assert np.isfinite([check.factor, check.factor_sigma, comparison.log10_chance(check)]).all()
