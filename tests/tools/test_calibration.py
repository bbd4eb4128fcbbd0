"""Calibration on planted errors: claims that are wrong by a known factor give that factor, and shares are counted."""

import json
import math
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.special import bdtr, bdtrc, gammainc, gammaincinv
from support.scenes import random_for

from mapless.geometry import RigidTransform, rotation_from_vector
from mapless.scenes import Calibration
from mapless_server.method.bundle.estimate import SELF_TAIL_95, TAIL_95, USUAL_GAP, Accuracy, accuracy_from_covariance
from mapless_server.services.messages.radii import (
    Conditions,
    Factors,
    reported_radii,
    scaled_accuracy,
    scaled_covariance,
)
from mapless_server.store import SceneAttributes, SelfCalibration, calibration_kind
from mapless_tools.calibrate.claims import (
    MIN_QUERIES,
    Claim,
    Sample,
    factor_for,
    fit_factors,
    left_one_out,
)
from mapless_tools.calibrate.findings import RightRule, Share, auroc, find, reliability, risk_coverage
from mapless_tools.calibrate.queries import Outcome, other_world
from mapless_tools.calibrate.report import CalibrationReport, page, to_json, worst
from mapless_tools.dataset import Dataset

SIFT = Conditions("sift", "geometric", "BEST", "1")
KIND = calibration_kind(SIFT.features, SIFT.backend, SIFT.server_version)
SIGMA_M, SIGMA_DEG = 0.02, 0.1


def length(share: Any) -> Any:
    """What a normal vector of three directions, of deviation 1 in each, does not exceed with this probability."""
    return np.sqrt(2 * gammaincinv(1.5, share))


def share_below(at: float) -> float:
    """How probable it is that it does not."""
    return float(gammainc(1.5, at**2 / 2))


def claim(error: float, sigma: float = 1.0) -> Claim:
    """A claim of normal errors with this deviation in each of three directions."""
    covariance = sigma**2 * np.eye(3)
    return Claim.of(error, sigma * length(0.68), sigma * length(0.95), covariance)


def planted(count: int, times: float, case: str) -> Sample:
    """Answers whose errors are `times` as large as they claim."""
    random = random_for("calibration", case, count, times)
    lengths = np.linalg.norm(random.standard_normal((2, count, 3)), axis=2) * times
    return Sample(
        tuple(claim(SIGMA_M * it, SIGMA_M) for it in lengths[0]),
        tuple(claim(SIGMA_DEG * it, SIGMA_DEG) for it in lengths[1]),
    )


class TestClaims:
    def test_radii_are_the_stated_ones_and_interpolate_between(self) -> None:
        it = claim(1.0, 2.0)
        for p in (0.05, 0.5, 0.68, 0.9, 0.95, 0.99):
            just = 2 * length(p)
            assert replace(it, error=0.999 * just).held(p)
            assert not replace(it, error=1.001 * just).held(p)

    def test_stated_radii_stand_above_the_covariance(self) -> None:
        twice = Claim.of(1.0, 2 * length(0.68), 3 * length(0.95), np.eye(3))
        assert twice.probability(np.array([2 * length(0.68), 3 * length(0.95)])) == pytest.approx(
            [0.68, 0.95], abs=1e-3
        )
        assert twice.probability(np.array([0.0, 1e9])).tolist() == [0.0, 1.0]


class TestFactors:
    @pytest.mark.parametrize("times", [0.4, 1.0, 2.5])
    def test_many_answers_give_the_planted_factor(self, times: float) -> None:
        factors = fit_factors(planted(500, times, "many"))
        for factor in (factors.position_68, factors.position_95, factors.rotation_68, factors.rotation_95):
            assert factor == pytest.approx(times, rel=0.08)

    def test_tails_have_a_factor_of_their_own(self) -> None:
        """A fifth of the errors is five times as large: the 95 % radius grows more than that for 68 %."""
        random = random_for("tails")
        lengths = np.linalg.norm(random.standard_normal((500, 3)), axis=1) * np.where(
            random.random(500) < 0.2, 5.0, 1.0
        )
        claims = [claim(it) for it in lengths]
        for p in (0.68, 0.95):
            expected = np.quantile(lengths, p) / length(p)
            assert factor_for(claims, p) == pytest.approx(expected, rel=0.08)
        assert factor_for(claims, 0.95) > 1.5 * factor_for(claims, 0.68) > 1.5

    @pytest.mark.parametrize("times", [1 / 3, 1.0, 3.0])
    @pytest.mark.parametrize("count", [MIN_QUERIES, 26])
    def test_few_answers_still_hold_on_answers_not_seen(self, count: int, times: float) -> None:
        """On average over calibrations, and by the distribution the errors were planted with."""
        held = []
        for trial in range(12):
            claims = planted(count, times, f"few {trial}").position
            held.append([share_below(factor_for(claims, p) * length(p) / times) for p in (0.68, 0.95)])
        share_68, share_95 = np.mean(held, axis=0)
        assert share_95 >= 0.9
        assert (0.5 if count == MIN_QUERIES else 0.6) <= share_68 <= (0.95 if count == MIN_QUERIES else 0.8)

    def test_the_wider_radius_stays_the_wider_one(self) -> None:
        """All errors are the same, so the quantiles are too, and the radii would change places."""
        claims = tuple(claim(3.0) for _ in range(200))
        factors = fit_factors(Sample(claims, claims))
        assert factors.position_68 * length(0.68) <= factors.position_95 * length(0.95) * (1 + 1e-9)

    def test_an_answer_is_not_judged_by_itself(self) -> None:
        """One error is beyond all others: its own claim does not hold, the others' factors do not know of it."""
        sample = planted(20, 1.0, "left out")
        outlier = claim(100 * SIGMA_M, SIGMA_M)
        after = left_one_out(Sample((*sample.position[:-1], outlier), sample.rotation))
        assert not after.position[-1].held(0.99)
        alone = factor_for(sample.position[:-1], 0.95)
        assert after.position[-1].radius_95 == pytest.approx(alone * outlier.radius_95)

    @pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf, 1001.0])
    def test_senseless_ones_are_refused(self, value: float) -> None:
        with pytest.raises(ValueError, match=r"0\.01 to 1000"):
            Factors(position_95=value)


class TestApplying:
    COVARIANCE = (lambda a: a @ a.T)(random_for("covariance").standard_normal((6, 6)) * [[0.1]] * 3 + [[0.01]] * 6)
    FACTORS = Factors(2.0, 3.0, 0.5, 0.75)

    MEASURED = Calibration(2.0, 3.0, 0.5, 0.75, 20, "sift", "geometric", "BEST", server_version="1")

    def own(self, count: int = 30) -> SelfCalibration:
        return SelfCalibration(KIND, 7, count, 2.0, 0.5)

    def test_of_references_hold_at_the_usual_gap(self) -> None:
        before, attributes = Accuracy(1.0, 2.0, 3.0, 4.0), SceneAttributes(self_calibrations=(self.own(),))
        after = reported_radii(before, self.COVARIANCE, SIFT, KIND, attributes, USUAL_GAP)
        assert (after.accuracy.position_68_m, after.accuracy.rotation_68_deg) == (2.0, 1.5)
        assert (after.calibration, after.count) == ("SELF", 30)
        near, far = (reported_radii(before, self.COVARIANCE, SIFT, KIND, attributes, it).accuracy for it in (0.05, 0.2))
        assert near.position_68_m < after.accuracy.position_68_m < far.position_68_m

    def test_many_references_leave_less_to_the_tails(self) -> None:
        before, tails = Accuracy(1.0, 2.0, 3.0, 6.0), []
        for count in (3, 30, 3000):
            attributes = SceneAttributes(self_calibrations=(self.own(count=count),))
            after = reported_radii(before, self.COVARIANCE, SIFT, KIND, attributes, USUAL_GAP).accuracy
            tails.append(after.position_95_m / after.position_68_m)
            assert after.rotation_95_deg / after.rotation_68_deg == pytest.approx(tails[-1])
        assert 2.0 > tails[0] > tails[1] > tails[2] == pytest.approx(2.0 * SELF_TAIL_95 / TAIL_95, rel=1e-2)

    def test_errors_of_references_are_below_no_radius(self) -> None:
        noisy = SceneAttributes(self_calibrations=(replace(self.own(), reference_noise_m=0.01),))
        for radius_m in (1e-4, 1e-2, 1.0):
            before = Accuracy(radius_m, 2 * radius_m, 3.0, 4.0)
            after = reported_radii(before, self.COVARIANCE, SIFT, KIND, noisy, USUAL_GAP).accuracy
            assert after.position_68_m == pytest.approx(math.hypot(2 * radius_m, 0.01), rel=1e-2)

    def test_measured_ones_win_over_those_of_references(self) -> None:
        both = SceneAttributes(calibration=self.MEASURED, self_calibrations=(self.own(),))
        after = reported_radii(Accuracy(1.0, 2.0, 3.0, 4.0), self.COVARIANCE, SIFT, KIND, both, 0.3)
        assert (after.calibration, after.count, after.accuracy) == ("MEASURED", 20, Accuracy(2.0, 6.0, 1.5, 3.0))
        np.testing.assert_array_equal(after.covariance, scaled_covariance(self.COVARIANCE, self.FACTORS))

    def test_the_covariance_has_the_calibrated_68_percent_radii(self) -> None:
        before = accuracy_from_covariance(self.COVARIANCE)
        covariance = scaled_covariance(self.COVARIANCE, self.FACTORS)
        after = accuracy_from_covariance(covariance)
        assert after.position_68_m == pytest.approx(2 * before.position_68_m)
        assert after.rotation_68_deg == pytest.approx(0.5 * before.rotation_68_deg)
        assert np.linalg.eigvalsh(covariance).min() > -1e-12

    @pytest.mark.parametrize("field", ["features", "backend", "variant", "server_version"])
    def test_what_something_else_computed_stays_uncalibrated(self, field: str) -> None:
        before, other = Accuracy(1.0, 2.0, 3.0, 4.0), replace(SIFT, **{field: "other"})
        others = calibration_kind(other.features, other.backend, other.server_version)
        for conditions, kind, calibration, calibrations in (
            (SIFT, KIND, None, ()),
            (SIFT, KIND, None, (self.own(count=0),)),
            (SIFT, calibration_kind("sift", "geometric+depth", "1"), None, (self.own(),)),
            (other, others, self.MEASURED, ()),
            (other, others, None, (self.own(),)),
        ):
            attributes = SceneAttributes(calibration=calibration, self_calibrations=calibrations)
            after = reported_radii(before, self.COVARIANCE, conditions, kind, attributes, 0.1)
            assert after.accuracy == before
            assert after.calibration == "GENERIC"
            np.testing.assert_array_equal(after.covariance, self.COVARIANCE)

    def test_the_wider_radius_is_never_the_smaller_one(self) -> None:
        after = scaled_accuracy(Accuracy(1.0, 1.1, 1.0, 1.1), Factors(3.0, 1.0, 3.0, 1.0))
        assert after == Accuracy(3.0, 3.0, 3.0, 3.0)


class TestShares:
    @pytest.mark.parametrize(("part", "whole"), [(0, 7), (3, 7), (7, 7), (68, 100)])
    def test_the_ends_of_an_interval_are_as_rare_as_stated(self, part: int, whole: int) -> None:
        share = Share.of(part, whole)
        if part:
            assert bdtrc(part - 1, whole, share.low) == pytest.approx(0.025)
        else:
            assert share.low == 0
        if part < whole:
            assert bdtr(part, whole, share.high) == pytest.approx(0.025)
        else:
            assert share.high == 1

    def test_right_claims_lie_on_the_diagonal(self) -> None:
        count = 400
        exact = [claim(float(length((i + 0.5) / count))) for i in range(count)]
        points = reliability(exact)
        assert (points[0][0], points[-1][0]) == (0.05, 0.99)
        np.testing.assert_allclose([share for _, share in points], [p for p, _ in points], atol=0.006)


class TestSelective:
    SCORES = (0.9, 0.8, 0.8, 0.5, 0.2)
    RIGHT = (True, True, False, True, False)

    def test_area_is_the_share_of_pairs_in_order(self) -> None:
        pairs = [
            (a > b) + (a == b) / 2
            for a, r in zip(self.SCORES, self.RIGHT, strict=True)
            for b, s in zip(self.SCORES, self.RIGHT, strict=True)
            if r and not s
        ]
        assert auroc(self.SCORES, self.RIGHT) == pytest.approx(np.mean(pairs))
        assert math.isnan(auroc((0.1, 0.2), (True, True)))

    def test_equal_scores_are_accepted_together(self) -> None:
        points = risk_coverage(self.SCORES, self.RIGHT)
        assert [(it.accepted, it.wrong) for it in points] == [(1, 0), (3, 1), (4, 1), (5, 2)]
        assert [it.coverage for it in points] == pytest.approx([1 / 3, 2 / 3, 1, 1])


def outcome(
    name: str, error: float, *, trust: float | None = None, conditions: Conditions = SIFT, sigma_m: float = SIGMA_M
) -> Outcome:
    """An answer that is off by so many sigmas."""
    pose = RigidTransform(np.eye(3), np.zeros(3))
    return Outcome(
        name=name,
        error_m=error * sigma_m,
        error_deg=error * SIGMA_DEG,
        position=claim(error * sigma_m, sigma_m),
        rotation=claim(error * SIGMA_DEG, SIGMA_DEG),
        trust=trust,
        inlier_count=100,
        match_count=200,
        rejection="",
        message="",
        conditions=conditions,
        true_pose=pose,
        pose=pose,
    )


def rejected(name: str, reason: str) -> Outcome:
    return replace(
        outcome(name, 1.0),
        error_m=math.inf,
        error_deg=math.inf,
        position=None,
        rotation=None,
        pose=None,
        rejection=reason,
        message="few <matches>",
    )


class TestFindings:
    def outcomes(self, count: int = 40) -> list[Outcome]:
        """Twice as far off as claimed; those with little trust more than 10 cm."""
        lengths = (2 * length((np.arange(count) + 0.5) / count)).tolist()
        answers = [outcome(f"a{i}", it, trust=1 - it / 20) for i, it in enumerate(lengths)]
        return [*answers, rejected("r0", "LOW_OVERLAP"), rejected("r1", "LOW_OVERLAP"), rejected("r2", "GATE")]

    def test_counts_factors_and_trust(self) -> None:
        found = find(self.outcomes(), RightRule())
        assert found.factors is not None
        assert found.factors.position_68 == pytest.approx(2.0, rel=0.1)
        assert found.rejections == {"LOW_OVERLAP": 2, "GATE": 1}
        by_row = {(it.claim, it.probability): it for it in found.held}
        first = by_row["position", 0.68]
        assert first.before.part == sum(it <= length(0.68) for it in 2 * length((np.arange(40) + 0.5) / 40))
        assert first.after is not None
        assert first.after.value == pytest.approx(0.68, abs=0.05)
        assert found.right.whole == 40
        assert 0 < found.right.part < 40
        assert found.auroc == 1.0
        assert found.trusted[-1].coverage == 1.0
        assert found.trusted[-1].risk == pytest.approx(1 - found.right.value)

    def test_answers_of_other_features_are_left_out(self) -> None:
        stronger = [outcome(f"s{i}", 50.0, conditions=replace(SIFT, features="aliked")) for i in range(5)]
        found = find([*self.outcomes(), *stronger], RightRule())
        assert (found.conditions, found.others, len(found.sample)) == (SIFT, 5, 40)
        assert "5 answers came from other features (aliked) and are left out" in page(report(found))

    def test_a_folder_without_answers_is_reported(self) -> None:
        found = find([rejected("r0", "GATE")], RightRule())
        assert found.factors is None
        assert "0 answers are too few" in found.refusal
        assert json.loads(json.dumps(to_json(report(found)), allow_nan=False))["factors"] is None
        assert "GATE" in page(report(found))

    def test_the_page_needs_nothing_else(self) -> None:
        html = page(report(find(self.outcomes(), RightRule())))
        assert html.count("<svg") == 5
        assert "few &lt;matches&gt;" in html
        html = re.sub(
            r'xmlns(:xlink)?="http[^"]*"|(?:href=|url\()"?#', "", html
        )  # names, and places in the page itself
        assert re.findall(r"(?:src|href|url)\s*[=(]|<script|@import|https?://", html) == []

    def test_only_what_exceeds_its_claim_is_listed_as_such(self) -> None:
        exceeding = [it.name for it in worst(report(find(self.outcomes(), RightRule())))]
        assert exceeding[0] == "a39"
        assert len(exceeding) == 10
        held = report(find([outcome(f"a{i}", 0.5) for i in range(12)], RightRule()))
        assert worst(held) == []
        assert "No answer is further off" in page(held)

    def test_the_json_has_the_diagram(self) -> None:
        content = json.loads(json.dumps(to_json(report(find(self.outcomes(), RightRule()))), allow_nan=False))
        assert content["factors"]["position_68"] == pytest.approx(2.0, rel=0.1)
        assert len(content["reliability"]["position"]["before"]) == 95
        assert content["per_query"][-1]["rejection"] == {"reason": "GATE", "message": "few <matches>"}


def report(found: object) -> CalibrationReport:
    dataset = Dataset("kitchen", (), True, "survey")
    return CalibrationReport(dataset, "s", 30, 10, RightRule(), "not stored: a dry run", found)  # type: ignore[arg-type]


class TestOtherWorld:
    MOTION = RigidTransform(rotation_from_vector([0.1, 0.5, -0.3]), np.array([3.0, -1.0, 0.5]))

    def answers(self, motion: RigidTransform, noise_m: float = 0.01) -> list[Outcome]:
        random = random_for("worlds")
        answers = []
        for i in range(8):
            true = RigidTransform(rotation_from_vector(random.normal(0, 1, 3)), random.normal(0, 2, 3))
            seen = motion.compose(true).shifted(random.normal(0, noise_m, 3))
            error_m = float(np.linalg.norm(seen.translation - true.translation))
            it = replace(outcome(f"a{i}", 1.0), error_m=error_m, true_pose=true, pose=seen)
            answers.append(replace(it, position=claim(error_m, 0.01)))
        return answers

    def test_has_the_planted_motion(self) -> None:
        found = other_world(self.answers(self.MOTION))
        assert found is not None
        assert found.moved_m == pytest.approx(np.linalg.norm(self.MOTION.translation), abs=0.1)
        assert found.turned_deg == pytest.approx(math.degrees(np.linalg.norm([0.1, 0.5, -0.3])), abs=1e-6)
        assert found.left_m < 0.05

    def test_the_same_world_is_not(self) -> None:
        assert other_world(self.answers(RigidTransform(np.eye(3), np.zeros(3)))) is None

    def test_answers_that_are_wrong_each_in_its_way_are_not(self) -> None:
        assert other_world(self.answers(RigidTransform(np.eye(3), np.zeros(3)), noise_m=1.0)) is None
