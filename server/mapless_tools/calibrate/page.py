"""The report as one HTML file, with its charts: reliability, errors beside claims, risk against coverage."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from scipy.special import bdtrik

from mapless_tools.charts import figure_of, inline_svg, new_axes, plot, use_logarithms
from mapless_tools.pages import render

from .claims import Claim
from .findings import DIAGRAM, Findings, reliability
from .queries import Outcome
from .report import COLUMNS, RULES, CalibrationReport, held_rows, worst

SMALLEST_CM, SMALLEST_DEG = 0.01, 0.001
"""Smaller errors are drawn as these: no ground truth is that good."""


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


def charts_of(found: Findings, unit: str) -> list[Figure]:
    """All charts of what was found; a length is in centimetres where `unit` is "m", else in the folder's unit."""
    length_unit, per_unit = ("cm", 100.0) if unit == "m" else (unit, 1.0)
    figures = []
    for kind, kind_unit, factor, smallest in (
        ("position", length_unit, per_unit, SMALLEST_CM),
        ("rotation", "°", 1.0, SMALLEST_DEG),
    ):
        claims = getattr(found.sample, kind)
        if claims:
            calibrated = getattr(found.after, kind) if found.after else ()
            figures += [
                _reliability(kind, claims, calibrated),
                _beside_claims(kind, claims, kind_unit, factor, smallest),
            ]
    return [*figures, _risk(found)] if found.trusted else figures


def _reliability(kind: str, claims: Sequence[Claim], calibrated: Sequence[Claim]) -> Figure:
    title = f"Reliability of the {kind}'s radii"
    axes = new_axes(title, "claimed: the truth is within, %", "it was, % of answers")
    axes.set(xlim=(0, 100), ylim=(0, 100))
    for label, its in (("as claimed", claims), ("with the factors of all others", calibrated)):
        if its:
            plot(axes, label, *(100 * np.transpose(reliability(its))))
    plot(axes, "exactly right", (0, 100), (0, 100), dotted=True)
    probabilities, count = np.array(DIAGRAM), len(claims)
    for label, tail in (("by chance, at least", 0.025), ("by chance, at most", 0.975)):
        shares = np.ceil(bdtrik(tail, count, probabilities)) / count
        plot(axes, label, (100 * probabilities).tolist(), (100 * shares).tolist(), dotted=True)
    return figure_of(axes)


def _beside_claims(kind: str, claims: Sequence[Claim], unit: str, factor: float, smallest: float) -> Figure:
    radii = [max(factor * claim.radius_95, smallest) for claim in claims]
    errors = [max(factor * claim.error, smallest) for claim in claims]
    title = f"Errors of the {kind} beside their claims"
    axes = new_axes(title, f"claimed 95 % radius, {unit}", f"error, {unit}")
    use_logarithms(axes.xaxis, axes.yaxis)
    axes.scatter(radii, errors, s=12, label="answers")
    ends = (min(*radii, *errors), max(*radii, *errors))
    plot(axes, "equal: below it holds", ends, ends, dotted=True)
    return figure_of(axes)


def _risk(found: Findings) -> Figure:
    title = "Accepting answers from the highest trust down"
    axes = new_axes(title, "right answers accepted, %", "wrong ones among the accepted, %")
    coverage, risk = (100 * np.transpose([(point.coverage, point.risk) for point in found.trusted])).tolist()
    axes.set(xlim=(0, 100), ylim=(0, max(5.0, min(100.0, 1.2 * max(risk)))))
    plot(axes, "by trust", coverage, risk, marker="o")
    return figure_of(axes)
