"""The report as one HTML file."""

from __future__ import annotations

from mapless_tools.charts import inline_svg
from mapless_tools.pages import render

from .charts import charts_of
from .queries import Outcome
from .report import COLUMNS, RULES, CalibrationReport, held_rows, worst


def page(report: CalibrationReport) -> str:
    """The report."""
    return render(
        "calibration.html",
        title=f"Calibration of mapless: {report.title}",
        report=report,
        columns=COLUMNS,
        held=held_rows(report),
        svgs=map(inline_svg, charts_of(report.found, report.unit)),
        exceeding=[_row(it, report.unit) for it in worst(report)],
        rejected=[(it.name, it.rejection, it.message) for it in report.found.outcomes if it.rejection],
        rules=RULES,
    )


def _row(it: Outcome, unit: str) -> tuple[str, ...]:
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
