"""Compares the answers to the same cases before and after a change, as Markdown."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from mapless_tools.output_files import markdown_table

from .asking import Row
from .cases import Expected

SMALLEST = 1e-9
"""Errors below it count as it in ratios."""


def report(before: Sequence[Row], after: Sequence[Row]) -> list[str]:
    """A table by kind, then the photographs whose outcome differs, and wrong ones that are wrong in both."""
    pairs = paired(before, after)
    kinds = list(dict.fromkeys(first["kind"] for first, _ in pairs))
    head = "kind | photographs | right | wrong | rejected before | rejected after | errors after / before | processor s"
    rows = [_kind_row(kind, [it for it in pairs if it[0]["kind"] == kind]) for kind in kinds]
    lines = [*markdown_table(head, [*rows, _kind_row("all", pairs)]), ""]
    differing = [it for it in pairs if it[0]["outcome"] != it[1]["outcome"]]
    lines += [f"{len(differing)} photographs whose outcome differs:", ""]
    for pair in differing:
        lines += _difference(*pair)
    both = [it for it in pairs if it[0]["outcome"] == it[1]["outcome"] == "wrong"]
    lines += ["", f"{len(both)} wrong in both:", ""]
    for pair in both:
        lines += _difference(*pair)
    return [*lines, "", *_moved(pairs), "", *summary("before", before), *summary("after", after)]


def paired(before: Sequence[Row], after: Sequence[Row]) -> list[tuple[Row, Row]]:
    """The answers of both to the same cases; ValueError if these have none in common."""
    by_key = {_key(it): it for it in after}
    pairs = [(it, by_key[_key(it)]) for it in before if _key(it) in by_key]
    if not pairs:
        raise ValueError("the two files have no case in common")
    return pairs


def summary(label: str, rows: Sequence[Row]) -> list[str]:
    """How many answers are as expected, and the wrong ones by name."""
    unexpected = [it for it in rows if not is_expected(it)]
    lines = [f"{label}: {len(rows)} cases, {len(rows) - len(unexpected)} as expected"]
    wrong = [it for it in unexpected if it["outcome"] == "wrong"]
    lines += [f"- wrong: {it['kind']}: {it['name']} ({described(it)})" for it in wrong]
    others = Counter((it["kind"], it["expected"], it["outcome"]) for it in unexpected if it["outcome"] != "wrong")
    return [*lines, *(f"- {kind}: expected {what}, is {is_}: {n}" for (kind, what, is_), n in others.items()), ""]


def table(rows: Sequence[Row]) -> list[str]:
    """The outcomes of one file, by kind."""
    kinds = dict.fromkeys(it["kind"] for it in rows)
    body = []
    for kind in [*kinds, "all"]:
        own = [it for it in rows if kind in ("all", it["kind"])]
        counts = Counter(it["outcome"] for it in own)
        expected = sum(map(is_expected, own))
        spent = sum(it["processor_s"] for it in own)
        cells = [kind, len(own), counts["right"], counts["wrong"], _reasons(own), expected, f"{spent:.0f}"]
        body.append(cells)
    return markdown_table("kind | photographs | right | wrong | rejected | as expected | processor s", body)


def is_expected(row: Row) -> bool:
    """Whether an answer is what its case expects."""
    outcome, expected = row["outcome"], row["expected"]
    if outcome == "wrong" or outcome.startswith("failed"):
        return False
    if expected == Expected.AMBIGUOUS:
        return bool(outcome == "AMBIGUOUS" and len(row["hypotheses"]) == 2)
    return {
        Expected.RIGHT: bool(outcome == "right"),
        Expected.REJECTED: bool(outcome != "right"),
        Expected.RIGHT_OR_REJECTED: True,
    }[Expected(expected)]


def described(row: Row) -> str:
    """An answer in a line."""
    text = row["outcome"]
    if row.get("pose") is not None:
        error = "-" if row["error"] is None else f"{row['error']:.4g} / {row['error_deg']:.3g} deg"
        trust = "-" if row["trust"] is None else f"{row['trust']:.2g}"
        radii = "-" if row["radii"] is None else f"{row['radii'][1]:.3g} / {row['radii'][3]:.3g} deg"
        text += f", off {error} at distance {row['distance_seen']:.3g}, trust {trust}, 95 % within {radii}"
        text += f", {row['inliers']} of {row['matches']} inliers"
    else:
        text += f": {row['message']}"
        hypotheses = row.get("hypotheses") or ()
        text += f" ({len(hypotheses)} hypotheses)" if hypotheses else ""
    attempts = ", attempts " + "; ".join(map(_attempt, row["attempts"])) if row.get("attempts") else ""
    tracked = ", tracked" if row.get("retrieval") == "pose-prior" else ""
    return f"{text}, {row.get('features', '-')}{tracked}, {row['processor_s']:.2f} s{attempts}"


def _attempt(attempt: Row) -> str:
    chosen = ", answered" if attempt["chosen"] else ""
    return f"{attempt['rung']} with {attempt['features'].split('-')[0]}: {attempt['outcome']}{chosen}"


def _kind_row(kind: str, pairs: Sequence[tuple[Row, Row]]) -> list[object]:
    sides = list(zip(*pairs, strict=True))
    counts = [Counter(it["outcome"] for it in side) for side in sides]
    spent = [sum(it["processor_s"] for it in side) for side in sides]
    ratios = [_error_ratio(*it) for it in pairs if it[0]["outcome"] == it[1]["outcome"] == "right"]
    mean = f"{np.exp(np.mean(np.log(ratios))):.3f} ({len(ratios)})" if ratios else "-"
    both = (f"{counts[0][it]} / {counts[1][it]}" for it in ("right", "wrong"))
    return [kind, len(pairs), *both, *map(_reasons, sides), mean, f"{spent[0]:.0f} / {spent[1]:.0f}"]


def _reasons(rows: Sequence[Row]) -> str:
    counts = Counter(it["outcome"] for it in rows if it["outcome"] not in ("right", "wrong"))
    return ", ".join(f"{count} {reason}" for reason, count in counts.most_common()) or "0"


def _error_ratio(before: Row, after: Row) -> float:
    return float(max(after["error"], SMALLEST) / max(before["error"], SMALLEST))


def _difference(before: Row, after: Row) -> Iterator[str]:
    yield f"- {before['kind']}: {before['name']} (expected {before['expected']})"
    yield f"  - before: {described(before)}"
    yield f"  - after: {described(after)}"


def _moved(pairs: Sequence[tuple[Row, Row]], count: int = 10) -> list[str]:
    """Those right in both whose errors changed most."""
    right = [it for it in pairs if it[0]["outcome"] == it[1]["outcome"] == "right"]
    right.sort(key=lambda it: -abs(np.log(_error_ratio(*it))))
    lines = [f"right in both, errors that changed most ({len(right)} in all):", ""]
    for before, after in right[:count]:
        ratio = _error_ratio(before, after)
        if ratio != 1:
            lines += [f"- {ratio:.3g} times: {before['kind']}: {before['name']}"]
            lines += [f"  - before: {described(before)}", f"  - after: {described(after)}"]
    return lines


def _key(row: Mapping[str, str]) -> tuple[str, str]:
    return row["kind"], row["name"]
