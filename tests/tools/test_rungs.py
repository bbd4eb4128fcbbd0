"""The worth of each kind of attempt, on planted answers with known errors."""

import math
from io import StringIO

import pytest
from rich.console import Console
from support.evaluations import evaluation, query_result

from mapless import Attempt
from mapless_tools.evaluate.metrics import EarlierAnswer, QueryResult
from mapless_tools.evaluate.report import print_report, to_json
from mapless_tools.evaluate.rungs import Rung, largest_error, rungs_of, wrong_count

RIGHT, WRONG, LOST = 0.01, 1.0, math.inf


def answered(error: float, *attempts: str, earlier: tuple[tuple[str, float], ...] = ()) -> QueryResult:
    """An answer off by so many metres, with attempts "rung outcome"; the chosen one begins with a star.

    Earlier answers have a rung and an error each.
    """
    tried = []
    for attempt in attempts:
        rung, outcome = attempt.removeprefix("*").split()
        tried.append(Attempt(rung, "sift", outcome, 0.5, 0.25, chosen=attempt.startswith("*")))
    before = tuple(EarlierAnswer(rung, error, 0.1) for rung, error in earlier)
    return query_result("q", error, 0.1, (30, 40), "planted", attempts=tuple(tried), earlier=before)


@pytest.mark.parametrize(
    ("error", "attempts", "expected"),
    [
        (RIGHT, ["*plain localized"], {"plain": (1, 1, 1, 0)}),
        (RIGHT, ["plain few", "*wide localized"], {"plain": (1, 0, 0, 0), "wide": (1, 1, 1, 0)}),
        (RIGHT, ["plain localized", "*wide localized"], {"plain": (1, 0, 0, 0), "wide": (1, 1, 0, 0)}),
        (RIGHT, ["*plain localized", "wide localized"], {"plain": (1, 1, 1, 0), "wide": (1, 0, 0, 0)}),
        (WRONG, ["plain few", "*wide localized"], {"plain": (1, 0, 0, 0), "wide": (1, 1, 0, 1)}),
        (WRONG, ["plain localized", "*wide localized"], {"plain": (1, 0, 0, 0), "wide": (1, 1, 0, 1)}),
        (LOST, ["*plain few", "wide failed"], {"plain": (1, 1, 0, 0), "wide": (1, 0, 0, 0)}),
        (RIGHT, ["wide few", "wide unfinished", "*last localized"], {"wide": (1, 0, 0, 0), "last": (1, 1, 1, 0)}),
        (RIGHT, [], {}),
    ],
)
def test_a_rung_has_what_its_attempts_gave(
    error: float, attempts: list[str], expected: dict[str, tuple[int, int, int, int]]
) -> None:
    """On how many it was tried, how many it answered, rescued, and made wrong."""
    rungs = rungs_of([answered(error, *attempts)], largest_error(True, 3.0))
    assert {it.rung: (it.tried, it.answered, it.rescued, it.wrong) for it in rungs} == expected


@pytest.mark.parametrize(
    ("earlier", "rung"),
    [
        ((), "wide"),
        ((("plain", RIGHT),), "wide"),
        ((("plain", WRONG),), "plain"),
        ((("plain", WRONG), ("lines", RIGHT)), "wide"),
        ((("plain", RIGHT), ("lines", WRONG)), "lines"),
    ],
)
def test_the_rung_that_made_an_answer_wrong_counts(earlier: tuple[tuple[str, float], ...], rung: str) -> None:
    """Not one that only found another wrong pose."""
    tried = ["plain localized", "lines localized", "*wide localized"]
    rungs = rungs_of([answered(WRONG, *tried, earlier=earlier)], 0.25)
    assert [it.rung for it in rungs if it.wrong] == [rung]
    assert sum(it.wrong for it in rungs) == 1


def test_rungs_add_up_over_photographs_in_the_order_tried() -> None:
    results = [
        answered(RIGHT, "*plain localized"),
        answered(RIGHT, "plain few", "wide few", "*wide localized"),
        answered(WRONG, "plain few", "*turned localized"),
    ]
    assert rungs_of(results, 0.25) == (
        Rung("plain", 3, 1, 1, 0, 0.75), Rung("wide", 1, 1, 1, 0, 0.5), Rung("turned", 1, 1, 0, 1, 0.25)
    )  # fmt: skip


def test_a_right_answer_is_near_in_the_folders_own_unit() -> None:
    """A quarter of a metre, or 5 % of the radius of the references' trajectory."""
    assert (largest_error(True, 100.0), largest_error(False, 100.0)) == (0.25, 5.0)
    off_by_2 = [answered(2.0, "*plain localized")]
    assert (wrong_count(off_by_2, 0.25), wrong_count(off_by_2, 5.0)) == (1, 0)
    turned = [query_result("q", 0.0, 5.1, (30, 40), "")]
    assert wrong_count(turned, 0.25) == 1


def test_the_report_has_a_table_of_attempts_and_json_the_same() -> None:
    measured = evaluation(
        answered(RIGHT, "plain few", "*wide localized"), answered(WRONG, "*plain localized"), answered(LOST)
    )
    text = StringIO()
    print_report(measured, Console(file=text, width=150))
    assert "2 of 3, 1 of them wrong" in text.getvalue()
    assert [line.split() for line in text.getvalue().splitlines() if "wide" in line] == [
        ["│", "wide", "│", "1", "│", "1", "│", "1", "│", "0", "│", "0.2", "│"]
    ]
    content = to_json(measured)
    assert content["wrong"] == 1
    assert content["rungs"] == [
        {"rung": "plain", "tried": 2, "answered": 1, "rescued": 0, "wrong": 1, "processor_s": 0.5},
        {"rung": "wide", "tried": 1, "answered": 1, "rescued": 1, "wrong": 0, "processor_s": 0.25},
    ]
    assert [it["outcome"] for it in content["per_query"][0]["attempts"]] == ["few", "localized"]
