"""The covariance of a pose against planted noise: of pixels, of reference poses, of the scale.

Many poses are solved, each with noise of its own, and the mean of their squared errors is compared with the mean of
what was stated, position and rotation apart. With 20 poses the ratio of two standard deviations is known to an eighth.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from support.compare import assert_jacobian, finite_differences
from support.planted import (
    NO_INTRINSICS,
    NOISE,
    disturbed,
    drift_field,
    drifted,
    metric_scale,
    stages,
    true_correspondences,
    true_structure,
)
from support.scenes import CAMERA, SceneOptions, SyntheticScene, make_scene, random_for

from mapless.answers import Accuracy
from mapless.geometry import Array, RigidTransform, Similarity, rotation_from_vector
from mapless.provenance import GIVEN_POSE, Provenance
from mapless_server.method.bundle.adjust import adjust_pose, with_covariance
from mapless_server.method.bundle.dispersion import (
    Dispersion,
    UncertaintyOptions,
    dispersed_covariance,
    scale_covariance,
)
from mapless_server.method.bundle.estimate import (
    PosedSupport,
    PoseEstimate,
    PoseStage,
    Support,
    error_radii,
    with_halves,
)
from mapless_server.method.bundle.pose_problem import (
    DRIFT_INFLATION,
    OWN_INFLATION,
    USUAL_DRIFT,
    USUAL_OWN,
    AdjustInput,
    AdjustOptions,
    PoseErrors,
    most_probable,
    pose_errors,
)
from mapless_server.method.judge.evidence import evidence_of, votes_of
from mapless_server.method.optim.optimize import motion_jacobian, moved, pose_hessian, world_covariance, world_jacobian
from mapless_server.method.optim.rotations import rotation_vector
from mapless_server.method.pose.pnp import PnpOptions, solve_pose
from mapless_server.method.structure.model import Structure

POSITION, ROTATION = slice(0, 3), slice(3, 6)
PLAIN = UncertaintyOptions(gap_growth=0.0)
"""Without what grows with the gap and with lone references, which planted noise does not have."""
PLAIN_ADJUST = AdjustOptions(uncertainty=PLAIN)
FEW = SceneOptions(point_count=120, reference_count=4, distractor_count=0)
UNSCALED = metric_scale(Similarity(1.0, np.eye(3), np.zeros(3)), RigidTransform(np.eye(3), np.zeros(3)))


def error(found: RigidTransform, true: RigidTransform) -> Array:
    """X y z rx ry rz."""
    return np.concatenate([found.translation - true.translation, rotation_vector(found.rotation @ true.rotation.T)])


def true_by_stated(errors: list[Array], covariances: list[Array], axes: slice) -> float:
    """Standard deviation of the errors along these axes, true by stated."""
    squared, stated = np.mean(np.square(errors), axis=0), np.mean([np.diag(c) for c in covariances], axis=0)
    return float(np.sqrt(squared[axes].sum() / stated[axes].sum()))


def adjusted_poses(
    references: int, own_px: float, drift_px: float, options: UncertaintyOptions = PLAIN, seeds: int = 20
) -> Array:
    """True by stated, position and rotation, (2, 2): by the jackknife alone, and with halves of the data.

    References are turned and moved by so many pixels, each on its own and with the distance.
    """
    planted = SceneOptions(point_count=150, reference_count=references, distractor_count=0)
    own, drift = own_px / planted.camera.focal_x_px, drift_px / planted.camera.focal_x_px
    errors, covariances = [], []
    for seed in range(seeds):
        scene = make_scene(random_for("uncertain", references, seed), planted)
        random = random_for("uncertain noise", seed)
        noisy = disturbed(scene.references, random, own * planted.distance_m, np.degrees(own))
        centre = scene.world_from_query.translation
        noisy = drifted(noisy, centre, random, drift * planted.distance_m, np.degrees(drift))
        structure, matches, estimate = stages(scene, noisy)
        adjusted = adjust_pose(
            AdjustInput(scene.query, noisy, structure, matches, AdjustOptions(uncertainty=options)), estimate
        )
        query_matches = true_correspondences(scene).query_matches
        support = Support(scene.query, noisy, structure, matches, np.zeros(3), query_matches).posed(adjusted)
        halves = evidence_of(support, votes_of(support))
        covered = with_halves(adjusted, halves.disagreement * support.distance_m())
        errors.append(error(adjusted.world_from_camera, scene.world_from_query))
        covariances.append((adjusted.covariance, covered.covariance))
    stated = [list(it) for it in zip(*covariances, strict=True)]
    return np.array([[true_by_stated(errors, it, axes) for axes in (POSITION, ROTATION)] for it in stated])


@pytest.mark.parametrize(("references", "own_px"), [(4, 0.0), (8, 0.0), (5, 1.0), (10, 1.0)])
def test_covariance_of_planted_noise_equals_sampling(references: int, own_px: float) -> None:
    """Within a third: noise of pixels (half a pixel), and of reference poses, each its own."""
    jackknife, with_its_halves = adjusted_poses(references, own_px, 0.0)
    assert min(jackknife.min(), with_its_halves.min()) > 0.65
    assert max(jackknife.max(), with_its_halves.max()) < 1.35


@pytest.mark.parametrize("references", [2, 3])
def test_few_references_with_errors_do_not_claim_too_little(references: int) -> None:
    """By the jackknife alone two claim half of their errors."""
    alone = adjusted_poses(references, 1.0, 0.0, replace(PLAIN, modelled_freedom=0.0))
    shrunk = adjusted_poses(references, 1.0, 0.0)
    assert alone[0, 0] > 1.1
    assert 0.5 < shrunk[0].min() < shrunk[0].max() < 1.0


def test_drift_of_reference_poses_is_found_in_part() -> None:
    """By twice the pixels' noise; leaving out one reference does not show what its neighbours share."""
    found = adjusted_poses(8, 0.0, 1.0)
    assert found.min() > 0.8
    assert found.max() < 1.8


def support_of(
    scene: SyntheticScene, structure: Structure, estimate: PoseEstimate, options: UncertaintyOptions = PLAIN
) -> PosedSupport:
    matches = true_structure(scene)[1]
    return Support(scene.query, scene.references, structure, matches, np.zeros(3)).posed(estimate)


def test_covariance_of_scale_noise_equals_sampling() -> None:
    """Predicted points, all too far or too near by 2 % as seen from the references' centroid: the query goes along."""
    random, errors, covariances = random_for("scale"), [], []
    for seed in range(20):
        scene = make_scene(random_for("scaled", seed), replace(FEW, query_offset_m=(1.2, -0.4, 0.8)))
        centroid = np.mean([r.world_from_camera.translation for r in scene.references], axis=0)
        structure, matches = true_structure(scene, NOISE)
        factor = 1 + random.normal(0, 0.02)
        wrong = replace(structure, x_in_world=centroid + factor * (structure.x_in_world - centroid))
        estimate = solve_pose(scene.query, wrong, matches, scene.world_from_query, PnpOptions())
        assert isinstance(estimate, PoseEstimate)
        errors.append(error(estimate.world_from_camera, scene.world_from_query))
        scale = replace(UNSCALED, deviation=0.02)
        covariances.append(scale_covariance(estimate.world_from_camera, centroid, scale.deviation))
        support = support_of(scene, wrong, estimate)
        stated = with_covariance(support, scale, PLAIN_ADJUST, points_are_predicted=True).covariance
        assert np.linalg.eigvalsh(stated - covariances[-1]).min() > -1e-12  # it comes on top of everything else
    position = true_by_stated(errors, covariances, POSITION)
    assert position == pytest.approx(1, abs=0.4)


def test_an_initial_poses_covariance_covers_its_errors() -> None:
    """5 cm off its optimum: the stated standard deviation in this direction is 5 cm."""
    scene = make_scene(random_for("initial"), FEW)
    structure, matches, estimate = stages(scene, scene.references)
    off = np.array([0.03, 0.0, 0.04])
    moved = RigidTransform(estimate.world_from_camera.rotation, estimate.world_from_camera.translation + off)
    errors_px = np.full(len(matches), 2.0)
    initial = replace(estimate, world_from_camera=moved, stage=PoseStage.INITIAL, errors_px=errors_px)
    wide = replace(PLAIN_ADJUST, loss_scale_sigma=100.0)
    covariance = with_covariance(support_of(scene, structure, initial), UNSCALED, wide).covariance
    along = off / np.linalg.norm(off)
    assert np.sqrt(along @ covariance[:3, :3] @ along) == pytest.approx(0.05, rel=0.3)
    refined = with_covariance(support_of(scene, structure, estimate), UNSCALED, wide).covariance
    assert np.sqrt(along @ refined[:3, :3] @ along) < 0.02


def test_covariance_grows_with_the_gap() -> None:
    """As the gap to twice its exponent."""
    one = np.diag([1.0, 2.0, 3.0, 1.0, 2.0, 3.0])
    options = replace(PLAIN, gap_growth=0.1, modelled_freedom=0.0)

    def trace(gap: float) -> float:
        found = Dispersion(one, np.zeros((9, 6)), np.zeros(6), one, 6, gap, NO_INTRINSICS)
        return float(np.trace(dispersed_covariance(found, RigidTransform(np.eye(3), np.zeros(3)), options)))

    assert trace(0.2) / trace(0.1) == pytest.approx(2**0.2)
    assert trace(5.0) == trace(0.5)


@pytest.mark.parametrize("count", [1, 2, 3, 10])
def test_few_references_leave_more_to_what_is_modelled(count: int) -> None:
    nowhere, here = np.zeros((count, 6)), RigidTransform(np.eye(3), np.zeros(3))
    same = Dispersion(nowhere, np.zeros((9, 6)), np.zeros(6), np.eye(6), count, 0.1, NO_INTRINSICS)
    shrunk = dispersed_covariance(same, here, replace(PLAIN, modelled_freedom=1.0))
    jacobian = world_jacobian(here)
    np.testing.assert_allclose(shrunk, jacobian @ jacobian.T / count, atol=1e-12)


def test_the_step_to_the_optimum_counts_in_full() -> None:
    here, offset = RigidTransform(np.eye(3), np.zeros(3)), np.array([0.0, 0.0, 0.0, 0.1, 0.2, 0.3])
    moved = Dispersion(np.zeros((2, 6)), np.zeros((9, 6)), offset, np.zeros((6, 6)), 2, 0.1, NO_INTRINSICS)
    step = np.repeat([PLAIN.position_factor, PLAIN.rotation_factor], 3) * (world_jacobian(here) @ offset)
    np.testing.assert_allclose(dispersed_covariance(moved, here, PLAIN, True), np.outer(step, step), atol=1e-12)


def test_matches_with_one_point_keep_the_former_covariance() -> None:
    scene = make_scene(random_for("spot"), FEW)
    structure, _, estimate = stages(scene, scene.references)
    nowhere = replace(structure, x_in_world=np.zeros_like(structure.x_in_world))
    covariance = with_covariance(support_of(scene, nowhere, estimate), UNSCALED, PLAIN_ADJUST).covariance
    np.testing.assert_array_equal(covariance, estimate.covariance)


FOCAL_PX, DEPTH_M, LEVEL_PX = 500.0, 4.0, 0.5


def planted(case: str, count: int = 8) -> tuple[Array, Array, Array, PoseErrors]:
    """Centres (K, 3), rotations (K, 3, 3), the query's centre and the errors of references in a random arrangement."""
    random = random_for(case)
    centres, query = random.normal(0, 1, (count, 3)), random.normal(0, 0.3, 3)
    rotations = np.stack([rotation_from_vector(v) for v in random.normal(0, 1, (count, 3))])
    return centres, rotations, query, pose_errors(centres, rotations, query, LEVEL_PX, FOCAL_PX, DEPTH_M)


def test_the_drift_has_the_covariance_of_a_random_walk() -> None:
    """Errors in the world: a shift of the centre by -R^T v, a rotation by R^T w."""
    centres, rotations, query, errors = planted("walk", 4)
    spacing_m = float(np.median([np.linalg.norm(a - b) for i, a in enumerate(centres) for b in centres[:i]]))
    random, places = random_for("walks"), np.concatenate([query[None], centres])
    unit = LEVEL_PX / FOCAL_PX * np.repeat([DEPTH_M, 1.0], 3)
    walks = np.array([drift_field(places, spacing_m, random, 400)[1:] * unit for _ in range(4000)])
    motions = np.concatenate(
        [np.einsum("kab,nkb->nka", rotations, walks[:, :, part]) for part in (slice(3), slice(3, 6))], axis=2
    )
    found = np.cov(motions.reshape(len(walks), -1).T)
    scale = np.sqrt(np.outer(np.diag(errors.drift), np.diag(errors.drift)))
    np.testing.assert_allclose(found / scale, errors.drift / scale, atol=0.1)


def test_a_reference_at_the_place_of_the_query_does_not_drift() -> None:
    centres, rotations, _, _ = planted("at the query")
    errors = pose_errors(centres, rotations, centres[2], LEVEL_PX, FOCAL_PX, DEPTH_M)
    np.testing.assert_allclose(errors.drift[12:18], 0, atol=1e-15)


def test_references_at_one_place_have_a_finite_covariance() -> None:
    _, rotations, query, _ = planted("one place")
    errors = pose_errors(np.zeros((8, 3)), rotations, query, LEVEL_PX, FOCAL_PX, DEPTH_M)
    assert np.linalg.eigvalsh(errors.covariance(0.1, 1.0)).min() > 0


def test_a_stated_accuracy_adds_to_its_reference_alone() -> None:
    centres, rotations, query, errors = planted("stated", 3)
    unit_68 = float(error_radii(np.eye(3), 0.68))
    accuracy = Accuracy(0.02 * unit_68, 1.0, math.degrees(0.003 * unit_68), 9.0)
    stated = pose_errors(
        centres,
        rotations,
        query,
        LEVEL_PX,
        FOCAL_PX,
        DEPTH_M,
        stated=[GIVEN_POSE, Provenance(accuracy=accuracy), GIVEN_POSE],
    )
    added = stated.covariance(0.1, 0.4) - errors.covariance(0.1, 0.4)
    variances = [0.0] * 6 + [0.02**2] * 3 + [0.003**2] * 3 + [0.0] * 6
    np.testing.assert_allclose(added, np.diag(variances), atol=1e-15)


PLACED = Provenance(
    accuracy=Accuracy(10 * LEVEL_PX / FOCAL_PX * DEPTH_M, 1.0, math.degrees(10 * LEVEL_PX / FOCAL_PX), 9.0)
)
"""Ten times the structure's noise."""


@pytest.mark.parametrize(("own", "drift", "placed"), [(0.05, 2.0, 0), (0.8, 0.1, 0), (0.4, 0.4, 0), (0.4, 0.4, 4)])
def test_planted_sizes_are_found(own: float, drift: float, placed: int) -> None:
    """Within a factor of two, in the mean over gradients drawn from their distribution; also beside placed references.

    What these state of their errors is not taken for errors of the given poses.
    """
    found = []
    for seed in range(20):
        centres, rotations, query, _ = planted(f"sizes {seed}", 10)
        stated = [*[PLACED] * placed, *[GIVEN_POSE] * (10 - placed)]
        errors = pose_errors(centres, rotations, query, LEVEL_PX, FOCAL_PX, DEPTH_M, stated=stated)
        random = random_for("sizes", seed)
        unit = np.append(np.sqrt(np.diag(errors.own)), np.sqrt(np.diag(errors.own))[:6])
        factor = random.normal(0, 10, (200, len(unit))) / unit
        matrix = factor.T @ factor
        error = random.multivariate_normal(np.zeros(60), errors.covariance(own, drift))
        gradient = factor.T @ random.normal(size=200) - matrix @ np.append(error, np.zeros(6))
        found.append(most_probable(errors, matrix, gradient))
    mean_own, mean_drift = np.exp(np.log(found).mean(axis=0)) / (OWN_INFLATION, DRIFT_INFLATION)
    # The smaller part, below a third of the larger one, is only known to be small.
    assert own / 2 < mean_own < 2 * own or mean_own < drift / 3
    assert drift / 2 < mean_drift < 2 * drift or mean_drift < own / 3


@pytest.mark.parametrize("value", [np.nan, 0.0])
def test_without_evidence_the_usual_sizes_are_taken(value: float) -> None:
    _, _, _, errors = planted("no evidence", 3)
    own, drift = most_probable(errors, np.full((24, 24), value), np.full(24, value))
    assert own == OWN_INFLATION * USUAL_OWN
    assert drift == DRIFT_INFLATION * USUAL_DRIFT


# Errors in world coordinates


def test_motion_jacobian_equals_finite_differences() -> None:
    for x in random_for("motion").normal(size=(5, 3)):

        def moved_point(motion: Array, x: Array = x) -> Array:
            return np.asarray(rotation_from_vector(motion[3:]) @ x + motion[:3])

        assert_jacobian(motion_jacobian(x), moved_point, np.zeros(6), tolerance=1e-7)


def test_covariance_from_projections_is_in_world_axes() -> None:
    """The inverse of J^T J, with J by finite differences in the coordinates of the covariance."""
    pose = RigidTransform(rotation_from_vector([0.2, -0.3, 0.1]), np.array([0.4, -0.2, -4.0]))
    x_in_world = random_for("covariance").normal(size=(60, 3))

    def projections(error: Array) -> Array:
        return CAMERA.project(moved(pose, error).inverse().apply(x_in_world)).ravel()

    jacobian = finite_differences(projections, np.zeros(6))
    covariance = world_covariance(pose_hessian(CAMERA, pose, x_in_world) / 0.5**2, pose)
    expected = 0.5**2 * np.linalg.inv(jacobian.T @ jacobian)
    np.testing.assert_allclose(covariance, expected, atol=1e-5 * np.abs(expected).max())
    np.testing.assert_array_equal(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance).min() > 0


@pytest.mark.parametrize(
    "eigenvalues", [(1, 1, 1), (1, 0, 0), (1, 1, 0), (1, 0.1, 0.1), (1, 0.5, 0.01), (1, 1e-3, 1e-6), (4, 4, 0.1)]
)
@pytest.mark.parametrize("probability", [0.68, 0.95])
def test_radius_equals_the_quantile_of_samples(eigenvalues: tuple[float, ...], probability: float) -> None:
    rng = np.random.default_rng(7)
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    errors = np.sqrt((rng.normal(size=(200_000, 3)) ** 2 * eigenvalues).sum(axis=1))
    covariance = axes @ np.diag(eigenvalues) @ axes.T
    (radius,) = error_radii(covariance, [probability])
    assert radius == pytest.approx(np.quantile(errors, probability), rel=0.04)


def test_zero_covariance_has_radius_zero() -> None:
    assert error_radii(np.zeros((3, 3)), [0.95]) == 0.0
