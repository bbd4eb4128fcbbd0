"""What the report draws: reliability, errors beside claims, risk against coverage."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import bdtr

from mapless_tools.evaluate.svg import Axis, Chart, Curve, log_range

from .claims import Claim
from .findings import DIAGRAM, Findings, reliability

SMALLEST_CM, SMALLEST_DEG = 0.01, 0.001
"""Errors below are not told apart: no ground truth is that good."""


def charts_of(found: Findings, unit: str) -> list[Chart]:
    """All charts of what was found; a length is in centimetres where `unit` is "m", else in the folder's unit."""
    length = ("cm", 100.0) if unit == "m" else (unit, 1.0)
    charts = []
    for kind, (name, factor), smallest in (
        ("position", length, SMALLEST_CM),
        ("rotation", ("°", 1.0), SMALLEST_DEG),
    ):
        claims = getattr(found.sample, kind)
        if claims:
            after = getattr(found.after, kind) if found.after else ()
            charts += [_reliability(kind, claims, after), _beside(kind, claims, name, factor, smallest)]
    return charts + _risk(found)


def _reliability(kind: str, claims: Sequence[Claim], after: Sequence[Claim]) -> Chart:
    curves = [Curve("as claimed", _per_cent(reliability(claims)))]
    if after:
        curves.append(Curve("with the factors of all others", _per_cent(reliability(after))))
    curves.append(Curve("exactly right", ((0.0, 0.0), (100.0, 100.0)), from_paper=True))
    for name, tail in (("by chance, at least", 0.025), ("by chance, at most", 0.975)):
        shares = tuple((100 * p, 100 * _chance(len(claims), p, tail)) for p in DIAGRAM)
        curves.append(Curve(name, shares, from_paper=True))
    return Chart(
        f"Reliability of the {kind}'s radii",
        Axis("claimed: the truth is within, %", 0, 100),
        Axis("it was, % of answers", 0, 100),
        tuple(curves),
    )


def _chance(count: int, probability: float, tail: float) -> float:
    """Quantile of the share of claims that hold if each does with a probability."""
    return float(np.searchsorted(bdtr(np.arange(count + 1), count, probability), tail)) / count


def _beside(kind: str, claims: Sequence[Claim], unit: str, factor: float, smallest: float) -> Chart:
    points = tuple((factor * claim.radius_95, max(factor * claim.error, smallest)) for claim in claims)
    low, high = log_range([value for point in points for value in point], smallest)
    axes = Axis(f"claimed 95 % radius, {unit}", low, high, True), Axis(f"error, {unit}", low, high, True)
    exact = Curve("equal: below it holds", ((low, low), (high, high)), from_paper=True)
    return Chart(f"Errors of the {kind} beside their claims", *axes, (exact, Curve("answers", points, joined=False)))


def _risk(found: Findings) -> list[Chart]:
    if not found.trusted:
        return []
    points = tuple((100 * point.coverage, 100 * point.risk) for point in found.trusted)
    top = max(5.0, min(100.0, 1.2 * max(risk for _, risk in points)))
    axes = Axis("right answers accepted, %", 0, 100), Axis("wrong ones among the accepted, %", 0, top)
    return [Chart("Accepting answers from the highest trust down", *axes, (Curve("by trust", points, marked=True),))]


def _per_cent(points: Sequence[tuple[float, float]]) -> tuple[tuple[float, float], ...]:
    return tuple((100 * x, 100 * y) for x, y in points)
