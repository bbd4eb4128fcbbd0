"""The model of self-calibration: from references localized against the others to radii and trust of answers.

A reference's result is its error beside the radius that its answer claims, and the trust of the answer. Only right
answers count: wrong ones are the subject of trust, and a reference whose own pose is wrong gives no right answer, so it
changes nothing here (the audit reports it). An answer is right within a share of the distance and an angle, independent
of the unit.

An error of position or angle is modelled as

    ln e = ln(median ratio x sqrt((f g^b r)^2 + s^2)) + normal noise of standard deviation c,

r the claimed radius, f the factor of the scene, s the errors of the references' own poses, which no answer is free of
and which do not shrink with its radius, and g the gap: errors grow faster with the distance to the references than
radii do, and a reference that is left out is farther from the others than a query is. b comes from scenes with known
poses. f and s are means of the posterior on a grid. The prior of f is log-normal about 1, the generic radii, that of s
half-normal; both have the spread between scenes (empirical Bayes: Efron and Morris 1975). So few answers are shrunk
towards the generic radii, and the same equation serves the first few and the many of idle time.

What few answers leave open widens radii: with the variance V of ln sqrt(f^2 + s^2) in the posterior, ln e of the next
answer has the variance c^2 + V, and the radius of a share p is exp(z_p (sqrt(c^2 + V) - c)) times as large, z_p the
quantile of the normal distribution.

The quantiles of trust are those of the n answers and of n0 = `trust_prior` answers whose trust is distributed as it is
elsewhere, uniformly. Factors that `mapless-server evaluate --calibrate` measures on photographs with known poses are
fitted alike, without quantiles of trust. Priors are chosen by leaving whole scenes out.
"""

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass

import numpy as np

from mapless.geometry import Array
from mapless_server.bounds import check_bounds
from mapless_server.method.bundle.estimate import SELF_TAIL_95, TAIL_95, Accuracy, growth
from mapless_server.method.judge.judge import LEVELS
from mapless_server.store import SelfCalibration

RIGHT_SHARE, RIGHT_DEG = 0.05, 5.0
"""A right answer is off by at most this share of the distance to what the photograph shows, and these degrees."""

_FACTORS = np.exp(np.linspace(np.log(0.15), np.log(6.0), 57))
_NOISES = np.array([0.0, 0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0, 1.3, 1.7, 2.2, 3.0, 4.0])
"""Values of f, and of s by the median radius, that are tried."""

_NORMAL_68, _NORMAL_95 = 0.468, 1.645
"""Quantiles of the normal distribution."""

_FARTHEST_LOG = 3.0
"""Standard deviations beyond which an error counts no more."""


@dataclass(frozen=True)
class FitOptions:
    """Options of the model.

    Attributes:
        median_ratio: median ratio of errors to their 68 % radius, if the radius is right.
        scatter: c, the standard deviation of the logarithm of this ratio; that of the length of a normal error.
        factor_log: standard deviation of ln f between scenes. Evidence: first-answers.
        noise_share: standard deviation of s, as a share of the median radius. Evidence: first-answers.
        trust_prior: n0 of the quantiles of trust.
        least_answers: with fewer right answers, the calibration changes nothing.
    """

    median_ratio: float = 0.76
    scatter: float = 0.65
    factor_log: float = 0.5
    noise_share: float = 0.9
    trust_prior: float = 20.0
    least_answers: int = 3

    def __post_init__(self) -> None:
        check_bounds(self, "median_ratio scatter factor_log noise_share trust_prior", above=0)
        check_bounds(self, "least_answers", at_least=1)


@dataclass(frozen=True)
class LeftOut:
    """The answer to a reference that was localized against the others.

    Attributes:
        error_m, error_deg: difference to its given pose.
        claimed: generic radii of the answer.
        trust: generic trust of the answer.
        gap: distance of the answer to its nearest reference, as a share of the depth that it sees.
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
    """Fits the calibration of a scene to answers of a kind; without enough right answers it changes nothing."""
    options = options or FitOptions()
    right = [it for it in results if it.is_right]
    if len(right) < options.least_answers:
        return SelfCalibration(kind, generation, 0)
    grown = np.array([growth(it.gap) for it in right])
    claimed = np.array([astuple(it.claimed) for it in right])
    position = _posterior(np.array([it.error_m for it in right]), claimed[:, 0], grown, options)
    rotation = _posterior(np.array([it.error_deg for it in right]), claimed[:, 2], grown, options)
    wrong = [it.trust for it in results if not it.is_right]
    quantiles = _trust_quantiles(np.array([it.trust for it in right]), max(wrong, default=0.0), options)
    return SelfCalibration(
        kind,
        generation,
        len(right),
        position.factor,
        rotation.factor,
        position.noise,
        rotation.noise,
        tuple(quantiles.tolist()),
        position_tail=position.tail,
        rotation_tail=rotation.tail,
    )


@dataclass(frozen=True)
class _Posterior:
    """Factor and noise for radii of 68 %, and the factor on the ratio of the radius of 95 % to it."""

    factor: float
    noise: float
    tail: float


def _posterior(error: Array, radius: Array, grown: Array, options: FitOptions) -> _Posterior:
    """F and s of errors (N,) with claimed radii (N,), at gaps that multiply the errors by `grown` (N,)."""
    unit = max(float(np.median(radius)), np.finfo(float).tiny)
    scaled = _FACTORS[:, None, None] * (radius * grown / unit)
    expected = options.median_ratio * np.hypot(scaled, _NOISES[:, None])  # (F, S, N)
    off = (np.log(np.maximum(error / unit, 1e-9)) - np.log(np.maximum(expected, 1e-9))) / options.scatter
    likelihood = -0.5 * np.minimum(off**2, _FARTHEST_LOG**2).sum(axis=2)
    unusual = (np.log(_FACTORS)[:, None] / options.factor_log) ** 2 + (_NOISES / options.noise_share) ** 2
    posterior = likelihood - 0.5 * unusual + np.log(np.gradient(_NOISES))  # the steps of s are not even
    weight = np.exp(posterior - posterior.max())
    weight /= weight.sum()
    log_radius = np.log(np.hypot(_FACTORS[:, None], _NOISES))
    variance = float((weight * (log_radius - (weight * log_radius).sum()) ** 2).sum())
    wider = math.hypot(options.scatter, math.sqrt(variance)) - options.scatter
    at_68 = math.exp(_NORMAL_68 * wider)
    return _Posterior(
        at_68 * float(np.exp(weight.sum(axis=1) @ np.log(_FACTORS))),
        at_68 * float(weight.sum(axis=0) @ _NOISES) * unit,
        SELF_TAIL_95 / TAIL_95 * math.exp((_NORMAL_95 - _NORMAL_68) * wider),
    )


def _trust_quantiles(right: Array, highest_wrong: float, options: FitOptions) -> Array:
    """Quantiles of the generic trust of the scene's right answers at `LEVELS`.

    They are never above the generic ones: references are often taken on one walk, and do not show how much harder
    photographs from elsewhere are. Nor are they so low that a wrong answer in this scene would be accepted that is
    rejected otherwise.
    """
    trust = np.linspace(0, 1, 1001)
    of_scene = np.searchsorted(np.sort(right), trust, side="right") / len(right)
    share = (len(right) * of_scene + options.trust_prior * trust) / (len(right) + options.trust_prior)
    quantiles = trust[np.searchsorted(share, np.array(LEVELS) - 1e-12)]
    levels = np.array(LEVELS)
    return np.clip(quantiles, np.minimum(levels, highest_wrong), levels)
