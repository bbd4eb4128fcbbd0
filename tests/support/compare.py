"""Comparison of poses, safe against NaN, and of derivatives with finite differences."""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from mapless.geometry import Array, RigidTransform, rotation_angle_deg


def pose_error(actual: RigidTransform, expected: RigidTransform) -> tuple[float, float]:
    """Distance of the origins in metres and angle between the axes in degrees."""
    return (
        float(np.linalg.norm(actual.translation - expected.translation)),
        rotation_angle_deg(actual.rotation @ expected.rotation.T),
    )


def assert_pose_close(actual: RigidTransform, expected: RigidTransform, *, metres: float, degrees: float) -> None:
    """Fails unless both errors are within their own tolerance."""
    error_m, error_deg = pose_error(actual, expected)
    assert error_m <= metres, f"{error_m:g} m away, {metres:g} m allowed"
    assert error_deg <= degrees, f"turned by {error_deg:g} deg, {degrees:g} deg allowed"


def finite_differences(function: Callable[[Array], ArrayLike], at: ArrayLike, step: float = 1e-6) -> Array:
    """Central differences (M, N) of a function from (N,) to (M,) or to a number."""
    x = np.asarray(at, float)
    columns = [
        (np.ravel(function(x + step * axis)) - np.ravel(function(x - step * axis))) / (2 * step)
        for axis in np.eye(len(x))
    ]
    return np.stack(columns, axis=-1)


def assert_jacobian(
    jacobian: ArrayLike,
    function: Callable[[Array], ArrayLike],
    at: ArrayLike,
    *,
    step: float = 1e-6,
    tolerance: float = 1e-6,
) -> None:
    """Fails unless `jacobian`, (M, N) or (N,), is the derivative of `function` at (N,).

    `tolerance` is a share of the largest entry, if that is above one.
    """
    expected = finite_differences(function, at, step)
    actual = np.reshape(np.asarray(jacobian, float), expected.shape)
    np.testing.assert_allclose(actual, expected, rtol=0, atol=tolerance * max(1.0, float(np.abs(expected).max())))
