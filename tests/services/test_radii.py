"""Reported radii: those of the method times the factors of a scene's calibration."""

import math
from dataclasses import replace

import numpy as np
import pytest
from support.scenes import random_for

from mapless.geometry import RigidTransform
from mapless.scenes import Calibration
from mapless_server.method.bundle.estimate import (
    USUAL_GAP,
    Accuracy,
    PoseEstimate,
    PoseStage,
    accuracy_from_covariance,
    with_information,
)
from mapless_server.services.messages.radii import (
    Conditions,
    Factors,
    calibration_of,
    reported_radii,
    scaled_accuracy,
    scaled_covariance,
)
from mapless_server.store import SceneAttributes, SelfCalibration, calibration_kind

SIFT = Conditions("sift", "geometric", "BEST", "1")
KIND = calibration_kind(SIFT.features, SIFT.backend, SIFT.server_version)
COVARIANCE = (lambda a: a @ a.T)(random_for("covariance").standard_normal((6, 6)) * [[0.1]] * 3 + [[0.01]] * 6)
FACTORS = Factors(2.0, 3.0, 0.5, 0.75)

MEASURED = Calibration(2.0, 3.0, 0.5, 0.75, 20, "sift", "geometric", "BEST", server_version="1")


def own(count: int = 30) -> SelfCalibration:
    return SelfCalibration(KIND, 7, count, 2.0, 0.5)


def test_of_references_hold_at_the_usual_gap() -> None:
    before, attributes = Accuracy(1.0, 2.0, 3.0, 4.0), SceneAttributes(self_calibrations=(own(),))
    after = reported_radii(before, COVARIANCE, SIFT, KIND, attributes, USUAL_GAP)
    assert (after.accuracy.position_68_m, after.accuracy.rotation_68_deg) == (2.0, 1.5)
    assert (after.calibration, after.count) == ("SELF", 30)
    near, far = (reported_radii(before, COVARIANCE, SIFT, KIND, attributes, it).accuracy for it in (0.05, 0.2))
    assert near.position_68_m < after.accuracy.position_68_m < far.position_68_m


def test_tails_of_references_widen_what_holds_for_more() -> None:
    attributes = SceneAttributes(self_calibrations=(replace(own(), position_tail=0.9, rotation_tail=1.2),))
    after = reported_radii(Accuracy(1.0, 2.0, 3.0, 6.0), COVARIANCE, SIFT, KIND, attributes, USUAL_GAP).accuracy
    assert after.position_95_m / after.position_68_m == pytest.approx(0.9 * 2.0)
    assert after.rotation_95_deg / after.rotation_68_deg == pytest.approx(1.2 * 2.0)


def test_errors_of_references_are_below_no_radius() -> None:
    noisy = SceneAttributes(self_calibrations=(replace(own(), reference_noise_m=0.01),))
    for radius_m in (1e-4, 1e-2, 1.0):
        before = Accuracy(radius_m, 2 * radius_m, 3.0, 4.0)
        after = reported_radii(before, COVARIANCE, SIFT, KIND, noisy, USUAL_GAP).accuracy
        assert after.position_68_m == pytest.approx(math.hypot(2 * radius_m, 0.01), rel=1e-2)


@pytest.mark.parametrize("share", [0.3, 2.0])
def test_what_adopted_references_are_off_is_not_scaled(share: float) -> None:
    attributes, theirs = SceneAttributes(self_calibrations=(own(),)), share * COVARIANCE
    before = accuracy_from_covariance(COVARIANCE)
    found = reported_radii(before, COVARIANCE, SIFT, KIND, attributes, USUAL_GAP, theirs)
    kept = min(share, 1.0)
    scale = np.repeat([2.0, 0.5], 3)
    scaled = scale[:, None] * COVARIANCE * scale
    np.testing.assert_allclose(found.covariance, (1 - kept) * scaled + kept * COVARIANCE, atol=1e-9)
    expected_m = math.sqrt(4 * (1 - kept) + kept) * before.position_68_m
    assert found.accuracy.position_68_m == pytest.approx(expected_m, rel=1e-3)


def test_a_prior_does_not_scale_what_adopted_ones_are_off() -> None:
    """The prior is along z alone: along x and y references are as far off as before."""
    everything, theirs = np.diag([1e-4] * 3 + [1e-6] * 3), np.diag([9e-5] * 3 + [0.0] * 3)
    alone = PoseEstimate(
        RigidTransform.identity(),
        PoseStage.REFINED,
        np.ones(9, bool),
        np.ones(9),
        everything,
        reference_covariance=theirs,
    )
    informed = with_information(alone, np.diag([0.0, 0.0, 1e8, 0.0, 0.0, 0.0]))
    attributes = SceneAttributes(calibration=replace(MEASURED, position_factor_68=0.1, position_factor_95=0.1))
    before, theirs_after = accuracy_from_covariance(informed.covariance), informed.reference_covariance
    found = reported_radii(before, informed.covariance, SIFT, KIND, attributes, USUAL_GAP, theirs_after)
    np.testing.assert_allclose(np.diag(found.covariance)[:2], 0.01 * 1e-5 + 9e-5)
    assert found.covariance[2, 2] < 1e-8
    least_m = accuracy_from_covariance(np.diag([9e-5, 9e-5, 0.0, 0.0, 0.0, 0.0])).position_68_m
    assert found.accuracy.position_68_m == pytest.approx(least_m, rel=2e-3)


def test_measured_ones_win_over_those_of_references() -> None:
    both = SceneAttributes(calibration=MEASURED, self_calibrations=(own(),))
    after = reported_radii(Accuracy(1.0, 2.0, 3.0, 4.0), COVARIANCE, SIFT, KIND, both, 0.3)
    assert (after.calibration, after.count, after.accuracy) == ("MEASURED", 20, Accuracy(2.0, 6.0, 1.5, 3.0))
    np.testing.assert_array_equal(after.covariance, scaled_covariance(COVARIANCE, FACTORS))


def test_the_covariance_has_the_calibrated_68_percent_radii() -> None:
    before = accuracy_from_covariance(COVARIANCE)
    covariance = scaled_covariance(COVARIANCE, FACTORS)
    after = accuracy_from_covariance(covariance)
    assert after.position_68_m == pytest.approx(2 * before.position_68_m)
    assert after.rotation_68_deg == pytest.approx(0.5 * before.rotation_68_deg)
    assert np.linalg.eigvalsh(covariance).min() > -1e-12


@pytest.mark.parametrize("field", ["features", "backend", "variant", "server_version"])
def test_what_something_else_computed_stays_uncalibrated(field: str) -> None:
    before, other = Accuracy(1.0, 2.0, 3.0, 4.0), replace(SIFT, **{field: "other"})
    others = calibration_kind(other.features, other.backend, other.server_version)
    for conditions, kind, calibration, calibrations in (
        (SIFT, KIND, None, ()),
        (SIFT, KIND, None, (own(count=0),)),
        (SIFT, calibration_kind("sift", "geometric+depth", "1"), None, (own(),)),
        (other, others, MEASURED, ()),
        (other, others, None, (own(),)),
    ):
        attributes = SceneAttributes(calibration=calibration, self_calibrations=calibrations)
        after = reported_radii(before, COVARIANCE, conditions, kind, attributes, 0.1)
        assert after.accuracy == before
        assert after.calibration == "GENERIC"
        np.testing.assert_array_equal(after.covariance, COVARIANCE)


def test_the_wider_radius_is_never_the_smaller_one() -> None:
    after = scaled_accuracy(Accuracy(1.0, 1.1, 1.0, 1.1), Factors(3.0, 1.0, 3.0, 1.0))
    assert after == Accuracy(3.0, 3.0, 3.0, 3.0)


@pytest.mark.parametrize("gap", [0.02, USUAL_GAP, 0.4])
def test_measured_by_the_same_model_they_are_those_of_references(gap: float) -> None:
    found = replace(own(), reference_noise_m=0.5, reference_noise_deg=0.25)
    by_references = SceneAttributes(self_calibrations=(found,))
    measured = SceneAttributes(calibration=calibration_of(found, SIFT))
    before = Accuracy(1.0, 2.0, 3.0, 4.0)
    expected = reported_radii(before, COVARIANCE, SIFT, KIND, by_references, gap)
    after = reported_radii(before, COVARIANCE, SIFT, KIND, measured, gap)
    assert (after.accuracy, after.count) == (expected.accuracy, expected.count)
    assert (after.calibration, expected.calibration) == ("MEASURED", "SELF")


def test_factors_that_grow_need_a_gap_others_do_not() -> None:
    before = Accuracy(1.0, 2.0, 3.0, 4.0)
    for calibration, source in ((MEASURED, "MEASURED"), (calibration_of(own(), SIFT), "GENERIC")):
        attributes = SceneAttributes(calibration=calibration)
        assert reported_radii(before, COVARIANCE, SIFT, KIND, attributes, None).calibration == source


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf, 1001.0])
def test_senseless_factors_are_refused(value: float) -> None:
    with pytest.raises(ValueError, match=r"0\.01 to 1000"):
        Factors(position_95=value)
