"""Structure: derivatives, the robust cost against SciPy's, planted points and levels of noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares
from support.fake_network import FakeNetwork, FakeNetworkOptions
from support.planted import metric_scale, true_correspondences, true_tracks
from support.scenes import CAMERA, SceneOptions, SyntheticScene, arc_poses, make_scene, random_for

from mapless.geometry import Array, RigidTransform
from mapless_server.cache import LruCache
from mapless_server.method.features.matching import CorrespondOptions
from mapless_server.method.features.tracks import Tracks
from mapless_server.method.features.views import Features, PosedView, View
from mapless_server.method.optim.optimize import SYMMETRIC, solve_columns, take
from mapless_server.method.pairs.correspond import Correspondences, MatchedReferences, Matcher
from mapless_server.method.pairs.pair import Matching
from mapless_server.method.structure import structure as stage
from mapless_server.method.structure.model import Structure
from mapless_server.method.structure.observations import (
    MIN_NOISE_LEVEL_PX,
    ONE_PIXEL,
    KeypointNoise,
    Observations,
    adjust_points,
    better_start,
    estimate_noise,
    triangulate,
)
from mapless_server.method.structure.structure import (
    PAPER_STRUCTURE,
    StructureOptions,
    build_structure,
    observe,
    predicted_points,
    triangulated_structure,
    trustworthy,
)


def planted(
    case: str, options: SceneOptions, noise: KeypointNoise = ONE_PIXEL
) -> tuple[SyntheticScene, Observations, Array]:
    """A scene, the observations of all its points by the references, and where these points are."""
    scene = make_scene(random_for(case), options)
    tracks, points = true_tracks(scene)
    return scene, observe(tracks, scene.references, noise), scene.x_in_world[points]


def cost_by_point(observations: Observations, x_in_world: Array, scale: float) -> Array:
    """The cost (P,) as the module's equation has it, by a loop over observations."""
    cost = np.zeros(len(x_in_world))
    for point, residual in zip(observations.tracks.point, observations.residuals(x_in_world).T, strict=True):
        s = float(residual @ residual)
        cost[point] += 2 * scale**2 * (np.sqrt(1 + s / scale**2) - 1)
    return cost


def one_point(observations: Observations, point: int) -> Observations:
    """The observations of one point alone."""
    mine = observations.tracks.point == point
    return Observations(
        Tracks(np.zeros(mine.sum(), np.intp), np.arange(mine.sum()), np.zeros(mine.sum(), np.intp)),
        take(observations.pixel, mine),
        observations.size_px[mine],
        observations.sigma_px[mine],
        take(observations.rotation, mine),
        take(observations.translation, mine),
        take(observations.focal_px, mine),
        take(observations.principal_px, mine),
    )


def add_outliers(observations: Observations, random: np.random.Generator, share: float) -> Observations:
    """The same with some observations anywhere within 60 px."""
    wrong = random.random(len(observations.tracks.point)) < share
    offset = random.uniform(-60, 60, (len(observations.tracks.point), 2)).T
    return replace(observations, pixel=observations.pixel + np.where(wrong, offset, 0.0))


# The cost


def test_residuals_are_projections_minus_observations() -> None:
    scene, observations, truth = planted("residuals", SceneOptions(point_count=30), KeypointNoise(0.5, 0.05))
    tracks, _ = true_tracks(scene)
    residuals = observations.residuals(truth)
    for o, (point, view, keypoint) in enumerate(zip(tracks.point, tracks.view, tracks.keypoint, strict=True)):
        reference = scene.references[view]
        projected = CAMERA.project(reference.world_from_camera.inverse().apply(truth[point]))
        sigma_px = np.hypot(0.5, 0.05 * 8.0)
        expected = (projected - reference.view.features.keypoints[keypoint]) / sigma_px
        np.testing.assert_allclose(residuals[:, o], expected, atol=1e-9)


# Small systems


@pytest.mark.parametrize("matrix", [np.zeros((3, 3)), np.diag([1.0, 1.0, 0.0]), np.ones((3, 3)) * 1e8])
def test_singular_systems_have_no_solution(matrix: Array) -> None:
    regular = np.diag([1.0, 2.0, 4.0])
    found = solve_columns(np.array([(matrix[i, j], regular[i, j]) for i, j in SYMMETRIC]), np.ones((3, 2))).T
    assert np.isnan(found[0]).all()
    np.testing.assert_allclose(found[1], [1, 0.5, 0.25])


# Triangulation


def test_triangulation_is_exact_without_noise() -> None:
    _, observations, truth = planted("exact", SceneOptions(noise_px=0.0))
    # Keypoints are rounded to float32: 3e-5 px, of which the worst point has a parallax of 7 degrees.
    assert np.linalg.norm(triangulate(observations) - truth, axis=1).max() < 1e-5


def test_parallel_rays_have_no_point() -> None:
    poses = [RigidTransform(np.eye(3), np.array([x, 0.0, 0.0])) for x in (0.0, 0.5)]
    middle = np.array([[479.5, 359.5]], np.float32)
    view = View(CAMERA, Features(middle, np.ones((1, 1), np.float32), np.ones(1, np.float32)))
    references = [PosedView(str(i), "", view, pose) for i, pose in enumerate(poses)]
    tracks = Tracks(np.array([0, 0]), np.array([0, 1]), np.array([0, 0]))
    observations = observe(tracks, references, ONE_PIXEL)
    assert np.isnan(triangulate(observations)).all()
    assert np.isnan(adjust_points(observations, triangulate(observations), 1.0, 3)).all()


def test_each_point_starts_from_the_better_of_two_starts() -> None:
    _, observations, truth = planted("start", SceneOptions(point_count=40))
    bad = truth + np.array([0.0, 0.0, 0.5])
    first, second = truth.copy(), bad.copy()
    first[::2], second[::2] = bad[::2], truth[::2]
    first[4] = np.nan
    np.testing.assert_array_equal(better_start(observations, first, second, 1.0), truth)
    second[5] = np.nan
    np.testing.assert_array_equal(better_start(observations, first, second, 1.0)[5], truth[5])


# Adjustment of points


@pytest.mark.parametrize("outlier_share", [0.0, 0.15])
def test_points_equal_scipys_with_soft_l1_loss(outlier_share: float) -> None:
    random = random_for("scipy", outlier_share)
    options = SceneOptions(point_count=12, reference_count=5)
    _, observations, truth = planted("scipy", options, KeypointNoise(0.7, 0.05))
    observations = add_outliers(observations, random, outlier_share)
    scale = 1.5
    adjusted = adjust_points(observations, truth, scale, iterations=100)
    for p in range(len(truth)):
        mine = one_point(observations, p)

        def lengths(x: Array, mine: Observations = mine) -> Array:
            return np.asarray(np.linalg.norm(mine.residuals(x[None]), axis=0))

        # rho of SciPy is of each function's square, so one function is the length of one residual.
        best = least_squares(  # type: ignore[operator]  # mypy takes it for the module of that name
            lengths, truth[p], loss="soft_l1", f_scale=scale, xtol=1e-12, ftol=1e-14, gtol=1e-12, x_scale="jac"
        )
        reached = cost_by_point(mine, adjusted[p : p + 1], scale)[0]
        assert reached <= 2 * best.cost * (1 + 1e-6) + 1e-9
        if reached >= 2 * best.cost * (
            1 - 1e-6
        ):  # else SciPy stopped short, at a length of zero it cannot differentiate
            np.testing.assert_allclose(adjusted[p], best.x, atol=2e-4)


@pytest.mark.parametrize("displacement_m", [0.01, 0.3, 3.0])
@pytest.mark.parametrize("iterations", [1, 3, 10])
def test_no_cost_ever_increases(displacement_m: float, iterations: int) -> None:
    random = random_for("monotone", displacement_m)
    _, observations, truth = planted("monotone", SceneOptions(point_count=200))
    observations = add_outliers(observations, random, 0.1)
    start = truth + random.normal(0, displacement_m, truth.shape)
    before = cost_by_point(observations, start, 1.0)
    after = cost_by_point(observations, adjust_points(observations, start, 1.0, iterations), 1.0)
    valid = np.isfinite(before)
    assert (after[valid] <= before[valid]).all()
    assert after[valid].sum() < before[valid].sum()


def test_nan_points_do_not_change_other_points() -> None:
    _, observations, truth = planted("nan", SceneOptions(point_count=50))
    start = truth + 0.05
    start[7] = np.nan
    start[8] = [0.0, 0.0, -100.0]  # behind every camera
    adjusted = adjust_points(observations, start, 1.0, 5)
    assert np.isnan(adjusted[7]).all()
    np.testing.assert_array_equal(adjusted[8], start[8])
    others = np.delete(np.arange(len(truth)), [7, 8])
    alone = adjust_points(observations, truth + 0.05, 1.0, 5)
    np.testing.assert_array_equal(adjusted[others], alone[others])


# Noise and trust


@pytest.mark.parametrize("level_px", [0.3, 1.0, 3.0])
@pytest.mark.parametrize(("reference_count", "tolerance"), [(3, 0.12), (8, 0.05)])
def test_a_planted_level_of_noise_is_found(level_px: float, reference_count: int, tolerance: float) -> None:
    # Three views on a line leave more of the residual across the line than along it, which the formula averages.
    guess = KeypointNoise(0.5, 0.0)
    options = SceneOptions(noise_px=level_px, reference_count=reference_count, seen_share=1.0)
    _, observations, truth = planted(f"level {level_px} {reference_count}", options, guess)
    points = adjust_points(observations, truth, 20.0, iterations=10)
    assert estimate_noise(observations, points, guess).level_px == pytest.approx(level_px, rel=tolerance)


def test_the_noise_of_keypoint_size_is_subtracted() -> None:
    # Keypoints of 8 px with a slope of 0.05 have 0.4 px of their own: 0.3 of 0.5 px is left for the level.
    guess = KeypointNoise(1.0, 0.05)
    _, observations, truth = planted("slope", SceneOptions(noise_px=0.5, reference_count=8), guess)
    points = adjust_points(observations, truth, 20.0, iterations=10)
    noise = estimate_noise(observations, points, guess)
    assert noise.level_px == pytest.approx(0.3, rel=0.1)
    assert noise.slope == 0.05


def test_without_noise_or_points_the_level_is_the_least() -> None:
    guess = KeypointNoise(0.4, 0.01)
    _, observations, truth = planted("noiseless", SceneOptions(noise_px=0.0), guess)
    assert estimate_noise(observations, truth, guess).level_px == pytest.approx(MIN_NOISE_LEVEL_PX)
    _, few, truth = planted("few", SceneOptions(point_count=6, reference_count=3), guess)
    assert estimate_noise(few, truth, guess) == guess


def test_points_with_little_parallax_are_not_trusted() -> None:
    scene, observations, truth = planted("parallax", SceneOptions(box_m=(2.0, 1.5, 30.0), distance_m=20.0))
    centres = np.stack([p.translation for p in arc_poses(SceneOptions(distance_m=20.0))])
    limit_deg = 5.0
    options = StructureOptions(min_parallax_deg=limit_deg, max_residual_sigma=None)
    trusted = trustworthy(observations, truth, options)
    tracks, _ = true_tracks(scene)
    for p, x in enumerate(truth):
        rays = x - centres[tracks.view[tracks.point == p]]
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        angle_deg = np.degrees(np.arccos(np.clip(rays @ rays[0], -1, 1))).max()
        assert trusted[p] == (angle_deg >= limit_deg), (p, angle_deg)
    assert 0 < trusted.sum() < len(trusted)


def test_points_with_large_residuals_are_not_trusted() -> None:
    _, observations, truth = planted("unfit", SceneOptions(noise_px=0.0, point_count=60))
    wrong = np.zeros(len(observations.tracks.point), bool)
    wrong[observations.tracks.starts[[3, 9]]] = True
    spoilt = replace(observations, pixel=observations.pixel + np.where(wrong, 5.0, 0.0))
    points = truth.copy()
    points[5] = np.nan
    points[6] = [0.0, 0.0, -100.0]
    trusted = trustworthy(spoilt, points, StructureOptions())
    assert np.flatnonzero(~trusted).tolist() == [3, 5, 6, 9]
    anyway = trustworthy(spoilt, points, StructureOptions(max_residual_sigma=None))
    assert np.flatnonzero(~anyway).tolist() == [5, 6]


# The stage


def build(
    scene: SyntheticScene, options: StructureOptions, network_options: FakeNetworkOptions | None = None
) -> tuple[Structure, NDArray[np.int64]]:
    """The structure of a scene, and which of its points each point shows, by its first keypoint."""
    network = FakeNetwork(scene, options=network_options)
    structure = build_structure(
        network.reconstruct(scene.query, scene.references),
        metric_scale(network.world_from_local, scene.world_from_query),
        scene.references,
        true_correspondences(scene),
        options,
    )
    tracks = structure.tracks
    first = zip(tracks.view[tracks.starts], tracks.keypoint[tracks.starts], strict=True)
    return structure, np.array([scene.reference_points[v][k] for v, k in first], np.int64)


def test_predictions_are_scaled_depths_of_the_first_keypoint() -> None:
    scene = make_scene(random_for("predicted"), SceneOptions(noise_px=0.0, point_count=100))
    network = FakeNetwork(scene)
    tracks, points = true_tracks(scene)
    predicted = predicted_points(
        network.reconstruct(scene.query, scene.references),
        metric_scale(network.world_from_local, scene.world_from_query),
        scene.references,
        tracks,
    )
    error_m = np.linalg.norm(predicted - scene.x_in_world[points], axis=1)
    assert np.median(error_m) < 1e-4  # now and then two keypoints share a cell of the map
    assert np.quantile(error_m, 0.9) < 1e-3


def test_without_optimization_points_are_as_predicted() -> None:
    scene = make_scene(random_for("stay"), SceneOptions(point_count=200))
    options = replace(PAPER_STRUCTURE, optimize=False)
    structure, shown = build(scene, options, FakeNetworkOptions(depth_noise_m=0.1))
    network = FakeNetwork(scene, options=FakeNetworkOptions(depth_noise_m=0.1))
    predicted = predicted_points(
        network.reconstruct(scene.query, scene.references),
        metric_scale(network.world_from_local, scene.world_from_query),
        scene.references,
        structure.tracks,
    )
    np.testing.assert_array_equal(structure.x_in_world, predicted)
    assert len(shown) > 100


@pytest.mark.parametrize("options", [StructureOptions(), PAPER_STRUCTURE], ids=["ours", "paper"])
def test_the_planted_points_are_found(options: StructureOptions) -> None:
    scene = make_scene(random_for("stage"), SceneOptions(noise_px=0.0))
    structure, shown = build(scene, options, FakeNetworkOptions(depth_noise_m=0.05, bad_depth_share=0.05))
    assert len(shown) > 0.9 * len(true_tracks(scene)[1]) * (1 if options.all_references else 0.8)
    error_m = np.linalg.norm(structure.x_in_world - scene.x_in_world[shown], axis=1)
    assert np.quantile(error_m, 0.95) < 1e-4
    assert np.isfinite(structure.x_in_world).all()


def test_wrong_observations_are_pruned_from_good_tracks() -> None:
    scene = make_scene(random_for("prune"), SceneOptions(reference_count=6, noise_px=0.3, seen_share=1.0))
    # A third of the points get a keypoint in reference 5 that shows something else.
    last = scene.references[5]
    moved = last.view.features.keypoints + np.where(np.arange(len(last.view.features)) % 3 == 0, 30, 0)[:, None]
    features = replace(last.view.features, keypoints=moved.astype(np.float32))
    references = (*scene.references[:5], replace(last, view=replace(last.view, features=features)))
    spoilt = replace(scene, references=references)
    structure, shown = build(spoilt, StructureOptions())
    wrong = (structure.tracks.view == 5) & (structure.tracks.keypoint % 3 == 0)
    assert wrong.sum() < 0.02 * len(shown)
    assert len(shown) > 0.9 * len(true_tracks(scene)[1])
    assert np.median(np.linalg.norm(structure.x_in_world - scene.x_in_world[shown], axis=1)) < 0.01


# Structures of a set of references


@pytest.fixture
def triangulations(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """An entry for each structure that is computed."""
    computed: list[int] = []
    real = stage._triangulated

    def counted(*arguments: Any) -> Structure:
        computed.append(1)
        return real(*arguments)

    monkeypatch.setattr(stage, "_triangulated", counted)
    return computed


def triangulated_by(
    matcher: Matcher,
    scene: SyntheticScene,
    references: Sequence[PosedView],
    shift: float = 0.0,
    matching: Matching = Matching.STRICT,
) -> Structure:
    """As `localize` does: matched in the world, triangulated around an origin."""
    nearby = [replace(r, world_from_camera=r.world_from_camera.shifted(np.full(3, -shift))) for r in references]
    return triangulated_structure(nearby, matcher.correspond(scene.query, references, matching), StructureOptions())


def test_a_set_of_references_is_triangulated_once_in_any_order(triangulations: list[int]) -> None:
    scene = make_scene(random_for("once"), SceneOptions(point_count=150, reference_count=4))
    matcher, uncached = Matcher(), Matcher(CorrespondOptions(structure_bytes=0))
    for chosen, shift in (([0, 1, 2, 3], 0.0), ([2, 0, 3, 1], 7.0), ([3, 2, 1, 0], 0.0)):
        references = [scene.references[i] for i in chosen]
        found = triangulated_by(matcher, scene, references, shift)
        assert len(triangulations) == 1
        plain = triangulated_by(uncached, scene, references, shift)
        triangulations.pop()
        for a, b in zip(parts(found), parts(plain), strict=True):
            np.testing.assert_array_equal(a, b)
        tracks, shown = found.tracks, [scene.reference_points[i] for i in chosen]
        point = np.array([shown[v][k] for v, k in zip(tracks.view, tracks.keypoint, strict=True)])
        off_m = np.linalg.norm(found.x_in_world[tracks.point] + shift - scene.x_in_world[point], axis=1)
        assert np.median(off_m) < 0.01
        first = tracks.view[tracks.starts] * 10_000 + tracks.keypoint[tracks.starts]
        assert (np.diff(first) > 0).all()
        assert (np.diff(tracks.point * 4 + tracks.view) > 0).all()


def parts(structure: Structure) -> tuple[NDArray[Any], ...]:
    tracks = structure.tracks
    return structure.x_in_world, tracks.point, tracks.view, tracks.keypoint, np.array(structure.noise.level_px)


def test_other_references_and_wide_matches_have_a_structure_of_their_own(triangulations: list[int]) -> None:
    scene = make_scene(random_for("sets"), SceneOptions(point_count=100, reference_count=4))
    matcher = Matcher()
    whole, strict, wide = scene.references, Matching.STRICT, Matching.WIDE
    for references, kind in ((whole, strict), (whole, wide), (whole[:3], strict)) * 2:
        triangulated_by(matcher, scene, references, matching=kind)
    assert len(triangulations) == 3


def test_structures_are_bounded_and_leave_with_their_references(triangulations: list[int]) -> None:
    scene = make_scene(random_for("bounded sets"), SceneOptions(point_count=100, reference_count=4))
    a, b, c, d = scene.references
    size = triangulated_by(Matcher(), scene, [a, b, c]).size_bytes
    matcher = Matcher(CorrespondOptions(structure_bytes=2 * size + size // 2))
    triangulations.clear()
    for references in ([a, b, c], [a, b, d], [a, b, c]):
        triangulated_by(matcher, scene, references)
    assert len(triangulations) == 2
    triangulated_by(matcher, scene, [b, c, d])
    triangulated_by(matcher, scene, [a, b, d])
    assert len(triangulations) == 4, "the least recently used one was dropped"
    matcher.forget({c.key})
    triangulated_by(matcher, scene, [a, b, d])
    assert len(triangulations) == 4
    triangulated_by(matcher, scene, [b, c, d])
    assert len(triangulations) == 5


def test_sets_without_any_point_are_bounded_too() -> None:
    scene = make_scene(random_for("no points"), SceneOptions(point_count=50, reference_count=3))
    cache = LruCache[Any](100_000)
    for number in range(100):
        references = tuple(replace(it, key=f"{it.key} {number}") for it in scene.references)
        nothing = Correspondences({}, (), MatchedReferences(references, "rule", cache))
        assert not len(triangulated_structure(references, nothing, StructureOptions()).x_in_world)
    assert cache.evictions > 0
