"""One rule decides in which of several scenes a photograph was taken, on planted poses scored by their inliers."""

from collections.abc import Sequence

import numpy as np
import pytest

from mapless.geometry import RigidTransform
from mapless_server.method.bundle.estimate import PoseStage
from mapless_server.method.bundle.priors import NO_PRIORS, PositionPrior, Priors
from mapless_server.method.judge.answer import Answer, Localization
from mapless_server.method.judge.decide import PLACES, decide
from mapless_server.method.judge.hypothesis import Attempt, Doubt, Found, found_by
from mapless_server.method.judge.worlds import World, decide_among
from mapless_server.method.options import DoubtOptions
from mapless_server.method.rejection import PoseHypothesis, Rejection, RejectionReason

INLIERS = 100
CLEARLY_MORE = int(INLIERS * PLACES.clearly_more) + 1
ON_EARTH = RigidTransform(np.eye(3), np.zeros(3))


def pose(x_m: float) -> RigidTransform:
    return RigidTransform(np.eye(3), np.array([x_m, 0.0, 0.0]))


def accepted(x_m: float = 0.0, inliers: int = INLIERS) -> Answer:
    covariance = np.diag([1e-4] * 3 + [1e-6] * 3)
    return Answer(Localization(pose(x_m), covariance, PoseStage.REFINED, inliers, 2 * inliers, 0.7, (), 0.5))


def rejected(reason: RejectionReason = RejectionReason.TOO_FEW_MATCHES, places: int = 0) -> Answer:
    hypotheses = tuple(PoseHypothesis(pose(float(i)), 10, ()) for i in range(places))
    return Answer(Rejection(reason, "planted", hypotheses=hypotheses))


def world(
    rank: int, answers: Sequence[Answer], priors: Priors = NO_PRIORS, ecef_from_world: RigidTransform | None = None
) -> World:
    found: list[Found] = [found_by(Attempt(scene=rank), it, DoubtOptions()) for it in answers]
    return World(f"key-{rank}", f"name-{rank}", found, decide(found, priors), priors, ecef_from_world)


@pytest.mark.parametrize("first", [0, 1])
def test_the_scene_with_clearly_more_is_answered(first: int) -> None:
    worlds = [world(0, [accepted()]), world(1, [accepted(5.0, CLEARLY_MORE)])]
    verdict = decide_among([worlds[first], worlds[1 - first]])
    assert verdict.outcome is worlds[1].verdict.outcome
    assert not verdict.doubts & Doubt.TWO_PLACES


def test_two_scenes_that_fit_are_ambiguous() -> None:
    verdict = decide_among([world(0, [accepted()]), world(1, [accepted(5.0, CLEARLY_MORE - 2)])])
    assert isinstance(verdict.outcome, Rejection)
    assert verdict.outcome.reason is RejectionReason.AMBIGUOUS
    assert [it.world for it in verdict.outcome.hypotheses] == ["key-1", "key-0"]
    assert all(f"'name-{rank}'" in verdict.outcome.message for rank in (0, 1))
    assert verdict.doubts is Doubt.TWO_PLACES


@pytest.mark.parametrize("apart_m", [0.0, 1.0])
def test_poses_that_agree_on_the_earth_are_one_place(apart_m: float) -> None:
    better = world(1, [accepted(5.0, INLIERS + 1)], ecef_from_world=pose(apart_m - 5.0))
    verdict = decide_among([world(0, [accepted()], ecef_from_world=ON_EARTH), better])
    assert (verdict.outcome is better.verdict.outcome) is (apart_m == 0)


def test_a_prior_in_one_world_decides_between_two() -> None:
    prior = Priors(position=PositionPrior(np.zeros(3), 0.01 * np.eye(3)))
    worlds = [world(0, [accepted()], prior), world(1, [accepted(5.0)], prior)]
    assert decide_among(worlds).outcome is worlds[0].verdict.outcome


def test_an_accepted_pose_comes_before_a_rejection() -> None:
    worlds = [world(0, [rejected()]), world(1, [accepted()])]
    assert decide_among(worlds).outcome is worlds[1].verdict.outcome


def test_of_two_rejections_the_first_or_the_one_of_two_places_is_given() -> None:
    plain, second, two = (rejected(), rejected(), rejected(RejectionReason.AMBIGUOUS, places=2))
    assert decide_among([world(0, [plain]), world(1, [second])]).chosen.attempt.scene == 0
    verdict = decide_among([world(0, [plain]), world(1, [two])])
    assert isinstance(verdict.outcome, Rejection)
    assert [it.world for it in verdict.outcome.hypotheses] == ["key-1", "key-1"]
