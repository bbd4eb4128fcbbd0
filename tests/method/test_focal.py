"""The focal length estimated from a photograph: wrong ones are detected, right ones are never reported."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from support.planted import true_structure
from support.scenes import SceneOptions, SyntheticScene, make_scene, random_for

from mapless_server.method.pnp import PnpOptions, solve_pose
from mapless_server.method.rejection import Advice, RejectionReason
from mapless_server.method.results import PoseEstimate, Support
from mapless_server.method.trust.focal import Focal, FocalOptions, wrong_focal
from mapless_server.method.trust.judge import JudgeOptions, judge

OPTIONS = FocalOptions()
FACTORS = (0.6, 0.85, 0.93, 1.07, 1.15, 1.7)


def solved(scene: SyntheticScene, factor: float) -> Support:
    """A planted photograph, solved with a focal length that is so many times the true one."""
    given = scene.query.camera
    camera = replace(given, focal_x_px=given.focal_x_px * factor, focal_y_px=given.focal_y_px * factor)
    query = replace(scene.query, camera=camera)
    structure, matches = true_structure(scene)
    estimate = solve_pose(query, structure, matches, scene.world_from_query, PnpOptions())
    assert isinstance(estimate, PoseEstimate)
    return Support(query, scene.references, structure, matches, estimate, np.zeros(3))


def planted(case: object, **options: object) -> SyntheticScene:
    return make_scene(random_for("focal", case), replace(SceneOptions(outlier_share=0.2), **options))  # type: ignore[arg-type]


@pytest.mark.parametrize("factor", FACTORS)
def test_a_wrong_focal_length_is_detected_and_estimated(factor: float) -> None:
    """With every fifth match wrong, within the standard deviation that the estimate states."""
    scene = planted(factor)
    found = wrong_focal(solved(scene, factor), OPTIONS)
    assert found is not None
    true_px = scene.query.camera.focal_x_px
    assert found.given_px == pytest.approx(factor * true_px)
    assert abs(np.log(found.estimated_px / true_px)) < 4 * found.sigma
    assert found.sigma < 0.02
    assert found.agreeing > found.agreeing_before


@pytest.mark.parametrize(("least", "decides"), [(0.25, True), (0.9, False)])
def test_the_first_step_decides_only_where_enough_matches_agree(least: float, decides: bool) -> None:
    """About half of them do; the bound on the step is one that every step is below."""
    support = solved(planted("first step", outlier_share=0.7, point_count=600), 1.15)
    found = wrong_focal(support, replace(OPTIONS, first_share=100.0, first_agreeing=least))
    assert (found is None) is decides


def test_the_true_focal_length_is_never_reported() -> None:
    for case in range(16):
        few = {"point_count": 60, "noise_px": 1.5} if case % 2 else {}
        assert wrong_focal(solved(planted(case, **few), 1.0), OPTIONS) is None


def test_points_in_a_frontal_plane_do_not_determine_it() -> None:
    """A nearer camera with a wider lens has the same image."""
    for factor in (0.85, 1.15):
        scene = planted(
            factor, box_m=(4.0, 2.4, 0.0), query_offset_m=(0.0, 0.0, 0.0), reference_count=2, outlier_share=0.0
        )
        found = wrong_focal(solved(scene, factor), OPTIONS)
        assert found is None


def test_few_matches_do_not_determine_it() -> None:
    scene = planted("few", point_count=18, outlier_share=0.0)
    assert wrong_focal(solved(scene, 1.15), OPTIONS) is None


def test_the_judge_rejects_with_both_numbers_and_a_hint() -> None:
    support = solved(planted("judge"), 1.15)
    matches = [np.empty((0, 2), np.int32)] * len(support.references)
    rejection = judge(support, matches, 1.0, JudgeOptions()).rejection
    assert rejection is not None
    assert rejection.reason is RejectionReason.GATE
    found = re.search(r"give ([0-9.]+) times the focal length", rejection.message)
    assert found is not None
    assert float(found[1]) == pytest.approx(1 / 1.15, rel=0.01)
    assert rejection.focal_ratio == pytest.approx(1 / 1.15, rel=0.01)
    assert rejection.hint is not None
    assert rejection.hint.advice is Advice.CHECK_CALIBRATION
    assert rejection.hint.best_reference in {reference.name for reference in support.references}


def test_it_is_wrong_only_beyond_tolerance_and_error() -> None:
    wrong = Focal(0.2, 0.01, agreeing=100, agreeing_before=40, given_px=500.0, reference_count=5.0)
    assert wrong.is_wrong(OPTIONS)
    assert not replace(wrong, log_ratio=OPTIONS.max_log_ratio * 0.9).is_wrong(OPTIONS)
    assert not replace(wrong, sigma=0.06).is_wrong(OPTIONS)
    assert not replace(wrong, agreeing=30).is_wrong(OPTIONS)
    assert not replace(wrong, reference_count=2.0).is_wrong(OPTIONS)  # two references may err together


def test_a_support_without_a_pose_is_refused() -> None:
    with pytest.raises(ValueError, match="estimate"):
        wrong_focal(replace(solved(planted("none"), 1.0), estimate=None), OPTIONS)


@pytest.mark.parametrize("wrong", [{"max_log_ratio": 0.0}, {"loss_scales_sigma": ()}, {"grid": 0}])
def test_options_outside_their_bounds_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="must be"):
        FocalOptions(**wrong)  # type: ignore[arg-type]
