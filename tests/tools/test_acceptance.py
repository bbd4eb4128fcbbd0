"""The acceptance tables count what was planted: right and wrong poses, accepted and not, of their own place or none."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
from support.scenes import SceneOptions, make_scene, random_for

from mapless_server.method.answer import Localization, LocalizeOptions
from mapless_server.method.rejection import Rejection
from mapless_tools.calibrate.acceptance import Verdict, cross_table, metric_table, own_verdict, threshold_of
from mapless_tools.calibrate.pairs import Measured, Pair, answered, pose_of

RIGHT, WRONG = (0.09, 4.9), (0.11, 0.1)


def measured(off: tuple[float, float] | None, score: float, k: int = 10) -> Measured:
    """An answer whose verdict is the score itself; it is accepted from 0.5 on."""
    pair = Pair("place", k, cast(Any, None), (), None)
    answer: Any = SimpleNamespace(verdict=Verdict(score >= 0.5, score), outcome="planted")
    return Measured(pair, answer, off)


def as_planted(answer: Any) -> Verdict:
    return cast(Verdict, answer.verdict)


PLANTED = [
    measured(RIGHT, 0.9),
    measured(RIGHT, 0.8),
    measured(RIGHT, 0.1),
    measured((0.01, 5.1), 0.7),
    measured(WRONG, 0.2),
    measured(None, -1.0),
]


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_a_row_counts_right_and_wrong_poses() -> None:
    head, _, row, total = metric_table(PLANTED, as_planted, 0.6)
    assert len(cells(head)) == len(cells(row)) == 10
    assert cells(row) == [
        "place", "10", "6", "5", "3", "2 (66.7 %)", "3", "1 (33.3 %)", "0.667", "0 (0.0 %)"
    ]  # fmt: skip
    assert cells(total)[2:] == cells(row)[2:]


def test_the_threshold_keeps_the_share_that_is_asked_for() -> None:
    assert threshold_of(PLANTED, as_planted, 0.6) == 0.8
    assert threshold_of(PLANTED, as_planted, 1.0) == 0.1
    assert threshold_of(PLANTED[3:], as_planted) is None


def test_any_answer_from_references_of_another_place_is_wrong() -> None:
    elsewhere = [measured((np.inf, np.inf), 0.3), measured(None, -1.0)]
    lines = cross_table(elsewhere, as_planted, 0.2)
    assert lines[0] == "2 pairs of a query and references of another scene: 0 accepted"
    assert lines[1] == "1 have a pose; their highest score is 0.3"
    assert lines[2].startswith("1 reach 0.2")
    accepted = cross_table([measured((np.inf, np.inf), 0.6)], lambda _: Verdict(True, 0.6))
    assert accepted[0].endswith("1 accepted")
    assert accepted[-1].startswith("accepted: place: ")


def test_the_methods_own_verdict_is_its_answer_and_its_trust() -> None:
    """The same photograph answered and, with next to no coverage, rejected: the pose and its trust are the same."""
    scene = make_scene(random_for("acceptance"), SceneOptions(point_count=250, reference_count=4, distractor_count=20))
    pair = Pair("planted", 4, scene.query, scene.references, scene.world_from_query)
    (answer,) = answered([pair])
    (strict,) = answered([pair], LocalizeOptions(coverage=1e-9))
    assert isinstance(answer.answer.outcome, Localization)
    assert isinstance(strict.answer.outcome, Rejection)
    assert (answer.right, strict.right) == (True, True)
    given, refused = own_verdict(answer.answer), own_verdict(strict.answer)
    assert (given.accepted, refused.accepted) == (True, False)
    assert given.score == answer.answer.outcome.trust
    found = pose_of(strict.answer)
    assert found is not None
    np.testing.assert_allclose(found.matrix(), answer.answer.outcome.world_from_camera.matrix(), atol=0.02)
    assert abs(refused.score - given.score) < 0.2
