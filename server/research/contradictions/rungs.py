"""The worth of each rung of the ladder, from files of answers, and from those that `mapless-server evaluate` writes."""

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from mapless_tools.output_files import markdown_table

from .asking import RIGHT_DEG, RIGHT_M, RIGHT_SHARE, Row


def answers_of(file: Path) -> Iterator[tuple[str, list[Row]]]:
    """The outcome of each photograph, which is "right", "wrong" or another word, and its attempts."""
    content = json.loads(file.read_text())
    try:
        if "answers" in content:
            found = [(it["outcome"], it.get("attempts", [])) for it in content["answers"]]
        else:
            found = [(_outcome(it), it["attempts"]) for it in content["per_query"]]
    except (TypeError, KeyError) as error:
        raise ValueError(f"{file} has no answers, or none with attempts: {error!r}") from None
    if any(isinstance(attempt, str) for _, attempts in found for attempt in attempts):
        raise ValueError(f"{file} is of an earlier version, whose attempts are sentences")
    yield from found


def _outcome(query: Mapping[str, float]) -> str:
    """As what is wrong everywhere: the distance is that to the references."""
    if not query["localized"]:
        return "rejected"
    unit = "m" if "translation_m" in query else "units"
    error, distance = query[f"translation_{unit}"], query[f"reference_distance_{unit}"]
    largest = min(RIGHT_M, RIGHT_SHARE * distance) if unit == "m" else RIGHT_SHARE * distance
    return "right" if error <= largest and query["rotation_deg"] <= RIGHT_DEG else "wrong"


def rungs(answers: Iterable[tuple[str, list[Row]]]) -> list[str]:
    """The rungs, apart where a pose was accepted before and where none was, with the photographs that they answered."""
    counts, spent_s = Counter[tuple[str, str, str]](), Counter[tuple[str, str]]()
    for outcome, attempts in answers:
        before = "no"
        for attempt in attempts:
            key = (attempt["rung"], before)
            spent_s[key] += attempt["processor_s"]
            counts[(*key, "tried")] += 1
            counts[(*key, outcome)] += attempt["chosen"]
            before = "yes" if attempt["outcome"] == "localized" else before
    head = "rung | accepted before | tried | answered right | answered wrong | processor s | s for each right"
    return markdown_table(head, [_row(key, counts, spent_s[key]) for key in sorted(spent_s)])


def _row(key: tuple[str, str], counts: Counter[tuple[str, str, str]], spent_s: float) -> list[object]:
    tried, right, wrong = (counts[(*key, it)] for it in ("tried", "right", "wrong"))
    return [*key, tried, right, wrong, f"{spent_s:.0f}", f"{spent_s / right:.1f}" if right else "-"]
