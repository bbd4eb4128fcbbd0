"""The gain of each rung of the ladder, where a pose was accepted before it and where none was.

Every third case of `research.contradictions` is asked of a server with the settings of the environment.
"""

from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

from research.contradictions.asking import Row as Answer
from research.contradictions.asking import ask_all
from research.contradictions.cases import cases_of
from research.places import Scenes

from .page import Measurement, Row

EVERY = 3


def _rows(scenes: Path) -> Iterator[Row]:
    return earned(ask_all(cases_of(Scenes(scenes), every=EVERY)))


def earned(answers: Iterable[Answer]) -> Iterator[Row]:
    """The rungs, with the photographs that they answered; "accepted before" is whether a pose was accepted by then."""
    counts, spent_s = Counter[tuple[str, str, str]](), Counter[tuple[str, str]]()
    for answer in answers:
        before = "no"
        for attempt in answer.get("attempts", ()):
            key = (attempt["rung"], before)
            spent_s[key] += attempt["processor_s"]
            counts[(*key, "tried")] += 1
            counts[(*key, answer["outcome"])] += attempt["chosen"]
            before = "yes" if attempt["outcome"] == "localized" else before
    for key in sorted(spent_s):
        tried, right, wrong = (counts[(*key, it)] for it in ("tried", "right", "wrong"))
        yield {
            "rung": key[0],
            "accepted before": key[1],
            "tried": tried,
            "answered right": right,
            "answered wrong": wrong,
            "processor s": f"{spent_s[key]:.0f}",
            "s for each right": f"{spent_s[key] / right:.1f}" if right else "-",
        }


MEASUREMENTS = {"rungs": Measurement(_rows)}
