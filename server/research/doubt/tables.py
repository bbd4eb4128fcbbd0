"""Tables of files of answers, as Markdown."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from mapless_tools.output_files import markdown_table
from research.contradictions.asking import Row


def by(label: str, key: Callable[[Row], object], rows: Sequence[Row]) -> list[str]:
    """Outcomes, processor time and attempts of groups of rows and of all."""
    head = f"{label} | photographs | right | wrong | rejected | processor s, median | 95 % | attempts, mean"
    keys = list(dict.fromkeys(map(key, rows)))
    groups: list[tuple[object, Sequence[Row]]] = [(it, [row for row in rows if key(row) == it]) for it in keys]
    if len(groups) != 1:
        groups.append(("all", rows))
    return markdown_table(head, [[name, *_cells(own)] for name, own in groups if own])


def _cells(rows: Sequence[Row]) -> list[object]:
    right, wrong = (sum(row["outcome"] == it for row in rows) for it in ("right", "wrong"))
    failed = sum(row["outcome"].startswith("failed") for row in rows)
    rejected = len(rows) - right - wrong - failed
    spent_s = [row["processor_s"] for row in rows]
    tried = np.mean([len(row.get("attempts", ())) for row in rows])
    times = (f"{np.quantile(spent_s, share):.2f}" for share in (0.5, 0.95))
    return [len(rows), right, wrong, f"{rejected}, {failed} failed" if failed else rejected, *times, f"{tried:.1f}"]


def by_turn(rows: Sequence[Row], turn: str) -> list[str]:
    """Outcomes at each turn, a field of the rows, of photographs right at the smallest, and the cost by that."""
    turns = sorted({row[turn] for row in rows})
    upright = {_photograph(row): row for row in rows if row[turn] == turns[0] and row["outcome"] == "right"}
    body = []
    for it in turns:
        own = [row for row in rows if row[turn] == it and _photograph(row) in upright]
        body.append([it, *_turned_cells(own, upright)])
    first = f"at {turns[0]}"
    head = f"{turn} | right {first} | right | wrong | rejected | processor s, median | 95 % | by that {first} | sums"
    return markdown_table(head, body)


def _turned_cells(rows: Sequence[Row], upright: dict[tuple[str, str], Row]) -> Iterable[object]:
    if not rows:
        return [0, *"-------"]
    spent_s = np.array([row["processor_s"] for row in rows])
    upright_s = np.array([upright[_photograph(row)]["processor_s"] for row in rows])
    count, right, wrong, rejected, median, most, _ = _cells(rows)
    share = f"{right} ({100 * int(str(right)) / len(rows):.0f} %)"
    ratios = f"{np.median(spent_s / upright_s):.2f}", f"{spent_s.sum() / upright_s.sum():.2f}"
    return [count, share, wrong, rejected, median, most, *ratios]


def _photograph(row: Row) -> tuple[str, str]:
    return row["folder"], row["photograph"]
