"""The whole method on planted scenes, over a fake network and over the geometric backend."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from support.compare import assert_pose_close, pose_error
from support.localizing import (
    JUDGED,
    LATER_STAGES,
    MATCHER,
    ROUGH,
    SCENE,
    Cancelled,
    answer_of,
    pipeline_of,
    pose_of,
    weak_below,
)
from support.planted import moved_references
from support.scenes import SceneOptions, make_scene, random_for

from mapless.geometry import Array, RigidTransform, rotation_angle_deg, rotation_from_vector
from mapless_server.method.bundle.estimate import (
    JACKKNIFE_SHARE,
    PosedSupport,
    PoseEstimate,
    PoseStage,
    accuracy_from_covariance,
    with_halves,
)
from mapless_server.method.features.views import Matches, PosedView, View
from mapless_server.method.judge.evidence import evidence_of, votes_of
from mapless_server.method.localize import localize
from mapless_server.method.options import LocalizeOptions, ScaleStrategy, StageContext, Variant
from mapless_server.method.pairs.correspond import Correspondences, Matcher
from mapless_server.method.pairs.pair import Matching
from mapless_server.method.pipeline import Pipeline
from mapless_server.method.structure.model import ScaleStage

# Accuracy


@pytest.mark.parametrize("strategy", ScaleStrategy)
@pytest.mark.parametrize("variant", Variant)
@pytest.mark.parametrize("backend", ["geometric", "network"])
def test_every_variant_finds_the_planted_pose(backend: str, variant: Variant, strategy: ScaleStrategy) -> None:
    answer = answer_of(pipeline_of(backend), LocalizeOptions(variant, strategy))
    found = pose_of(answer)
    assert_pose_close(found.world_from_camera, SCENE.world_from_query, metres=0.01, degrees=0.1)
    assert answer.scale is not None
    if strategy is not ScaleStrategy.TWO_STAGE:
        assert answer.scale.stage is ScaleStage(strategy.value)
    if variant is Variant.COARSE:
        assert found.covariance is None
        assert found.pose_stage is PoseStage.INITIAL
    else:
        assert found.covariance is not None
        assert np.linalg.eigvalsh(found.covariance).min() > 0
        assert 0.8 * found.match_count < found.inlier_count <= found.match_count
        assert 0.2 < found.reprojection_error_px < 2


def test_refinement_makes_a_rough_pose_accurate() -> None:
    errors = {
        variant: pose_error(
            pose_of(answer_of(pipeline_of("network", options=ROUGH), LocalizeOptions(variant))).world_from_camera,
            SCENE.world_from_query,
        )
        for variant in Variant
    }
    assert errors[Variant.COARSE][0] > 0.01
    assert errors[Variant.FULL][0] < 0.5 * errors[Variant.COARSE][0]
    assert errors[Variant.BEST][0] < 0.5 * errors[Variant.COARSE][0]
    assert max(errors[Variant.FULL][1], errors[Variant.BEST][1]) < 0.5 * errors[Variant.COARSE][1]


def test_wrong_keypoints_and_few_points_do_not_prevent_a_pose() -> None:
    for seed in range(4):
        scene = make_scene(
            random_for("hard", seed),
            SceneOptions(point_count=200, outlier_share=0.35, reference_count=4, seen_share=0.7),
        )
        found = pose_of(localize(scene.query, scene.references, pipeline_of("geometric", scene), LocalizeOptions()))
        assert_pose_close(found.world_from_camera, scene.world_from_query, metres=0.03, degrees=0.3)


def test_a_flat_scene_is_localized() -> None:
    scene = make_scene(random_for("flat"), SceneOptions(box_m=(4.0, 2.4, 0.0), reference_count=4))
    found = pose_of(localize(scene.query, scene.references, pipeline_of("geometric", scene), LocalizeOptions()))
    assert_pose_close(found.world_from_camera, scene.world_from_query, metres=0.02, degrees=0.2)


# What comes with the answer


def test_stages_run_in_order_and_are_timed() -> None:
    before = ["correspond", "coarse", "scale"]
    for variant, after in (
        (Variant.COARSE, []),
        (Variant.NO_STRUCTURE, [*LATER_STAGES, *JUDGED]),
        (Variant.FULL, [*LATER_STAGES, *JUDGED]),
        (Variant.BEST, [*LATER_STAGES, "adjust", *JUDGED]),
    ):
        seconds = answer_of(pipeline_of("network"), LocalizeOptions(variant)).stage_seconds
        assert list(seconds) == before + after
        assert all(0 < s < 10 for s in seconds.values())


def test_match_and_inlier_counts_are_those_of_each_reference() -> None:
    answer = answer_of(pipeline_of("geometric"))
    found = pose_of(answer)
    matches = MATCHER.correspond(SCENE.query, SCENE.references).query_matches
    assert answer.reference_match_counts == tuple(len(m) for m in matches)
    assert len(answer.reference_inlier_counts) == len(SCENE.references)
    assert max(answer.reference_inlier_counts) <= found.inlier_count
    assert sum(answer.reference_inlier_counts) >= 2 * found.inlier_count  # every point is seen at least twice


def test_errors_are_as_large_as_the_covariance() -> None:
    """Within the factor by which it is inflated."""
    squares = []
    for seed in range(12):
        scene = make_scene(random_for("honest", seed), SceneOptions(point_count=150, reference_count=4))
        found = pose_of(localize(scene.query, scene.references, pipeline_of("geometric", scene), LocalizeOptions()))
        assert found.covariance is not None
        shift = found.world_from_camera.translation - scene.world_from_query.translation
        squares.append(shift @ np.linalg.solve(found.covariance[:3, :3], shift))
    assert 0.3 < np.mean(squares) < 4.5  # 3 if it were exact


def test_radii_contain_the_distance_of_halves() -> None:
    """Half of it, in quadrature with a share of the radius by the jackknife; what halves share counts in full."""
    for seed in range(3):
        scene = make_scene(random_for("apart", seed), SceneOptions(point_count=150, outlier_share=0.5))
        answer = localize(scene.query, scene.references, pipeline_of("geometric", scene), LocalizeOptions(coverage=1.0))
        found, support = pose_of(answer), answer.support
        assert isinstance(support, PosedSupport)
        assert support.estimate.intrinsics is not None
        assert found.covariance is not None
        apart_m = evidence_of(support, votes_of(support)).disagreement * support.distance_m()
        given, shared = support.estimate.covariance, support.estimate.intrinsics.pose_covariance
        halves = (apart_m / 2 / accuracy_from_covariance(given).position_68_m) ** 2
        assert halves > 0.001
        expected = JACKKNIFE_SHARE * (given - shared) + shared + halves * given
        np.testing.assert_allclose(found.covariance, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("apart_in_radii", "halves"), [(0.0, 0.0), (2.0, 1.0), (6.0, 9.0), (1e6, 9.0)])
def test_halves_enlarge_radii_to_a_limit(apart_in_radii: float, halves: float) -> None:
    growth = np.sqrt(JACKKNIFE_SHARE + halves)
    estimate = PoseEstimate(SCENE.world_from_query, PoseStage.REFINED, np.ones(4, bool), np.ones(4), np.eye(6))
    radius_m = accuracy_from_covariance(estimate.covariance).position_68_m
    larger = with_halves(estimate, apart_in_radii * radius_m)
    assert accuracy_from_covariance(larger.covariance).position_68_m == pytest.approx(growth * radius_m)


def test_halves_say_nothing_of_a_pose_with_priors() -> None:
    alone = PoseEstimate(SCENE.world_from_query, PoseStage.REFINED, np.ones(4, bool), np.ones(4), np.eye(6))
    informed = replace(alone, without_priors=alone)
    assert with_halves(informed, 1.0) is informed


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_an_answer_is_finite_where_all_its_numbers_are(number: float) -> None:
    answer = answer_of(pipeline_of("geometric"))
    found, scale = pose_of(answer), answer.scale
    assert scale is not None
    assert found.covariance is not None
    assert answer.is_finite
    assert replace(answer, scale=None, outcome=replace(found, covariance=None)).is_finite
    at = found.world_from_camera
    for outcome in (
        replace(found, world_from_camera=replace(at, rotation=at.rotation * number)),
        replace(found, world_from_camera=replace(at, translation=np.array([0.0, number, 0.0]))),
        replace(found, covariance=np.diag([0.01] * 5 + [number])),
        replace(found, reprojection_error_px=number),
    ):
        assert not replace(answer, outcome=outcome).is_finite
    for spoilt in (replace(scale, metres_per_unit=number), replace(scale, deviation=number)):
        assert not replace(answer, scale=spoilt).is_finite


# Wide correspondences


def test_a_weak_answer_is_recomputed_from_wide_correspondences(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Matching] = []
    correspond = Matcher.correspond

    def spy(
        self: Matcher,
        query: View,
        references: Sequence[PosedView],
        matching: Matching = Matching.STRICT,
        check: Callable[[], None] = lambda: None,
        query_matches: Sequence[Matches] | None = None,
    ) -> Correspondences:
        asked.append(matching)
        assert (query_matches is not None) == matching.is_wide, "the query is matched once"
        return correspond(self, query, references, matching, check, query_matches)

    monkeypatch.setattr(Matcher, "correspond", spy)
    strong = pose_of(answer_of(pipeline_of("geometric"), doubt=weak_below(10)))
    assert asked == [Matching.STRICT]
    again = answer_of(pipeline_of("geometric"), doubt=weak_below(10**6))
    assert asked == [Matching.STRICT, Matching.STRICT, Matching.WIDE]
    assert pose_of(again).inlier_count >= strong.inlier_count
    assert list(again.stage_seconds) == ["correspond", "coarse", "scale", *LATER_STAGES, "adjust", *JUDGED]
    assert_pose_close(pose_of(again).world_from_camera, SCENE.world_from_query, metres=0.01, degrees=0.1)

    for variant in (Variant.COARSE, Variant.NO_STRUCTURE, Variant.FULL):  # the paper's forms stay the paper's
        asked.clear()
        answer_of(pipeline_of("geometric"), LocalizeOptions(variant), doubt=weak_below(10**6))
        assert asked == [Matching.STRICT]


@pytest.mark.parametrize("steps", [0, 1, 10, 20])
def test_a_cancelled_query_stops_at_the_next_check(steps: int) -> None:
    asked = iter(range(steps))

    def check() -> None:
        if next(asked, None) is None:
            raise Cancelled

    with pytest.raises(Cancelled):
        localize(SCENE.query, SCENE.references, Pipeline(), LocalizeOptions(), StageContext(check))


# What must not matter


@pytest.mark.parametrize("backend", ["geometric", "network"])
def test_the_same_query_has_the_same_answer_bit_for_bit(backend: str) -> None:
    first, second = (
        pose_of(answer_of(replace(pipeline_of(backend), matcher=matcher))) for matcher in (Matcher(), Matcher())
    )
    assert first.world_from_camera.matrix().tobytes() == second.world_from_camera.matrix().tobytes()
    assert first.covariance is not None
    assert second.covariance is not None
    assert first.covariance.tobytes() == second.covariance.tobytes()
    assert (first.inlier_count, first.match_count) == (second.inlier_count, second.match_count)


@pytest.mark.parametrize("variant", [Variant.COARSE, Variant.FULL, Variant.BEST])
def test_the_answer_moves_with_the_world(variant: Variant) -> None:
    moved = RigidTransform(rotation_from_vector([0.7, -1.5, 2.0]), np.array([120.0, -40.0, 7.0]))
    options = LocalizeOptions(variant)
    here = pose_of(answer_of(pipeline_of("geometric"), options))
    there = pose_of(localize(SCENE.query, moved_references(SCENE.references, moved), pipeline_of("geometric"), options))
    assert_pose_close(there.world_from_camera, moved.compose(here.world_from_camera), metres=1e-4, degrees=1e-3)
    if here.covariance is not None and there.covariance is not None:
        turn = np.kron(np.eye(2), moved.rotation)
        expected: Array = turn @ here.covariance @ turn.T
        np.testing.assert_allclose(there.covariance, expected, atol=0.01 * np.abs(expected).max())


@pytest.mark.parametrize("metres", [1e6, 1e7])
@pytest.mark.parametrize("variant", Variant)
def test_large_world_coordinates_cost_no_digits(variant: Variant, metres: float) -> None:
    offset = np.array([metres, -metres, 1e3])
    far = moved_references(SCENE.references, RigidTransform(np.eye(3), offset))
    near_pose, far_pose = (
        pose_of(localize(SCENE.query, it, pipeline_of("geometric"), LocalizeOptions(variant))).world_from_camera
        for it in (SCENE.references, far)
    )
    np.testing.assert_allclose(far_pose.translation - offset, near_pose.translation, rtol=0, atol=1e-6)
    assert rotation_angle_deg(far_pose.rotation @ near_pose.rotation.T) < 1e-3


def test_the_order_of_references_hardly_changes_the_pose() -> None:
    answers = [
        pose_of(localize(SCENE.query, references, pipeline_of("geometric"), LocalizeOptions()))
        for references in (SCENE.references, SCENE.references[::-1])
    ]
    assert_pose_close(answers[0].world_from_camera, answers[1].world_from_camera, metres=1e-3, degrees=0.01)
