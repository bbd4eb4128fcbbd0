"""The order of attempts, by the doubts that are left."""

import pytest

from mapless_server.method import ladder
from mapless_server.method.judge.hypothesis import Attempt, Doubt, Raster, Solver, Where
from mapless_server.method.ladder import RUNGS, Situation, first_attempt, further
from mapless_server.method.pairs.pair import Matching

ALL = Situation(
    may_be_elsewhere=True,
    has_place=True,
    can_match_strongly=(False, True),
    upright_only=True,
)


def climbed(doubts: Doubt, situation: Situation) -> list[str]:
    """The rungs that are tried if every attempt leaves these doubts."""
    _, attempt = first_attempt(situation)
    tried, names = [attempt], list[str]()
    while following := next(further(attempt, None, tried, doubts, situation), None):
        rung, attempt = following
        tried.append(attempt)
        names.append(rung.name)
        assert len(names) < 100
    return names


@pytest.mark.parametrize(
    ("doubts", "situation", "expected"),
    [
        (Doubt.NONE, ALL, []),
        (Doubt.CAMERA | Doubt.STARVED, ALL, []),
        (Doubt.REFERENCES, Situation(), []),
        (Doubt.STARVED, Situation(), ["wide", "lines"]),
        (Doubt.CHANCE, Situation(), ["wide"]),
        (Doubt.FEW_INLIERS, Situation(can_match_strongly=(False, False)), ["wide"]),
        (Doubt.WIDE_RADIUS, Situation(can_match_strongly=(False, False)), ["stronger"]),
        (Doubt.LOW_TRUST, Situation(can_match_strongly=(False, True)), ["stronger", "rematched"]),
        (Doubt.STARVED, Situation(reference_count=1), []),
        (Doubt.STARVED, Situation(is_best=False), []),
        (Doubt.TWO_PLACES, Situation(has_place=True), ["one place"]),
        (Doubt.LIKE_ELSEWHERE, Situation(may_be_elsewhere=True), ["elsewhere"]),
        (
            Doubt.STARVED,
            Situation(can_match_strongly=(False, True), upright_only=True),
            ["wide", "lines", "turned", "wide", "lines", "stronger", "rematched", "wide", "lines"],
        ),
    ],
)
def test_what_follows_a_doubt(doubts: Doubt, situation: Situation, expected: list[str]) -> None:
    assert climbed(doubts, situation) == expected


@pytest.mark.parametrize("doubts", [Doubt.STARVED, Doubt.CHANCE, Doubt.TWO_PLACES, ~Doubt.CAMERA])
def test_the_ladder_ends(doubts: Doubt) -> None:
    assert len(climbed(doubts, ALL)) < 50


def test_no_attempt_is_made_twice() -> None:
    attempt = Attempt(1, matching=Matching.STRONG_WIDE, solver=Solver.LINES)
    tried = [attempt, Attempt(1)]
    for _, following in further(attempt, None, tried, ~Doubt.CAMERA, ALL):
        assert following not in tried


def test_stronger_features_keep_the_turn_of_the_best_pose() -> None:
    turned = Attempt(raster=Raster.TURNED, angle_deg=90.0)
    situation = Situation(can_match_strongly=(False, False))
    for best, expected in ((turned, turned), (None, Attempt())):
        (_, attempt) = next(it for it in further(turned, best, [turned], Doubt.LOW_TRUST, situation))
        assert (attempt.features, attempt.raster, attempt.angle_deg) == (1, expected.raster, expected.angle_deg)


def test_tracking_comes_first_where_a_prior_says_what_is_near() -> None:
    name, attempt = first_attempt(Situation(can_be_tracked=True))
    assert (name, attempt.where) == (ladder.TRACKED, Where.NEAR_PRIOR)
    assert first_attempt(Situation()) == (ladder.AS_IT_IS, Attempt())


def test_each_rung_has_a_name_a_doubt_and_words() -> None:
    assert len({it.name for it in RUNGS}) == len(RUNGS)
    assert all(it.doubts and it.changes and it.needs and it.cost and it.untried for it in RUNGS)
