"""Small motions of rigid transforms."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from mapless.geometry import Array, RigidTransform, rotation_from_vector


def perturbed(target_from_source: RigidTransform, step: Array) -> RigidTransform:
    """After a left perturbation (v, w) (6,): a turn by w about the target's origin, then a shift by v."""
    turn = rotation_from_vector(step[3:])
    return RigidTransform(turn @ target_from_source.rotation, turn @ target_from_source.translation + step[:3])


def rotation_vector(rotation: Array) -> Array:
    """The inverse of `rotation_from_vector`: axis (3,) times angle, 0 to pi radians."""
    axis = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    cosine, sine = (float(np.trace(rotation)) - 1) / 2, float(np.linalg.norm(axis)) / 2
    if cosine < -0.5:  # near a half turn the axis vanishes from the differences
        return np.asarray(Rotation.from_matrix(rotation).as_rotvec())
    angle = math.atan2(sine, cosine)
    return np.asarray(axis / 2 * (angle / sine if sine > 1e-9 else 1.0))
