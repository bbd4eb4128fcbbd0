"""Trust is the share of right answers that look at most as good, and coverage the share of them that passes."""

from dataclasses import replace

import numpy as np
import pytest
from support.planted import true_correspondences, true_structure
from support.pnp_problems import POSE, problem_of
from support.scenes import CAMERA, SceneOptions, SyntheticScene, make_scene, random_for

from mapless.geometry import RigidTransform
from mapless_server.method.bundle.estimate import PosedSupport, PoseEstimate, Support
from mapless_server.method.features.limits import LOSS_SCALE_PX
from mapless_server.method.features.views import Matches, PosedView
from mapless_server.method.judge import evidence as halves_of
from mapless_server.method.judge import judge as judging
from mapless_server.method.judge.evidence import (
    NO_AGREEMENT,
    Evidence,
    disagreement_of_matches,
    disagreement_of_references,
    epipolar_share,
    evidence_of,
    expected_share,
    findable_count,
    hull_share,
    votes_of,
)
from mapless_server.method.judge.judge import JudgeOptions, judge, trust_of
from mapless_server.method.optim.optimize import pose_jacobian
from mapless_server.method.options import LocalizeOptions
from mapless_server.method.pose.pnp import PnpOptions, solve_pose
from mapless_server.method.rejection import Rejection, RejectionReason

OPTIONS = JudgeOptions()
COVERAGE = LocalizeOptions().coverage
GOOD = Evidence(
    inlier_count=300,
    match_count=330,
    found_share=0.5,
    expected_share=0.6,
    hull_share=0.6,
    epipolar_share=0.7,
    matches_apart=0.0015,
    references_apart=0.002,
)
POOR = Evidence(22, 102, 0.1, 0.6, 0.04, 0.1, 0.3, 0.2)
"""Such a pose was off by a tenth of the distance to the photograph's contents."""


def support_of(outlier_share: float = 0.0, seen_share: float = 0.9) -> PosedSupport:
    """A planted photograph, solved."""
    options = SceneOptions(point_count=300, outlier_share=outlier_share, seen_share=seen_share)
    return solved(make_scene(random_for("judge", outlier_share, seen_share), options))


def verdict(support: PosedSupport, coverage: float, options: JudgeOptions = OPTIONS) -> tuple[float, Rejection | None]:
    judged = judge(replace(support, query_matches=query_matches_of(support)), coverage, options)
    return judged.trust, judged.rejection


def query_matches_of(support: PosedSupport) -> tuple[Matches, ...]:
    """The matches with each reference that the support's matches come from."""
    tracks, matches = support.structure.tracks, support.matches
    keypoint_of = np.full(len(support.structure.x_in_world), -1)
    keypoint_of[matches.point] = matches.keypoint
    of_references = []
    for view in range(len(support.references)):
        rows = (tracks.view == view) & (keypoint_of[tracks.point] >= 0)
        pairs = np.stack([keypoint_of[tracks.point[rows]], tracks.keypoint[rows]], axis=1)
        of_references.append(pairs.astype(np.int32))
    return tuple(of_references)


def test_trust_is_high_with_good_support_and_low_without() -> None:
    assert trust_of(GOOD, OPTIONS) > 0.3
    assert trust_of(POOR, OPTIONS) < 1 - COVERAGE


@pytest.mark.parametrize("shape", ["line", "one point"])
@pytest.mark.parametrize("count", [6, 40, 400])
def test_poses_from_degenerate_points_are_rejected(shape: str, count: int) -> None:
    on_a_line = np.linspace(-1, 1, count)[:, None] * np.array([1.0, 0.3, 0.2])
    x_in_world = on_a_line if shape == "line" else np.zeros((count, 3))
    query, structure, matches = problem_of(x_in_world, CAMERA.project(POSE.inverse().apply(x_in_world)))
    for initial in (POSE, POSE.shifted(np.array([3.0, 1.0, 0.0]))):
        estimate = solve_pose(query, structure, matches, initial, PnpOptions())
        if isinstance(estimate, Rejection):
            continue
        reference = PosedView("key", "scenes/s/references/r", query, POSE)
        none = (np.empty((0, 2), np.int32),)
        support = Support(query, (reference,), structure, matches, np.zeros(3), none).posed(estimate)
        rejection = judge(support, COVERAGE, OPTIONS).rejection
        assert rejection is not None


def test_poses_with_trust_below_1_minus_coverage_are_rejected() -> None:
    support = support_of()
    trust, rejection = verdict(support, 1.0)
    assert rejection is None
    assert 0 < trust < 1
    just_enough, too_little = min(1.0, 1 - trust + 1e-6), 1 - trust - 1e-6
    assert verdict(support, just_enough) == (trust, None)
    refused = verdict(support, too_little)[1]
    assert refused is not None
    assert refused.reason is RejectionReason.GATE
    assert refused.message.startswith(
        f"its trust of {np.floor(1000 * trust) / 1000:g} is below the {1 - too_little:.6g} "
    )
    assert "matches agree" in refused.message


@pytest.mark.parametrize(("share", "is_accepted"), [(0.079, True), (0.081, False), (1.0, False)])
def test_a_radius_of_too_many_wrong_poses_is_rejected(share: float, is_accepted: bool) -> None:
    """Whatever the coverage; the 68 % radius of one direction is nearly its standard deviation."""
    support = support_of()
    assert support.estimate
    covariance = np.diag([(share * support.distance_m() / 0.9945) ** 2, 0, 0, 1e-6, 1e-6, 1e-6])
    _, rejection = verdict(replace(support, estimate=replace(support.estimate, covariance=covariance)), 1.0)
    assert (rejection is None) is is_accepted
    if rejection:
        assert rejection.reason is RejectionReason.GATE
        assert rejection.hint
        assert rejection.hint.best_reference
        assert rejection.imprecise is not None
        assert rejection.imprecise.world_from_camera is support.estimate.world_from_camera


def test_a_pose_with_too_little_evidence_is_not_only_imprecise() -> None:
    support = support_of()
    wide = replace(support, estimate=replace(support.estimate, covariance=support.distance_m() ** 2 * np.eye(6)))
    trust, rejection = verdict(wide, 1.0)
    assert rejection is not None
    assert rejection.imprecise is not None
    doubted = verdict(wide, 1 - trust - 1e-6)[1]
    assert doubted is not None
    assert (doubted.message, doubted.imprecise) == (rejection.message, None)


def test_worse_matches_and_fewer_points_lower_the_trust() -> None:
    clean, noisy, sparse = (verdict(s, 1.0)[0] for s in (support_of(), support_of(0.5), support_of(0.0, 0.3)))
    assert clean > noisy
    assert clean > sparse


def evidence(support: PosedSupport) -> Evidence:
    matched = replace(support, query_matches=query_matches_of(support))
    return evidence_of(matched, votes_of(matched))


def test_expected_share_is_the_median_of_each_references_own() -> None:
    """In plain rows, one reference at a time."""
    support, shares = support_of(0.25), []
    for i, it in enumerate(support.references):
        projected = it.view.camera.project(it.world_from_camera.inverse().apply(support.structure.x_in_world))
        size = [it.view.camera.width_px, it.view.camera.height_px]
        inside = ((projected >= -0.5) & (projected < np.array(size) - 0.5)).all(axis=1).sum()
        shares.append((support.structure.tracks.view == i).sum() / min(inside, len(it.view.features)))
    assert expected_share(support.structure, support.references) == pytest.approx(np.median(shares))


def test_epipolar_share_is_the_planted_share_of_two_references() -> None:
    """Wrong matches of the two best references count, those of others do not."""
    support = support_of()
    assert support.estimate is not None
    strongest = np.argsort(-np.array(support.inliers_by_reference()), kind="stable")[:2].tolist()
    for shares in ((0.0, 0.0), (0.5, 0.0), (0.5, 0.25)):
        matches = query_matches_of(support)
        for view, of_reference in enumerate(matches):
            share = shares[strongest.index(view)] if view in strongest else 0.9
            wrong = np.arange(len(of_reference)) < share * len(of_reference)
            of_reference[wrong, 1] = np.roll(of_reference[wrong, 1], 7)
        expected = (1 - shares[0]) * (1 - shares[1])
        counts, pose = support.inliers_by_reference(), support.estimate.world_from_camera
        found = epipolar_share(support.query, support.references, matches, counts, pose)
        assert found == pytest.approx(expected, abs=0.05), "but for wrong ones that are on the line by chance"


def test_keypoints_without_a_place_are_no_evidence() -> None:
    """Every second has none; half of the matches are wrong."""
    support = support_of()
    assert support.estimate is not None
    matches = query_matches_of(support)
    for of_reference in matches:
        wrong = np.arange(len(of_reference)) < 0.5 * len(of_reference)
        of_reference[wrong, 1] = np.roll(of_reference[wrong, 1], 7)
    keypoints = support.query.features.keypoints.copy()
    keypoints[::2] = np.nan
    query = replace(support.query, features=replace(support.query.features, keypoints=keypoints))
    counts, pose = support.inliers_by_reference(), support.estimate.world_from_camera
    assert epipolar_share(query, support.references, matches, counts, pose) == pytest.approx(0.25, abs=0.06)


def test_the_unit_of_the_world_is_no_evidence() -> None:
    support = support_of()
    assert support.estimate is not None

    def scaled(pose: RigidTransform) -> RigidTransform:
        return RigidTransform(pose.rotation, 1000 * pose.translation)

    references = tuple(replace(r, world_from_camera=scaled(r.world_from_camera)) for r in support.references)
    larger = replace(
        support,
        references=references,
        structure=replace(support.structure, x_in_world=1000 * support.structure.x_in_world),
        estimate=replace(support.estimate, world_from_camera=scaled(support.estimate.world_from_camera)),
    )
    assert evidence(larger).score == pytest.approx(evidence(support).score, abs=0.05)


def test_degenerate_evidence_has_a_finite_score() -> None:
    """No result of a solver may give a score of NaN, which no comparison rejects."""
    worst = Evidence(4, 5000, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0)
    assert np.isfinite(worst.score)
    assert trust_of(worst, OPTIONS) < 1 - COVERAGE


def test_agreement_with_gravity_only_adds_to_the_trust(monkeypatch: pytest.MonkeyPatch) -> None:
    """As much as its chance is small, and less than if nothing but chance made poses wrong."""
    doubtful = Evidence(40, 60, 0.2, 0.5, 0.2, 0.3, 0.02, 0.03)
    trusts = [trust_of(doubtful, OPTIONS, log10_chance) for log10_chance in (0.0, -1.0, -3.0)]
    assert trusts[0] == trust_of(doubtful, OPTIONS)
    assert trusts[0] < trusts[1] < trusts[2]
    monkeypatch.setattr(judging, "AGREEMENT_WEIGHT", 1.0)
    assert trust_of(doubtful, OPTIONS, -3.0) > trusts[2]


def test_hull_share_of_a_rectangle_is_its_area() -> None:
    corners = np.array([[0.0, 0.0], [480.0, 0.0], [480.0, 360.0], [0.0, 360.0], [100.0, 100.0]])
    query, _, matches = problem_of(np.zeros((5, 3)), corners)
    assert hull_share(query, matches, np.ones(5, bool)) == pytest.approx(0.25, rel=1e-4)


def test_findable_points_are_in_front_and_inside_the_image() -> None:
    inside = POSE.apply(CAMERA.rays(np.array([[0.0, 0.0], [959.0, 719.0]])) * 3.0)
    outside = POSE.apply(CAMERA.rays(np.array([[-2.0, 0.0], [959.0, 722.0]])) * 3.0)
    behind = POSE.apply([0.0, 0.0, -2.0])[None]
    query, structure, _ = problem_of(np.concatenate([inside, outside, behind]), np.zeros((5, 2)))
    assert findable_count(query, structure.x_in_world, POSE) == 2
    bare = problem_of(inside[:1], np.zeros((1, 2)))[0]
    assert findable_count(bare, structure.x_in_world, POSE) == 1


# Halves of the data


DISTANCE_M = 4.0


def scene_of(case: object, **options: object) -> SyntheticScene:
    return make_scene(random_for("agreement", case), replace(SceneOptions(point_count=300), **options))  # type: ignore[arg-type]


def solved(scene: SyntheticScene) -> PosedSupport:
    structure, matches = true_structure(scene)
    estimate = solve_pose(scene.query, structure, matches, scene.world_from_query, PnpOptions())
    assert isinstance(estimate, PoseEstimate)
    return Support(scene.query, scene.references, structure, matches, np.zeros(3)).posed(estimate)


def both(scene: SyntheticScene, support: PosedSupport) -> tuple[float, float]:
    votes = votes_of(replace(support, query_matches=true_correspondences(scene).query_matches))
    return (
        disagreement_of_matches(support, DISTANCE_M),
        disagreement_of_references(support, votes, DISTANCE_M),
    )


def test_halves_move_by_the_steps_of_each_alone() -> None:
    """The steps of all halves at once are those of weighted least squares, half by half and match by match."""
    support = support_of()
    assert support.estimate is not None
    matches, camera = support.matches, support.query.camera
    seen = matches.seen(support.query, support.structure.x_in_world)
    pose, random = support.estimate.world_from_camera, np.random.default_rng(0)
    halves = random.random((3, len(matches))) < 0.5
    shifts = halves_of._shifts_nearby(seen, halves, pose, DISTANCE_M)
    in_camera = pose.inverse().apply(seen.x_in_world)
    jacobian, residual = np.moveaxis(pose_jacobian(camera, in_camera), 2, 0), camera.project(in_camera) - seen.pixels
    for half, shift in zip(halves & (np.linalg.norm(residual, axis=1) < halves_of.PNP.inlier_px), shifts, strict=True):
        motion = np.zeros(6)
        for _ in range(halves_of.LINEAR_STEPS):
            hessian, gradient = np.zeros((6, 6)), np.zeros(6)
            for slope, error in zip(jacobian[half], (residual + jacobian @ motion)[half], strict=True):
                weight = 1 / (1 + error @ error / LOSS_SCALE_PX**2)
                hessian += weight * slope.T @ slope
                gradient += weight * slope.T @ error
            motion = motion - np.linalg.solve(hessian, gradient)
        np.testing.assert_allclose(shift, -pose.rotation @ motion[:3], rtol=1e-4, atol=1e-9)
        assert np.linalg.norm(shift) > 1e-5


@pytest.mark.parametrize("outlier_share", [0.0, 0.3])
def test_halves_of_a_right_pose_agree(outlier_share: float) -> None:
    for case in range(5):
        scene = scene_of(case, outlier_share=outlier_share)
        assert max(both(scene, solved(scene))) < 0.01


def test_small_motions_of_halves_are_those_of_ransac(monkeypatch: pytest.MonkeyPatch) -> None:
    scenes = [scene_of(case, outlier_share=0.3, noise_px=1.0) for case in range(5)]
    supports = [solved(scene) for scene in scenes]
    moved = [both(*it) for it in zip(scenes, supports, strict=True)]
    monkeypatch.setattr("mapless_server.method.judge.evidence.LEAST_AGREEING", 10**9)
    found = [both(*it) for it in zip(scenes, supports, strict=True)]
    assert moved != found
    np.testing.assert_allclose(moved, found, rtol=0.1, atol=2e-4)  # a thousandth counts as nothing


def test_a_line_of_points_does_not_say_that_halves_agree() -> None:
    scene = scene_of("line")
    support = solved(scene)
    along = np.linspace(0, 1, len(support.structure.x_in_world))[:, None]
    x_in_world = scene.world_from_query.apply(np.array([-1.0, 0, 4]) + along * np.array([2.0, 0, 1]))
    pixels = scene.query.camera.project(scene.world_from_query.inverse().apply(x_in_world)).astype(np.float32)
    keypoints = scene.query.features.keypoints.copy()
    keypoints[support.matches.keypoint] = pixels[support.matches.point]
    query = replace(scene.query, features=replace(scene.query.features, keypoints=keypoints))
    line = replace(support, query=query, structure=replace(support.structure, x_in_world=x_in_world))
    assert disagreement_of_matches(line, DISTANCE_M) > 0.1


def test_halves_of_random_matches_disagree() -> None:
    scene = scene_of("random")
    support = solved(scene)
    shuffled = random_for("shuffled").permutation(support.matches.point)
    wrong = replace(support, matches=replace(support.matches, point=shuffled))
    assert disagreement_of_matches(wrong, DISTANCE_M) > 0.1


def test_halves_of_references_with_wrong_poses_disagree() -> None:
    """Points seen by references of one half are where those references were moved to."""
    scene = scene_of("moved")
    support = solved(scene)
    votes = votes_of(replace(support, query_matches=true_correspondences(scene).query_matches))
    shift = np.array([1.0, 0.0, 0.0])
    shifted = votes.seen.x_in_world + np.where((votes.reference % 2 == 0)[:, None], shift, 0.0)
    moved = replace(votes, seen=replace(votes.seen, x_in_world=shifted))
    assert disagreement_of_references(support, votes, DISTANCE_M) < 0.01
    assert disagreement_of_references(support, moved, DISTANCE_M) > 0.05


def test_fewer_matches_than_two_poses_need_give_none() -> None:
    scene = scene_of("few", point_count=60)
    support, few = solved(scene), slice(0, 6)
    matches = support.matches
    kept = replace(matches, point=matches.point[few], keypoint=matches.keypoint[few], guided=matches.guided[few])
    assert disagreement_of_matches(replace(support, matches=kept), DISTANCE_M) == NO_AGREEMENT


def test_guided_matches_take_no_part_beside_others() -> None:
    scene = scene_of("guided")
    support = solved(scene)
    wrong = random_for("guided").permutation(support.matches.point)
    guided = np.arange(len(wrong)) % 3 > 0
    point = np.where(guided, wrong, support.matches.point)
    mixed = replace(support, matches=replace(support.matches, point=point, guided=guided))
    assert disagreement_of_matches(mixed, DISTANCE_M) < 0.01
    only = replace(support, matches=replace(support.matches, guided=np.ones(len(wrong), bool)))
    assert disagreement_of_matches(only, DISTANCE_M) < 0.01
