"""Rotations as vectors: axis times angle."""

import math

import numpy as np

from mapless.geometry import Array


def rotation_vector(rotation: Array) -> Array:
    """Inverse of `rotation_from_vector`: axis (3,) times angle, 0 to pi radians."""
    axis = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    cosine, sine = (float(np.trace(rotation)) - 1) / 2, float(np.linalg.norm(axis)) / 2
    if cosine < -0.5:  # near a half turn the axis vanishes from the differences
        from scipy.spatial.transform import Rotation  # takes as long as all of numpy, and is hardly ever needed

        return np.asarray(Rotation.from_matrix(rotation).as_rotvec())
    angle = math.atan2(sine, cosine)
    return np.asarray(axis / 2 * (angle / sine if sine > 1e-9 else 1.0))
