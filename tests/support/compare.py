"""Comparison of poses, safe against NaN: an error that is not a number is never small enough."""

import numpy as np

from mapless.geometry import RigidTransform, rotation_angle_deg


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
