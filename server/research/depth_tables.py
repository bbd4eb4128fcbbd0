"""Answers with the depth of references or without it, and their tables in Markdown."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.special import betaincinv

WRONG_SHARE = 0.05


@dataclass(frozen=True)
class Outcome:
    """One answer.

    Attributes:
        place: the folder.
        kind: "one", "several" or "elsewhere".
        references: number of references.
        has_depth: whether they have their depth.
        query: name of the photograph.
        median_m: median depth of the references.
        error_m, error_deg: of an answer, after the common scale; None without one.
        of_68, of_95: the position's error by both radii; None without an answer.
        reason: of a rejection; empty for an answer.
        rung: the attempt that gave it, or the last one.
        processor_s: of all attempts.
        photo_has_depth: whether the photograph has its depth.
    """

    place: str
    kind: str
    references: int
    has_depth: bool
    query: str
    median_m: float
    error_m: float | None
    error_deg: float | None
    of_68: float | None
    of_95: float | None
    reason: str
    rung: str
    processor_s: float
    photo_has_depth: bool = False

    @property
    def is_localized(self) -> bool:
        """Whether there is an answer."""
        return self.error_m is not None

    @property
    def share(self) -> float:
        """The error by the median depth; infinite for a photograph of another place."""
        return np.inf if self.kind == "elsewhere" else (self.error_m or 0.0) / self.median_m


def written(outcome: Outcome, file: Path | None) -> Outcome:
    """The outcome, which is appended to a file, if there is one."""
    if file is not None:
        with file.open("a") as opened:
            opened.write(json.dumps(asdict(outcome)) + "\n")
    return outcome


def alone_rows(found: Sequence[Outcome]) -> Iterator[str]:
    """The table of one reference with depth, and of photographs of other places, with intervals of 95 %."""
    yield "| place | localized | wrong | median error | in 68 % | in 95 % | elsewhere answered |"
    yield "|---|---|---|---|---|---|---|"
    one = [it for it in found if it.kind == "one"]
    places = [*dict.fromkeys(it.place for it in one)]
    for name, some in [*((p, [p]) for p in places), *([("all", places)] if places else [])]:
        its = [it for it in one if it.place in some]
        right = [it for it in its if it.is_localized]
        away = [it for it in found if it.kind == "elsewhere" and it.place in some]
        cells = [
            name,
            ratio(len(right), len(its)),
            str(sum(it.share > WRONG_SHARE for it in right)),
            f"{100 * np.median([it.share for it in right]):.2f} %" if right else "",
            ratio(sum((it.of_68 or 0) <= 1 for it in right), len(right)),
            ratio(sum((it.of_95 or 0) <= 1 for it in right), len(right)),
            f"{sum(it.is_localized for it in away)} of {len(away)}",
        ]
        yield f"| {' | '.join(cells)} |"


def several_rows(found: Sequence[Outcome]) -> Iterator[str]:
    """The table of several references, with their depth and without; the median is of photographs localized by both."""
    yield "| place | references | localized without | with | wrong | median error without | with | with / without |"
    yield "|---|---|---|---|---|---|---|---|"
    several = [it for it in found if it.kind == "several"]
    for place, count in dict.fromkeys((it.place, it.references) for it in several):
        its = [it for it in several if (it.place, it.references) == (place, count)]
        without, with_depth = ({it.query: it for it in its if it.has_depth is has} for has in (False, True))
        both = [q for q in without if without[q].is_localized and with_depth[q].is_localized]
        errors = [[1000 * (side[q].error_m or 0) for q in both] for side in (without, with_depth)]
        wrong = [
            sum(it.is_localized and it.share > WRONG_SHARE for it in side.values()) for side in (without, with_depth)
        ]
        counts = [f"{sum(it.is_localized for it in side.values())} of {len(side)}" for side in (without, with_depth)]
        cells = [
            place,
            str(count),
            *counts,
            f"{wrong[0]}, {wrong[1]}",
            *(f"{np.median(it):.1f} mm" if both else "" for it in errors),
            _change(*errors) if both else "",
        ]
        yield f"| {' | '.join(cells)} |"


def _change(before: Sequence[float], after: Sequence[float]) -> str:
    """The geometric mean of the errors' ratios, with its interval of 95 %, by a bootstrap over photographs."""
    ratios = np.log(np.maximum(after, 1e-3)) - np.log(np.maximum(before, 1e-3))
    drawn = np.random.default_rng(0).choice(ratios, (2000, len(ratios))).mean(axis=1)
    low, high = np.exp(np.quantile(drawn, [0.025, 0.975]))
    return f"{np.exp(ratios.mean()):.2f} ({low:.2f} to {high:.2f})"


def ratio(count: int, total: int) -> str:
    """A share with its interval of 95 %."""
    low, high = 100 * betaincinv(count + 0.5, total - count + 0.5, [0.025, 0.975])  # Jeffreys
    return f"{count} of {total} ({low:.0f} to {high:.0f} %)"
