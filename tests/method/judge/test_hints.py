"""The hint of each rejection: stage, advice, message and best reference."""

from dataclasses import replace

import numpy as np
import pytest
from support.scenes import make_scene, random_for

from mapless.geometry import RigidTransform
from mapless_server.method.bundle.estimate import PoseStage
from mapless_server.method.features.views import PosedView, View
from mapless_server.method.judge.answer import Answer, Localization
from mapless_server.method.judge.hints import hinted
from mapless_server.method.rejection import Advice, Hint, PoseHypothesis, Rejection, RejectionReason

SCENE = make_scene(random_for("hints"))
NAMES = [reference.name for reference in SCENE.references]
ENOUGH = (40, 60, 50, 45, 33, 31)
"""Matches with the references: more than chance, the second the most."""


def view_of(count: int) -> View:
    """The photograph with so many features."""
    f = SCENE.query.features
    rows = np.resize(np.arange(len(f)), count)
    features = replace(f, keypoints=f.keypoints[rows], descriptors=f.descriptors[rows], sizes_px=f.sizes_px[rows])
    return replace(SCENE.query, features=features)


def hint_of(
    reason: RejectionReason,
    matches: tuple[int, ...] = ENOUGH,
    features: int = 900,
    references: tuple[PosedView, ...] = SCENE.references,
    has_prior: bool = False,
) -> Hint:
    answer = Answer(Rejection(reason, "planted"), reference_match_counts=matches[: len(references)])
    outcome = hinted(answer, view_of(features), references, has_prior).outcome
    assert isinstance(outcome, Rejection)
    assert (outcome.reason, outcome.message) == (reason, "planted")
    assert isinstance(outcome.hint, Hint)
    return outcome.hint


@pytest.mark.parametrize("reason", RejectionReason)
def test_every_reason_has_a_hint_of_one_sentence(reason: RejectionReason) -> None:
    for references in (SCENE.references, SCENE.references[:1], ()):
        hint = hint_of(reason, references=references)
        assert hint.message.endswith(".")
        assert hint.message[0].isupper()
        assert (hint.stage == "") == (not references or reason is RejectionReason.LOW_TEXTURE)


@pytest.mark.parametrize(
    ("reason", "matches", "features", "advice"),
    [
        (RejectionReason.LOW_TEXTURE, ENOUGH, 5, Advice.RETAKE_PHOTOGRAPH),
        (RejectionReason.DEGENERATE_REFERENCES, ENOUGH, 900, Advice.SPREAD_REFERENCES),
        (RejectionReason.NO_USABLE_REFERENCES, ENOUGH, 900, Advice.SPREAD_REFERENCES),
        (RejectionReason.SCALE_UNRELIABLE, ENOUGH, 900, Advice.SPREAD_REFERENCES),
        (RejectionReason.LOW_OVERLAP, ENOUGH, 900, Advice.LOOK_AT_REFERENCE),
        (RejectionReason.LOW_OVERLAP, (3, 9, 4, 0, 0, 1), 900, Advice.CHOOSE_OTHER_REFERENCES),
        (RejectionReason.LOW_OVERLAP, (3, 9, 4, 0, 0, 1), 120, Advice.RETAKE_PHOTOGRAPH),
        (RejectionReason.LOW_OVERLAP, (300,) * 6, 900, Advice.ADD_REFERENCES),
        (RejectionReason.PNP_FAILED, (300,) * 6, 900, Advice.ADD_REFERENCES),
        (RejectionReason.TOO_FEW_MATCHES, (3, 9, 4, 0, 0, 1), 900, Advice.CHOOSE_OTHER_REFERENCES),
        (RejectionReason.GATE, ENOUGH, 900, Advice.LOOK_AT_REFERENCE),
        (RejectionReason.AMBIGUOUS, ENOUGH, 900, Advice.TELL_PLACES_APART),
        (RejectionReason.PRIOR_CONFLICT, ENOUGH, 900, Advice.CHECK_PRIOR),
    ],
)
def test_the_advice_follows_from_the_numbers(
    reason: RejectionReason, matches: tuple[int, ...], features: int, advice: Advice
) -> None:
    assert hint_of(reason, matches, features).advice is advice


def test_two_scenes_are_told_apart_by_naming_one() -> None:
    hypotheses = tuple(PoseHypothesis(RigidTransform.identity(), 50, (), world=it) for it in ("church", "office"))
    answer = Answer(
        Rejection(RejectionReason.AMBIGUOUS, "planted", hypotheses=hypotheses), reference_match_counts=ENOUGH
    )
    outcome = hinted(answer, view_of(900), SCENE.references).outcome
    assert isinstance(outcome, Rejection)
    assert isinstance(outcome.hint, Hint)
    assert outcome.hint.message.startswith("Name the scene, narrow the group, ")
    assert "prior on the pose" in hint_of(RejectionReason.AMBIGUOUS).message


def test_the_best_reference_is_the_one_with_counted_matches() -> None:
    assert hint_of(RejectionReason.LOW_OVERLAP).best_reference == NAMES[1]
    assert hint_of(RejectionReason.LOW_OVERLAP, (0,) * 6).best_reference is None
    rejection = Rejection(RejectionReason.GATE, "planted")
    answer = Answer(rejection, reference_match_counts=ENOUGH, reference_inlier_counts=(0, 1, 0, 7, 0, 0))
    outcome = hinted(answer, view_of(900), SCENE.references).outcome
    assert isinstance(outcome, Rejection)
    assert outcome.hint is not None
    assert outcome.hint.best_reference == NAMES[1]
    assert "shares 60 of" in outcome.hint.message


def test_matches_with_one_reference_only_ask_for_another() -> None:
    """Its very photograph shares all features with it, and hardly any has a point."""
    alone, others = Rejection(RejectionReason.LOW_OVERLAP, "planted", tried=27), (0, 1267, 8, 0, 2, 0)
    outcome = hinted(Answer(alone, reference_match_counts=others), view_of(1267), SCENE.references).outcome
    assert isinstance(outcome, Rejection)
    assert outcome.hint is not None
    assert outcome.hint.advice is Advice.ADD_REFERENCES
    assert outcome.hint.best_reference == NAMES[1]
    assert NAMES[1] in outcome.hint.message


@pytest.mark.parametrize(
    ("matches", "tried", "advice"),
    [
        ((800, 955, 700, 0, 0, 0), 2, Advice.CHECK_CALIBRATION),
        ((800, 955, 700, 0, 0, 0), 100, Advice.ADD_REFERENCES),
        ((0, 955, 90, 0, 0, 0), 2, Advice.ADD_REFERENCES),
    ],
)
def test_poses_are_doubted_where_two_references_share_much(
    matches: tuple[int, ...], tried: int, advice: Advice
) -> None:
    rejection = Rejection(RejectionReason.LOW_OVERLAP, "planted", tried=tried)
    outcome = hinted(Answer(rejection, reference_match_counts=matches), view_of(2048), SCENE.references).outcome
    assert isinstance(outcome, Rejection)
    assert outcome.hint is not None
    assert outcome.hint.advice is advice


def test_a_prior_that_leaves_no_reference_is_to_be_checked() -> None:
    reason = RejectionReason.NO_USABLE_REFERENCES
    assert hint_of(reason, references=(), has_prior=True).advice is Advice.CHECK_PRIOR
    assert hint_of(reason, references=()).advice is Advice.ADD_REFERENCES
    assert hint_of(reason, references=SCENE.references[:1]).advice is Advice.ADD_REFERENCES


def test_poses_and_existing_hints_are_not_changed() -> None:
    localized = Answer(Localization(RigidTransform.identity(), np.eye(6), PoseStage.REFINED, 50, 60, 1.0))
    assert hinted(localized, view_of(900), SCENE.references) is localized
    own = Answer(Rejection(RejectionReason.GATE, "planted", Hint("pnp", Advice.CHECK_PRIOR, "Own.")))
    assert hinted(own, view_of(900), SCENE.references) is own
