"""Robust losses rho(s) of a squared residual s, with a scale c; both in standard deviations.

    loss       rho(s)                           weight rho'(s)
    Cauchy     c^2 log(1 + s / c^2)             1 / (1 + s / c^2)
    soft L1    2 c^2 (sqrt(1 + s / c^2) - 1)    1 / sqrt(1 + s / c^2)

Both are s for small s. For large s, soft L1 grows like the residual, and Cauchy's loss like its logarithm, so that the
influence of outliers vanishes. The weights are those of iteratively reweighted least squares: the gradient of a sum of
losses is 2 sum rho'(s) J^T r. (As in `scipy.optimize.least_squares`, with f_scale = c.)
"""

from __future__ import annotations

import numpy as np

from mapless.geometry import Array

from .arrays import AnyArray


def cauchy_cost(squared: Array, scale: float) -> float:
    """The sum of rho over squared residuals (N,); NaN if one is."""
    return float(scale**2 * np.log1p(squared / scale**2).sum())


def cauchy_weight(squared: Array, scale: float) -> Array:
    """Weights rho' (N,)."""
    return np.asarray(1 / (1 + squared / scale**2))


def soft_l1(squared: AnyArray, scale: float) -> AnyArray:
    """Losses rho (N,)."""
    return 2 * scale**2 * ((1 + squared / scale**2) ** 0.5 - 1)


def soft_l1_weight(squared: AnyArray, scale: float) -> AnyArray:
    """Weights rho' (N,)."""
    return 1 / (1 + squared / scale**2) ** 0.5
