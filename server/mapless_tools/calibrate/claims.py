"""A claim beside the truth: how large the error is, and how large the radii for any probability were said to be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapless.geometry import Array
from mapless_server.method.uncertainty.accuracy import error_radii

LEVELS = np.concatenate([[0.005], np.arange(1, 100) / 100, [0.995, 0.999]])
"""Probabilities for which radii are known; between them they are interpolated."""


@dataclass(frozen=True, eq=False)
class Claim:
    """An error and what was claimed of it, in one unit.

    Attributes:
        error: distance to the truth.
        radius_68, radius_95: claimed not to be exceeded with this probability.
        radii: (L,) the same for `LEVELS`, never falling.
    """

    error: float
    radius_68: float
    radius_95: float
    radii: Array

    @classmethod
    def of(cls, error: float, radius_68: float, radius_95: float, covariance: Array) -> Claim:
        """From what an answer says.

        An answer states two radii and a covariance. The radius for another probability p is the covariance's
        (`error_radii`) times what the stated ones are of the covariance's own: exactly at 68 and 95 %, linear in p
        between, constant beyond.

        Args:
            error: distance to the truth.
            radius_68: the stated one, the unit of `error`.
            radius_95: likewise.
            covariance: (3, 3), the unit of `error`, squared.
        """
        at = (0.68, 0.95)
        own = error_radii(covariance, LEVELS)
        stated = np.array([radius_68, radius_95]) / np.maximum(np.interp(at, LEVELS, own), np.finfo(float).tiny)
        return cls(error, radius_68, radius_95, np.maximum.accumulate(own * np.interp(LEVELS, at, stated)))

    def held(self, probability: float) -> bool:
        """Whether the truth lies within the radius for a probability, one of `LEVELS`' range."""
        return bool(self.error <= np.interp(probability, LEVELS, self.radii))

    def probability(self, length: Array) -> Array:
        """The claimed probability (N,) that the error does not exceed lengths (N,)."""
        radii, levels = np.concatenate([[0.0], self.radii]), np.concatenate([[0.0], LEVELS])
        return np.asarray(np.interp(length, radii, levels, right=1.0), float)

    def times(self, factor_68: float, factor_95: float) -> Claim:
        """The claim with its radii multiplied, as an answer's are (`scaled_accuracy`); between, linear in p."""
        factors = np.interp(LEVELS, (0.68, 0.95), (factor_68, factor_95))
        radius_68 = factor_68 * self.radius_68
        return Claim(
            self.error,
            radius_68,
            max(radius_68, factor_95 * self.radius_95),
            np.maximum.accumulate(factors * self.radii),
        )
