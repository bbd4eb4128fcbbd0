"""One rule decides which of several hypotheses is answered, on planted poses and on planted matches."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapless.geometry import RigidTransform, rotation_from_vector
from mapless_server.method.bundle.estimate import (
    PoseEstimate,
    PoseStage,
    Support,
    accuracy_from_covariance,
    error_radii,
)
from mapless_server.method.bundle.priors import PositionPrior, Priors
from mapless_server.method.features.tracks import Tracks
from mapless_server.method.judge import decide as module
from mapless_server.method.judge.answer import Answer, Localization
from mapless_server.method.judge.decide import PLACES, at_one_place, decide
from mapless_server.method.judge.hypothesis import (
    Attempt,
    Doubt,
    Failed,
    Found,
    Hypothesis,
    Raster,
    Solver,
    Where,
    doubts_of,
    found_by,
)
from mapless_server.method.options import DoubtOptions
from mapless_server.method.pairs.pair import Matching
from mapless_server.method.rejection import (
    Advice,
    IntrinsicsCheck,
    IntrinsicsParameter,
    PoseHypothesis,
    Rejection,
    RejectionReason,
)
from mapless_server.method.structure.model import PointMatches, Structure
from mapless_server.method.structure.observations import KeypointNoise

FIRST, STRONGER = Attempt(), Attempt(features=1)
OPTIONS = DoubtOptions()
NONE = Priors()
AT_ORIGIN = Priors(position=PositionPrior(np.zeros(3), 0.05**2 * np.eye(3)))
DISTANCE_M = 10.0


def pose(x_m: float, turn_deg: float = 0.0) -> RigidTransform:
    return RigidTransform(rotation_from_vector([0.0, np.radians(turn_deg), 0.0]), np.array([x_m, 0.0, 0.0]))


def accepted(
    x_m: float = 0.0, inliers: int = 100, sigma_m: float = 0.01, trust: float = 0.5, turn_deg: float = 0.0
) -> Answer:
    covariance = np.diag([sigma_m**2] * 3 + [np.radians(0.1) ** 2] * 3)
    return Answer(
        Localization(pose(x_m, turn_deg), covariance, PoseStage.REFINED, inliers, 2 * inliers, 0.7, (), trust)
    )


def rejected(reason: RejectionReason = RejectionReason.TOO_FEW_MATCHES, **changes: Any) -> Answer:
    return Answer(Rejection(reason, "planted", **changes))


def posed(answer: Answer, x_m: float, inliers: int = 100, sigma_m: float = 0.01) -> Answer:
    """With the pose that was found, whether accepted or not, of points 10 m ahead; no matches with references."""
    points, none = np.tile([x_m, 0.0, DISTANCE_M], (inliers, 1)), np.empty(0, np.intp)
    matches = PointMatches(np.arange(inliers), np.arange(inliers), np.zeros(inliers, bool), 20.0)
    estimate = PoseEstimate(
        pose(x_m), PoseStage.REFINED, np.ones(inliers, bool), np.zeros(inliers), sigma_m**2 * np.eye(6)
    )
    structure = Structure(points, Tracks(none, none, none), KeypointNoise(1.0, 0.0))
    unused: Any = None
    return replace(answer, support=Support(unused, (), structure, matches, np.zeros(3)).posed(estimate))


def found(answer: Answer, attempt: Attempt = FIRST) -> Found:
    return found_by(attempt, answer, OPTIONS)


def hypothesis(answer: Answer, attempt: Attempt = FIRST) -> Hypothesis:
    made = found(answer, attempt)
    assert isinstance(made, Hypothesis)
    return made


@pytest.fixture(autouse=True)
def _inliers_are_the_scores(monkeypatch: pytest.MonkeyPatch) -> None:
    """The planted poses have no matches with references, by which they would be scored."""
    monkeypatch.setattr(module, "matches_of", lambda _: [])


class TestDoubt:
    @pytest.mark.parametrize("reason", RejectionReason)
    def test_a_rejection_leaves_one_doubt(self, reason: RejectionReason) -> None:
        special = {"DEGENERATE_REFERENCES": Doubt.REFERENCES, "GATE": Doubt.CHANCE, "AMBIGUOUS": Doubt.TWO_PLACES}
        special["PRIOR_CONFLICT"] = Doubt.BEYOND_LIMITS
        assert doubts_of(rejected(reason), OPTIONS) is special.get(reason.name, Doubt.STARVED)

    def test_wrong_intrinsics_leave_nothing_to_try(self) -> None:
        check = IntrinsicsCheck(IntrinsicsParameter.FOCAL_LENGTH, 525.0, 541.0, 2.0, 1.6, conflict=True, used=True)
        assert doubts_of(rejected(RejectionReason.GATE, intrinsics_checks=(check,)), OPTIONS) is Doubt.CAMERA

    @given(trust=st.floats(0, 1), sigma_m=st.floats(1e-4, 1.0), inliers=st.integers(1, 200))
    def test_low_trust_wide_radius_or_few_inliers(self, trust: float, sigma_m: float, inliers: int) -> None:
        radius_m = float(error_radii(np.eye(3) * sigma_m**2, [0.68])[0])
        doubts = doubts_of(accepted(0.0, inliers, sigma_m, trust), OPTIONS)
        assert (Doubt.LOW_TRUST in doubts) is (trust < OPTIONS.trust)
        assert (Doubt.WIDE_RADIUS in doubts) is (radius_m > OPTIONS.radius_m)
        assert (Doubt.FEW_INLIERS in doubts) is (inliers < OPTIONS.inliers)

    def test_an_unchecked_pose_leaves_no_doubt(self) -> None:
        coarse = Localization(RigidTransform.identity(), None, PoseStage.INITIAL, 0, 0, 0.0)
        assert doubts_of(Answer(coarse), OPTIONS) is Doubt.NONE
        assert isinstance(found(Answer(coarse)), Hypothesis)


class TestOnePlace:
    @given(apart_m=st.floats(0, 3), sigma_m=st.floats(1e-3, 0.5), share=st.booleans())
    def test_within_radii_share_of_distance_or_the_least(self, apart_m: float, sigma_m: float, share: bool) -> None:
        made = [accepted(0.0, sigma_m=sigma_m), accepted(apart_m)]
        if share:
            made = [posed(made[0], 0.0, sigma_m=sigma_m), posed(made[1], apart_m)]
        radii = [accuracy_from_covariance(it * np.eye(6)).position_95_m for it in (sigma_m**2, 1e-4)]
        reach_m = max(PLACES.same_position_m, sum(radii), PLACES.same_share * DISTANCE_M if share else 0.0)
        if abs(apart_m - reach_m) > 1e-6:
            first, second = map(hypothesis, made)
            assert at_one_place(first, second) is at_one_place(second, first) is (apart_m < reach_m)

    def test_halves_that_disagree_join_no_places(self) -> None:
        """The answers claim 0.5 m, the jackknife 1 cm."""
        first, second = (hypothesis(posed(accepted(x_m, sigma_m=0.5), x_m)) for x_m in (0.0, 1.0))
        assert not at_one_place(first, second)
        first, second = (hypothesis(accepted(x_m, sigma_m=0.5)) for x_m in (0.0, 1.0))
        assert at_one_place(first, second)

    @pytest.mark.parametrize(("turn_deg", "is_same"), [(1.9, True), (3.0, False)])
    def test_poses_that_look_elsewhere_are_two_places(self, turn_deg: float, is_same: bool) -> None:
        assert at_one_place(hypothesis(accepted()), hypothesis(accepted(turn_deg=turn_deg))) is is_same


class TestDecide:
    @pytest.mark.parametrize("order", [1, -1])
    def test_an_accepted_pose_is_better_than_none(self, order: int) -> None:
        both = [found(rejected()), found(accepted(), STRONGER)][::order]
        assert isinstance(decide(both, NONE).outcome, Localization)

    def test_within_a_place_the_best_accepted_pose_is_answered(self) -> None:
        poses = [(0.0, 60), (0.01, 90), (0.02, 70)]
        few, many, third = (found(accepted(x_m, inliers), Attempt(i)) for i, (x_m, inliers) in enumerate(poses))
        refused = found(posed(rejected(RejectionReason.GATE), 0.03, 300), Attempt(3))
        assert decide([few, many, third, refused], NONE).chosen is many

    def test_doubts_are_those_that_no_pose_of_the_place_removes(self) -> None:
        both = [found(accepted(trust=0.1, inliers=50)), found(accepted(inliers=60), STRONGER)]
        assert decide(both, NONE).doubts is Doubt.FEW_INLIERS

    @pytest.mark.parametrize(("inliers", "is_answered"), [(44, False), (45, True), (300, True)])
    @pytest.mark.parametrize("far", [{"x_m": 3.0}, {"turn_deg": 20.0}], ids=["far", "turned"])
    def test_of_two_places_the_clearly_better_is_answered(
        self, far: dict[str, float], inliers: int, is_answered: bool
    ) -> None:
        assert PLACES.clearly_more == 1.5
        verdict = decide([found(accepted(inliers=30)), found(accepted(inliers=inliers, **far), STRONGER)], NONE)
        if is_answered:
            assert verdict.chosen.attempt is STRONGER
            return
        assert isinstance(verdict.outcome, Rejection)
        assert (verdict.outcome.reason, verdict.doubts) == (RejectionReason.AMBIGUOUS, Doubt.TWO_PLACES)
        assert [it.inlier_count for it in verdict.outcome.hypotheses] == sorted((30, inliers), reverse=True)

    @pytest.mark.parametrize("reason", [RejectionReason.GATE, RejectionReason.AMBIGUOUS])
    @pytest.mark.parametrize(("x_m", "is_answered"), [(0.4, True), (0.6, False)])
    def test_a_rejected_pose_elsewhere_is_evidence(
        self, reason: RejectionReason, x_m: float, is_answered: bool
    ) -> None:
        weak, strong = found(posed(rejected(reason), 0.0, 90)), found(posed(accepted(x_m), x_m), STRONGER)
        assert isinstance(decide([weak, strong], NONE).outcome, Localization) is is_answered

    def test_a_pose_beyond_hard_limits_is_no_evidence(self) -> None:
        beyond = found(posed(rejected(RejectionReason.PRIOR_CONFLICT), 0.0, 300))
        verdict = decide([beyond, found(posed(accepted(3.0), 3.0), STRONGER)], NONE)
        assert isinstance(verdict.outcome, Localization)

    def test_without_a_pose_the_strongest_features_first_word_counts(self) -> None:
        reasons = RejectionReason.LOW_TEXTURE, RejectionReason.LOW_OVERLAP, RejectionReason.PNP_FAILED
        attempts = FIRST, STRONGER, STRONGER.but(solver=Solver.LINES)
        made = [found(rejected(reason), attempt) for reason, attempt in zip(reasons, attempts, strict=True)]
        verdict = decide(made, NONE)
        assert isinstance(verdict.outcome, Rejection)
        assert verdict.outcome.reason is RejectionReason.LOW_OVERLAP
        assert verdict.doubts is Doubt.STARVED

    def test_a_mirrored_photograph_has_no_pose(self) -> None:
        mirrored = Failed(FIRST.but(raster=Raster.TURNED), rejected(RejectionReason.GATE), Doubt.CAMERA)
        verdict = decide([found(accepted(trust=0.1)), mirrored], NONE)
        assert (verdict.chosen, verdict.doubts) == (mirrored, Doubt.CAMERA)


def imprecise(x_m: float = 0.0, inliers: int = 100) -> Answer:
    """The answer with a pose that its radius alone speaks against."""
    given = PoseHypothesis(pose(x_m), inliers, ("near",), np.eye(6))
    return posed(rejected(RejectionReason.GATE, imprecise=given), x_m, inliers)


class TestImprecise:
    def test_such_a_rejection_is_preferred_to_those_without_a_pose(self) -> None:
        outcome = decide([found(imprecise()), found(rejected(), STRONGER)], NONE).outcome
        assert isinstance(outcome, Rejection)
        assert outcome.reason is RejectionReason.GATE
        assert outcome.imprecise is not None

    def test_of_one_place_the_best_pose_is_offered(self) -> None:
        worse, better = found(imprecise(0.0, 60)), found(imprecise(0.01, 90), FIRST.but(matching=Matching.WIDE))
        assert decide([worse, better], NONE).chosen is better

    @pytest.mark.parametrize(("inliers", "is_offered"), [(60, True), (70, False)])
    def test_another_place_that_could_be_it_forbids_it(self, inliers: int, is_offered: bool) -> None:
        other = found(posed(rejected(RejectionReason.GATE), 5.0, inliers), FIRST.but(matching=Matching.WIDE))
        outcome = decide([found(imprecise()), other], NONE).outcome
        assert isinstance(outcome, Rejection)
        assert (outcome.imprecise is not None) is is_offered

    @pytest.mark.parametrize(("x_m", "is_offered"), [(0.0, True), (30.0, False)])
    def test_a_prior_that_it_contradicts_forbids_it(self, x_m: float, is_offered: bool) -> None:
        outcome = decide([found(imprecise(x_m))], AT_ORIGIN).outcome
        assert isinstance(outcome, Rejection)
        assert (outcome.imprecise is not None) is is_offered

    def test_a_named_cause_is_said_instead(self) -> None:
        check = IntrinsicsCheck(IntrinsicsParameter.FOCAL_LENGTH, 525.0, 541.0, 2.0, 1.6, conflict=True, used=True)
        wrong = found(posed(rejected(RejectionReason.GATE, intrinsics_checks=(check,)), 0.0), STRONGER)
        outcome = decide([found(imprecise()), wrong], NONE).outcome
        assert isinstance(outcome, Rejection)
        assert outcome.intrinsics_checks
        assert outcome.imprecise is None


class TestPriors:
    def test_they_decide_between_places_that_scores_do_not(self) -> None:
        both = [found(accepted(30.0, 149)), found(accepted(0.0, 100), STRONGER)]
        assert decide(both, AT_ORIGIN).chosen is both[1]

    def test_the_place_they_exclude_is_ambiguous_at_best(self) -> None:
        near, elsewhere = found(accepted(0.0, 100)), found(accepted(30.0, 300), FIRST.but(where=Where.ANYWHERE))
        outcome = decide([near, elsewhere], AT_ORIGIN).outcome
        assert isinstance(outcome, Rejection)
        assert outcome.reason is RejectionReason.AMBIGUOUS
        assert outcome.hint is not None
        assert outcome.hint.advice is Advice.CHECK_PRIOR
        assert [it.inlier_count for it in outcome.hypotheses] == [300, 100]

    def test_a_place_they_exclude_is_answered_if_no_other_fits(self) -> None:
        assert isinstance(decide([found(accepted(30.0))], AT_ORIGIN).outcome, Localization)

    @pytest.mark.parametrize(("inliers", "decides"), [(101, True), (100, False)])
    def test_they_choose_one_of_an_attempts_two_places(self, inliers: int, decides: bool) -> None:
        places = PoseHypothesis(pose(6.0), 150, ("there",)), PoseHypothesis(pose(0.0), inliers, ("here",))
        ambiguous = found(posed(rejected(RejectionReason.AMBIGUOUS, hypotheses=places), 6.0, 150))
        verdict = decide([ambiguous], AT_ORIGIN)
        assert isinstance(verdict.outcome, Rejection)
        assert verdict.place is (places[1] if decides else None)
        if not decides:
            assert verdict.outcome.hint is not None
            assert "the other place" in verdict.outcome.hint.message

    def test_an_ambiguous_answer_keeps_its_hypotheses(self) -> None:
        places = PoseHypothesis(pose(6.0), 150, ("there",)), PoseHypothesis(pose(0.0), 120, ("here",))
        ambiguous = found(posed(rejected(RejectionReason.AMBIGUOUS, hypotheses=places), 6.0, 150))
        failed = found(posed(rejected(RejectionReason.GATE), 0.0, 20), FIRST.but(where=Where.ONE_PLACE))
        wide = found(rejected(), FIRST.but(matching=Matching.WIDE))
        outcome = decide([ambiguous, failed, wide], NONE).outcome
        assert isinstance(outcome, Rejection)
        assert outcome.hypotheses == places
