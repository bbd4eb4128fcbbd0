"""Claimed radii compared with the truth, and the factors that correct them, from few photographs.

The ratio of an error to the radius that was claimed for probability p should be below 1 with probability p. The factor
is the value below which it is with probability p, estimated from the ratios of n answers. With few answers a sample
quantile says little, least of all for 95 %; so the claims themselves count as m = `PRIOR_QUERIES` further answers,
whose ratios are distributed as claimed: their p-quantile is 1. That is the predictive distribution of a Dirichlet
process whose base is the claim (Ferguson 1973),

    P(ratio <= f) = (n F_n(f) + m F_0(f)) / (n + m),

and the factor is where it reaches p. F_n is the conformal one (Vovk, Gammerman and Shafer 2005): k / (n + 1) at the
k-th smallest ratio, so that the next answer is within the factor as often as stated even if nothing is known but the n
answers; what remains beyond the largest ratio is spread up to twice the largest.

A mixture, and not a factor drawn towards 1: where claims are far too small, most ratios lie where the prior has nothing
more to say, and the factor follows them; where they are too large the prior holds it back. Its errors are on the safe
side. Simulated with normal and with heavy-tailed errors and claims of a third, once and three times the truth, the
calibrated radii of answers not seen held 94 to 100 % (95 % radius) and 57 to 86 % (68 %) after 10 answers, 95 to 100 %
and 64 to 76 % after 26, 95 or 96 % and 67 to 69 % after 150, where the claims' own 68 % radius held 6 to 100 %.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapless.geometry import Array
from mapless.scenes import MAX_FACTOR, MIN_FACTOR
from mapless_server.method.bundle.estimate import error_radii
from mapless_server.services.messages.radii import Factors

LEVELS = np.concatenate([[0.005], np.arange(1, 100) / 100, [0.995, 0.999]])
"""Probabilities for which radii are known; between them they are interpolated."""
PRIOR_QUERIES = 3.0
"""m. With 5, in the same simulation, the 68 % radius held 53 to 97 % after 10 answers and 62 to 79 % after 26."""
MIN_QUERIES = 10
"""With fewer, one photograph more or less changes the share within the 68 % radius by more than 10 %, which is all that
a calibration is for."""
_TRIED = np.exp(np.linspace(np.log(MIN_FACTOR), np.log(MAX_FACTOR), 2305))
"""Factors that are tried: steps of half a per cent."""


@dataclass(frozen=True, eq=False)
class Claim:
    """An error and the radii claimed for it, in one unit; `radii` (L,) are those of the probabilities `LEVELS`."""

    error: float
    radius_68: float
    radius_95: float
    radii: Array

    @classmethod
    def of(cls, error: float, radius_68: float, radius_95: float, covariance: Array) -> "Claim":
        """Makes the claim of an answer, which states two radii and a covariance (3, 3), in the unit of `error`.

        The radius for another probability p is the covariance's (`error_radii`) times what the stated ones are of the
        covariance's own: exactly at 68 and 95 %, linear in p between, constant beyond.
        """
        at = (0.68, 0.95)
        own = error_radii(covariance, LEVELS)
        stated = np.array([radius_68, radius_95]) / np.maximum(np.interp(at, LEVELS, own), np.finfo(float).tiny)
        return cls(error, radius_68, radius_95, np.maximum.accumulate(own * np.interp(LEVELS, at, stated)))

    def held(self, probability: float) -> bool:
        """Whether the truth is within the radius for a probability in the range of `LEVELS`."""
        return bool(self.error <= np.interp(probability, LEVELS, self.radii))

    def probability(self, length: Array) -> Array:
        """The claimed probability (N,) that the error does not exceed lengths (N,)."""
        radii, levels = np.concatenate([[0.0], self.radii]), np.concatenate([[0.0], LEVELS])
        return np.asarray(np.interp(length, radii, levels, right=1.0), float)

    def times(self, factor_68: float, factor_95: float) -> "Claim":
        """The claim with its radii multiplied, as in `scaled_accuracy`; linear in the probability in between."""
        factors = np.interp(LEVELS, (0.68, 0.95), (factor_68, factor_95))
        radius_68 = factor_68 * self.radius_68
        return Claim(
            self.error,
            radius_68,
            max(radius_68, factor_95 * self.radius_95),
            np.maximum.accumulate(factors * self.radii),
        )


class TooFewQueries(ValueError):
    """There are too few answers to calibrate from; the message says how many."""


@dataclass(frozen=True, eq=False)
class Sample:
    """Claims of position (metres) and rotation (degrees), in the same order."""

    position: tuple[Claim, ...]
    rotation: tuple[Claim, ...]

    def __post_init__(self) -> None:
        if len(self.position) != len(self.rotation):
            raise ValueError(f"{len(self.position)} positions, {len(self.rotation)} rotations")

    def __len__(self) -> int:
        return len(self.position)

    def times(self, factors: Factors) -> "Sample":
        """The sample with its radii multiplied."""
        return Sample(
            tuple(it.times(factors.position_68, factors.position_95) for it in self.position),
            tuple(it.times(factors.rotation_68, factors.rotation_95) for it in self.rotation),
        )


def fit_factors(sample: Sample) -> Factors:
    """Fits the factors of a sample; TooFewQueries if it is too small."""
    if len(sample) < MIN_QUERIES:
        raise TooFewQueries(
            f"{len(sample)} answers are too few to calibrate from, {MIN_QUERIES} are needed: with fewer, chance decides"
        )
    return Factors(*_pair(sample.position), *_pair(sample.rotation))


def left_one_out(sample: Sample) -> Sample:
    """Multiplies each claim by the factors from all others, as for a photograph that was not used to calibrate."""
    return Sample(_left_one_out(sample.position), _left_one_out(sample.rotation))


def factor_for(claims: Sequence[Claim], probability: float) -> float:
    """The factor for the radius of a probability, 0.68 or 0.95; 1 without claims."""
    ratios, claimed = _table(claims, probability)
    return _factor(ratios, claimed.mean(axis=0), probability) if claims else 1.0


def _pair(claims: Sequence[Claim]) -> tuple[float, float]:
    """Factors for 68 and 95 %; the latter is so large that no answer's 95 % radius becomes the smaller one."""
    factor_68, factor_95 = (factor_for(claims, p) for p in (0.68, 0.95))
    narrowest = max(claim.radius_68 / max(claim.radius_95, np.finfo(float).tiny) for claim in claims)
    return factor_68, min(max(factor_95, factor_68 * narrowest), MAX_FACTOR)


def _left_one_out(claims: Sequence[Claim]) -> tuple[Claim, ...]:
    if len(claims) < 2:
        return tuple(claims)
    factors = []
    for probability in (0.68, 0.95):
        ratios, claimed = _table(claims, probability)
        others = (claimed.sum(axis=0) - claimed) / (len(claims) - 1)
        factors.append([_factor(np.delete(ratios, i), others[i], probability) for i in range(len(claims))])
    return tuple(claim.times(*pair) for claim, *pair in zip(claims, *factors, strict=True))


def _table(claims: Sequence[Claim], probability: float) -> tuple[Array, Array]:
    """Ratios (n,) of errors to radii, and the probability (n, G) that each claim gives to the tried ratios."""
    radii = np.array([claim.radius_68 if probability == 0.68 else claim.radius_95 for claim in claims])
    radii = np.maximum(radii, np.finfo(float).tiny)
    claimed = [claim.probability(_TRIED * radius) for claim, radius in zip(claims, radii, strict=True)]
    return np.array([claim.error for claim in claims]) / radii, np.reshape(claimed, (len(claims), len(_TRIED)))


def _factor(ratios: Array, claimed: Array, probability: float) -> float:
    """The ratio at which the predictive distribution reaches a probability; ratios (n,), mean claims (G,)."""
    count = len(ratios)
    predictive = (count * _empirical(np.sort(ratios)) + PRIOR_QUERIES * claimed) / (count + PRIOR_QUERIES)
    reached = np.flatnonzero(predictive >= probability)
    return float(_TRIED[reached[0]]) if len(reached) else MAX_FACTOR


def _empirical(ratios: Array) -> Array:
    """The conformal distribution (G,) of sorted ratios (n,): k / (n + 1) at the k-th, linear in between."""
    knots = np.concatenate([[0.0], ratios, [2 * ratios[-1]]])
    return np.interp(_TRIED, knots, np.arange(len(knots)) / (len(ratios) + 1))
