"""Errors that poses of references are known to have, as `Provenance` states them.

A reference whose pose has a covariance C of its own, world_from_camera in ROS's order (see `optimize`), moves by the
left perturbation T e of camera_from_world, where e has the covariance C and T = -diag(R_cw, R_cw); one with radii alone
has errors as large along each axis. An adjustment holds it to its pose by T C T^T (see `pose_problem`).

Poses of adopted references rest on the same surveyed ones, so their errors are not independent of each other, and
leaving one out does not show them (see `dispersion`). They are taken as common: e_i = C_i^(1/2) z, with one z of
covariance I for all. Where motions xi_i of the given poses move the query's by sum_i J_i xi_i, the answer has, besides
what its data show, the covariance

    M M^T,    M = W sum_i J_i T_i C_i^(1/2),

W of `world_jacobian`. If all references are adopted, with one C, that is about C; surveyed ones make it less.
"""

from collections.abc import Sequence

import numpy as np

from mapless.geometry import Array, RigidTransform
from mapless.provenance import ADOPTED, Provenance

from ..features.views import PosedView
from ..optim.optimize import world_jacobian
from .estimate import accuracy_from_covariance


def stated_variances(provenances: Sequence[Provenance]) -> Array:
    """Variances (K, 6) along and about each axis that the radii of 68 % have; 0 for references without any."""
    unit = accuracy_from_covariance(np.eye(6))
    ratios = [
        (it.accuracy.position_68_m / unit.position_68_m, it.accuracy.rotation_68_deg / unit.rotation_68_deg)
        if it.accuracy
        else (0.0, 0.0)
        for it in provenances
    ]
    return np.repeat(np.square(ratios), 3, axis=1)


def stated_covariance(provenances: Sequence[Provenance], rotations: Array) -> Array:
    """Covariance (6 K, 6 K) of left perturbations; rotations (K, 3, 3) are camera_from_world."""
    covariance = np.diag(stated_variances(provenances).ravel())
    for i, provenance in enumerate(provenances):
        if provenance.covariance is not None:
            turn, own = _turn(rotations[i]), slice(6 * i, 6 * i + 6)
            covariance[own, own] = turn @ np.array(provenance.covariance) @ turn.T
    return covariance


def common_covariance(references: Sequence[PosedView], by_motions: Array, world_from_query: RigidTransform) -> Array:
    """Covariance (6, 6) of a query's pose by what adopted references are off in common.

    `by_motions` (6, 6 K) are derivatives of the query's left perturbation by those of the references' given poses.
    """
    moved = world_jacobian(world_from_query) @ by_motions @ common_motion(references)
    return np.asarray(moved @ moved.T)


def common_motion(references: Sequence[PosedView]) -> Array:
    """Left perturbations (6 K, 6) of references' poses by the standard deviations of z; 0 of surveyed ones."""
    provenances = [it.provenance for it in references]
    motion = np.zeros((len(references), 6, 6))
    for i, (it, variances) in enumerate(zip(references, stated_variances(provenances), strict=True)):
        if it.provenance.source == ADOPTED:
            own = it.provenance.covariance
            turn = _turn(it.world_from_camera.rotation.T)
            motion[i] = -turn @ _root(np.diag(variances) if own is None else np.array(own))
    return motion.reshape(-1, 6)


def _turn(rotation: Array) -> Array:
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = rotation
    return turn


def _root(covariance: Array) -> Array:
    """The symmetric root of a covariance (6, 6)."""
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    return np.asarray((vectors * np.sqrt(values.clip(min=0))) @ vectors.T)
