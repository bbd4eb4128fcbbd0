"""`python -m bench.results`: writes the tables of docs/results.md and README.md again from docs/results/*.json.

`--check` only compares them. `--take FILE` first takes the figures of a file that `make bench`, `make load` or
`mapless-server evaluate --json` wrote: rows of the same scene, references and features are replaced.
"""

import argparse
import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from mapless_tools.output_files import markdown_table

Row = dict[str, Any]

ROOT = Path(__file__).resolve().parents[2]
FIGURES = ROOT / "docs/results"
"""A file for each table: machine, command (as Markdown), and rows, each with the commit and date of its measurement."""

PAGES = (ROOT / "docs/results.md", ROOT / "README.md")
DIGITS = {"cm": ".2f", "%": ".3f", "units": ".4g"}
METHODS = {"sift": "SIFT", "auto": "`auto`", "colmap": "COLMAP 4.2"}
_TABLE = re.compile(r"^(<!-- results: (\w+) -->\n).*?^(<!-- end -->)$", re.MULTILINE | re.DOTALL)


def main() -> int:
    """Writes or compares the pages; returns 1 if `--check` finds a difference."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="only report pages that differ from the figures")
    parser.add_argument("--take", type=Path, nargs="+", default=[], metavar="FILE", help="files with new figures")
    parser.add_argument("--commit", help="what was measured; default: the commit that is checked out")
    parser.add_argument("--latency", action="store_true", help="take times too: the machine did nothing else")
    given = parser.parse_args()
    for file in given.take:
        commit = given.commit or _git("rev-parse", "--short=8", "HEAD")
        try:
            tables = taken(json.loads(file.read_text(encoding="utf-8")), given.latency)
            date = f"{datetime.fromtimestamp(file.stat().st_mtime, UTC):%Y-%m-%d}"
        except (OSError, ValueError) as error:
            parser.error(f"{file}: {error}")
        for name, rows in tables.items():
            store(name, [row | {"commit": commit, "date": date} for row in rows])
    differing = [page for page in PAGES if current(text := page.read_text(encoding="utf-8")) != text]
    for page in differing:
        print(f"{page.relative_to(ROOT)}{' differs from docs/results' if given.check else ''}")
        if not given.check:
            page.write_text(current(page.read_text(encoding="utf-8")), encoding="utf-8")
    return 1 if given.check and differing else 0


def current(page: str) -> str:
    """A page's text with its tables made again, each between `<!-- results: NAME -->` and `<!-- end -->`."""
    return _TABLE.sub(lambda found: f"{found[1]}\n{table(found[2])}\n\n{found[3]}", page)


def table(name: str) -> str:
    """The table of this name; below it how, of which commits and on which machine it was measured."""
    make = TABLES[name]
    figures = json.loads((FIGURES / f"{name.removesuffix('_short')}.json").read_text(encoding="utf-8"))
    head, *rows = make(figures["rows"])
    measured = sorted({(row["commit"], row["date"]) for row in figures["rows"] if row.get("method") != "colmap"})
    commits = ", ".join(f"{commit} ({date})" for commit, date in measured)
    line = f"Measured by {figures['command']}; commits {commits}; {figures['machine']}."
    lines = markdown_table(" | ".join(head), rows)
    return "\n".join(lines if name.endswith("_short") else [*lines, "", line])


# Tables


def scenes(rows: list[Row], with_commit: bool = True) -> Iterable[list[str]]:
    """A line for each scene and number of references, with a column for each method."""
    methods = [method for method in METHODS if any(row["method"] == method for row in rows)]
    yield ["scene", "references", *(METHODS[it] for it in methods), *(["commit"] if with_commit else [])]
    groups: dict[tuple[str, int | None], dict[str, Row]] = {}
    for row in rows:
        groups.setdefault((row["scene"], row["references"]), {})[row["method"]] = row
    for (scene, references), by_method in groups.items():
        own = dict.fromkeys(row["commit"] for method, row in by_method.items() if method != "colmap")
        cells = [_outcome(by_method[it]) if it in by_method else "" for it in methods]
        split = "leave one out" if references is None else str(references)
        yield [scene, split, *cells, *([", ".join(own)] if with_commit else [])]


def scenes_of_maps(rows: list[Row]) -> Iterable[list[str]]:
    """The scenes that a map was made of, without commits."""
    with_map = {(row["scene"], row["references"]) for row in rows if row["method"] == "colmap"}
    return scenes([row for row in rows if (row["scene"], row["references"]) in with_map], with_commit=False)


def _outcome(row: Row) -> str:
    """Median error; in brackets how many are localized where not all are, and how many of them are wrong."""
    found, asked, wrong = row["localized"], row["queries"], row["wrong"]
    error = "" if row["median"] is None else f"{row['median']:{DIGITS[row['unit']]}} {row['unit']}"
    error += "" if row["median_deg"] is None else f" / {row['median_deg']:.3f}°"
    counts = [f"{found} of {asked}"] if found < asked else []
    counts += [f"{wrong} wrong"] if wrong else []
    return f"{error} ({', '.join(counts)})".strip() if counts else error


def unseen(rows: list[Row]) -> Iterable[list[str]]:
    """Places that no constant was chosen with."""
    yield ["place", "references", "localized", "wrong", "median error of positions", "in 68 % radii", "commit"]
    for row in rows:
        held = "" if row["held_68"] is None else f"{row['held_68']} %"
        median = "" if row["median"] is None else f"{row['median']} {row['unit']}"
        localized = f"{row['localized']} of {row['queries']}"
        references = str(row["references"] or "all others")
        yield [row["place"], references, localized, str(row["wrong"]), median, held, row["commit"]]


def radii(rows: list[Row]) -> Iterable[list[str]]:
    """How often the truth lies inside the radii, positions and angles."""
    heads = [f"{when}, {level} %" for when in ("after import", "calibrated") for level in (68, 95)]
    yield ["places", "references", "answers", *heads]
    for row in rows:
        shares = [f"{position}, {angle}" for position, angle in row["held"]]
        yield [row["places"], row["references"], str(row["answers"]), *shares]


def figures(rows: list[Row]) -> Iterable[list[str]]:
    """A line for each figure."""
    yield ["figure", "median", "95 %", "commit"]
    for row in rows:
        values = (f"{row[it]:g} {row['unit']}" if row.get(it) is not None else "" for it in ("median", "p95"))
        yield [row["figure"], *values, row["commit"]]


def load(rows: list[Row]) -> Iterable[list[str]]:
    """A line for each rate of calls."""
    times = ["p50 ms", "p95 ms", "p99 ms", "slowest refusal ms"]
    yield ["offered", "sent", "answered/s", "refused/s", *times, "answered after the deadline"]
    for row in rows:
        rates = (f"{row[it]:.2f}" for it in ("answered_per_s", "refused_per_s"))
        spent = ("" if row[it] is None else f"{row[it]:.0f}" for it in ("p50_ms", "p95_ms", "p99_ms", "refusal_ms"))
        yield [row["offered"], str(row["sent"]), *rates, *spent, str(row["overdue"])]


def serving(rows: list[Row]) -> Iterable[list[str]]:
    """A line for each figure with its bar."""
    yield ["figure", "measured", "bar", "commit"]
    for row in rows:
        yield [row["figure"], row["value"], row["bar"] or "", row["commit"]]


TABLES: dict[str, Callable[[list[Row]], Iterable[list[str]]]] = {
    "accuracy": scenes,
    "accuracy_short": scenes_of_maps,
    "references": scenes,
    "unseen": unseen,
    "radii": radii,
    "latency": figures,
    "load": load,
    "serving": serving,
    "robustness": serving,
}

# Figures


def taken(content: Row, with_latency: bool) -> dict[str, list[Row]]:
    """The rows of each table that a file of `bench`, `bench.load` or `evaluate --json` has; ValueError for others."""
    if not isinstance(content, dict):
        raise ValueError("no file of bench, bench.load or evaluate --json")
    if "pipeline" in content:
        return {"load": _load_rows(content["pipeline"])}
    if "per_query" in content:
        return {"references": [_scene_row(content)]}
    if "scenes" not in content or content["quick"]:
        raise ValueError("neither a complete run of bench nor a file of bench.load pipeline or evaluate --json")
    rows = [_scene_row(it) for it in (*content["scenes"], *content["others"])]
    latency = _latency_rows(rows[0]["method"], content["latency"]) if with_latency else []
    return {"accuracy": rows, "latency": latency}


def _scene_row(measured: Row) -> Row:
    """The median is in cm, or where the unit is arbitrary in per cent of the distance to the references."""
    metric = measured["metric"]
    share = measured["relative"]["median_translation_of_reference_distance"]
    median = measured["median_translation_m"] if metric else share
    features = measured["features"]
    names = [features] if isinstance(features, str) else list(features)
    return {
        "scene": measured["scene"],
        "references": measured["references"] if measured["split"] == "references_and_queries" else None,
        "method": "sift" if all(name.startswith("sift") for name in names) else "auto",
        "queries": measured["queries"],
        "localized": measured["localized"],
        "wrong": measured["wrong"],
        "median": None if median is None else float(f"{100 * median:.4g}"),
        "unit": "cm" if metric else "%",
        "median_deg": measured["median_rotation_deg"] and float(f"{measured['median_rotation_deg']:.4g}"),
    }


def _latency_rows(method: str, latency: Row) -> list[Row]:
    calls = {
        "every photograph for the first time": latency["first_pass_ms"],
        "the same again": latency["warm_ms"],
        "first call of a fresh server": latency["cold_ms"],
    }
    rows: list[Row] = []
    for what, times in calls.items():
        ordered = sorted(times)
        median, p95 = (round(ordered[int(share * (len(ordered) - 1))]) for share in (0.5, 0.95))
        rows.append({"figure": f"{METHODS[method]}, {what}", "median": median, "p95": p95, "unit": "ms"})
    peak = round(latency["memory_mib"]["peak_mib"])
    return [*rows, {"figure": f"{METHODS[method]}, peak memory of the server", "median": peak, "unit": "MiB"}]


def _load_rows(pipeline: Row) -> list[Row]:
    steps = [("one at a time", pipeline["unloaded"])]
    steps += [(f"{100 * it['share_of_saturation']:.0f} % of saturation", it) for it in pipeline["steps"]]
    return [
        {
            "offered": offered,
            "sent": step["sent"],
            "answered_per_s": step["goodput_per_s"],
            "refused_per_s": step["refused_per_s"],
            **{name: step["answers"][name] for name in ("p50_ms", "p95_ms", "p99_ms")},
            "refusal_ms": step["refusals"]["max_ms"],
            "overdue": step["fates"].get("overdue", 0),
        }
        for offered, step in steps
    ]


def store(name: str, rows: list[Row]) -> None:
    """Replaces the rows of a table that are of the same thing, and adds the others."""
    file = FIGURES / f"{name}.json"
    content = json.loads(file.read_text(encoding="utf-8"))
    kept = {_subject(row): row for row in content["rows"]} | {_subject(row): row for row in rows}
    write(file, content | {"rows": list(kept.values())})


def write(file: Path, content: Row) -> None:
    """Writes strict JSON, a row on a line."""
    rows = ",\n".join(f"  {json.dumps(row, ensure_ascii=False, allow_nan=False)}" for row in content["rows"])
    head = json.dumps(content | {"rows": []}, indent=1, ensure_ascii=False)
    file.write_text(head.replace("[]", f"[\n{rows}\n ]") + "\n", encoding="utf-8")


def _subject(row: Row) -> tuple[Any, ...]:
    return tuple(row.get(it) for it in ("scene", "references", "method", "figure", "offered"))


def _git(*arguments: str) -> str:
    return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


if __name__ == "__main__":
    sys.exit(main())
