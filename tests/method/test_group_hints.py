"""The hint of each rejection of a rig or a sequence: advice, message and best reference."""

from dataclasses import replace

import numpy as np
import pytest
from support.groups import NOTHING
from support.scenes import make_scene, random_for

from mapless.geometry import RigidTransform, Similarity
from mapless_server.method.answer import Answer, Localization
from mapless_server.method.groups.checks import hinted_group
from mapless_server.method.groups.images import rejection_without_matches
from mapless_server.method.rejection import Advice, Hint, Rejection, RejectionReason
from mapless_server.method.results import MetricScale, PoseStage, ScaleStage

SCENE = make_scene(random_for("group hints"))
NAMES = [reference.name for reference in SCENE.references]


def hint_of(reason: RejectionReason, *matches: tuple[int, ...]) -> Hint:
    """Of a group whose photographs share so many features with the references."""
    images = [
        (Answer(Rejection(reason, "alone"), reference_match_counts=counts), SCENE.references) for counts in matches
    ]
    outcome = hinted_group(Rejection(reason, "planted"), images)
    assert (outcome.reason, outcome.message) == (reason, "planted")
    assert isinstance(outcome.hint, Hint)
    return outcome.hint


@pytest.mark.parametrize("reason", RejectionReason)
@pytest.mark.parametrize("matches", [(), (0, 0), (20, 5), (60, 50), (400, 9)])
def test_every_reason_has_a_hint_of_one_sentence(reason: RejectionReason, matches: tuple[int, ...]) -> None:
    hint = hint_of(reason, matches, ())
    assert hint.stage == "join"
    assert hint.message[0].isupper()
    assert hint.message.endswith(".")


def test_the_best_reference_shares_most_with_any_photograph() -> None:
    assert hint_of(RejectionReason.GATE, (40, 60, 50), (31, 33, 70), ()).best_reference == NAMES[2]
    assert hint_of(RejectionReason.GATE, (0, 0), ()).best_reference is None


@pytest.mark.parametrize(
    ("reason", "best", "advice"),
    [
        (RejectionReason.TOO_FEW_MATCHES, 8, Advice.CHOOSE_OTHER_REFERENCES),
        (RejectionReason.TOO_FEW_MATCHES, 50, Advice.LOOK_AT_REFERENCE),
        (RejectionReason.PNP_FAILED, 400, Advice.CHECK_CALIBRATION),
        (RejectionReason.GATE, 50, Advice.LOOK_AT_REFERENCE),
        (RejectionReason.SCALE_UNRELIABLE, 400, Advice.RETAKE_PHOTOGRAPH),
    ],
)
def test_the_advice_follows_from_the_shared_features(reason: RejectionReason, best: int, advice: Advice) -> None:
    hint = hint_of(reason, (best, 3))
    assert hint.advice is advice
    if reason is not RejectionReason.SCALE_UNRELIABLE:
        assert str(best) in hint.message


def test_depths_of_a_network_do_not_pose_a_group() -> None:
    pose = RigidTransform.identity()
    scale = MetricScale(1.0, ScaleStage.NETWORK, 0.0, 0, Similarity(1.0, np.eye(3), np.zeros(3)), pose)
    answer = Answer(Localization(pose, np.eye(6), PoseStage.REFINED, 50, 60, 0.7), scale)
    outcome = rejection_without_matches([replace(NOTHING, answer=answer)])
    assert outcome.reason is RejectionReason.TOO_FEW_MATCHES
    assert "with a single reference" in outcome.message


def test_without_matches_the_hint_is_the_furthest_photographs() -> None:
    own = Hint("coarse", Advice.SPREAD_REFERENCES, "Spread them.", NAMES[0])
    furthest = Rejection(RejectionReason.LOW_OVERLAP, "another place", own)
    images = [NOTHING, replace(NOTHING, answer=Answer(furthest))]
    outcome = hinted_group(rejection_without_matches(images), [])
    assert (outcome.reason, outcome.hint) == (RejectionReason.LOW_OVERLAP, own)
