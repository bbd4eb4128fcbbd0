"""The model: from references that were localized against the others to the radii and the trust of answers.

A reference's result is its error by the radii that its answer claims, and the trust of the answer. Right answers only
count: what judges the others is trust, and a reference whose own pose is wrong gives no right answer, so that it
changes nothing here (the audit names it). What is right is a share of the distance and an angle, whatever the unit.

Errors of answers grow faster with the distance to the references than radii do, and a reference that is left out is
farther from the others than a query is. So ratios are compared at one gap g (distance to the nearest reference by the
depth of what is seen): ln ratio = a + b ln g, with b from scenes with known poses, a of the scene. The factor of an
answer is that at its own gap (`method.uncertainty.gap`).

With n answers a factor is n / (n + n0) of what they say, in logarithms, as if n0 more answers had needed the factor 1
of the generic radii. The quantiles of trust are those of the n answers and of n0 answers whose trust is distributed as
it is elsewhere, uniformly. All n0 were chosen by leaving whole scenes out (`research.self_calibration`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass

import numpy as np

from mapless.geometry import Array
from mapless.scenes import MAX_FACTOR, MIN_FACTOR
from mapless_server.method.options import check_bounds
from mapless_server.method.trust.judge import LEVELS
from mapless_server.method.uncertainty.gap import growth
from mapless_server.method.uncertainty.radii import Accuracy
from mapless_server.store import SelfCalibration

RIGHT_SHARE, RIGHT_DEG = 0.05, 5.0
"""A right answer is off by at most this share of the distance to what the photograph shows, and these degrees."""

_MEDIAN_RATIO = 0.78
"""Median of the length of a normal error in two or three directions, by its quantile at 68 %."""


@dataclass(frozen=True)
class FitOptions:
    """Options of the model.

    Attributes:
        radius_prior: n0 of the factors of 68 %.
        tail_prior: n0 of what 95 % needs beyond 68 %.
        trust_prior: n0 of the quantiles of trust.
        least_answers: with fewer right answers, nothing is known of the scene.
    """

    radius_prior: float = 12.0
    tail_prior: float = 30.0
    trust_prior: float = 20.0
    least_answers: int = 3

    def __post_init__(self) -> None:
        check_bounds(self, "radius_prior tail_prior trust_prior", above=0)
        check_bounds(self, "least_answers", at_least=1)


@dataclass(frozen=True)
class LeftOut:
    """The answer to a reference that was localized against the others.

    Attributes:
        error_m, error_deg: difference to its given pose.
        claimed: radii, generic.
        trust: of the answer, generic.
        gap: distance of the answer to its nearest reference by the depth of what it sees.
        depth_m: that depth.
    """

    error_m: float
    error_deg: float
    claimed: Accuracy
    trust: float
    gap: float
    depth_m: float

    @property
    def is_right(self) -> bool:
        """Whether the answer is near enough to the given pose."""
        return self.error_m <= RIGHT_SHARE * self.depth_m and self.error_deg <= RIGHT_DEG


def fit(results: Sequence[LeftOut], kind: str, generation: int, options: FitOptions | None = None) -> SelfCalibration:
    """The calibration of a scene; without enough right answers it changes nothing.

    Args:
        results: of the references that gave an answer.
        kind: of the answers.
        generation: of the scene.
        options: see there.
    """
    options = options or FitOptions()
    right = [it for it in results if it.is_right]
    if len(right) < options.least_answers:
        return SelfCalibration(kind, generation, 0)
    grown = np.array([growth(it.gap) for it in right])
    claimed = np.array([astuple(it.claimed) for it in right])
    position = _factors(np.array([[it.error_m] for it in right]) / claimed[:, :2] / grown[:, :1], options)
    rotation = _factors(np.array([[it.error_deg] for it in right]) / claimed[:, 2:] / grown[:, 1:], options)
    wrong = [it.trust for it in results if not it.is_right]
    quantiles = _trust_quantiles(np.array([it.trust for it in right]), max(wrong, default=0.0), options)
    return SelfCalibration(kind, generation, len(right), *position, *rotation, tuple(quantiles.tolist()))


def _factors(ratios: Array, options: FitOptions) -> tuple[float, float]:
    """Factors of the radii of 68 and 95 %, from the ratios (N, 2) of errors to both."""
    count = len(ratios)
    logs = np.log(np.clip(ratios, MIN_FACTOR, MAX_FACTOR))
    # Two quantiles, because one of few is rough; of a distribution as claimed the median ratio is 0.78.
    at_68 = float(np.mean(np.quantile(logs[:, 0], (0.5, 0.68)) - np.log((_MEDIAN_RATIO, 1.0))))
    at_95 = float(np.quantile(logs[:, 1], 0.95)) - at_68
    factor_68 = count / (count + options.radius_prior) * at_68
    factor_95 = factor_68 + count / (count + options.tail_prior) * at_95
    bounded = np.exp(np.clip((factor_68, factor_95), np.log(MIN_FACTOR), np.log(MAX_FACTOR)))
    return float(bounded[0]), float(bounded[1])


def _trust_quantiles(right: Array, highest_wrong: float, options: FitOptions) -> Array:
    """Quantiles of the generic trust of the scene's right answers at `LEVELS`.

    Never above the generic ones: references are often taken on one walk, and do not show how much harder photographs
    from elsewhere are. Nor so low that a wrong answer of the scene's own would be accepted that otherwise is not.
    """
    trust = np.linspace(0, 1, 1001)
    of_scene = np.searchsorted(np.sort(right), trust, side="right") / len(right)
    share = (len(right) * of_scene + options.trust_prior * trust) / (len(right) + options.trust_prior)
    quantiles = trust[np.searchsorted(share, np.array(LEVELS) - 1e-12)]
    levels = np.array(LEVELS)
    return np.clip(quantiles, np.minimum(levels, highest_wrong), levels)
