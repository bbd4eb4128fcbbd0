"""The report of a calibration for people (a table, and one HTML file with charts) and for programs (JSON)."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table
from scipy.special import bdtrik

from mapless_server import __version__
from mapless_tools.charts import figure_of, inline_svg, new_axes, plot, use_logarithms
from mapless_tools.dataset import Dataset
from mapless_tools.output_files import finite, render

from .claims import MIN_QUERIES, PRIOR_QUERIES, Claim
from .findings import DIAGRAM, Findings, RightRule, Share, reliability
from .queries import Outcome

RULES = (
    "Shares are of answers that have a pose and radii, right and wrong ones; with the interval in which the true share "
    "lies with 95 % confidence (Clopper and Pearson). Photographs of one walk resemble each other, so they say less "
    "than as many of different places.",
    "Errors are distances to the poses of the folder, so whatever these are off by is in them.",
    f"A factor is where the distribution of error / radius reaches the stated probability; that of n answers is mixed "
    f"with {PRIOR_QUERIES:g} of answers that are as claimed, so that few answers say little. Fewer than {MIN_QUERIES} "
    "calibrate nothing.",
    "Dotted in the diagrams: what exactly right claims would show, and how far from that chance alone leads with so "
    "many answers, in 95 % of cases at each probability.",
    "With the factors of all others: each answer with those that all others give, so that none is judged by itself.",
    "Radii for other probabilities than 68 and 95 % are the covariance's, times what the stated radii are of its own: "
    "exactly at both, linear between, constant beyond.",
    "Trust is shown of the answers that were given; what the server rejected is counted by its reason alone.",
)


@dataclass(frozen=True, eq=False)
class CalibrationReport:
    """The figures of a calibration, and what they were measured on; the scene is empty if the folder alone was."""

    dataset: Dataset
    scene: str
    references: int
    count: int
    right: RightRule
    stored: str
    found: Findings

    @property
    def unit(self) -> str:
        """Unit of lengths; the metre for a stored scene."""
        return "m" if self.dataset.metric or self.scene else "units"

    @property
    def title(self) -> str:
        """The scene or the folder."""
        return f"scene {self.scene}, on {self.dataset.name}" if self.scene else self.dataset.name

    def facts(self) -> dict[str, str]:
        """What the figures were measured on, by name."""
        found, conditions = self.found, self.found.conditions
        answered = sum(it.pose is not None for it in found.outcomes)
        return {
            "photographs": f"{len(found.outcomes)} of {self.dataset.name}",
            "references": f"{self.references}, {self.count} a query; no photograph is compared with itself",
            "answered": f"{answered} of {len(found.outcomes)}",
            "rejected": ", ".join(f"{count} {reason}" for reason, count in found.rejections.items()) or "none",
            "right answers": f"{share_text(found.right)} within {self.right.position_m:g} {self.unit} and "
            f"{self.right.rotation_deg:g}°",
            "trust": trust_text(found),
            "computed by": "-"
            if conditions is None
            else f"{conditions.variant.lower()}; {conditions.backend}, {conditions.features}; mapless {__version__}"
            + (f"; {found.others} answers came from {_others(found)} and are left out" if found.others else ""),
            "ground truth": self.dataset.ground_truth or self.dataset.source or "not named",
            "calibration": self.stored,
        }


def _others(found: Findings) -> str:
    """What the answers that are left out were computed by, where that differs from the majority's."""
    if found.conditions is None:
        return "a computation without radii"
    majority = asdict(found.conditions)
    different = {
        f"other {name.replace('_', ' ')} ({value})"
        for it in found.outcomes
        if it.pose is not None and it.conditions is not None
        for name, value in asdict(it.conditions).items()
        if value != majority[name]
    }
    return " and ".join(sorted(different)) or "a computation without radii"


def share_text(share: Share) -> str:
    """Text of a share: per cent, count, and interval."""
    if not share.whole:
        return "-"
    return (
        f"{100 * share.value:.1f} % ({share.part} of {share.whole}; {100 * share.low:.0f} to {100 * share.high:.0f} %)"
    )


def trust_text(found: Findings) -> str:
    """Text on how well trust separates right from wrong answers."""
    if not found.right.whole:
        return "nothing was answered"
    if not found.trusted:
        return "answers have none"
    if math.isnan(found.auroc):
        return "nothing to separate: all answers are right" if found.right.part else "no answer is right"
    return f"a right answer has more of it than a wrong one in {100 * found.auroc:.1f} % of pairs (AUROC)"


def held_rows(report: CalibrationReport) -> Iterator[tuple[str, ...]]:
    """A row for each radius, cells as in `COLUMNS`."""
    for it in report.found.held:
        yield (
            f"{it.claim}, {100 * it.probability:.0f} %",
            share_text(it.before),
            "-" if it.factor is None else f"{it.factor:.2f}",
            "-" if it.after is None else share_text(it.after),
        )


COLUMNS = ("radius", "held, as claimed", "factor", "with the factors of all others")


def worst(report: CalibrationReport) -> list[Outcome]:
    """The ten answers that exceed a claimed 95 % radius by most, these first."""
    answered = [it for it in report.found.outcomes if it.position is not None and it.rotation is not None]
    return sorted((it for it in answered if _excess(it) > 1), key=lambda it: -_excess(it))[:10]


def print_report(report: CalibrationReport, console: Console) -> None:
    """Prints the figures."""
    table = Table("", "", title=report.title, show_header=False, title_justify="left")
    for name, value in report.facts().items():
        table.add_row(name, value)
    console.print(table, highlight=False, markup=False)
    shares = Table(*COLUMNS)
    for row in held_rows(report):
        shares.add_row(*row)
    console.print(shares, highlight=False, markup=False)


def to_json(report: CalibrationReport) -> dict[str, Any]:
    """Everything as JSON values; infinite and unknown ones are null."""
    found = report.found
    return {
        "folder": report.dataset.name,
        "scene": report.scene or None,
        "metric": report.unit == "m",
        "ground_truth": report.dataset.ground_truth or report.dataset.source,
        "version": __version__,
        "references": report.references,
        "k": report.count,
        "photographs": len(found.outcomes),
        "computed_by": asdict(found.conditions) if found.conditions else None,
        "left_out": found.others,
        "rejections": dict(found.rejections),
        "factors": asdict(found.factors) if found.factors else None,
        "refusal": found.refusal,
        "stored": report.stored,
        "held": [
            asdict(it) | {"before": _share(it.before), "after": it.after and _share(it.after)} for it in found.held
        ],
        "reliability": {kind: _reliability(report, kind) for kind in ("position", "rotation")},
        "right": asdict(report.right) | _share(found.right),
        "auroc": finite(found.auroc),
        "risk_coverage": [asdict(point) for point in found.trusted],
        "rules": [*RULES],
        "per_query": [_query(it, report.unit) for it in found.outcomes],
    }


def _excess(outcome: Outcome) -> float:
    claims = [claim for claim in (outcome.position, outcome.rotation) if claim]
    return max(claim.error / max(claim.radius_95, 1e-300) for claim in claims)


def _share(share: Share) -> dict[str, Any]:
    return asdict(share) | {"share": finite(share.value)}


def _reliability(report: CalibrationReport, kind: str) -> dict[str, Any]:
    found = report.found
    before, after = getattr(found.sample, kind), getattr(found.after, kind) if found.after else ()
    return {"before": reliability(before) if before else [], "after": reliability(after) if after else []}


def _query(it: Outcome, unit: str) -> dict[str, Any]:
    position, rotation = it.position, it.rotation
    return {
        "name": it.name,
        f"error_{unit}": finite(it.error_m),
        "error_deg": finite(it.error_deg),
        f"claimed_68_{unit}": position.radius_68 if position else None,
        f"claimed_95_{unit}": position.radius_95 if position else None,
        "claimed_68_deg": rotation.radius_68 if rotation else None,
        "claimed_95_deg": rotation.radius_95 if rotation else None,
        "trust": it.trust,
        "inliers": it.inlier_count,
        "matches": it.match_count,
        "rejection": {"reason": it.rejection, "message": it.message} if it.rejection else None,
        "features": it.conditions.features if it.conditions else None,
    }


SMALLEST_CM, SMALLEST_DEG = 0.01, 0.001
"""Smaller errors are drawn as these: no ground truth is that good."""


def page(report: CalibrationReport) -> str:
    """The HTML page of the report."""
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
    """All charts of the findings; lengths are in centimetres if `unit` is "m", else in the folder's unit."""
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
                _reliability_chart(kind, claims, calibrated),
                _beside_claims(kind, claims, kind_unit, factor, smallest),
            ]
    return [*figures, _risk(found)] if found.trusted else figures


def _reliability_chart(kind: str, claims: Sequence[Claim], calibrated: Sequence[Claim]) -> Figure:
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
