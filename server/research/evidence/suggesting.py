"""Suggestions of places for further references: a model of a building whose places change.

Forty places are photographed, some often and some seldom. A place changes now and then, for some days or until it is
surveyed, and then a share of its photographs is rejected that further references would rescue; at each place some
photographs are rejected by their own fault. Every week `report.summary` suggests places by the counts until then.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from unittest.mock import patch

import numpy as np

from mapless.geometry import Array, RigidTransform
from mapless_server.method.rejection import RejectionReason
from mapless_server.scenes.report import summary
from mapless_server.store.counts import Sums

from .page import Measurement, Row

SEEDS, PLACES, DAYS = 3, 40, 300
WARM_DAYS, AHEAD_DAYS, FIRST = 60, 28, 3
"""Days before the first report, days ahead in which photographs are counted, and suggestions that are followed."""
A_DAY = 0.5
"""Median of the photographs of a place a day; the standard deviation of their logarithm is 1."""
CHANGES, LACKING = 0.005, (0.2, 0.9)
"""Chance of a day that a place changes, and the share of its photographs that is rejected then."""
SHORT_DAYS, LONG_DAYS = 10.0, 60.0
"""Mean times of changes: half are short, half last until the place is surveyed, from when on it counts anew."""
AT_FAULT = (0.5, 9.5)
"""Parameters of a beta distribution: the share of a place's photographs that are rejected by their own fault."""
HALF_LIVES = (2, 4, 7, 14, 28, 56, 10_000)
LEAST = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)


@dataclass(frozen=True)
class Building:
    """Numbers (D, P) of photographs, whole, by day and place.

    Attributes:
        asked: all.
        rescued: those that are rejected, and that a further reference would rescue.
        at_fault: those that are rejected by their own fault.
        since: (D, P) day from which on a place's photographs count.
    """

    asked: Array
    rescued: Array
    at_fault: Array
    since: Array


@cache
def _building(seed: int) -> Building:
    random = np.random.default_rng(seed)
    lacking, since = np.zeros((DAYS, PLACES)), np.zeros((DAYS, PLACES), int)
    for place in range(PLACES):
        for day in np.flatnonzero(random.random(DAYS) < CHANGES).tolist():
            is_short = random.random() < 0.5
            until = day + 1 + int(random.exponential(SHORT_DAYS if is_short else LONG_DAYS))
            lacking[day:until, place] = random.uniform(*LACKING)
            if not is_short:
                since[until:, place] = until
    asked = random.poisson(random.lognormal(np.log(A_DAY), 1.0, PLACES), (DAYS, PLACES))
    rescued = random.binomial(asked, lacking)
    at_fault = random.binomial(asked - rescued, random.beta(*AT_FAULT, PLACES))
    return Building(*(np.asarray(it, float) for it in (asked, rescued, at_fault, since)))


def _suggested(building: Building, day: int) -> list[int]:
    """The places that a report of this day suggests."""
    places = dict[str, summary.Recent]()
    for place in range(PLACES):
        days = np.arange(int(building.since[day, place]), day + 1)
        weights = 2.0 ** ((days - day) / summary.HALF_LIFE_DAYS)
        asked, rejected = (it[days, place] for it in (building.asked, building.rescued + building.at_fault))
        if rejected.any():
            weighted = Sums(photograph_count=float(weights @ rejected))  # type: ignore[arg-type]
            lacking = {RejectionReason.LOW_OVERLAP: int(rejected.sum())}
            places[str(place)] = summary.Recent(int(asked.sum()), float(weights @ asked), lacking, weighted)
    poses = dict.fromkeys(places, RigidTransform.identity())
    return [int(it.place_key) for it in summary.suggestions(places, poses)]


@dataclass(frozen=True)
class Outcome:
    """Suggestions of all reports: how many, photographs that the first would rescue, those that any could, and so on.

    Attributes:
        reports, suggested: numbers.
        useless: suggestions that would rescue none in the days ahead.
        rescued, possible: photographs at the first suggestions, and at the best places.
    """

    reports: int
    suggested: int
    useless: int
    rescued: int
    possible: int


def _outcome() -> Outcome:
    reports = suggested = useless = rescued = possible = 0
    for seed in range(SEEDS):
        building = _building(seed)
        for day in range(WARM_DAYS, DAYS - AHEAD_DAYS, 7):
            ahead = building.rescued[day + 1 : day + 1 + AHEAD_DAYS].sum(axis=0)
            found = _suggested(building, day)
            reports, suggested = reports + 1, suggested + len(found)
            useless += sum(not ahead[it] for it in found)
            rescued += int(ahead[found[:FIRST]].sum())
            possible += int(np.sort(ahead)[-FIRST:].sum())
    return Outcome(reports, suggested, useless, rescued, possible)


def _row(title: str, value: float, in_use: float, shown: str) -> Row:
    found = _outcome()
    return {
        title: f"**{shown}**" if value == in_use else shown,
        "suggestions a week": f"{found.suggested / found.reports:.1f}",
        "of them would rescue none in four weeks": f"{100 * found.useless / max(found.suggested, 1):.0f} %",
        "rescued by the first three, of the most that three can": f"{100 * found.rescued / found.possible:.0f} %",
    }


def _half_life_rows(_: Path) -> Iterator[Row]:
    in_use = summary.HALF_LIFE_DAYS
    for days in HALF_LIVES:
        with patch.object(summary, "HALF_LIFE_DAYS", days):
            yield _row("days", days, in_use, "all count alike" if days == max(HALF_LIVES) else str(days))


def _least_rows(_: Path) -> Iterator[Row]:
    in_use = summary.LEAST_RESCUED
    for least in LEAST:
        with patch.object(summary, "LEAST_RESCUED", least):
            yield _row("least photographs", least, in_use, f"{least:g}")


MEASUREMENTS = {
    "suggestion-half-life": Measurement(_half_life_rows, needs_scenes=False),
    "suggestion-least": Measurement(_least_rows, needs_scenes=False),
}
