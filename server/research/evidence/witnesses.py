"""How many photographs, days and holders of tokens retire a reference, or ask for a new survey: a model of a year.

A reference's viewpoint is passed by four robots, each with a token, at random times; what its photographs say is drawn,
and what follows from it is computed by `adoption.policy`. On some days what stands before the reference hides it from
all of them.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mapless.scenes import AdoptionPolicy
from mapless_server.scenes.adoption.policy import (
    DAY_US,
    AdoptionOptions,
    is_contradicted,
    needs_survey,
    with_photograph,
    with_share,
)
from mapless_server.store.records import Standing

from .page import Measurement, Row

IN_USE = AdoptionOptions()
SEEDS, DAYS = 100, 365
ROBOTS, A_DAY = 4, 0.5
"""Tokens, and photographs that each takes a day from about the viewpoint."""
MISTAKEN = 0.03
"""Chance that a photograph contradicts a reference that is unchanged: the most that 0 of 101 pairs leave likely
(adoption-contradictions)."""
HIDDEN, HIDDEN_DAYS = 0.02, (2, 4)
"""Chance of a day that something is put before it, and for how many days at most: short and long."""
STILL_AGREEING = 0.05
"""Chance that a photograph agrees with a reference that has changed."""
ATTACKER, SELDOM = "attacker", 0.1
"""One token contradicts once a day a reference whose viewpoint the robots pass so much more seldom."""

WITNESSES = ((2, 1, 1), (3, 2, 1), (5, 1, 2), (5, 3, 1), (5, 3, 2), (5, 5, 2), (5, 3, 4), (10, 3, 2))
"""Contradictions in a row, days, and contradictions of others than the holder with most."""


def _photographs(random: np.random.Generator, factor: float = 1.0) -> Iterator[tuple[int, str]]:
    """Times, microseconds, and holders of the robots' photographs, in order; so many times as many as usual."""
    for day in range(DAYS):
        for time in sorted(random.random(random.poisson(factor * ROBOTS * A_DAY))):
            yield int((day + time) * DAY_US), f"robot-{random.integers(ROBOTS)}"


def _hidden_days(random: np.random.Generator, most: int) -> frozenset[int]:
    begins = np.flatnonzero(random.random(DAYS) < HIDDEN)
    return frozenset(day + i for day in begins.tolist() for i in range(random.integers(1, most + 1)))


def _retired_day(
    options: AdoptionOptions,
    seed: int,
    hidden_days: int = HIDDEN_DAYS[0],
    *,
    is_changed: bool = False,
    is_attacked: bool = False,
) -> int | None:
    """The day on which the reference is retired; None if it is not within the year."""
    random = np.random.default_rng([seed, int(is_changed)])
    hidden = frozenset[int]() if is_attacked else _hidden_days(random, hidden_days)
    photographs = list(_photographs(random, SELDOM if is_attacked else 1.0))
    if is_attacked:
        photographs += [(day * DAY_US, ATTACKER) for day in range(DAYS)]
    standing = Standing()
    for time_us, holder in sorted(photographs):
        contradicts = random.random() < (1 - STILL_AGREEING if is_changed else MISTAKEN)
        is_hidden = holder == ATTACKER or time_us // DAY_US in hidden
        standing = with_photograph(standing, 0.0 if contradicts or is_hidden else 1.0, time_us, holder, options)
        if is_contradicted(standing, options):
            return time_us // DAY_US
    return None


def _witness_rows(_: Path) -> Iterator[Row]:
    for count, days, others in WITNESSES:
        options = replace(IN_USE, contradictions=count, contradicting_days=days, contradicting_others=others)
        unchanged = [[_retired_day(options, seed, most) for seed in range(SEEDS)] for most in HIDDEN_DAYS]
        attacked = [_retired_day(options, seed, is_attacked=True) for seed in range(SEEDS)]
        changed = [_retired_day(options, seed, is_changed=True) for seed in range(SEEDS)]
        after = [DAYS if it is None else it for it in changed]
        name = f"{count}, {days}, {others}"
        yield {
            "contradictions, days, of others": f"**{name}**" if options == IN_USE else name,
            **{
                f"hidden for {most} days at most: retired within a year": _share(its)
                for most, its in zip(HIDDEN_DAYS, unchanged, strict=True)
            },
            "seldom seen, one token contradicts daily: retired": _share(attacked),
            "changed: days until it is, median": f"{np.median(after):.0f}",
            "of ten, the latest but one": f"{np.quantile(after, 0.9):.0f}",
        }


def _share(retired: Sequence[int | None]) -> str:
    return f"{sum(it is not None for it in retired)} of {len(retired)}"


OUTDATED = ((5, 3, 3), (5, 5, 3), (10, 5, 1), (10, 5, 3), (10, 5, 10), (10, 10, 3), (20, 10, 3))
"""Photographs that a median remembers, least with too small a share, and photographs that count a day."""
POLICY = AdoptionPolicy()
SPREAD = 0.15
"""Standard deviation of a photograph's share of surveyed support from that of its place."""
STEADY, LOST_A_DAY = (0.5, 0.4), 0.01
"""Shares of places that stay, and what a place that is renovated loses a day, from 0.8."""


def _outdated_day(options: AdoptionOptions, seed: int, *, start: float, lost_a_day: float) -> int | None:
    """The day on which a place needs a new survey; None if it does not within the year."""
    random, standing = np.random.default_rng([seed, 2]), Standing()
    for time_us, holder in _photographs(random):
        day = time_us // DAY_US
        true = max(start - lost_a_day * day, 0.02)
        share = float(np.clip(random.normal(true, SPREAD), 0, 1))
        standing = with_share(standing, share, time_us, holder, options)
        if needs_survey(standing, POLICY, options):
            return day
    return None


def _outdated_rows(_: Path) -> Iterator[Row]:
    due = round((0.8 - POLICY.min_surveyed_share) / LOST_A_DAY)
    for remembered, least, a_day in OUTDATED:
        options = replace(IN_USE, remembered=remembered, least_photographs=least, photographs_a_day=a_day)
        late = [_outdated_day(options, seed, start=0.8, lost_a_day=LOST_A_DAY) for seed in range(SEEDS)]
        days = [(DAYS if it is None else it) - due for it in late]
        name = f"{remembered}, {least}, {a_day}"
        yield {
            "remembered, least, a day": f"**{name}**" if options == IN_USE else name,
            **{
                f"share of {100 * it:.0f} %: outdated within a year": _share(
                    [_outdated_day(options, seed, start=it, lost_a_day=0.0) for seed in range(SEEDS)]
                )
                for it in STEADY
            },
            "renovated: days after 30 %, median": f"{np.median(days):.0f}",
            "earliest and latest of ten": f"{np.quantile(days, 0.1):.0f}, {np.quantile(days, 0.9):.0f}",
        }


MEASUREMENTS = {
    "adoption-witnesses": Measurement(_witness_rows, needs_scenes=False),
    "adoption-outdated": Measurement(_outdated_rows, needs_scenes=False),
}
