"""Tables of a renovated room, in Markdown."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date

import numpy as np

from mapless_tools.output_files import markdown_table

from .rendered_room.renovation import STEPS

ENOUGH_LEFT = 0.3
"""Share of the surveyed points in view from which on a photograph is to be localized."""


@dataclass(frozen=True)
class Seen:
    """How a photograph was answered.

    Attributes:
        name: of the photograph.
        survey_left: share of the surveyed points in its view that are as they were surveyed.
        surveyed_matches, matches: right ones, with surveyed references and with all.
        error_m: distance of the answer from the truth; None for a rejection.
        position_68_m, position_95_m: its radii.
        rejection: reason and message; empty for an answer.
        outdated_place: id of the reference whose place needs a new survey, as the rejection names it; else empty.
    """

    name: str
    survey_left: float
    surveyed_matches: int
    matches: int
    error_m: float | None = None
    position_68_m: float = 0.0
    position_95_m: float = 0.0
    rejection: str = ""
    outdated_place: str = ""

    @property
    def is_lost(self) -> bool:
        """Whether it was rejected, or its answer is outside its 95 % radius."""
        return not self.is_within(self.position_95_m)

    def is_within(self, radius_m: float) -> bool:
        """Whether there is an answer, so near to the truth."""
        return self.error_m is not None and self.error_m <= radius_m


@dataclass(frozen=True)
class StepResult:
    """Results of a step.

    Attributes:
        step, piece_share: its number, and the share of the pieces that are as they were surveyed.
        seen: its photographs.
        adopted_errors_m: of the poses of the adopted references that are not retired.
        adopted_held: how many of them are within their 95 % radii.
        retirements, outcomes: references that were retired, by reason, and photographs that were considered, by what
            became of them, since the first step.
        warnings: of the scene.
    """

    step: int
    piece_share: float
    seen: Sequence[Seen]
    adopted_errors_m: Sequence[float]
    adopted_held: int
    retirements: Mapping[str, int]
    outcomes: Mapping[str, int]
    warnings: Sequence[str]

    @property
    def answered(self) -> list[Seen]:
        """Localized photographs."""
        return [it for it in self.seen if it.error_m is not None]

    def where(self, *, enough: bool) -> list[Seen]:
        """Photographs that show enough of the survey, or too little."""
        return [it for it in self.seen if (it.survey_left >= ENOUGH_LEFT) == enough]


def report(results: Sequence[StepResult], *, adopts: bool) -> str:
    """A run's summary and tables."""
    first = float(np.mean([it.surveyed_matches for it in results[0].seen]))
    title = "With adoption" if adopts else "Without adoption"
    lines = [f"### {title}", "", *_summary(results), ""]
    lines += markdown_table(ANSWERS, [_answers(it, first) for it in results])
    if adopts:
        before = [None, *results[:-1]]
        lines += ["", *markdown_table(ADOPTED, [_adopted(it, last) for it, last in zip(results, before, strict=True)])]
    lost = [(result.step, it) for result in results for it in result.seen if it.is_lost]
    lines += ["", *markdown_table(LOST, [_lost(step, it) for step, it in lost])]
    return "\n".join(lines)


ANSWERS = (
    "step | pieces left | of the survey left | localized | where 30 % are left | where less | these rejected, named | "
    "median | largest | within 68 % | within 95 %"
)
ADOPTED = (
    "step | adopted | median | largest | within 95 % | retired: contradicted | outdated | photographs: adopted | "
    "nothing new | unsupported | others"
)
LOST = "step | photograph | survey left | right matches | of them surveyed | "
LOST += "error | 95 % radius | rejected"


def _summary(results: Sequence[StepResult]) -> list[str]:
    """The figures of the bar, of the steps in which walls and floor stay."""
    steps = [it for it in results if it.step <= STEPS]
    answered = [seen for it in steps for seen in it.answered]
    enough, little = ([seen for it in steps for seen in it.where(enough=enough)] for enough in (True, False))
    found = [[seen for seen in some if seen.error_m is not None] for some in (enough, little)]
    lines = [
        f"- localized where {100 * ENOUGH_LEFT:.0f} % of the surveyed points are left: {_of(found[0], enough)}",
        f"- localized where less: {_of(found[1], little)}",
        f"- within 68 %: {_of([it for it in answered if it.is_within(it.position_68_m)], answered)}, within 95 %: "
        f"{_of([it for it in answered if it.is_within(it.position_95_m)], answered)}",
    ]
    last = steps[-1]
    median, largest = _centimetres([it.error_m for it in last.answered if it.error_m is not None])
    lines.append(f"- answers at step {last.step}: off by {median} (median), {largest} (largest)")
    if last.adopted_errors_m:
        median, largest = _centimetres(last.adopted_errors_m)
        lines.append(f"- adopted references at step {last.step}: off by {median} (median), {largest} (largest)")
    return lines


def with_section(page: str, seed: int, commit: str, reports: Sequence[str]) -> str:
    """A page with the section of a seed, in place of an older one or at its end."""
    head, command = f"## Room of seed {seed}\n", f"`python -m research.renovation FOLDER --seed {seed} --page`"
    section = "\n\n".join([f"{head}\n{command}, {date.today().isoformat()}, {commit}.", *reports]) + "\n"
    before, found, after = page.partition(head)
    if not found:
        return f"{page.rstrip()}\n\n{section}"
    _, following, rest = after.partition("\n## ")
    return before + section + following + rest


def _answers(result: StepResult, first: float) -> list[str]:
    """Row of a step: its photographs and their answers; `first` is the mean number of surveyed matches at the first."""
    answered, little = result.answered, result.where(enough=False)
    rejected = [it for it in little if it.error_m is None]
    return [
        str(result.step),
        f"{100 * result.piece_share:.0f} %",
        f"{100 * float(np.mean([it.surveyed_matches for it in result.seen])) / first:.0f} %",
        _of(answered, result.seen),
        *(_of([it for it in some if it.error_m is not None], some) for some in (result.where(enough=True), little)),
        _of([it for it in rejected if it.outdated_place], rejected),
        *_centimetres([it.error_m for it in answered if it.error_m is not None]),
        _of([it for it in answered if it.is_within(it.position_68_m)], answered),
        _of([it for it in answered if it.is_within(it.position_95_m)], answered),
    ]


def _adopted(result: StepResult, before: StepResult | None) -> list[str]:
    """Row of a step: its adopted references, and what became of its photographs and of references."""
    outcomes, retirements = result.outcomes, result.retirements
    if before is not None:
        outcomes = {key: count - before.outcomes.get(key, 0) for key, count in outcomes.items()}
        retirements = {key: count - before.retirements.get(key, 0) for key, count in retirements.items()}
    named = ("adopted", "nothing_new", "unsupported")
    others = ", ".join(f"{key} {count}" for key, count in outcomes.items() if count and key not in named)
    return [
        str(result.step),
        str(len(result.adopted_errors_m)),
        *_centimetres(result.adopted_errors_m),
        f"{result.adopted_held} of {len(result.adopted_errors_m)}",
        *(str(retirements.get(it, 0)) for it in ("contradicted", "survey_outdated")),
        *(str(outcomes.get(it, 0)) for it in named),
        others,
    ]


def _lost(step: int, seen: Seen) -> list[str]:
    """Row of a photograph that was rejected, or whose answer is outside its 95 % radius."""
    error = "" if seen.error_m is None else f"{100 * seen.error_m:.2f} cm"
    radius = "" if seen.error_m is None else f"{100 * seen.position_95_m:.2f} cm"
    counts = [f"{100 * seen.survey_left:.0f} %", str(seen.matches), str(seen.surveyed_matches)]
    return [str(step), seen.name, *counts, error, radius, seen.rejection]


def _of(some: Sequence[Seen], of: Sequence[Seen]) -> str:
    return f"{len(some)} of {len(of)}"


def _centimetres(errors_m: Sequence[float]) -> list[str]:
    """Median and largest."""
    return [f"{100 * it:.2f} cm" for it in (float(np.median(errors_m)), max(errors_m))] if errors_m else ["", ""]
