"""The order of attempts, by the doubts that are left."""

from dataclasses import replace

import pytest

from mapless_server.method.judge.hypothesis import (
    AS_IT_IS,
    TRACKED,
    Attempt,
    Doubt,
    Raster,
    Solver,
    Where,
    first_attempt,
)
from mapless_server.method.ladder import RUNGS, Situation, further
from mapless_server.method.pairs.pair import Matching
from mapless_server.method.promise import Known

ALL = Situation(
    may_be_elsewhere=True,
    has_place=True,
    can_match_strongly=(False, False, True),
    any_roll=1,
    angles_deg=(90.0,),
)


def climbed(doubts: Doubt, situation: Situation) -> list[str]:
    """The rungs that are tried if every attempt leaves these doubts."""
    attempt = Attempt()
    tried, names = [attempt], list[str]()
    while following := next(further(attempt, tried, doubts, situation), None):
        rung, made = following
        tried.append(made)
        names.append(rung.name)
        attempt = attempt if made.raster is Raster.MIRRORED else made  # it has a result only if it ends the ladder
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
        (Doubt.OTHER_SCENE, Situation(other_scene=1), ["other scene"]),
        (Doubt.CAMERA | Doubt.STARVED, replace(ALL, other_scene=1), ["other scene"]),
        (
            Doubt.STARVED,
            Situation(can_match_strongly=(False, False, True), any_roll=1),
            ["wide", "lines", "any roll", *("mirrored", "wide"), "stronger", *("rematched", "wide", "lines")],
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
    for _, following in further(attempt, tried, ~Doubt.CAMERA, ALL):
        assert following not in tried


@pytest.mark.parametrize("before", [Attempt(), Attempt(1)])
def test_upright_features_are_found_turned_as_the_roll_is_known(before: Attempt) -> None:
    situation = Situation(can_match_strongly=(False, False, False), any_roll=1, angles_deg=(30.0, 210.0))
    tried = [before, Attempt(raster=Raster.TURNED, angles_deg=(30.0, 210.0))]
    changed = {rung.name: it for rung, it in further(before, [before], Doubt.STARVED, situation)}
    assert changed["turned"] == tried[1]
    assert changed["stronger"] == replace(tried[1], features=2, angles_deg=(30.0,))
    assert before.features == 1 or changed["any roll"] == Attempt(1)


def test_stronger_features_are_not_turned_where_most_matches_are_upright() -> None:
    situation = Situation(can_match_strongly=(False, False), angles_deg=(0.0, 90.0))
    changed = {rung.name: it for rung, it in further(Attempt(), [Attempt()], Doubt.STARVED, situation)}
    assert changed["turned"].angles_deg == (0.0, 90.0)
    assert changed["stronger"] == Attempt(1)


@pytest.mark.parametrize("any_roll", [None, 0])
def test_first_features_are_worth_the_same_at_any_roll(any_roll: int | None) -> None:
    situation = Situation(any_roll=any_roll, known=Known(agreement=2.5))
    names = {rung.name for rung, _ in further(Attempt(), [Attempt()], Doubt.STARVED, situation)}
    assert {"wide", "lines"} <= names


def test_tracking_comes_first_where_a_prior_says_what_is_near() -> None:
    name, attempt = first_attempt(True)
    assert (name, attempt.where) == (TRACKED, Where.NEAR_PRIOR)
    assert first_attempt(False) == (AS_IT_IS, Attempt())


def test_each_rung_has_a_name_a_doubt_and_words() -> None:
    assert len({it.name for it in RUNGS}) == len(RUNGS)
    assert all(it.doubts and it.changes and it.needs and it.cost and it.untried for it in RUNGS)
