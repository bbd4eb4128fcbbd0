"""How surely something contradicts intrinsics: one bound for all that accuse a camera, of a query or of references.

Under the null hypothesis the intrinsics are right, and a statistic z of mean 0 and standard deviation 1 exceeds a value
with a chance of at most exp(-z^2 / 2): for a normal variable, and for z = sum d / sqrt(sum d^2) of differences d whose
signs are arbitrary (Hoeffding 1963). Of `tested` alternatives, of which the best one is reported, each could have been
the one: the expected number of false accusations is tested exp(-z^2 / 2).

What intrinsics are accused by, and of how many alternatives:

    an estimated error of a parameter, times `HEAVY_TAIL`            4 parameters        `bundle.intrinsics`
    what a pose of another camera gains, keypoint by keypoint        cameras tried       `judge.cameras`, `judge.hints`
    the focal length that a reference's neighbours give              1                   `scenes.audit.comparison`

So are the poses of photographs of which too many pairs are bad (`pairs.readings.verdict`).
"""

import math

import numpy as np

from mapless.geometry import Array

MAX_LOG10_CHANCE = -4.0
"""Largest log10 of the expected number of accusations of what is right by one test. Evidence: accusation-chance."""

HEAVY_TAIL = 1.47
"""Factor on the standard deviations of estimated errors, which are right at 68 %: the tails are heavier than those of a
normal distribution, as those of radii (`estimate.TAIL_95`). For one parameter of four the bound is 6.77 of them.
Evidence: accusation-chance."""


def log10_chance(sigmas: float, tested: int) -> float:
    """log10 of an upper bound of the expected number of `tested` right values that seem off by as many sigmas."""
    return math.log10(tested) - max(sigmas, 0.0) ** 2 / 2 * math.log10(math.e)


def is_significant(sigmas: float, tested: int) -> bool:
    """Whether right intrinsics would not seem wrong by so many standard deviations."""
    return log10_chance(sigmas, tested) <= MAX_LOG10_CHANCE


def least_sigmas(tested: int) -> float:
    """From how many standard deviations on the best of `tested` alternatives is significant."""
    return math.sqrt(2 * (math.log10(tested) - MAX_LOG10_CHANCE) / math.log10(math.e))


def sigmas_of_gains(gains: Array) -> float:
    """The statistic of differences (N,) that are as often positive as negative under the null hypothesis; 0 if none."""
    length = float(np.linalg.norm(gains))
    return float(gains.sum()) / length if length > 0 else 0.0
