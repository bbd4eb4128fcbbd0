"""Errors of a photograph's intrinsics: what they do to its keypoints.

Four numbers describe them: s = ln(f / f given), one for both axes; the shift (x, y) of the principal point, pixels; and
the change of the lens model's first radial coefficient, k1, or of what stands for it (`Distortion.bent`). A keypoint is
undistorted with the given intrinsics to a pixel y of the ideal pinhole camera, in normalized coordinates, by
y = D^-1((u - c) / f). With other intrinsics the same keypoint is, to first order,

    y - J^-1 (s D(y) + dc / f + dk1 dD/dk1),    J = dD/dy,

where D is the given lens model: dD/dk1 = y |y|^2 for radial-tangential distortion, which stands for a pinhole too, and
theta^3 y / |y| for a fisheye.

With all other unknowns eliminated from the normal equations of an adjustment, what is left is the information that the
photograph's matches have of these errors; of a flat wall that is next to none. The standard deviations contain what
matches share, because they measure how the estimate changes without each reference and each region (see `dispersion`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera
from mapless.lenses import Distortion, RadialTangential
from mapless_server.bounds import check_bounds

from ..features.views import View, undistort_pixels
from ..significance import HEAVY_TAIL, least_sigmas
from .priors import IntrinsicsSigma

PRINCIPAL = (1, 2)
"""Indices of the principal point among the four errors."""

DOUBTED_SIGMAS = 3.0
"""Standard deviations from which on errors of the intrinsics are doubted: a photograph that is off by more of what
it alone has does not share the references' camera; an estimate that leaves its prior by more has diverged; and if the
linear check finds more, other cameras are tried. Evidence: other-cameras."""


@dataclass(frozen=True)
class ContradictionOptions:
    """Options that define when a photograph contradicts a parameter of its intrinsics.

    Attributes:
        sigmas: it is off by more standard deviations of the given and the estimated value together; by default by so
            many that it is significant.
        focal_share, principal_share, k1: standard deviations (of the focal length and the width, as shares) above
            which a photograph does not determine a parameter: noise in the depth of a flat wall's points looks like
            relief of the wall.
    """

    sigmas: float = HEAVY_TAIL * least_sigmas(tested=4)
    focal_share: float = 0.02
    principal_share: float = 0.02
    k1: float = 0.05

    def __post_init__(self) -> None:
        check_bounds(self, "sigmas focal_share principal_share k1", above=0)

    def contradicted(self, value: Array, sigma: Array, given_sigma: Array, width_px: int) -> NDArray[np.bool_]:
        """(4,): which errors of these values and standard deviations are too large for given ones of `given_sigma`."""
        limit_px = self.principal_share * width_px
        determined = sigma < np.array([self.focal_share, limit_px, limit_px, self.k1])
        return np.asarray(determined & (np.abs(value) > self.sigmas * np.hypot(given_sigma, sigma)))


@dataclass(frozen=True, eq=False)
class IntrinsicsEquations:
    """Normal equations of I errors, all other unknowns eliminated; see `dispersion`.

    They are the four of the intrinsics, or the six components of a motion during the read-out (see `shutter`).

    Attributes:
        matrices, gradients: (1 + K, I, I) and (1 + K, I): of all data, and without each of K references.
        region_matrices, region_gradients: (G, I, I) and (G, I): the parts of G regions of the photograph.
        motion: (6, I) how the pose moves with each error: x y z rx ry rz, fixed world axes.
    """

    matrices: Array
    gradients: Array
    region_matrices: Array
    region_gradients: Array
    motion: Array

    def estimate(
        self, removed: Array, information: Array, inflation: float, region_factor: float
    ) -> tuple[Array, Array]:
        """The errors (..., I), and their covariance (..., I, I), which contains what matches share.

        As that of a pose, it is the sum of the jackknife over references and over regions; to which come what the prior
        leaves and what the residuals say, for few references may agree by chance.

        Args:
            removed: (I,) errors that are removed where the equations are linearized.
            information: (..., I) inverse variances of the errors without the photograph.
            inflation: factor of standard deviations that follow from residuals; weighs the data against the prior.
            region_factor: see `UncertaintyOptions`.

        Raises:
            np.linalg.LinAlgError: the data do not determine an error without a prior.
        """
        matrices, prior = self.matrices / inflation**2, information[..., None] * np.eye(len(removed))
        inverses = np.linalg.inv(matrices + prior[..., None, :, :])
        gradients = self.gradients / inflation**2 + (information * removed)[..., None, :]
        changes = -(inverses @ gradients[..., None])[..., 0]
        change, inverse = changes[..., :1, :], inverses[..., 0, :, :]
        parts = self.region_gradients + (self.region_matrices @ change[..., None])[..., 0]
        regions = parts @ inverse / inflation**2
        without = changes[..., 1:, :] if len(matrices) > 1 else change  # no reference sees the matches
        both = (it - it.mean(axis=-2, keepdims=True) for it in (without, region_factor * regions))
        references, regions = (np.swapaxes(it, -1, -2) @ it for it in both)
        count, chance = without.shape[-2], inverse @ (prior + matrices[0] / inflation**2) @ inverse
        return removed + change[..., 0, :], (count - 1) / count * references + regions + chance


@dataclass(frozen=True, eq=False)
class IntrinsicsEvidence:
    """Evidence of a photograph's matches about the errors of its intrinsics: true minus given, for s, x, y and k1.

    Attributes:
        given: the camera, in pixels of the processed image, with its distortion.
        sent: the same in pixels of the photograph as it was sent.
        value: (4,) each error as the photograph alone gives it, the other three held by their priors. One that is not
            removed is too small: it takes weight from the matches that show it.
        sigma: (4,) standard deviations of these, with all that matches share.
        prior_sigma: (4,) standard deviations of the errors without the photograph, as of a camera of its own.
        covariance: (4, 4) about zero, of the errors that remain in the intrinsics with which the pose was computed:
            what the photograph and the prior say together, uncertainty and value.
        motion: (6, 4) how the pose moves with each error: x y z rx ry rz, fixed world axes.
        removed: (4,) the errors that were removed before the pose was computed.
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
        """The part of these errors in the covariance (6, 6) of a pose that was computed without them."""
        return np.asarray(self.motion @ self.covariance @ self.motion.T)

    def contradicted(self, options: ContradictionOptions, prior_sigma: Array | None = None) -> NDArray[np.bool_]:
        """Whether each parameter (4,) is significantly wrong.

        `prior_sigma` (4,): standard deviations of the given values; by default those of the request, unless they are
        wider than the usual ones: the photograph is then more accurate.
        """
        usual = np.minimum(self.prior_sigma, IntrinsicsSigma().of(self.given)) if prior_sigma is None else prior_sigma
        return options.contradicted(self.value, self.sigma, usual, self.given.width_px)


@dataclass(frozen=True, eq=False)
class IntrinsicsTerms:
    """A photograph's intrinsics as they are known without its matches.

    Attributes:
        given: the photograph, with its intrinsics as given.
        prior_sigma: (4,) see `IntrinsicsEvidence`.
        held_sigma: (4,) the same where the pose was computed: less for a camera that the references share, more for
            parameters that the photograph contradicts.
        removed: (4,) errors that are removed from the intrinsics at which they are linearized.
    """

    given: View
    prior_sigma: Array
    held_sigma: Array
    removed: Array = field(default_factory=lambda: np.zeros(4))


def intrinsics_evidence(
    equations: IntrinsicsEquations,
    terms: IntrinsicsTerms,
    suspicion: ContradictionOptions,
    inflation: float,
    region_factor: float,
) -> IntrinsicsEvidence | None:
    """Computes the evidence from normal equations of the errors of the intrinsics; None if they are singular.

    An error that exceeds `suspicion` counts in full in the pose's covariance: given intrinsics are right or far off,
    the latter more often than a normal distribution says. The factors are those of `IntrinsicsEquations.estimate`.
    """
    given, removed, prior_sigma, held_sigma = terms.given, terms.removed, terms.prior_sigma, terms.held_sigma
    try:
        # Only the prior is known of an error that moves no keypoint: k1 of a lens model without such a coefficient.
        is_seen = np.diag(np.diag(equations.matrices[0]) > 0)
        others = np.where(is_seen, 0.0, prior_sigma**-2.0)
        found, covariance = equations.estimate(removed, others, inflation, region_factor)
        value, sigma = np.diag(found), np.sqrt(np.einsum("iii->i", covariance))
        # A camera that errs otherwise than the references' is not theirs, though K is the same: its lens may differ.
        is_other = np.abs(value) > DOUBTED_SIGMAS * np.hypot(held_sigma, sigma)
        held_sigma = np.maximum(held_sigma, prior_sigma) if is_other[:3].any() else held_sigma
        doubtful = suspicion.contradicted(value, sigma, prior_sigma, given.camera.width_px)
        doubtful[:3] &= held_sigma[:3] >= prior_sigma[:3]  # K of a shared camera errs alike
        held = np.where(doubtful, np.maximum(held_sigma, np.abs(value)), held_sigma)
        found, covariance = equations.estimate(removed, held**-2.0, inflation, region_factor)
    except np.linalg.LinAlgError:
        return None
    left = found - removed
    camera = replace(given.camera, distortion=given.distortion)
    sent = given.photograph.camera if given.photograph else camera
    total = covariance + np.outer(left, left)
    evidence = IntrinsicsEvidence(camera, sent, value, sigma, prior_sigma, total, equations.motion, removed)
    return evidence if np.isfinite(evidence.pose_covariance).all() and np.isfinite(sigma).all() else None


def keypoint_motion(camera: Camera, distortion: Distortion | None, pixels: Array) -> Array:
    """Shift (N, 2, 4) of ideal pixels (N, 2) for one unit of each of the four errors of the intrinsics."""
    ideal = camera.rays(pixels)[:, :2]
    lens = distortion or RadialTangential()
    bent, by_k1 = lens.distort(ideal), lens.by_bend(ideal)
    focal = np.array([camera.focal_x_px, camera.focal_y_px])
    by_principal = np.broadcast_to(np.diag(1 / focal), (len(pixels), 2, 2))
    motion = np.concatenate([bent[:, :, None], by_principal, by_k1[:, :, None]], axis=2)
    if distortion is not None:
        motion = np.linalg.solve(lens.by_ideal(ideal), motion)
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
        distortion=lens.bent(k1),
    )


def corrected_view(view: View, errors: Array) -> View:
    """Returns the view after these errors are removed from its intrinsics; keypoints without an ideal pixel are NaN."""
    better, photograph = corrected(replace(view.camera, distortion=view.distortion), errors), view.photograph
    if photograph is not None:
        scale = photograph.camera.width_px / view.camera.width_px
        photograph = replace(photograph, camera=corrected(photograph.camera, errors * [1, scale, scale, 1]))
    return replace(read_as(view, better), photograph=photograph)


def read_as(view: View, camera: Camera) -> View:
    """Returns the view as read with other intrinsics and another lens; keypoints without an ideal pixel are NaN.

    The camera is in pixels of the view; that of the photograph stays as it is.
    """
    features, lens = view.features, replace(view.camera, distortion=view.distortion)
    if camera.distortion is not None or lens.distortion is not None:
        pixels = lens.project(lens.rays(features.pixels()))
        features = replace(features, keypoints=undistort_pixels(pixels, camera).astype(np.float32))
    return replace(view, camera=camera.pinhole(), features=features, distortion=camera.distortion)
