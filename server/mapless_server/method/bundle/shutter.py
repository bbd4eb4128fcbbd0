"""Rolling shutter: the motion of a camera while its rows are read, as the photograph's own matches show it.

A rolling shutter reads one row after the other. At the time t of a row, as a share of the read-out, -1/2 to 1/2, the
camera stands at

    camera_from_world(t) = Exp(t m) camera_from_world,    m = (v, w),

where camera_from_world is the pose in the middle, which is answered, and m the motion during the read-out. To first
order a match moves by t J m, where J is the derivative of its projection by the pose.

Before a pose is solved, m is estimated with it from the matches, and the keypoints are moved to where a camera that
stands still in the middle would show them; what follows is as without a rolling shutter. After the adjustment what is
left of m is an unknown of its normal equations, as errors of the intrinsics are (see `intrinsics`): the pose follows,
and the covariance contains how uncertain m is.

A camera stands still, or moves slowly or fast, so the prior of m is a mixture of normal distributions: v and w have
`SCALES` times the standard deviations that are stated, about zero, or about what the device's tracking says. The
matches decide what each part counts: with their information L of m, whose maximum is at m_0, one of mean a and
covariance P has the likelihood

    ln p = -1/2 ln det(1 + P L) - 1/2 (m_0 - a)^T (L - L (L + P^-1)^-1 L) (m_0 - a) + constant.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from mapless.geometry import Array, RigidTransform

from ..features.limits import INEXACT_INLIER_PX, INLIER_PX
from ..features.views import View
from ..optim.optimize import (
    MinimizeOptions,
    cauchy_cost,
    cauchy_weight,
    damped_step,
    minimize,
    moved,
    perturbed,
    pose_jacobian,
    world_jacobian,
)
from ..structure.model import PixelPoints
from ..structure.observations import MIN_NOISE_LEVEL_PX
from .adjust import LEAST_MATCHES
from .bundle import BundleProblem
from .dispersion import disperse
from .estimate import PosedSupport, PoseEstimate
from .intrinsics import IntrinsicsEquations
from .normal_equations import Bundle
from .pose_problem import AdjustInput, AdjustOptions, pose_problem
from .priors import NO_PRIORS, Priors
from .readout import RollingShutter

SCALES: tuple[float, ...] = (0.001, 0.25, 1.0)
"""Standard deviations of the motion, by the stated one: of a camera that stands still, or moves slowly or fast.
Evidence: rolling-shutter."""
SHARES: tuple[float, ...] = (0.6, 0.2, 0.2)
"""How many cameras move so. Evidence: rolling-shutter."""

LOSS_SCALES_PX = (INEXACT_INLIER_PX, INLIER_PX, AdjustOptions.loss_scale_sigma)
"""Scales of the Cauchy loss, one after the other: at the first pose matches are off by what the motion moves them."""
STEPS = MinimizeOptions(AdjustOptions.iterations, AdjustOptions.min_decrease)
"""Steps with each of these scales."""
LEAST_DEPTH = 0.1
"""Least depth of a match, by the usual one: wrong ones beside the camera would be behind it after a small motion.

In a room, 3 m, it is 0.3 m: six times what a vehicle of 3 m/s moves in half of a read-out of 33 ms. Right matches are
hardly ever nearer: references would see them from elsewhere.
"""

TRACKED_SHARE = 0.9
"""How often the motion is as the device's tracking says, which may jump.

Not measured: what is left to the other parts has to be enough for the matches to outvote a jump, which one of two
standard deviations does (a likelihood ratio of 9 is one of 2.1).
"""


@dataclass(frozen=True, eq=False)
class MotionPrior:
    """The prior of m: a mixture of S normal distributions.

    Attributes:
        mean: (S, 6) metres and radians during the read-out.
        sigma: (S, 6) standard deviations.
        share: (S,) probability of each.
    """

    mean: Array
    sigma: Array
    share: Array

    @staticmethod
    def of(shutter: RollingShutter, distance_m: float) -> "MotionPrior":
        """The prior where matches are as far as `distance_m`, by which the stated angular speed says the linear one."""
        turn, tracked = shutter.turn, shutter.tracked
        shift = shutter.shift or turn * distance_m
        shift_scale, turn_scale = (it.ravel() for it in np.meshgrid(SCALES, SCALES))
        sigma = np.repeat(np.stack([shift * shift_scale, turn * turn_scale], axis=1), 3, axis=1)
        free = MotionPrior(np.zeros_like(sigma), sigma, np.outer(SHARES, SHARES).ravel())
        if tracked is None:
            return free
        mean = np.tile(tracked.mean, (len(sigma), 1))
        left = np.repeat([tracked.left_shift, tracked.left_turn], 3)
        shares = (1 - TRACKED_SHARE) * free.share, TRACKED_SHARE * free.share
        # The widest is the last one.
        return MotionPrior(*map(np.concatenate, ((mean, free.mean), (left * sigma, sigma), shares[::-1])))

    @property
    def spread(self) -> Array:
        """Second moments (6, 6) of the mixture about zero."""
        return np.asarray(np.diag(self.share @ self.sigma**2) + (self.share * self.mean.T) @ self.mean)

    def posterior(self, information: Array, gradient: Array, motion: Array) -> tuple[Array, Array]:
        """The probability of each part (S,) by the matches, and the steps (S, 6) from a motion m to the maxima.

        The matches are given by their information L (6, 6), and L (m - m_0) (6,).
        """
        precision, off = self.sigma**-2.0, motion - self.mean
        total = information + precision[:, :, None] * np.eye(6)
        b = off @ information - gradient
        solved = np.linalg.solve(total, np.stack([b, gradient + precision * off], axis=2))
        fit = (b * solved[..., 0]).sum(axis=1) + 2 * off @ gradient - ((off @ information) * off).sum(axis=1)
        log_p = np.log(self.share) + (np.log(precision).sum(axis=1) - np.linalg.slogdet(total)[1] + fit) / 2
        p = np.exp(log_p - log_p.max())
        return np.asarray(p / p.sum(), float), np.asarray(-solved[..., 1], float)


@dataclass(frozen=True, eq=False)
class StillView:
    """A photograph as a camera that stands still in the middle of the read-out would have taken it.

    Attributes:
        view: its view.
        time: (N,) when the row of each keypoint was read, as a share of the read-out.
        motion: (6,) the motion that was removed from its keypoints.
        world_from_camera: the pose in the middle.
    """

    view: View
    time: Array
    motion: Array
    world_from_camera: RigidTransform


def still_view(
    query: View, seen: PixelPoints, keypoint: NDArray[np.intp], start: RigidTransform, shutter: RollingShutter
) -> StillView:
    """Removes the most probable motion from a photograph's keypoints.

    Args:
        query: the photograph.
        seen: (M) its matches with points.
        keypoint: (M,) their keypoints.
        start: its pose by those of the matches that fit a camera that stands still.
        shutter: what is known of its read-out.
    """
    time = row_times(query, shutter)
    unmoved = StillView(query, time, np.zeros(6), start)
    depth = start.inverse().apply(seen.x_in_world)[:, 2]
    near = seen.errors_px(start) < INEXACT_INLIER_PX
    if near.sum() < LEAST_MATCHES:
        return unmoved
    distance_m = float(np.median(depth[near]))
    front = np.flatnonzero(depth > LEAST_DEPTH * distance_m)
    prior = MotionPrior.of(shutter, distance_m)
    pose, motion = _most_probable(seen[front], time[keypoint[front]], prior, start.inverse())
    x_in_camera = _at_times(pose.apply(seen.x_in_world[front]), time[keypoint[front]], motion)
    fits = np.linalg.norm(seen.camera.project(x_in_camera) - seen.pixels[front], axis=1) < INEXACT_INLIER_PX
    if not fits.any():
        return unmoved
    # A keypoint without a point is as far as the nearest one that has one.
    pixels = query.features.pixels()
    nearest = KDTree(seen.pixels[front][fits]).query(pixels)[1]
    rays = query.camera.rays(pixels) * x_in_camera[fits, 2][nearest, None]
    turns = Rotation.from_rotvec(time[:, None] * motion[3:])
    at_rest = query.camera.project(turns.apply(rays - time[:, None] * motion[:3], inverse=True))
    if not np.nanmax(np.linalg.norm(at_rest - pixels, axis=1)) >= MIN_NOISE_LEVEL_PX:  # the adjustment finds the rest
        return unmoved
    features = replace(query.features, keypoints=at_rest.astype(np.float32))
    return StillView(replace(query, features=features), time, motion, pose.inverse())


def row_times(view: View, shutter: RollingShutter) -> Array:
    """When the row of each keypoint (N,) was read: shares of the read-out, -1/2 to 1/2; see RollingShutter."""
    lens, camera = replace(view.camera, distortion=view.distortion), view.camera
    pixels = lens.project(lens.rays(view.features.pixels()))
    share = (pixels + 0.5) / (camera.width_px, camera.height_px) - 0.5
    return np.asarray(share @ shutter.direction.value)


def with_motion(
    support: PosedSupport,
    still: StillView,
    shutter: RollingShutter,
    options: AdjustOptions,
    priors: Priors = NO_PRIORS,
) -> PoseEstimate:
    """The estimate of a support with what is left of the motion: the pose follows it, the covariance contains it.

    The support's view is that of `still`, or the same read with other intrinsics. Those of the priors that the estimate
    uses hold the pose while it follows, and so say something of the motion, too.
    """
    estimate, used = support.estimate, priors.consistent(support.estimate.prior_checks)
    equations = _equations(support, still.time, options, used)
    if equations is None:
        return without_motion(support, still.time, shutter, used)
    prior = MotionPrior.of(shutter, support.distance_m())
    inflation, region_factor, removed = options.error_inflation, options.uncertainty.region_factor, still.motion
    given = equations.matrices[0] / inflation**2, equations.gradients[0] / inflation**2
    probability, _ = prior.posterior(*given, removed)
    parts = zip(removed - prior.mean, prior.sigma, strict=True)
    found = [equations.estimate(off, sigma**-2.0, inflation, region_factor) for off, sigma in parts]
    motions, covariances = prior.mean + [it for it, _ in found], np.array([it for _, it in found])
    motion = probability @ motions
    off = motions - motion
    covariance = np.einsum("s,sij->ij", probability, covariances + off[:, :, None] * off[:, None])
    by_motion = equations.motion
    step = by_motion @ (motion - removed)
    pose = moved(estimate.world_from_camera, step)
    change = by_motion @ covariance @ by_motion.T
    seen = support.matches.seen(support.query, support.structure.x_in_world)[estimate.inliers]
    if not np.median(seen.errors_px(pose)) < INLIER_PX:  # the equations are not linear so far
        pose, change = estimate.world_from_camera, change + np.outer(step, step)
    return _with_covariance(replace(estimate, world_from_camera=pose), change)


def without_motion(
    support: PosedSupport, time: Array, shutter: RollingShutter, used: Priors = NO_PRIORS
) -> PoseEstimate:
    """The estimate of a support whose matches do not show the motion: the covariance contains all of its prior.

    It contains no more than the priors on the pose that were used leave.
    """
    estimate, two_view = support.estimate, support.two_view
    x_in_world = support.structure.x_in_world[support.matches.point[estimate.inliers]]
    keypoint = support.matches.keypoint[estimate.inliers]
    if two_view is not None:
        x_in_world = np.concatenate([x_in_world, two_view.x_in_world[two_view.inliers]])
        keypoint = np.concatenate([keypoint, two_view.keypoint[two_view.inliers]])
    by_pose = pose_jacobian(support.query.camera, estimate.world_from_camera.inverse().apply(x_in_world))
    information = np.einsum("aim,ajm->ij", by_pose, by_pose)
    cross = np.einsum("aim,ajm->ij", by_pose, by_pose * time[keypoint])
    by_motion = world_jacobian(estimate.world_from_camera) @ -np.linalg.pinv(information, hermitian=True) @ cross
    spread = MotionPrior.of(shutter, support.distance_m()).spread
    return _with_covariance(estimate, used.sharpened(by_motion @ spread @ by_motion.T, estimate.world_from_camera))


def _with_covariance(estimate: PoseEstimate, by_motion: Array) -> PoseEstimate:
    """The estimate whose covariance contains a part (6, 6) by the motion, too."""
    return replace(estimate, covariance=estimate.covariance + by_motion, motion_covariance=by_motion)


def _most_probable(
    seen: PixelPoints, time: Array, prior: MotionPrior, start: RigidTransform
) -> tuple[RigidTransform, Array]:
    """camera_from_world in the middle and the motion (6,), means over the parts of the prior."""
    pose, motion = start, np.zeros(6)
    for scale_px in LOSS_SCALES_PX:
        problem = _Moving(seen, time, prior, scale_px)
        pose, motion = minimize(problem, (pose, motion), STEPS)
    information, gradient = (it / AdjustOptions.error_inflation**2 for it in problem.of_matches((pose, motion)))
    known = np.linalg.pinv(information[:6, :6], hermitian=True)
    left = information[6:, 6:] - information[6:, :6] @ known @ information[:6, 6:]
    slope = gradient[6:] - information[6:, :6] @ known @ gradient[:6]
    probability, steps = prior.posterior(left, slope, motion)
    step = probability @ steps
    return perturbed(pose, -known @ (gradient[:6] + information[:6, 6:] @ step)), motion + step


@dataclass(frozen=True, eq=False)
class _Moving:
    """The cost and its derivatives by pose and motion; see `optimize.Problem`. A point is camera_from_world and m.

    Points are fixed. Times (M,) are those of the matches; the prior is its widest part.
    """

    seen: PixelPoints
    time: Array
    prior: MotionPrior
    loss_scale_px: float

    def cost(self, x: tuple[RigidTransform, Array]) -> float:
        """Cost at a point; NaN if a point in the world is behind the camera."""
        residual = self._residual(self._in_camera(x))
        prior = (((x[1] - self.prior.mean[-1]) / self.prior.sigma[-1]) ** 2).sum()
        weighted = AdjustOptions.error_inflation**2 * float(prior)
        return cauchy_cost((residual**2).sum(axis=1), self.loss_scale_px) + weighted

    def linearize(self, x: tuple[RigidTransform, Array]) -> tuple[Array, Array]:
        """Half the cost's information (12, 12) and gradient (12,): of the left perturbation, and of the motion."""
        information, gradient = self.of_matches(x)
        weight = (AdjustOptions.error_inflation / self.prior.sigma[-1]) ** 2
        information[6:, 6:] += np.diag(weight)
        gradient[6:] += weight * (x[1] - self.prior.mean[-1])
        return information, gradient

    def of_matches(self, x: tuple[RigidTransform, Array]) -> tuple[Array, Array]:
        """The same without the prior, derivatives to first order in m.

        A perturbation of the pose in the middle is taken for one at the time of the row, without Ad(Exp(t m)).
        """
        x_in_camera = self._in_camera(x)
        residual = self._residual(x_in_camera)
        weight = cauchy_weight((residual**2).sum(axis=1), self.loss_scale_px)
        by_pose = pose_jacobian(self.seen.camera, x_in_camera)
        jacobian = np.concatenate([by_pose, self.time * by_pose], axis=1)
        weighted = weight * jacobian
        information = weighted[0] @ jacobian[0].T + weighted[1] @ jacobian[1].T
        return information, weighted[0] @ residual[:, 0] + weighted[1] @ residual[:, 1]

    def step(
        self, x: tuple[RigidTransform, Array], equations: tuple[Array, Array], damping: float
    ) -> tuple[RigidTransform, Array] | None:
        """The point after a step; None where it is not determined."""
        step = damped_step(*equations, damping)
        return None if step is None else (perturbed(x[0], step[:6]), x[1] + step[6:])

    def _in_camera(self, x: tuple[RigidTransform, Array]) -> Array:
        return _at_times(x[0].apply(self.seen.x_in_world), self.time, x[1])

    def _residual(self, x_in_camera: Array) -> Array:
        return np.asarray(self.seen.camera.project(x_in_camera) - self.seen.pixels)


def _at_times(x_in_camera: Array, time: Array, motion: Array) -> Array:
    """Points (M, 3) in the frame of the camera at the time (M,) of each, from those in the middle: Exp(t m) x.

    To first order in m: the shift is t v, as if the camera did not turn meanwhile.
    """
    turned = Rotation.from_rotvec(time[:, None] * motion[3:]).apply(x_in_camera)
    return np.asarray(turned + time[:, None] * motion[:3])


def _equations(support: PosedSupport, time: Array, options: AdjustOptions, used: Priors) -> IntrinsicsEquations | None:
    """Normal equations of the motion, all other unknowns eliminated; None if the matches do not determine a pose.

    They contain the priors on the pose that were used, as the adjustment weighs them.
    """
    estimate = support.estimate
    chosen = np.flatnonzero(estimate.errors_px < options.max_error_px)
    if len(chosen) < LEAST_MATCHES:
        return None
    problem, there = pose_problem(AdjustInput.of(support, options), chosen, estimate.world_from_camera)
    problem = replace(problem, priors=used, prior_weight=options.error_inflation**2)
    wider, bundle = _with_motion(problem, there.bundle, time)
    dispersion = disperse(wider, bundle, options.uncertainty.max_matches, bool(used))
    return None if dispersion is None else dispersion.intrinsics


def _with_motion(problem: BundleProblem, bundle: Bundle, time: Array) -> tuple[BundleProblem, Bundle]:
    """Adds the motion to the unknowns of a problem, without a prior; times (N,) are those of the query's keypoints."""
    tracks, seen, none = problem.observations.tracks, problem.by_view, np.zeros(6)
    by_pose = seen.at(bundle).by_pose[:, :, seen.parts[-1]]
    keypoint = tracks.keypoint[tracks.view == len(problem.given.rotation)]
    wider = replace(problem, by_view=replace(seen, by_intrinsics=by_pose * time[keypoint]))
    wider = replace(wider, intrinsics_information=none, intrinsics_offset=none)
    return wider, replace(bundle, intrinsics=none)
