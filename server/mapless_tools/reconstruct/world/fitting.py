"""Nonlinear least squares, by SciPy."""

from collections.abc import Callable

import numpy as np
from scipy.optimize import least_squares

from mapless.geometry import Array


def least(residuals: Callable[[Array], Array], start: Array, robust_beyond: float | None = None) -> tuple[Array, Array]:
    """The argument of least squared residuals, and their Jacobian there, (residuals, arguments).

    Residuals beyond `robust_beyond` count linearly (soft L1).
    """
    loss = {} if robust_beyond is None else {"loss": "soft_l1", "f_scale": robust_beyond}
    # mypy takes the function for the module of its name.
    found = least_squares(residuals, start, **loss)  # type: ignore[operator]
    return np.asarray(found.x), np.asarray(found.jac)
