"""A page of evidence: which constant, what was asked, of which data, the alternatives measured, the decision."""

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

PAGES = Path(__file__).parents[3] / "docs" / "evidence"


@dataclass(frozen=True)
class Question:
    """A question about a constant.

    Attributes:
        key: name of the page.
        constant: module, colon, and name of the constant or Class.field of an options' default.
        question: sentences for a person.
        data: the photographs and how they are used.
        decision: why the constant has its value.
    """

    key: str
    constant: str
    question: str
    data: str
    decision: str

    @property
    def value(self) -> Any:
        """The constant's value in the code."""
        module, name = self.constant.split(":")
        found: Any = importlib.import_module(module)
        for part in name.split("."):
            found = getattr(found, part)
        return found


Row = Mapping[str, object]
"""Figures of one alternative, by the titles of the table's columns."""


def page(question: Question, value: object, rows: Sequence[Row]) -> str:
    """The page in Markdown, with the constant's value and today's date."""
    titles = list(rows[0])
    lines = [titles, ["---"] * len(titles), *([str(row[title]) for title in titles] for row in rows)]
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    command = f"PYTHONPATH=client:server python -m research.evidence {question.key}"
    return (
        f"# {question.key}\n\n`{question.constant}` = `{value!r}`\n\n"
        f"**Question.** {question.question}\n\n**Data.** {question.data}\n\n"
        f"**Command.** `{command}`, {date.today().isoformat()}.\n\n{table}\n\n**Decision.** {question.decision}\n"
    )
