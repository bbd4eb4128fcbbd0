"""Pages of evidence, docs/evidence/KEY.md: which constants, the question, the data, the alternatives, the decision.

A person writes the text; the program writes the table and the line of its command.
"""

import re
import subprocess
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path

PAGES = Path(__file__).parents[3] / "docs" / "evidence"
Row = Mapping[str, object]
"""Figures of one alternative, by the titles of the table's columns."""
_COMMAND = re.compile(r"^\*\*Command\.\*\* .*(?:\n(?!\n).*)*", re.MULTILINE)
_TABLE = re.compile(r"(?:^\|.*\n)+", re.MULTILINE)


@dataclass(frozen=True)
class Measurement:
    """How a key is measured again.

    Attributes:
        rows: makes the rows of the page's table from a folder of scenes, one for each alternative. ValueError or
            OSError if the folder lacks what the key needs.
        decide: the value of the constant that the rows decide for; None where a person weighs them. With it `make
            nightly` measures the key by turns, so that it takes at most a minute.
        needs_scenes: whether the folder is read.
    """

    rows: Callable[[Path], Iterable[Row]]
    decide: Callable[[Sequence[Row]], object] | None = None
    needs_scenes: bool = True


def least(title: str) -> Callable[[Sequence[Row]], float]:
    """Decides for the first alternative whose number in a column is within 5 % of the least: more gains nothing."""

    def decided(rows: Sequence[Row]) -> float:
        bound = 1.05 * min(_at(it, title) for it in rows)
        return _at(next(it for it in rows if _at(it, title) <= bound))

    return decided


def most(title: str) -> Callable[[Sequence[Row]], float]:
    """Decides for the last alternative whose number in a column is the largest: the most that loses nothing."""

    def decided(rows: Sequence[Row]) -> float:
        bound = max(_at(it, title) for it in rows)
        return _at(next(it for it in reversed(rows) if _at(it, title) == bound))

    return decided


def _at(row: Row, title: str = "") -> float:
    """The first number in a column; by default in the first one, which has the constant's value."""
    cell = str(row[title] if title else next(iter(row.values())))
    found = re.search(r"-?[\d.]+", cell)
    if found is None:
        raise ValueError(f"{title} has no number: {cell}")
    return float(found.group())


def table(rows: Sequence[Row]) -> str:
    """The rows in Markdown; all have the same columns."""
    titles = list(rows[0])
    lines = [titles, ["---"] * len(titles), *([str(row[title]) for title in titles] for row in rows)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def rewritten(text: str, key: str, rows: Sequence[Row], data: str = "", sample: int | None = None) -> str:
    """A page's text with the command, today's date, the commit, and the first table after them.

    `data` is the name of the folder of scenes, if it is not the usual one, `sample` the number of them that were
    measured, if not all. ValueError if the page has no line
    "**Command.**".
    """
    command = _COMMAND.search(text)
    if command is None:
        raise ValueError(f"docs/evidence/{key}.md has no line **Command.** and hence no place for the table")
    before, after = text[: command.start()], text[command.end() :].lstrip("\n")
    found = _TABLE.search(after)
    begin, end = found.span() if found is not None else (0, 0)
    after = after[:begin] + table(rows) + ("" if found is not None else "\n") + after[end:]
    where = (f" DATA={data}" if data else "") + (f" ARGS='--sample {sample}'" if sample else "")
    when = f"{date.today().isoformat()}, {measured_commit()}"
    return f"{before}**Command.** `make evidence KEY={key}{where}`, {when}.\n\n{after}"


def measured_commit() -> str:
    """The commit whose code is measured, and whether files differ from it."""

    def git(*arguments: str) -> str:
        return subprocess.run(
            ["git", *arguments], cwd=PAGES.parent, check=True, capture_output=True, text=True
        ).stdout.strip()

    changed = git("status", "--porcelain", "--untracked-files=no", "--", ":/server", ":/client")
    return git("rev-parse", "--short=8", "HEAD") + (" with changes" if changed else "")
