"""Radii of a pose: errors that are not exceeded with a probability, by its covariance."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gammaincinv

from mapless.geometry import Array

TAIL_95 = 1.51
"""Factor on the radius of 95 %, for heavy tails; the covariance is right at 68 %. From `research.radii`."""


@dataclass(frozen=True)
class Accuracy:
    """Radii: errors not exceeded in 68 and 95 % of cases."""

    position_68_m: float
    position_95_m: float
    rotation_68_deg: float
    rotation_95_deg: float


def accuracy_from_covariance(covariance: Array) -> Accuracy:
    """Radii of a pose's covariance (6, 6): order x y z rx ry rz, metres and radians."""
    shares = np.array([0.68, 0.95])
    position_68_m, position_95_m = error_radii(covariance[:3, :3], shares).tolist()
    rotation_68, rotation_95 = error_radii(covariance[3:, 3:], shares).tolist()
    return Accuracy(
        position_68_m=position_68_m,
        position_95_m=TAIL_95 * position_95_m,
        rotation_68_deg=math.degrees(rotation_68),
        rotation_95_deg=TAIL_95 * math.degrees(rotation_95),
    )


def error_radii(covariance: Array, probabilities: ArrayLike) -> Array:
    """Lengths (P,) that a zero-mean normal vector with this covariance (n, n) does not exceed with probabilities (P,).

    The squared length is a sum of chi-squares weighted by the eigenvalues, approximated by one scaled chi-square with
    the same mean and variance (Satterthwaite). Exact if all eigenvalues are equal or all but one vanish, else within
    4 %.
    """
    probabilities = np.asarray(probabilities, float)
    eigenvalues = np.linalg.eigvalsh(covariance).clip(min=0)
    total = float(eigenvalues.sum())
    if total <= 0:
        return np.zeros(len(probabilities))
    scale = float((eigenvalues**2).sum()) / total
    degrees_of_freedom = total / scale
    return np.asarray(np.sqrt(2 * scale * gammaincinv(degrees_of_freedom / 2, probabilities)), float)
