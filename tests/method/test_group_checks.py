"""A rig with a wrong mounting and a session that is not metric are rejected; right ones are accepted."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from mapless.geometry import RigidTransform
from mapless_server.method.answer import Answer, Localization
from mapless_server.method.groups.checks import check_mounting, check_unit
from mapless_server.method.groups.rig import RigEstimate
from mapless_server.method.groups.sequence import SequenceEstimate
from mapless_server.method.rejection import Advice, Rejection, RejectionReason
from mapless_server.method.results import PoseStage

HERE = RigidTransform.identity()


def alone(inliers: int) -> Answer:
    return Answer(Localization(HERE, None, PoseStage.REFINED, inliers, 2 * inliers, 1.0))


def rig(*kept: int) -> RigEstimate:
    matched = [SimpleNamespace(source=SimpleNamespace(image=i), inliers=np.ones(n)) for i, n in enumerate(kept)]
    return RigEstimate(HERE, np.eye(6), cast(Any, tuple(matched)), np.zeros(3))


def walk(step_m: float, sigma_m: float = 0.01) -> SequenceEstimate:
    poses = tuple(RigidTransform(np.eye(3), np.array([i * step_m, 0, 0])) for i in range(5))
    covariances = np.tile(sigma_m**2 * np.eye(6), (5, 1, 1))
    return SequenceEstimate(cast(Any, None), 0.0, poses, covariances, (), np.zeros(3))


def test_photographs_that_lose_their_inliers_reject_the_rig() -> None:
    found = check_mounting(rig(1, 0, 688), [alone(681), alone(438), alone(690)])
    assert isinstance(found, Rejection)
    assert found.reason is RejectionReason.GATE
    assert "1 of 681 in images[0], 0 of 438 in images[1]" in found.message
    assert found.hint is not None
    assert found.hint.advice is Advice.CHECK_CALIBRATION


@pytest.mark.parametrize("lost", [alone(29), Answer(Rejection(RejectionReason.GATE, "chance"))])
def test_photographs_with_few_inliers_alone_reject_nothing(lost: Answer) -> None:
    estimate = rig(600, 3)
    assert check_mounting(estimate, [alone(640), lost]) is estimate


@pytest.mark.parametrize("unit_m", [0.01, 0.5, 2.0])
def test_a_walk_of_another_length_is_rejected_with_its_unit(unit_m: float) -> None:
    found = check_unit(walk(0.5), walk(0.5 / unit_m).world_from_camera)
    assert isinstance(found, Rejection)
    assert found.reason is RejectionReason.SCALE_UNRELIABLE
    assert f"its unit is {unit_m:.2f} m" in found.message


@pytest.mark.parametrize(("drift", "sigma_m"), [(1.0, 0.001), (1.1, 0.001), (0.85, 0.001), (2.0, 0.3)])
def test_drift_and_uncertain_lengths_are_accepted(drift: float, sigma_m: float) -> None:
    estimate = walk(0.5, sigma_m)
    assert check_unit(estimate, walk(0.5 * drift).world_from_camera) is estimate
