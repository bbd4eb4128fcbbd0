"""Scale and initial pose: planted similarities are found; with faults the other stage is used, or it is rejected."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.fake_network import FakeNetwork, FakeNetworkOptions
from support.scenes import SceneOptions, SyntheticScene, make_scene, random_for

from mapless.geometry import RigidTransform, Similarity, rotation_angle_deg, rotation_from_vector
from mapless_server.method.coarse import scale as stages
from mapless_server.method.coarse.scale import estimate_scale, trajectory_scale
from mapless_server.method.features.views import ReconstructedView, Reconstruction
from mapless_server.method.options import ScaleStrategy
from mapless_server.method.pairs.correspond import Correspondences
from mapless_server.method.pairs.epipolar import triangulate_depths
from mapless_server.method.rejection import Rejection, RejectionReason
from mapless_server.method.structure.model import MetricScale, ScaleStage

EXACT = SceneOptions(noise_px=0.0)
TRIANGULATION, TRAJECTORY = ScaleStrategy.TRIANGULATION, ScaleStrategy.TRAJECTORY
CONSISTENTLY_WRONG = FakeNetworkOptions(bad_depth_share=0.7, bad_depth_factors=(1.4, 1.4), depth_noise_m=0.01)


def true_matches(scene: SyntheticScene, per_pair: int | None = None) -> Correspondences:
    """The matches that show the same point, at most so many of each pair of references."""
    pairs = {}
    for i, j in combinations(range(len(scene.references)), 2):
        known = [np.where(points >= 0, points, -1 - k) for k, points in enumerate(scene.reference_points)]
        _, in_first, in_second = np.intersect1d(known[i], known[j], return_indices=True)
        pairs[i, j] = np.stack([in_first, in_second], axis=1)[:per_pair].astype(np.int32)
    return Correspondences(pairs, ())


def scale_of(
    scene: SyntheticScene,
    network: FakeNetwork,
    strategy: ScaleStrategy = ScaleStrategy.TWO_STAGE,
    matches: Correspondences | None = None,
    metre_sigma: float | None = None,
) -> MetricScale:
    predicted = replace(network.reconstruct(scene.query, scene.references), metre_sigma=metre_sigma)
    outcome = estimate_scale(predicted, scene.references, matches or true_matches(scene), strategy)
    assert isinstance(outcome, MetricScale), outcome
    return outcome


def rejection_of(
    reconstruction: Reconstruction, scene: SyntheticScene, strategy: ScaleStrategy = ScaleStrategy.TWO_STAGE
) -> Rejection:
    outcome = estimate_scale(reconstruction, scene.references, true_matches(scene), strategy)
    assert isinstance(outcome, Rejection), outcome
    return outcome


def assert_same_pose(actual: RigidTransform, expected: RigidTransform, metres: float, degrees: float) -> None:
    assert np.linalg.norm(actual.translation - expected.translation) < metres
    assert rotation_angle_deg(actual.rotation @ expected.rotation.T) < degrees


def transformed(view: ReconstructedView, similarity: Similarity) -> ReconstructedView:
    """The same prediction in another local frame."""
    point_map = (similarity.scale * view.point_map).astype(np.float32)
    return replace(view, point_map=point_map, local_from_camera=similarity.transform_pose(view.local_from_camera))


SCENE = make_scene(random_for("frames"), SceneOptions(point_count=200, reference_count=4))
MATCHES = true_matches(SCENE)
RECONSTRUCTION = FakeNetwork(
    SCENE, 4, FakeNetworkOptions(depth_noise_m=0.02, pose_noise_m=0.01, pose_noise_deg=0.1)
).reconstruct(SCENE.query, SCENE.references)


# The planted truth comes back.


@pytest.mark.parametrize("strategy", list(ScaleStrategy))
@pytest.mark.parametrize("dense", [False, True])
def test_the_scale_is_exact_without_noise(strategy: ScaleStrategy, dense: bool) -> None:
    scene = make_scene(random_for("exact"), EXACT)
    network = FakeNetwork(scene, 1, FakeNetworkOptions(dense=dense))
    result = scale_of(scene, network, strategy)

    truth = network.world_from_local
    assert result.metres_per_unit == pytest.approx(truth.scale, rel=1e-6)
    assert result.deviation < 1e-6
    assert_same_pose(result.world_from_query, scene.world_from_query, metres=1e-5, degrees=1e-5)
    corners = np.random.default_rng(0).normal(size=(8, 3))
    np.testing.assert_allclose(
        result.world_from_local.inverse().apply(corners), truth.inverse().apply(corners), rtol=1e-4, atol=1e-5
    )


@pytest.mark.parametrize("seed", range(8))
def test_noise_and_bad_depths_cost_half_a_percent(seed: int) -> None:
    scene = make_scene(random_for("noise", seed))
    network = FakeNetwork(scene, seed, FakeNetworkOptions(depth_noise_m=0.01, bad_depth_share=0.3))
    result = scale_of(scene, network)
    assert result.stage is ScaleStage.TRIANGULATION
    assert result.metres_per_unit == pytest.approx(network.world_from_local.scale, rel=5e-3)


def test_wrong_matches_do_not_move_the_median() -> None:
    scene = make_scene(random_for("wrong matches"))
    matches = true_matches(scene)
    random = random_for("wrong matches", "shuffle")
    for pair in matches.reference_pairs.values():
        wrong = random.random(len(pair)) < 0.4
        pair[wrong, 1] = random.permutation(pair[wrong, 1])
    network = FakeNetwork(scene, 2)
    result = scale_of(scene, network, TRIANGULATION, matches)
    assert result.metres_per_unit == pytest.approx(network.world_from_local.scale, rel=2e-3)


@pytest.mark.parametrize("strategy", [ScaleStrategy.TWO_STAGE, ScaleStrategy.TRAJECTORY])
def test_the_initial_pose_is_as_good_as_the_predicted_poses(strategy: ScaleStrategy) -> None:
    scene = make_scene(random_for("pose noise"))
    network = FakeNetwork(scene, 3, FakeNetworkOptions(depth_noise_m=0.01, pose_noise_m=0.01, pose_noise_deg=0.2))
    result = scale_of(scene, network, strategy)
    assert_same_pose(result.world_from_query, scene.world_from_query, metres=0.08, degrees=1.5)


@settings(max_examples=25, deadline=None)
@given(
    scale=st.floats(1e-3, 1e3),
    turn=st.tuples(*[st.floats(-3, 3)] * 3),
    shift=st.tuples(*[st.floats(-100, 100)] * 3),
    strategy=st.sampled_from(ScaleStrategy),
)
def test_the_local_frame_does_not_change_the_result(
    scale: float, turn: tuple[float, ...], shift: tuple[float, ...], strategy: ScaleStrategy
) -> None:
    moved = Reconstruction(
        transformed(RECONSTRUCTION.query, Similarity(scale, rotation_from_vector(turn), np.array(shift))),
        tuple(
            transformed(view, Similarity(scale, rotation_from_vector(turn), np.array(shift)))
            for view in RECONSTRUCTION.references
        ),
    )
    before = estimate_scale(RECONSTRUCTION, SCENE.references, MATCHES, strategy)
    after = estimate_scale(moved, SCENE.references, MATCHES, strategy)
    assert isinstance(before, MetricScale)
    assert isinstance(after, MetricScale)
    assert (after.stage, after.anchor) == (before.stage, before.anchor)
    assert after.metres_per_unit * scale == pytest.approx(before.metres_per_unit, rel=1e-6)
    assert_same_pose(after.world_from_query, before.world_from_query, metres=1e-5, degrees=1e-5)


# Which stage decides.


def test_the_anchor_has_the_highest_total_confidence() -> None:
    scene = make_scene(random_for("anchor"), EXACT)
    for confidences, anchor in [((0.2, 0.3, 0.3, 0.8, 0.1, 0.7), 3), ((0.5, 0.5, 0.5, 0.5, 0.5, 0.5), 0)]:
        network = FakeNetwork(scene, 6, FakeNetworkOptions(reference_confidences=confidences, dense=True))
        result = scale_of(scene, network)
        assert result.anchor == anchor
        reference = network.reconstruct(scene.query, scene.references).references[anchor]
        tied = result.world_from_local.transform_pose(reference.local_from_camera)
        assert_same_pose(tied, scene.references[anchor].world_from_camera, metres=1e-9, degrees=1e-5)


def test_with_few_matches_the_trajectory_gives_the_scale() -> None:
    scene = make_scene(random_for("few"), EXACT)
    network = FakeNetwork(scene, 7, FakeNetworkOptions(bad_depth_share=1.0))
    result = scale_of(scene, network, matches=true_matches(scene, per_pair=0))
    assert result.stage is ScaleStage.TRAJECTORY
    assert result.metres_per_unit == pytest.approx(network.world_from_local.scale, rel=1e-9)
    # One match of each of 15 pairs, two ratios a match, against 24.
    enough = scale_of(scene, FakeNetwork(scene, 7), matches=true_matches(scene, per_pair=1))
    assert enough.stage is ScaleStage.TRIANGULATION


def test_a_wrong_triangulated_scale_has_the_larger_deviation() -> None:
    scene = make_scene(random_for("biased"))
    network = FakeNetwork(scene, 8, replace(CONSISTENTLY_WRONG, pose_noise_m=0.01))
    alone = scale_of(scene, network, TRIANGULATION)
    assert alone.metres_per_unit < 0.8 * network.world_from_local.scale
    assert alone.deviation > 0.2

    both = scale_of(scene, network)
    assert both.stage is ScaleStage.TRAJECTORY
    assert both.deviation < alone.deviation
    assert both.metres_per_unit == pytest.approx(network.world_from_local.scale, rel=0.03)


def test_a_wrong_trajectory_scale_has_the_larger_deviation() -> None:
    # One camera predicted a metre away makes the trajectory too large for the scale that suits all others, S_traj.
    scene = make_scene(random_for("too large"), SceneOptions(reference_count=12, baseline_m=0.1))
    faults = FakeNetworkOptions(bad_depth_share=1.0, bad_depth_factors=(1.2, 1.2), bad_pose_count=1, bad_pose_m=1.0)
    network = FakeNetwork(scene, 11, faults)
    first, second, both = (scale_of(scene, network, strategy) for strategy in ScaleStrategy)
    assert stages.MAX_DEVIATION < first.deviation < second.deviation
    assert (both.stage, both.metres_per_unit) == (ScaleStage.TRIANGULATION, first.metres_per_unit)


def test_a_good_triangulated_scale_precedes_a_better_trajectory(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = make_scene(random_for("gate"))
    network = FakeNetwork(scene, 10, FakeNetworkOptions(bad_depth_share=1.0, bad_depth_factors=(1.03, 1.03)))
    both = scale_of(scene, network)
    assert both.stage is ScaleStage.TRIANGULATION
    assert both.deviation == pytest.approx(0.03, abs=0.01)
    monkeypatch.setattr(stages, "MAX_DEVIATION", 0.01)
    strict = scale_of(scene, network)
    assert strict.stage is ScaleStage.TRAJECTORY
    assert strict.deviation < 1e-6


def test_a_stage_that_contradicts_the_networks_metre_is_not_used() -> None:
    """Depths too large, and a camera predicted so far away that the trajectory seems to be so, too."""
    scene = make_scene(random_for("too large"), SceneOptions(reference_count=12, baseline_m=0.1))
    faults = FakeNetworkOptions(bad_depth_share=1.0, bad_depth_factors=(1.2, 1.2), bad_pose_count=1, bad_pose_m=1.0)
    network = FakeNetwork(scene, 11, faults)
    network.world_from_local = replace(network.world_from_local, scale=1.0)
    arbitrary, wide, metric = (scale_of(scene, network, metre_sigma=it) for it in (None, 0.2, 0.05))
    assert arbitrary.stage is wide.stage is ScaleStage.TRIANGULATION
    assert metric.stage is ScaleStage.TRAJECTORY
    assert abs(np.log(metric.metres_per_unit)) < 0.15 < abs(np.log(arbitrary.metres_per_unit))
    alone = scale_of(scene, network, TRIANGULATION, metre_sigma=0.05)
    assert alone.metres_per_unit == arbitrary.metres_per_unit, "there is no other"


@pytest.mark.parametrize("metre", [0.25, 1.4, 4.0])
def test_two_stages_that_agree_outvote_the_networks_metre(metre: float) -> None:
    scene = make_scene(random_for("metre"))
    network = FakeNetwork(scene, 7, FakeNetworkOptions(depth_noise_m=0.01, pose_noise_m=0.002))
    network.world_from_local = replace(network.world_from_local, scale=metre)
    found = [scale_of(scene, network, metre_sigma=sigma) for sigma in (None, 0.2)]
    assert found[0].metres_per_unit == found[1].metres_per_unit == pytest.approx(metre, rel=0.02)
    assert found[0].stage is found[1].stage is ScaleStage.TRIANGULATION


@pytest.mark.parametrize("seed", range(4))
def test_bad_poses_do_not_change_the_trajectory_scale(seed: int) -> None:
    scene = make_scene(random_for("bad poses", seed), SceneOptions(point_count=200, reference_count=10))
    network = FakeNetwork(scene, seed, FakeNetworkOptions(pose_noise_m=0.005, bad_pose_count=2, bad_pose_m=0.3))
    result = scale_of(scene, network, TRAJECTORY)
    assert result.metres_per_unit == pytest.approx(network.world_from_local.scale, rel=0.02)


def test_baselines_out_of_range_are_not_triangulated(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = make_scene(random_for("baselines"), SceneOptions(point_count=200, reference_count=4, baseline_m=0.05))
    network = FakeNetwork(scene, 11)
    assert scale_of(scene, network).stage is ScaleStage.TRAJECTORY
    rejection = rejection_of(network.reconstruct(scene.query, scene.references), scene, TRIANGULATION)
    assert rejection.reason is RejectionReason.SCALE_UNRELIABLE
    assert "0 depths" in rejection.message
    monkeypatch.setattr(stages, "MIN_BASELINE_M", 0.04)
    assert scale_of(scene, network, TRIANGULATION).metres_per_unit > 0
    monkeypatch.setattr(stages, "MIN_BASELINE_M", 0.01)
    monkeypatch.setattr(stages, "MAX_BASELINE_M", 0.04)
    assert scale_of(scene, network).stage is ScaleStage.TRAJECTORY


def test_distant_points_are_not_triangulated(monkeypatch: pytest.MonkeyPatch) -> None:
    # 0.5 m apart and 150 m away: a parallax of 0.2 deg, and depths wrong by a quarter.
    distant = SceneOptions(point_count=200, box_m=(100.0, 60.0, 50.0), distance_m=150.0, reference_count=2)
    scene = make_scene(random_for("distant"), distant)
    network = FakeNetwork(scene, 12)
    monkeypatch.setattr(stages, "MIN_RADIUS_PER_DEPTH", 0.0)
    monkeypatch.setattr(stages, "MAX_DEVIATION", 1.0)
    assert scale_of(scene, network).stage is ScaleStage.TRAJECTORY
    monkeypatch.setattr(stages, "MIN_PARALLAX_DEG", 0.0)
    assert scale_of(scene, network).stage is ScaleStage.TRIANGULATION


# Rejections.


@pytest.mark.parametrize("strategy", list(ScaleStrategy))
@pytest.mark.parametrize("pose_noise_m", [0.0, 0.1])
def test_references_at_one_place_are_rejected(strategy: ScaleStrategy, pose_noise_m: float) -> None:
    scene = make_scene(random_for("one place"), SceneOptions(point_count=50, baseline_m=1e-3))
    network = FakeNetwork(scene, 14, FakeNetworkOptions(pose_noise_m=pose_noise_m))
    rejection = rejection_of(network.reconstruct(scene.query, scene.references), scene, strategy)
    assert rejection.reason is RejectionReason.DEGENERATE_REFERENCES
    assert "0.0017 of" in rejection.message


def test_references_too_close_for_the_scenes_depth_are_rejected() -> None:
    distant = SceneOptions(point_count=50, box_m=(100.0, 60.0, 50.0), distance_m=150.0, reference_count=3)
    scene = make_scene(random_for("too close"), replace(distant, baseline_m=0.2))
    rejection = rejection_of(FakeNetwork(scene).reconstruct(scene.query, scene.references), scene)
    assert rejection.reason is RejectionReason.DEGENERATE_REFERENCES


@pytest.mark.parametrize("strategy", list(ScaleStrategy))
def test_not_finite_is_rejected(strategy: ScaleStrategy) -> None:
    nowhere = RigidTransform(np.full((3, 3), np.nan), np.full(3, np.nan))
    good, *others = RECONSTRUCTION.references
    blind = [replace(view, point_map=np.full_like(view.point_map, np.nan)) for view in RECONSTRUCTION.references]
    infinite = [replace(view, point_map=np.full_like(view.point_map, np.inf)) for view in RECONSTRUCTION.references]
    behind = [replace(view, point_map=-view.point_map) for view in RECONSTRUCTION.references]
    for broken in (
        replace(RECONSTRUCTION, query=replace(RECONSTRUCTION.query, local_from_camera=nowhere)),
        replace(RECONSTRUCTION, references=(replace(good, local_from_camera=nowhere), *others)),
        replace(RECONSTRUCTION, references=tuple(blind)),
        replace(RECONSTRUCTION, references=tuple(infinite)),
        replace(RECONSTRUCTION, references=tuple(behind)),
    ):
        rejection = rejection_of(broken, SCENE, strategy)
        assert rejection.reason is RejectionReason.SCALE_UNRELIABLE


def test_a_confidence_that_is_not_finite_is_not_the_anchor() -> None:
    first, *others = RECONSTRUCTION.references
    first = replace(first, confidence=np.full_like(first.confidence, np.nan))
    result = estimate_scale(Reconstruction(RECONSTRUCTION.query, (first, *others)), SCENE.references, MATCHES)
    assert isinstance(result, MetricScale)
    assert result.anchor != 0


# The equations.


def test_trajectory_scale_equals_a_plain_implementation() -> None:
    random = random_for("twin")
    for _ in range(20):
        known = random.normal(size=(7, 3))
        predicted = (known + random.normal(0.0, 0.06, (7, 3))) / 2.5
        best = (0, -np.inf, np.nan)
        for i, j in combinations(range(7), 2):
            scale = np.linalg.norm(known[i] - known[j]) / np.linalg.norm(predicted[i] - predicted[j])
            offset = known.mean(axis=0) - (scale * predicted).mean(axis=0)
            distances = np.linalg.norm(scale * predicted + offset - known, axis=1)
            agree = distances[distances <= 0.10]
            rms = float(np.sqrt(np.mean((agree if len(agree) else distances) ** 2)))
            best = max(best, (len(agree), -rms, float(scale)))
        assert trajectory_scale(predicted, known) == pytest.approx(best[2])


def test_pairs_predicted_at_one_place_give_no_scale() -> None:
    known = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    predicted = np.array([[0.0, 0, 0], [0, 0, 0], [1, 0, 0]])
    assert trajectory_scale(predicted, known) in (1.0, 2.0)
    assert np.isnan(trajectory_scale(np.zeros((3, 3)), known))


def test_ray_depths_equal_a_plain_implementation() -> None:
    random = random_for("rays")
    centres, rays = random.normal(size=(50, 2, 3)), random.normal(size=(50, 2, 3))
    depth_m, parallax_deg = triangulate_depths(centres, rays)
    for centre, ray, depth, parallax in zip(centres, rays, depth_m, parallax_deg, strict=True):
        nearest = np.linalg.lstsq(np.stack([ray[0], -ray[1]], axis=1), centre[1] - centre[0], rcond=None)[0]
        np.testing.assert_allclose(depth, nearest, atol=1e-9)
        cosine = ray[0] @ ray[1] / np.linalg.norm(ray[0]) / np.linalg.norm(ray[1])
        assert parallax == pytest.approx(np.degrees(np.arccos(cosine)))


def test_parallel_rays_have_no_depth() -> None:
    rays = np.broadcast_to([0.0, 0.0, 1.0], (1, 2, 3))
    depth_m, parallax_deg = triangulate_depths(np.array([[[0.0, 0, 0], [1, 0, 0]]]), rays)
    assert np.isnan(depth_m).all()
    assert parallax_deg == 0
