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
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, Distortion, RadialTangential

from .features.image import undistort_pixels
from .options import IntrinsicsSigma, check_bounds
from .views import View

NAMES = ("focal length", "principal point x", "principal point y", "k1")
PRINCIPAL = (1, 2)
"""Which of the four errors are those of the principal point."""


@dataclass(frozen=True)
class ContradictionOptions:
    """Options that define when a photograph contradicts a parameter of its intrinsics.

    Attributes:
        sigmas: the parameter is off by more than this many standard deviations of its estimate. These do not contain
            errors that matches share: right parameters were off by at most 3.2 with SIFT in eleven scenes, by 4.3 with
            EdgePoint2 and five references of a kitchen, and by 7.5 among internet photographs (localized to 3 % of the
            distance), whose references have wrong intrinsics themselves.
        focal_share, principal_share, k1: standard deviations (of the focal length and the width, as shares) above
            which a photograph does not determine a parameter. Noise in the depth of a flat wall's points looks like
            relief of the wall: its focal length was off by 72 % with a standard deviation of 8.5 %.
    """

    sigmas: float = 8.0
    focal_share: float = 0.02
    principal_share: float = 0.02
    k1: float = 0.05

    def __post_init__(self) -> None:
        check_bounds(self, "sigmas focal_share principal_share k1", above=0)


@dataclass(frozen=True, eq=False)
class IntrinsicsEvidence:
    """What a photograph's matches say about the errors of its intrinsics: true minus given, for s, x, y and k1.

    Attributes:
        given: the camera, in pixels of the processed image, with its distortion.
        sent: the same in pixels of the photograph as it was sent.
        value: (4,) each error as the photograph alone gives it, the other three held by their priors.
        sigma: (4,) standard deviations of these; they contain errors of points and reference poses.
        prior_sigma: (4,) standard deviations of the errors without the photograph, as of a camera of its own.
        covariance: (4, 4) about zero, of the errors that remain in the intrinsics with which the pose was computed:
            what the photograph and the prior say together, uncertainty and value.
        motion: (6, 4) how the pose moves with each error: x y z rx ry rz, fixed world axes.
        removed: (4,) the errors that were removed before the pose was computed; zeros if it is that of the intrinsics
            as given.
    """

    given: Camera
    sent: Camera
    value: Array
    sigma: Array
    prior_sigma: Array
    covariance: Array
    motion: Array
    removed: Array

    @property
    def pose_covariance(self) -> Array:
        """What these errors add to the covariance (6, 6) of a pose that was computed without them."""
        return np.asarray(self.motion @ self.covariance @ self.motion.T)

    def contradicted(self, options: ContradictionOptions) -> NDArray[np.bool_]:
        """Which parameters (4,) are significantly wrong, and by more than one standard deviation of the prior.

        A prior that is wider than the default does not raise this limit: the photograph is then more accurate.
        """
        width_px, size = self.given.width_px, np.abs(self.value)
        usual = np.minimum(self.prior_sigma, IntrinsicsSigma().of(self.given))
        limit = np.array(
            [options.focal_share, options.principal_share * width_px, options.principal_share * width_px, options.k1]
        )
        significant = (size > options.sigmas * self.sigma) & (size > usual)
        return np.asarray(significant & (self.sigma < limit))


def intrinsics_evidence(
    matrix: Array,
    gradient: Array,
    given: View,
    removed: Array,
    prior_sigma: Array,
    held_sigma: Array,
    inflation: float,
    to_world: Array,
) -> IntrinsicsEvidence | None:
    """Computes the evidence from normal equations of poses and intrinsics; None if they are singular.

    Args:
        matrix: (U, U), with the points eliminated; the last 4 unknowns are errors of the intrinsics, without their
            prior, and the 6 before them the query's pose.
        gradient: (U,) of the same unknowns.
        given: the photograph, with its intrinsics as given.
        removed: (4,) errors that are removed from the intrinsics at which they are linearized.
        prior_sigma: (4,) see `IntrinsicsEvidence`.
        held_sigma: (4,) the same where the pose was computed: less for a camera that the references share, more for
            parameters that the photograph contradicts.
        inflation: factor on standard deviations that follow from residuals.
        to_world: (6, 6) derivative of the world error by the pose's unknowns.
    """
    split = len(gradient) - 4
    try:
        solved = np.linalg.solve(matrix[:split, :split], np.column_stack([matrix[:split, split:], gradient[:split]]))
        information = (matrix[split:, split:] - matrix[split:, :split] @ solved[:, :4]) / inflation**2
        slope = (gradient[split:] - matrix[split:, :split] @ solved[:, 4]) / inflation**2
        held = np.diag(held_sigma**-2.0)
        value, sigma = np.zeros(4), np.zeros(4)
        for i in range(4):
            others = held.copy()
            others[i, i] = 0.0
            alone = np.linalg.inv(information + others)
            value[i] = removed[i] - alone[i] @ (slope + others @ removed)
            sigma[i] = np.sqrt(alone[i, i])
        covariance = np.linalg.inv(information + held)
    except np.linalg.LinAlgError:
        return None
    left = covariance @ (slope + held @ removed)
    motion = -to_world @ solved[split - 6 :, :4]
    camera = replace(given.camera, distortion=given.distortion)
    sent = given.photograph.camera if given.photograph else camera
    total = covariance + np.outer(left, left)
    found = IntrinsicsEvidence(camera, sent, value, sigma, prior_sigma, total, motion, removed)
    return found if np.isfinite(found.pose_covariance).all() and np.isfinite(sigma).all() else None


def keypoint_motion(camera: Camera, distortion: Distortion | None, pixels: Array) -> Array:
    """Shift (N, 2, 4) of ideal pixels (N, 2) for one unit of each of the four errors of the intrinsics."""
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
    """Returns the camera and its distortion after these four errors are removed from its intrinsics."""
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


def corrected_view(view: View, errors: Array) -> View:
    """Returns the view after these errors are removed from its intrinsics; keypoints without an ideal pixel are NaN."""
    lens = replace(view.camera, distortion=view.distortion)
    pixels = lens.project(lens.rays(view.features.keypoints.astype(np.float64)))
    better, photograph = corrected(lens, errors), view.photograph
    if photograph is not None:
        scale = photograph.camera.width_px / view.camera.width_px
        photograph = replace(photograph, camera=corrected(photograph.camera, errors * [1, scale, scale, 1]))
    features = replace(view.features, keypoints=undistort_pixels(pixels, better).astype(np.float32))
    return replace(
        view, camera=better.pinhole(), features=features, distortion=better.distortion, photograph=photograph
    )


def _by_k1(lens: Distortion, ideal: Array) -> Array:
    """dD/dk1 (N, 2); lens models are linear in their coefficients."""
    return np.asarray(replace(lens, k1=lens.k1 + 1.0).distort(ideal) - lens.distort(ideal))


def _jacobian(lens: Distortion, ideal: Array, step: float = 1e-6) -> Array:
    """dD/dy (N, 2, 2), by finite differences."""
    ahead = [lens.distort(ideal + step * axis) - lens.distort(ideal - step * axis) for axis in np.eye(2)]
    return np.asarray(np.stack(ahead, axis=2) / (2 * step))
