"""The gate rejects poses that chance could support; two places that a photograph fits are ambiguous."""

import math
from collections.abc import Sequence
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from support import corner
from support.compare import assert_pose_close
from support.planted import moved_references
from support.pnp_problems import POSE, Problem, planted
from support.scenes import CAMERA, make_scene, random_for

from mapless.geometry import RigidTransform, rotation_from_vector
from mapless_server.images import ImageLimits, decode_image
from mapless_server.method.bundle.estimate import PoseEstimate
from mapless_server.method.features.extractors import make_extractor
from mapless_server.method.features.views import PosedView, View
from mapless_server.method.judge.answer import Answer, Localization
from mapless_server.method.localize import localize
from mapless_server.method.options import LocalizeOptions
from mapless_server.method.pairs.correspond import Matcher
from mapless_server.method.pipeline import Pipeline
from mapless_server.method.pose.pnp import (
    PnpOptions,
    false_alarms,
    format_false_alarms,
    gate_failure,
    log10_false_alarms,
    ransac,
    solve_pose,
)
from mapless_server.method.rejection import Rejection, RejectionReason
from mapless_server.method.structure.model import PointMatches

INLIER_PX = PnpOptions().inlier_px


def failure_of(problem: Problem, initial: RigidTransform = POSE) -> str:
    """Why the solver's pose fails the gate, or the solver's rejection; empty if the pose passes."""
    estimate = solve_pose(*problem, initial, PnpOptions())
    if isinstance(estimate, Rejection):
        assert estimate.reason is RejectionReason.PNP_FAILED
        return estimate.message
    return said(problem, estimate)


def said(problem: Problem, estimate: PoseEstimate) -> str:
    query, _, matches = problem
    return gate_failure(query.camera, matches, estimate.inliers, INLIER_PX) or ""


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
    assert format_false_alarms(math.inf, -3.0) == "many such poses expected by chance, at most 0.001 allowed"


@pytest.mark.parametrize(("log10", "number"), [(2.34, "220"), (-1.6, "0.025"), (-14.92, "10^-14.9"), (7.0, "10^7")])
def test_expected_poses_and_their_bound_in_words(log10: float, number: str) -> None:
    assert format_false_alarms(log10, -15.0) == f"{number} such poses expected by chance, at most 10^-15 allowed"


def test_guided_and_other_matches_have_their_own_chance() -> None:
    inliers = np.arange(100) < 40
    disc = INLIER_PX**2
    index = np.arange(100)
    free = PointMatches(index, index, np.zeros(100, bool), 0.0)
    share = math.pi * disc / (CAMERA.width_px * CAMERA.height_px)
    assert log10_false_alarms([(CAMERA, free, inliers)], INLIER_PX) == pytest.approx(false_alarms(100, 40, share))
    guided = PointMatches(index, index, np.ones(100, bool), 20.0)
    assert log10_false_alarms([(CAMERA, guided, inliers)], INLIER_PX) == pytest.approx(
        false_alarms(100, 40, disc / 400)
    )
    both = PointMatches(index, index, index % 2 == 0, 20.0)
    assert log10_false_alarms([(CAMERA, both, inliers)], INLIER_PX) == pytest.approx(
        min(false_alarms(50, 20, share), false_alarms(50, 20, disc / 400))
    )


ELSEWHERE = RigidTransform(rotation_from_vector([0.0, 0.7, 0.0]), np.array([20.0, -3.0, 8.0]))
"""Where the copy stands: another room, turned."""

SCENE = make_scene(random_for("ambiguity"))
PIPELINE = Pipeline(matcher=Matcher())


def copied(references: Sequence[PosedView], which: Sequence[int], where: RigidTransform) -> tuple[PosedView, ...]:
    """The references, some of which (by index) stand in the copy."""
    there = moved_references(tuple(references), where)
    return tuple(there[i] if i in which else r for i, r in enumerate(references))


def answer_of(references: Sequence[PosedView], query: View = SCENE.query) -> Answer:
    return localize(query, references, PIPELINE, LocalizeOptions())


def rejected(answer: Answer) -> Rejection:
    assert isinstance(answer.outcome, Rejection), answer.outcome
    return answer.outcome


@pytest.mark.parametrize("offset_m", [0.0, 1e6])
def test_both_of_two_identical_places_are_hypotheses(offset_m: float) -> None:
    """Every second reference stands in the copy: nothing decides."""
    far = RigidTransform(np.eye(3), np.array([offset_m, -offset_m, 0.0]))
    references = moved_references(SCENE.references, far)
    rejection = rejected(answer_of(copied(references, (1, 3, 5), ELSEWHERE)))
    assert rejection.reason is RejectionReason.AMBIGUOUS
    truth = far.compose(SCENE.world_from_query)
    here, there = sorted(rejection.hypotheses, key=lambda it: it.references)
    assert_pose_close(here.world_from_camera, truth, metres=0.02, degrees=0.3)
    assert_pose_close(there.world_from_camera, ELSEWHERE.compose(truth), metres=0.02, degrees=0.3)
    assert set(here.references) == {references[i].name for i in (0, 2, 4)}
    assert set(there.references) == {references[i].name for i in (1, 3, 5)}
    assert rejection.hypotheses[0].inlier_count >= rejection.hypotheses[1].inlier_count > 50
    assert "m apart" in rejection.message


@pytest.mark.parametrize("which", [(), (5,)], ids=["no copy", "one reference in the copy"])
def test_a_place_of_one_reference_is_no_hypothesis(which: Sequence[int]) -> None:
    """One reference alone has no points, so it proposes no place."""
    outcome = answer_of(copied(SCENE.references, which, ELSEWHERE)).outcome
    assert isinstance(outcome, Localization), outcome
    assert_pose_close(outcome.world_from_camera, SCENE.world_from_query, metres=0.02, degrees=0.3)


def test_the_clearly_better_supported_place_is_answered() -> None:
    """The copy has lost most of its points."""
    random = random_for("weak copy")

    def worn(view: PosedView) -> PosedView:
        f = view.view.features
        kept = random.random(len(f)) < 0.3
        features = replace(f, keypoints=f.keypoints[kept], descriptors=f.descriptors[kept], sizes_px=f.sizes_px[kept])
        return replace(view, key=f"{view.key}-worn", view=replace(view.view, features=features))

    copies = [worn(r) if i % 2 else r for i, r in enumerate(SCENE.references)]
    outcome = answer_of(copied(copies, (1, 3, 5), ELSEWHERE)).outcome
    assert isinstance(outcome, Localization), outcome
    assert_pose_close(outcome.world_from_camera, SCENE.world_from_query, metres=0.02, degrees=0.3)


def test_poses_within_the_bounds_are_one_place() -> None:
    """The second half is posed 5 cm off: bad references, but no second place."""
    nearby = RigidTransform(np.eye(3), np.array([0.05, 0.0, 0.0]))
    outcome = answer_of(copied(SCENE.references, (1, 3, 5), nearby)).outcome
    assert not (isinstance(outcome, Rejection) and outcome.reason is RejectionReason.AMBIGUOUS)


def test_outliers_without_a_common_pose_are_no_second_place(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of the keypoints lie anywhere."""
    search = Mock(wraps=ransac)
    monkeypatch.setattr("mapless_server.method.judge.judge.ransac", search)
    query, random = SCENE.query, random_for("outliers")
    keypoints = query.features.keypoints.copy()
    wrong = random.permutation(len(keypoints))[: len(keypoints) // 2]
    keypoints[wrong] = random.uniform((0, 0), (query.camera.width_px, query.camera.height_px), (len(wrong), 2))
    query = replace(query, features=replace(query.features, keypoints=keypoints))
    outcome = answer_of(SCENE.references, query).outcome
    assert isinstance(outcome, Localization), outcome
    assert_pose_close(outcome.world_from_camera, SCENE.world_from_query, metres=0.02, degrees=0.3)
    search.assert_called_once()


def test_a_photo_that_fits_two_identical_rooms_is_ambiguous() -> None:
    """Photographs of a corner, which stands twice in the world."""
    poses = [corner.pose(-16.0 + 4 * i, height_m=-1.6 + 0.1 * (i % 3)) for i in range(9)]
    extractor = make_extractor("sift")
    views = [extractor.extract(decode_image(corner.photograph(it), ImageLimits()), corner.CAMERA) for it in poses]
    references = [
        PosedView(f"p{i}", f"scenes/corner/references/p{i}", view, pose)
        for i, (view, pose) in enumerate(zip(views, poses, strict=True))
    ]
    query, truth, others = views[4], poses[4], references[:4] + references[5:]
    alone = answer_of(others, query).outcome
    assert isinstance(alone, Localization), alone
    assert_pose_close(alone.world_from_camera, truth, metres=0.02, degrees=0.3)
    rejection = rejected(answer_of(copied(others, range(1, 8, 2), ELSEWHERE), query))
    assert rejection.reason is RejectionReason.AMBIGUOUS, rejection
    here, there = sorted(rejection.hypotheses, key=lambda it: others[0].name not in it.references)
    assert_pose_close(here.world_from_camera, truth, metres=0.03, degrees=0.5)
    assert_pose_close(there.world_from_camera, ELSEWHERE.compose(truth), metres=0.03, degrees=0.5)
