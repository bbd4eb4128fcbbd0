"""The whole method on planted scenes, over a fake network and over the geometric backend."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from support.compare import assert_pose_close, pose_error
from support.fake_network import FakeNetwork, FakeNetworkOptions
from support.planted import moved_references
from support.scenes import CAMERA, SceneOptions, SyntheticScene, make_scene, random_for, unit_rows

import mapless_server.method.localize as method
from mapless.geometry import Array, RigidTransform, rotation_angle_deg, rotation_from_vector
from mapless_server.method import alternatives, pnp
from mapless_server.method.answer import Answer, Localization
from mapless_server.method.coarse import Outcome, Request
from mapless_server.method.coarse.geometric import GeometricReconstructor
from mapless_server.method.correspond import Correspondences, Matcher
from mapless_server.method.localize import MIN_FEATURES, localize, prepare, refine
from mapless_server.method.options import LocalizeOptions, ScaleStrategy, StageContext, Variant
from mapless_server.method.pipeline import Coarse, Pipeline, Prepared, StageOptions, coarse_answer, reconstruct
from mapless_server.method.rejection import Rejection, RejectionReason
from mapless_server.method.results import PoseEstimate, PoseStage, ScaleStage
from mapless_server.method.trust.evidence import evidence_of, votes_of
from mapless_server.method.uncertainty.radii import accuracy_from_covariance, covering_disagreement
from mapless_server.method.views import Features, Matches, PosedView, Reconstruction, View

SCENE = make_scene(random_for("localize"), SceneOptions(point_count=400, reference_count=5))
MATCHER = Matcher()
ROUGH = FakeNetworkOptions(depth_noise_m=0.03, pose_noise_m=0.01, pose_noise_deg=0.2)
JUDGED = ["uncertainty", "judge"]
LATER_STAGES = ["structure", "match", "pnp"]


@dataclass(frozen=True)
class ChangedNetwork:
    """A network whose reconstruction is changed."""

    network: FakeNetwork
    change: Callable[[Reconstruction], Reconstruction]
    name: str = "changed"
    weights_sha256: str = ""
    uses_correspondences: bool = False
    is_batched: bool = True

    def close(self) -> None:
        self.network.close()

    def bucket(self, query: View, references: Sequence[PosedView]) -> str:
        return str(self.network.bucket(query, references))

    def reconstruct_many(self, requests: Sequence[Request]) -> list[Outcome | Exception]:
        return [self.change(self.network.reconstruct(request.query, request.references)) for request in requests]


def pipeline_of(backend: str, scene: SyntheticScene = SCENE, options: FakeNetworkOptions | None = None) -> Pipeline:
    reconstructor = GeometricReconstructor() if backend == "geometric" else FakeNetwork(scene, 0, options)
    return Pipeline(reconstructor, MATCHER if scene is SCENE else Matcher())


def answer_of(pipeline: Pipeline, options: LocalizeOptions | None = None, query: View | None = None) -> Answer:
    return localize(query or SCENE.query, SCENE.references, pipeline, options or LocalizeOptions())


def pose_of(answer: Answer) -> Localization:
    assert isinstance(answer.outcome, Localization), answer.outcome
    return answer.outcome


def reason_of(answer: Answer) -> RejectionReason:
    assert isinstance(answer.outcome, Rejection), answer.outcome
    return answer.outcome.reason


def without_meaning(view: View) -> View:
    """The same keypoints, but their descriptors are like nothing else."""
    random = random_for("without meaning")
    descriptors = unit_rows(random.standard_normal(view.features.descriptors.shape)).astype(np.float32)
    return replace(view, features=replace(view.features, descriptors=descriptors))


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


def test_radii_cover_half_of_the_distance_of_halves() -> None:
    """Adds in quadrature to the radius by the jackknife; halves of the data alone give cameras that far apart."""
    for seed in range(3):
        scene = make_scene(random_for("apart", seed), SceneOptions(point_count=150, outlier_share=0.5))
        answer = localize(scene.query, scene.references, pipeline_of("geometric", scene), LocalizeOptions(coverage=1.0))
        found, support = pose_of(answer), answer.support
        assert support is not None
        assert support.estimate is not None
        assert found.covariance is not None
        votes = votes_of(support, support.query_matches)
        apart_m = evidence_of(support, votes, support.query_matches).disagreement * support.distance_m()
        radii = [accuracy_from_covariance(it) for it in (support.estimate.covariance, found.covariance)]
        assert radii[1].position_68_m == pytest.approx(np.hypot(radii[0].position_68_m, apart_m / 2))
        growth = radii[1].position_68_m / radii[0].position_68_m
        assert growth > 1.001
        assert radii[1].rotation_95_deg == pytest.approx(growth * radii[0].rotation_95_deg)


@pytest.mark.parametrize(("apart_in_radii", "growth"), [(0.0, 1.0), (2.0, 2**0.5), (6.0, 10**0.5), (1e6, 10**0.5)])
def test_halves_enlarge_radii_to_a_limit(apart_in_radii: float, growth: float) -> None:
    estimate = PoseEstimate(SCENE.world_from_query, PoseStage.REFINED, np.ones(4, bool), np.ones(4), np.eye(6))
    radius_m = accuracy_from_covariance(estimate.covariance).position_68_m
    larger = covering_disagreement(estimate, apart_in_radii * radius_m)
    assert accuracy_from_covariance(larger.covariance).position_68_m == pytest.approx(growth * radius_m)


def test_halves_say_nothing_of_a_pose_with_priors() -> None:
    alone = PoseEstimate(SCENE.world_from_query, PoseStage.REFINED, np.ones(4, bool), np.ones(4), np.eye(6))
    informed = replace(alone, without_priors=alone)
    assert covering_disagreement(informed, 1.0) is informed


# Wide correspondences


def test_a_weak_answer_is_recomputed_from_wide_correspondences(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[bool] = []
    correspond = Matcher.correspond

    def spy(
        self: Matcher,
        query: View,
        references: Sequence[PosedView],
        wide: bool,
        check: Callable[[], None],
        query_matches: Sequence[Matches] | None,
    ) -> Correspondences:
        asked.append(wide)
        assert (query_matches is not None) == wide, "the query is matched once"
        return correspond(self, query, references, wide, check, query_matches)

    monkeypatch.setattr(Matcher, "correspond", spy)
    strong = pose_of(answer_of(weak_below(10, pipeline_of("geometric"))))
    assert asked == [False]
    again = answer_of(weak_below(10**6, pipeline_of("geometric")))
    assert asked == [False, False, True]
    assert pose_of(again).inlier_count >= strong.inlier_count
    assert list(again.stage_seconds) == ["correspond", "coarse", "scale", *LATER_STAGES, "adjust", *JUDGED]
    assert_pose_close(pose_of(again).world_from_camera, SCENE.world_from_query, metres=0.01, degrees=0.1)

    for variant in (Variant.COARSE, Variant.NO_STRUCTURE, Variant.FULL):  # the paper's forms stay the paper's
        asked.clear()
        answer_of(weak_below(10**6, pipeline_of("geometric")), LocalizeOptions(variant))
        assert asked == [False]


def weak_below(weak_inliers: int, pipeline: Pipeline) -> Pipeline:
    return replace(pipeline, options=StageOptions(weak_inliers=weak_inliers))


class Cancelled(Exception):
    """What a check raises."""


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


# The initial pose


# Rejections


def blinded(reconstruction: Reconstruction) -> Reconstruction:
    """As of a network whose activations overflowed."""
    nowhere = RigidTransform(np.full((3, 3), np.nan), np.full(3, np.nan))
    return Reconstruction(
        replace(reconstruction.query, local_from_camera=nowhere),
        tuple(
            replace(r, local_from_camera=nowhere, point_map=np.full_like(r.point_map, np.nan))
            for r in reconstruction.references
        ),
    )


@pytest.mark.parametrize("backend", ["geometric", "network"])
@pytest.mark.parametrize("count", [0, 1])
def test_no_usable_references_is_the_reason(backend: str, count: int) -> None:
    answer = localize(SCENE.query, SCENE.references[:count], pipeline_of(backend), LocalizeOptions())
    assert reason_of(answer) is RejectionReason.NO_USABLE_REFERENCES
    assert answer.scale is None
    assert "adjust" not in answer.stage_seconds


@pytest.mark.parametrize("backend", ["geometric", "network"])
def test_degenerate_references_is_the_reason(backend: str) -> None:
    where = SCENE.references[0].world_from_camera.translation
    stacked = tuple(
        replace(r, key=f"{r.key}-stacked", world_from_camera=RigidTransform(r.world_from_camera.rotation, where))
        for r in SCENE.references
    )
    pipeline = pipeline_of(backend)
    if backend == "network":
        keys = replace(SCENE, references=stacked)
        pipeline = Pipeline(FakeNetwork(keys), Matcher())
    assert (
        reason_of(localize(SCENE.query, stacked, pipeline, LocalizeOptions())) is RejectionReason.DEGENERATE_REFERENCES
    )


@pytest.mark.parametrize("count", [0, MIN_FEATURES - 1])
def test_low_texture_is_the_reason(count: int) -> None:
    f = SCENE.query.features
    bare = View(CAMERA, Features(f.keypoints[:count], f.descriptors[:count], f.sizes_px[:count]))
    answer = answer_of(pipeline_of("geometric"), query=bare)
    assert reason_of(answer) is RejectionReason.LOW_TEXTURE
    assert not answer.stage_seconds


def test_low_overlap_is_the_reason() -> None:
    for seed in range(3):
        elsewhere = make_scene(random_for("elsewhere", seed), SceneOptions(point_count=400))
        answer = answer_of(pipeline_of("geometric"), query=elsewhere.query)
        assert reason_of(answer) is RejectionReason.LOW_OVERLAP
        assert list(answer.stage_seconds)[:3] == ["correspond", "coarse", "two_view"]


def test_scale_unreliable_is_the_reason() -> None:
    pipeline = Pipeline(ChangedNetwork(FakeNetwork(SCENE), blinded), MATCHER)
    answer = answer_of(pipeline, LocalizeOptions(Variant.FULL))
    assert reason_of(answer) is RejectionReason.SCALE_UNRELIABLE
    assert list(answer.stage_seconds) == ["correspond", "coarse", "scale"]


def test_too_few_matches_is_the_reason() -> None:
    answer = answer_of(pipeline_of("network"), query=without_meaning(SCENE.query))
    assert reason_of(answer) is RejectionReason.TOO_FEW_MATCHES
    assert answer.scale is not None


@pytest.mark.parametrize("seed", range(5))
def test_gate_is_the_reason(seed: int) -> None:
    """The paper's search matches anything near; with a wrong network and random descriptors that is rejected."""
    wrong = FakeNetwork(SCENE, seed, FakeNetworkOptions(pose_noise_m=0.5, pose_noise_deg=2.0))
    options = LocalizeOptions(Variant.FULL, ScaleStrategy.TRIANGULATION)
    answer = answer_of(Pipeline(wrong, MATCHER), options, without_meaning(SCENE.query))
    assert reason_of(answer) is RejectionReason.GATE


@pytest.mark.parametrize(
    ("strict", "wide", "wide_wins"),
    [
        ((60, 0.01), (70, 0.02), True),
        ((60, 0.01), (60, 0.005), False),
        ((60, 0.01), (70, 0.5), False),
        (None, (8, 0.5), True),
        ((8, 0.5), None, False),
    ],
    ids=["more inliers", "as many", "a claim as wide as a room", "instead of none", "none"],
)
def test_the_better_of_strict_and_wide_answer_is_returned(
    strict: tuple[int, float] | None, wide: tuple[int, float] | None, wide_wins: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def made(claim: tuple[int, float] | None) -> Answer:
        if claim is None:
            return Answer(Rejection(RejectionReason.LOW_OVERLAP, "nothing in common"))
        covariance = np.eye(6) * claim[1] ** 2
        return Answer(Localization(SCENE.world_from_query, covariance, PoseStage.REFINED, claim[0], 90, 1.0))

    answers = {False: made(strict), True: made(wide)}
    poses = iter((answers[False], answers[True]))
    monkeypatch.setattr(method, "solve", lambda *_: next(poses))
    found = answer_of(pipeline_of("geometric"))
    expected = answers[wide_wins].outcome
    assert isinstance(expected, Localization)
    assert pose_of(found).inlier_count == expected.inlier_count


@pytest.mark.parametrize(("backend", "times"), [("network", 1), ("geometric", 2)])
def test_a_network_runs_once_for_a_query(backend: str, times: int, monkeypatch: pytest.MonkeyPatch) -> None:
    pipeline, asked = pipeline_of(backend), list[int]()
    kind = type(pipeline.reconstructor)
    reconstruct_many = kind.reconstruct_many

    def counted(self: Any, requests: Sequence[Request]) -> list[Outcome | Exception]:
        asked.append(len(requests))
        return reconstruct_many(self, requests)

    monkeypatch.setattr(kind, "reconstruct_many", counted)
    answer_of(weak_below(10**6, pipeline))
    assert len(asked) == times


def looking_back(reconstruction: Reconstruction) -> Reconstruction:
    """Right but for the query, which is turned around."""
    query = reconstruction.query
    turned = query.local_from_camera.compose(RigidTransform(np.diag([-1.0, 1.0, -1.0]), np.zeros(3)))
    return replace(reconstruction, query=replace(query, local_from_camera=turned))


def test_pnp_failed_is_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    pipeline = Pipeline(ChangedNetwork(FakeNetwork(SCENE), looking_back), MATCHER)
    monkeypatch.setattr(pnp, "ransac", lambda *_: None)
    found = pose_of(answer_of(pipeline)).world_from_camera
    assert_pose_close(found, SCENE.world_from_query, metres=0.02, degrees=0.2)  # by two_view
    monkeypatch.setattr(alternatives, "solve_two_view", lambda *_: None)
    answer = answer_of(pipeline)
    assert reason_of(answer) is RejectionReason.PNP_FAILED
    assert list(answer.stage_seconds)[-2:] == ["pnp", "two_view"]


# Many queries, in three parts


def prepared_of(pipeline: Pipeline, options: LocalizeOptions | None = None, query: View | None = None) -> Prepared:
    context = StageContext()
    prepared = prepare(query or SCENE.query, SCENE.references, pipeline, options or LocalizeOptions(), context)
    assert isinstance(prepared, Prepared), prepared
    return prepared


def fewer_features(seed: int) -> View:
    """The query, but that every tenth of its features is not found."""
    f = SCENE.query.features
    kept = random_for("fewer features", seed).random(len(f)) < 0.9
    return replace(SCENE.query, features=Features(f.keypoints[kept], f.descriptors[kept], f.sizes_px[kept]))


def coarse_of(result: Coarse | Answer | Exception) -> Coarse:
    assert isinstance(result, Coarse), result
    return result


def same_bits(first: Answer, second: Answer) -> bool:
    one, other = pose_of(first), pose_of(second)
    return (
        one.world_from_camera.matrix().tobytes() == other.world_from_camera.matrix().tobytes()
        and (one.inlier_count, one.match_count) == (other.inlier_count, other.match_count)
        and list(first.stage_seconds) == list(second.stage_seconds)
    )


@pytest.mark.parametrize("weak_inliers", [0, 10**6])
@pytest.mark.parametrize("backend", ["geometric", "network"])
def test_queries_of_a_batch_have_the_answers_they_have_alone(backend: str, weak_inliers: int) -> None:
    """To the bit, where the backend itself gives the same bits; with their own options."""
    pipeline = weak_below(weak_inliers, pipeline_of(backend, options=None if backend == "geometric" else ROUGH))
    queries = [fewer_features(seed) for seed in range(3)] if backend == "geometric" else [SCENE.query] * 3
    choices = [LocalizeOptions(variant) for variant in (Variant.BEST, Variant.FULL)]
    options = [choices[i % 2] for i in range(3)]
    batch = [prepared_of(pipeline, o, q) for o, q in zip(options, queries, strict=True)]
    assert len({prepared.bucket for prepared in batch}) == 1
    parts = [coarse_of(result) for result in reconstruct(batch)]
    assert len({part.prepared.context.stage_seconds["coarse"] for part in parts}) == 1
    for part, option, query in zip(parts, options, queries, strict=True):
        assert same_bits(refine(part), answer_of(pipeline, option, query))


@pytest.mark.parametrize("reason", RejectionReason)
def test_two_views_rescue_no_pose_that_was_not_accepted(reason: RejectionReason) -> None:
    prepared = prepare(SCENE.query, SCENE.references, pipeline_of("geometric"), LocalizeOptions(), StageContext())
    assert isinstance(prepared, Prepared)
    found = {RejectionReason.GATE, RejectionReason.AMBIGUOUS, RejectionReason.DEGENERATE_REFERENCES}
    assert prepared.can_use_two_views(Answer(Rejection(reason, "planted"))) is (reason not in found)


def test_a_coarse_answer_has_the_initial_pose_and_its_stage() -> None:
    for backend in ("geometric", "network"):
        offset = np.full(3, 1e5)
        far = [replace(r, world_from_camera=r.world_from_camera.shifted(offset)) for r in SCENE.references]
        pipeline = replace(pipeline_of(backend, options=ROUGH), matcher=Matcher())  # the structure is another one
        prepared = prepare(SCENE.query, far, pipeline, LocalizeOptions(), StageContext())
        assert isinstance(prepared, Prepared)
        answer = coarse_answer(coarse_of(reconstruct([prepared])[0]))
        assert answer is not None
        expected = localize(SCENE.query, far, pipeline, LocalizeOptions(Variant.COARSE))
        found, asked_for = pose_of(answer), pose_of(expected)
        assert (found.pose_stage, asked_for.pose_stage) == (PoseStage.COARSE, PoseStage.INITIAL)
        assert found.covariance is None
        assert found.world_from_camera.matrix().tobytes() == asked_for.world_from_camera.matrix().tobytes()
        assert answer.scale is not None
        assert expected.scale is not None
        assert answer.scale.metres_per_unit == expected.scale.metres_per_unit
        assert answer.reference_match_counts == expected.reference_match_counts
        assert list(answer.stage_seconds)[:2] == ["correspond", "coarse"]


def test_without_an_initial_pose_there_is_no_coarse_answer() -> None:
    """But a refined one, from the matches with the references themselves, where the variant has it."""
    pipeline = Pipeline(ChangedNetwork(FakeNetwork(SCENE), blinded), MATCHER)
    hopeful, settled = reconstruct(
        [prepared_of(pipeline, LocalizeOptions(variant)) for variant in (Variant.BEST, Variant.FULL)]
    )
    assert coarse_answer(coarse_of(hopeful)) is None
    found = pose_of(refine(coarse_of(hopeful))).world_from_camera
    assert_pose_close(found, SCENE.world_from_query, metres=0.02, degrees=0.2)
    assert isinstance(settled, Answer)
    assert reason_of(settled) is RejectionReason.SCALE_UNRELIABLE


def test_one_querys_exception_does_not_fail_the_others() -> None:
    """Of its check before and after the backend, and of the backend, which is not called after a failed check."""
    network = FakeNetwork(SCENE)
    fault, asked = MemoryError("of this query"), []

    class Faulty(ChangedNetwork):
        def reconstruct_many(self, requests: Sequence[Request]) -> list[Outcome | Exception]:
            asked.append(len(requests))
            outcomes = super().reconstruct_many(requests)
            return [fault, *outcomes[1:]]

    pipeline = Pipeline(Faulty(network, lambda it: it), MATCHER)
    gone = Cancelled()
    later_calls: list[int] = []

    def already() -> None:
        raise gone

    def later() -> None:
        later_calls.append(len(later_calls))
        if len(later_calls) > 1:
            raise gone

    checks = [already, lambda: None, later, lambda: None]
    batch = [replace(prepared_of(pipeline), context=StageContext(check)) for check in checks]
    first, second, third, fourth = reconstruct(batch)
    assert first is gone
    assert second is fault
    assert third is gone
    assert pose_of(refine(coarse_of(fourth))).pose_stage is PoseStage.REFINED
    assert asked == [3]


def test_an_exception_of_the_whole_batch_is_raised_unchanged() -> None:
    fault = RuntimeError("CUDA error: an illegal memory access was encountered")

    class Broken(ChangedNetwork):
        def reconstruct_many(self, requests: Sequence[Request]) -> list[Outcome | Exception]:
            raise fault

    pipeline = Pipeline(Broken(FakeNetwork(SCENE), lambda it: it), MATCHER)
    with pytest.raises(RuntimeError) as raised:
        reconstruct([prepared_of(pipeline), prepared_of(pipeline)])
    assert raised.value is fault
    with pytest.raises(RuntimeError) as raised:
        answer_of(pipeline)
    assert raised.value is fault


def test_a_batch_has_one_reconstructor() -> None:
    with pytest.raises(ValueError, match="one reconstructor"):
        reconstruct([prepared_of(pipeline_of(backend)) for backend in ("geometric", "network")])
    assert reconstruct([]) == []
