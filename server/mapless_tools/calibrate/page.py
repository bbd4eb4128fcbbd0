"""The report as one HTML file that needs nothing else: tables and charts are in it, scripts are not."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from html import escape

from mapless_tools.evaluate import svg

from .charts import charts_of
from .queries import Outcome
from .report import COLUMNS, RULES, CalibrationReport, held_rows, worst

_STYLE = (
    """
:root { color-scheme: light dark; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1340px; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.6rem; } h2 { margin-top: 2.5rem; border-bottom: 1px solid; font-size: 1.2rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 14px; }
th, td { padding: .2rem .8rem; text-align: left; white-space: nowrap; }
thead th { border-bottom: 2px solid; }
.charts { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(460px, 100%), 1fr)); gap: 1.2rem;
  margin-top: 1.2rem; }
.note { font-size: 13px; opacity: .8; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .1rem 1rem; }
dt { opacity: .7; } dd { margin: 0; overflow-wrap: anywhere; }
"""
    + svg.STYLE
)


def page(report: CalibrationReport) -> str:
    """The report."""
    title = escape(f"Calibration of mapless: {report.title}")
    facts = (f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>" for name, value in report.facts().items())
    return "\n".join(
        (
            "<!DOCTYPE html>",
            '<html lang="en"><head><meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{title}</title><style>{_STYLE}</style></head><body>",
            f"<h1>{title}</h1>",
            "<dl>",
            *facts,
            "</dl>",
            "<h2>How often the truth lies within the claimed radius</h2>",
            *_table(COLUMNS, held_rows(report)),
            '<div class="charts">',
            *map(svg.draw, charts_of(report.found, report.unit)),
            "</div>",
            "<h2>What exceeds its claim most</h2>",
            *_exceeding(report),
            *_rejected(report.found.outcomes),
            "<h2>How to read it</h2>",
            *(f'<p class="note">{escape(rule)}</p>' for rule in RULES),
            "</body></html>\n",
        )
    )


_QUERY_COLUMNS = ("photograph", "off", "claimed 95 %", "turned", "claimed 95 %", "trust", "inliers")


def _exceeding(report: CalibrationReport) -> list[str]:
    rows = [_query_row(it, report.unit) for it in worst(report)]
    return _table(_QUERY_COLUMNS, rows) if rows else ["<p>No answer is further off than its radii of 95 %.</p>"]


def _query_row(it: Outcome, unit: str) -> tuple[str, ...]:
    return (
        it.name,
        _length(it.error_m, unit),
        _length(it.position.radius_95, unit) if it.position else "-",
        f"{it.error_deg:.3f}°",
        f"{it.rotation.radius_95:.3f}°" if it.rotation else "-",
        "-" if it.trust is None else f"{it.trust:.3f}",
        f"{it.inlier_count} of {it.match_count}",
    )


def _length(value: float, unit: str) -> str:
    return f"{100 * value:.2f} cm" if unit == "m" else f"{value:.4g} {unit}"


def _rejected(outcomes: Sequence[Outcome]) -> Iterator[str]:
    rejected = [(it.name, it.rejection, it.message) for it in outcomes if it.rejection]
    if rejected:
        yield "<h2>What was rejected</h2>"
        yield from _table(("photograph", "reason", "in words"), rejected)


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    cells = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    body = ("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return [f'<div class="wide"><table><thead><tr>{cells}</tr></thead><tbody>', *body, "</tbody></table></div>"]
