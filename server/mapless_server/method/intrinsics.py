"""Errors of a photograph's intrinsics: what they do to its keypoints.

Four numbers describe them: s = ln(f / f given), one for both axes; the shift (x, y) of the principal point, pixels; and
the change of the lens model's first radial coefficient, k1. A keypoint is undistorted with the given intrinsics to a
pixel y of the ideal pinhole camera, in normalized coordinates, by y = D^-1((u - c) / f). With other intrinsics the same
keypoint is, to first order,

    y - J^-1 (s D(y) + dc / f + dk1 dD/dk1),    J = dD/dy,

where D is the given lens model: dD/dk1 = y |y|^2 for radial-tangential distortion, which stands for a pinhole too, and
theta^3 y / |y| for a fisheye.

With all other unknowns eliminated from the normal equations of an adjustment, what is left is the information that the
photograph's matches have of these errors. Of a flat wall that is next to none: the standard deviations say so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapless.geometry import Array, Camera, Distortion, RadialTangential

from .options import check_bounds

NAMES = ("focal length", "principal point x", "principal point y", "k1")


@dataclass(frozen=True)
class IntrinsicsSigma:
    """Standard deviations of a photograph's intrinsics.

    Attributes:
        focal_share: of both focal lengths together, as a share of them. Lenses change by so much with focus and
            temperature, and calibrations repeat no better.
        principal_share: of each coordinate of the principal point, as a share of the image's width.
        k1: of the first radial coefficient.
    """

    focal_share: float = 0.003
    principal_share: float = 0.003
    k1: float = 0.01

    def __post_init__(self) -> None:
        check_bounds(self, "focal_share principal_share k1", above=0, at_most=1)

    def of(self, camera: Camera) -> Array:
        """(4,): of s, of the principal point in pixels of this camera, and of k1."""
        principal_px = self.principal_share * camera.width_px
        return np.array([self.focal_share, principal_px, principal_px, self.k1])


@dataclass(frozen=True, eq=False)
class IntrinsicsEvidence:
    """What a photograph's matches say of the errors of its intrinsics, all in the order of `NAMES`.

    Attributes:
        value: (4,) each error as the photograph alone gives it, the other three held by their priors.
        sigma: (4,) standard deviations of these; they contain errors of points and reference poses.
        prior_sigma: (4,) standard deviations of the errors without the photograph.
        covariance: (4, 4) about zero, of the errors that remain in a pose computed with the intrinsics as they are:
            what the photograph and the prior say together, uncertainty and value.
        motion: (6, 4) how the pose moves with each error: x y z rx ry rz, fixed world axes.
    """

    value: Array
    sigma: Array
    prior_sigma: Array
    covariance: Array
    motion: Array

    @property
    def pose_covariance(self) -> Array:
        """(6, 6): what these errors add to the covariance of a pose that was computed without them."""
        return np.asarray(self.motion @ self.covariance @ self.motion.T)


def intrinsics_evidence(
    matrix: Array, gradient: Array, errors: Array, prior_sigma: Array, inflation: float, to_world: Array
) -> IntrinsicsEvidence | None:
    """The evidence in normal equations of poses and intrinsics; None if they are singular.

    Args:
        matrix: (U, U) points eliminated; the last 4 unknowns are errors of the intrinsics, without their prior, the 6
            before them the query's pose.
        gradient: (U,).
        errors: (4,) at which they are linearized.
        prior_sigma: (4,) of the errors.
        inflation: of standard deviations that follow from residuals.
        to_world: (6, 6) derivative of the world error by the pose's unknowns.
    """
    split = len(gradient) - 4
    try:
        solved = np.linalg.solve(matrix[:split, :split], np.column_stack([matrix[:split, split:], gradient[:split]]))
        information = (matrix[split:, split:] - matrix[split:, :split] @ solved[:, :4]) / inflation**2
        slope = (gradient[split:] - matrix[split:, :split] @ solved[:, 4]) / inflation**2
        held = np.diag(prior_sigma**-2.0)
        value, sigma = np.zeros(4), np.zeros(4)
        for i in range(4):
            others = held.copy()
            others[i, i] = 0.0
            alone = np.linalg.inv(information + others)
            value[i] = errors[i] - alone[i] @ (slope + others @ errors)
            sigma[i] = np.sqrt(alone[i, i])
        covariance = np.linalg.inv(information + held)
    except np.linalg.LinAlgError:
        return None
    left = covariance @ (slope + held @ errors)
    motion = -to_world @ solved[split - 6 :, :4]
    found = IntrinsicsEvidence(value, sigma, prior_sigma, covariance + np.outer(left, left), motion)
    return found if np.isfinite(found.pose_covariance).all() and np.isfinite(sigma).all() else None


def keypoint_motion(camera: Camera, distortion: Distortion | None, pixels: Array) -> Array:
    """(N, 2, 4): by how much ideal pixels (N, 2) lie too far, for each of the four errors of the intrinsics."""
    ideal = camera.rays(pixels)[:, :2]
    lens = distortion or RadialTangential()
    bent, by_k1 = lens.distort(ideal), _by_k1(lens, ideal)
    focal = np.array([camera.focal_x_px, camera.focal_y_px])
    by_principal = np.broadcast_to(np.diag(1 / focal), (len(pixels), 2, 2))
    motion = np.concatenate([bent[:, :, None], by_principal, by_k1[:, :, None]], axis=2)
    if distortion is not None:
        motion = np.linalg.solve(_jacobian(lens, ideal), motion)
    return np.asarray(motion * focal[:, None])


def corrected(camera: Camera, errors: Sequence[float] | Array) -> Camera:
    """A camera, with its distortion, after these four errors are removed from its intrinsics."""
    log_ratio, x_px, y_px, k1 = (float(it) for it in errors)
    lens = camera.distortion or RadialTangential()
    return replace(
        camera,
        focal_x_px=camera.focal_x_px * np.exp(log_ratio),
        focal_y_px=camera.focal_y_px * np.exp(log_ratio),
        principal_x_px=camera.principal_x_px + x_px,
        principal_y_px=camera.principal_y_px + y_px,
        distortion=replace(lens, k1=lens.k1 + k1),
    )


def _by_k1(lens: Distortion, ideal: Array) -> Array:
    """dD/dk1, (N, 2): the models are linear in their coefficients."""
    return np.asarray(replace(lens, k1=lens.k1 + 1.0).distort(ideal) - lens.distort(ideal))


def _jacobian(lens: Distortion, ideal: Array, step: float = 1e-6) -> Array:
    """dD/dy, (N, 2, 2), by differences."""
    ahead = [lens.distort(ideal + step * axis) - lens.distort(ideal - step * axis) for axis in np.eye(2)]
    return np.asarray(np.stack(ahead, axis=2) / (2 * step))
