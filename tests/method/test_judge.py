"""Trust is the share of right answers that look at most as good, and coverage the share of them that passes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.planted import true_structure
from support.scenes import SceneOptions, make_scene, random_for

from mapless_server.method.pnp import PnpOptions, solve_pose
from mapless_server.method.rejection import Rejection, RejectionReason
from mapless_server.method.results import PoseEstimate, Support
from mapless_server.method.trust.judge import (
    FEATURES,
    LEVELS,
    Evidence,
    JudgeOptions,
    evidence_of,
    judge,
    score_of,
    trust_of,
)

OPTIONS = JudgeOptions()
INLIER_PX = PnpOptions().inlier_px
GOOD = Evidence(
    log10_false_alarms=-900.0,
    inlier_count=300,
    match_count=330,
    findable_count=600,
    hull_share=0.6,
    reference_count=4.0,
    error_sigma=1.0,
    position_95_m=0.02,
)
POOR = Evidence(-11.0, 11, 31, 70, 0.05, 1.6, 1.5, 0.4)
"""Such a pose was 89 cm off."""


def support_of(outlier_share: float = 0.0, seen_share: float = 0.9) -> Support:
    """A planted photograph, solved."""
    options = SceneOptions(point_count=300, outlier_share=outlier_share, seen_share=seen_share)
    scene = make_scene(random_for("judge", outlier_share, seen_share), options)
    structure, matches = true_structure(scene)
    estimate = solve_pose(scene.query, structure, matches, scene.world_from_query, PnpOptions())
    assert isinstance(estimate, PoseEstimate)
    return Support(scene.query, scene.references, structure, matches, estimate, np.zeros(3))


def verdict(support: Support, coverage: float, options: JudgeOptions = OPTIONS) -> tuple[float, Rejection | None]:
    judged = judge(support, [np.empty((0, 2), np.int32)] * len(support.references), INLIER_PX, coverage, options)
    return judged.trust, judged.rejection


def test_trust_is_high_with_good_support_and_low_without() -> None:
    assert trust_of(GOOD, OPTIONS) > 0.3
    assert trust_of(POOR, OPTIONS) < 0.01


@pytest.mark.parametrize(
    "better",
    [
        replace(GOOD, log10_false_alarms=-2000.0),
        replace(GOOD, match_count=305),
        replace(GOOD, findable_count=320),
        replace(GOOD, hull_share=0.9),
        replace(GOOD, reference_count=8.0),
        replace(GOOD, position_95_m=0.01),
    ],
)
def test_more_evidence_never_lowers_the_trust(better: Evidence) -> None:
    assert score_of(better, OPTIONS) >= score_of(GOOD, OPTIONS)
    assert score_of(replace(better, error_sigma=2.0), OPTIONS) <= score_of(better, OPTIONS)


@given(features=st.lists(st.floats(-10, 10), min_size=7, max_size=7), which=st.integers(0, 6), more=st.floats(0, 5))
def test_the_score_is_monotone_in_every_number(features: list[float], which: int, more: float) -> None:
    weights = np.array(OPTIONS.weights)
    raised = np.array(features)
    raised[which] += more
    assert raised @ weights >= np.array(features) @ weights - 1e-9
    assert len(FEATURES) == len(weights)


@given(share=st.floats(0, 1))
def test_trust_is_the_quantile_among_right_answers(share: float) -> None:
    """Scores drawn as those of right answers have a trust that is uniform: the share of them below t is t."""
    drawn = np.interp(np.random.default_rng(3).random(4000), LEVELS, OPTIONS.scores)
    trusts = np.interp(drawn, OPTIONS.scores, LEVELS)
    assert abs((trusts <= share).mean() - share) < 0.03


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


def test_worse_matches_and_fewer_points_lower_the_trust() -> None:
    clean, noisy, sparse = (verdict(s, 1.0)[0] for s in (support_of(), support_of(0.5), support_of(0.0, 0.3)))
    assert clean > noisy
    assert clean > sparse


def test_agreement_with_priors_lowers_the_false_alarms() -> None:
    """A prior that a pose found by chance would meet once in ten thousand."""
    support = support_of(0.0, 0.3)
    before, after = evidence_of(support, INLIER_PX), evidence_of(support, INLIER_PX, -4.0)
    assert after.log10_false_alarms == pytest.approx(before.log10_false_alarms - 4)
    assert trust_of(after, OPTIONS) >= trust_of(before, OPTIONS)


def test_evidence_has_the_planted_counts() -> None:
    support = support_of(0.25)
    evidence = evidence_of(support, INLIER_PX)
    assert support.estimate is not None
    assert evidence.inlier_count == support.estimate.inliers.sum()
    assert evidence.match_count == len(support.matches)
    assert evidence.inlier_share == pytest.approx(evidence.inlier_count / evidence.match_count)
    assert 0 < evidence.found_share <= 1
    assert 4.0 < evidence.reference_count <= 6.0  # all six see about as much of it
    assert np.isfinite(evidence.features()).all()


def test_degenerate_evidence_has_finite_features() -> None:
    """No result of a solver may give a score of NaN, which no comparison rejects."""
    worst = Evidence(np.inf, 4, 5000, 0, 0.0, 1.0, 1e6, 10.0)
    assert np.isfinite(worst.features()).all()
    assert trust_of(worst, OPTIONS) == 0.0


@pytest.mark.parametrize(
    "wrong",
    [
        {"weights": (1.0,)},
        {"weights": (-1.0,) * len(FEATURES)},
        {"scores": (1.0, 0.0) * (len(LEVELS) // 2)},
        {"scores": (0.0,)},
    ],
)
def test_options_outside_their_bounds_are_refused(wrong: dict[str, tuple[float, ...]]) -> None:
    with pytest.raises(ValueError, match="must be"):
        JudgeOptions(**wrong)  # type: ignore[arg-type]


def test_agreement_with_gravity_only_adds_to_the_trust() -> None:
    """As much as its chance is small, and less than if nothing but chance made poses wrong."""
    doubtful = Evidence(-60.0, 40, 60, 200, 0.2, 2.0, 1.0, 0.1)
    trusts = [trust_of(doubtful, OPTIONS, log10_chance) for log10_chance in (0.0, -1.0, -3.0)]
    assert trusts[0] == trust_of(doubtful, OPTIONS)
    assert trusts[0] < trusts[1] < trusts[2]
    all_of_it = replace(OPTIONS, agreement_weight=1.0)
    assert trust_of(doubtful, all_of_it, -3.0) > trusts[2]
    with pytest.raises(ValueError, match="must be"):
        replace(OPTIONS, agreement_weight=-0.1)
