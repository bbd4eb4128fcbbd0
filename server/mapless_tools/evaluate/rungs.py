"""The worth of each kind of attempt at a pose: on how many photographs it was made, and its results there."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

from .metrics import EarlierAnswer, QueryResult

RIGHT_M, RIGHT_SHARE, RIGHT_DEG = 0.25, 0.05, 5.0
"""An answer is right that is off by at most so many metres and degrees; where the unit of length is arbitrary, by such
a share of the radius of the references' trajectory."""
LOCALIZED = "localized"
"""The outcome of an attempt whose pose was accepted."""


@dataclass(frozen=True)
class Rung:
    """A kind of attempt, over all photographs.

    Attributes:
        rung: its name.
        tried: photographs on which it was made, once or more often.
        answered: photographs whose answer came from it, rejections included.
        rescued: those of them that are localized right although no earlier attempt's pose was accepted.
        wrong: photographs that are localized wrongly since this attempt: the answer before it was right, or none.
        processor_s: processor time of all its attempts, seconds.
    """

    rung: str
    tried: int
    answered: int
    rescued: int
    wrong: int
    processor_s: float


def largest_error(is_metric: bool, trajectory_radius: float) -> float:
    """Translation, in the dataset's unit, by which a right answer is off at most; the radius is the references'."""
    return RIGHT_M if is_metric else RIGHT_SHARE * trajectory_radius


def is_right(result: QueryResult | EarlierAnswer, largest: float) -> bool:
    """Whether an answer is a pose, off by at most so much, in the dataset's unit, and `RIGHT_DEG`."""
    return result.translation_error <= largest and result.rotation_error_deg <= RIGHT_DEG


def wrong_count(results: Sequence[QueryResult], largest: float) -> int:
    """How many queries are localized and off by more than that."""
    return sum(it.localized and not is_right(it, largest) for it in results)


def rungs_of(results: Sequence[QueryResult], largest: float) -> tuple[Rung, ...]:
    """The rungs that were tried, in the order in which they first were; `largest` is the error of a right answer."""
    names = dict.fromkeys(attempt.rung for result in results for attempt in result.attempts)
    return tuple(_rung(name, results, largest) for name in names)


def _rung(name: str, results: Sequence[QueryResult], largest: float) -> Rung:
    tried = [it for it in results if any(attempt.rung == name for attempt in it.attempts)]
    answered = [it for it in tried if any(attempt.rung == name and attempt.chosen for attempt in it.attempts)]
    return Rung(
        rung=name,
        tried=len(tried),
        answered=len(answered),
        rescued=sum(is_right(it, largest) and not _is_accepted_before(it) for it in answered),
        wrong=sum(_made_wrong_by(it, largest) == name for it in results),
        processor_s=sum(attempt.processor_s for it in tried for attempt in it.attempts if attempt.rung == name),
    )


def _made_wrong_by(result: QueryResult, largest: float) -> str | None:
    """The rung since which a query is localized wrongly; None if it is not, or if nothing lists its attempts."""
    rung = next((attempt.rung for attempt in result.attempts if attempt.chosen), None)
    if not result.localized or is_right(result, largest):
        return None
    for answer in reversed(result.earlier):
        if is_right(answer, largest):
            break
        rung = answer.rung
    return rung


def _is_accepted_before(result: QueryResult) -> bool:
    """Whether an attempt before the chosen one had an accepted pose."""
    before = itertools.takewhile(lambda attempt: not attempt.chosen, result.attempts)
    return any(attempt.outcome == LOCALIZED for attempt in before)
