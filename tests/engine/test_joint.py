"""Joint poses rest on references that agree with their own poses, as those of single photographs do."""

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import pytest
from support.groups import MATCH, NOTHING, drifting, images_of, looking
from support.scenes import random_for

from mapless_server.engine.failures import SceneMadeAnew
from mapless_server.engine.joint import pose_rig, pose_sequence
from mapless_server.engine.query import Query, Result
from mapless_server.method.bundle.priors import NO_PRIORS
from mapless_server.method.features.views import ReferenceErrors
from mapless_server.method.groups.images import GroupImage
from mapless_server.method.groups.rig import RigEstimate
from mapless_server.method.groups.sequence import SequenceEstimate
from mapless_server.method.options import LocalizeOptions
from mapless_server.method.rejection import Advice, Rejection, RejectionReason
from mapless_server.store import SceneAttributes, SceneState

CAMERAS = looking((-0.5, 0, -4), (0.2, -0.1, -4.2), (0.6, 0.2, -3.9))
CONTRADICTION = "the scene contradicts itself: of 20 pairs of references that show the same, 3 agree"


def joint(
    kind: str,
    images: Sequence[GroupImage],
    contradiction: str = "",
    made: Sequence[tuple[int, bool]] = ((0, False),) * 3,
) -> RigEstimate | SequenceEstimate | Rejection:
    """The joint pose of photographs in a scene of which this is said; when it was made, and whether it has metres."""
    pipeline = SimpleNamespace(
        options=SimpleNamespace(match=lambda *_: MATCH),
        matcher=SimpleNamespace(options=SimpleNamespace(guided_similarity=0.7)),
    )
    narrowing = SimpleNamespace(contradiction=lambda *_: "")
    options = LocalizeOptions(coverage=0.95)
    query = SimpleNamespace(options=options, priors=NO_PRIORS, narrowing=narrowing)
    results = [
        SimpleNamespace(
            answer=it.answer,
            tier=SimpleNamespace(pipeline=pipeline),
            scene=SceneState(1, create_time_us, SceneAttributes),
            attributes=SceneAttributes(contradiction=contradiction, arbitrary_unit=is_arbitrary),
            references=(),
        )
        for it, (create_time_us, is_arbitrary) in zip(images, made, strict=True)
    ]
    given = cast(list[Query], [query] * len(images)), cast(list[Result], results)
    if kind == "rig":
        return pose_rig(*given, CAMERAS)
    return pose_sequence(*given, drifting(random_for("joint"), CAMERAS, 0.005), False)


def with_errors(images: Sequence[GroupImage], error_px: ReferenceErrors | None) -> list[GroupImage]:
    """The photographs, with errors of the pairs of their references."""
    supports = [cast(Any, it.answer.support) for it in images]
    return [
        replace(it, answer=replace(it.answer, support=replace(support, reference_error_px=error_px)))
        for it, support in zip(images, supports, strict=True)
    ]


@pytest.fixture(params=["rig", "sequence"])
def kind(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def images() -> list[GroupImage]:
    return images_of(random_for("joint"), CAMERAS, alone=True, own_noise_m=0.002)


def test_references_that_disagree_carry_no_joint_pose(kind: str, images: list[GroupImage]) -> None:
    assert not isinstance(joint(kind, with_errors(images, lambda i, j: 0.4), ""), Rejection)
    assert not isinstance(joint(kind, with_errors(images, None), ""), Rejection)
    found = joint(kind, with_errors(images, lambda i, j: 40.0), "")
    assert isinstance(found, Rejection)
    assert found.hint is not None
    assert found.hint.advice is Advice.CHECK_REFERENCE_POSES
    assert "0 agree with their own poses" in found.message


def test_joint_poses_in_a_contradicting_scene_need_agreement(kind: str, images: list[GroupImage]) -> None:
    assert not isinstance(joint(kind, with_errors(images, lambda i, j: 0.4), CONTRADICTION), Rejection)
    found = joint(kind, with_errors(images, None), CONTRADICTION)
    assert isinstance(found, Rejection)
    assert found.message.startswith("no two of the references")
    assert found.message.endswith(CONTRADICTION)


def test_every_joint_rejection_says_the_contradiction_once(kind: str) -> None:
    said = Rejection(RejectionReason.LOW_TEXTURE, f"blank; {CONTRADICTION}")
    for outcome in (NOTHING.answer.outcome, said):
        nothing = replace(NOTHING, answer=replace(NOTHING.answer, outcome=outcome))
        found = joint(kind, [nothing] * 3, CONTRADICTION)
        assert isinstance(found, Rejection)
        assert found.hint is not None
        assert found.hint.advice is Advice.CHECK_REFERENCE_POSES
        assert found.message.count(CONTRADICTION) == 1


@pytest.mark.parametrize("last", [(8, False), (7, True)], ids=["made anew", "another unit"])
def test_photographs_of_two_scenes_have_no_joint_pose(
    kind: str, images: list[GroupImage], last: tuple[int, bool]
) -> None:
    agreeing = with_errors(images, lambda i, j: 0.4)
    assert not isinstance(joint(kind, agreeing, made=[(7, False)] * 3), Rejection)
    with pytest.raises(SceneMadeAnew):
        joint(kind, agreeing, made=[(7, False), (7, False), last])
