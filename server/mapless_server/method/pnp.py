"""Pose from 2D-3D matches: RANSAC and Levenberg-Marquardt, and whether to believe the result.

As in the paper, the refined pose replaces the initial one only if it explains at least as many matches. Whether the
winner is believed is our own: wrong matches alone must not be expected to support a pose as well (a-contrario model
estimation, Moisan and Stival 2004), and repeated texture, whose wrong matches do agree with each other, is told by two
things that a true pose has and it has not: what should be seen is found, and not in one corner only.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
import poselib
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.special import gammaln

from mapless.geometry import Array, Camera, RigidTransform, normalize_jacobian

from .match import PointMatches
from .rejection import Rejection, RejectionReason
from .structure import Structure
from .views import View


class PoseStage(str, Enum):
    """Which stage gave the pose."""

    INITIAL = "initial"
    REFINED = "refined"
    COARSE = "coarse"
    """The initial one, because there was no time to refine it."""


@dataclass(frozen=True)
class PnpOptions:
    """Options of the pose solver.

    Attributes:
        inlier_px: largest reprojection error of an inlier.
        loss_scale_px: of the Cauchy loss in the final refinement; about the error of a good keypoint.
        min_iterations: RANSAC's least; enough with an initial pose to start from.
        max_iterations: RANSAC's most, reached when 5 % of the matches are right.
        max_matches: a larger, evenly thinned number is not better, and scoring is linear in it.
        min_matches: fewer are no ground for a pose.
        max_log10_false_alarms: a pose is believed when fewer than 10 to this power poses supported as well are expected
            from wrong matches.
        min_found_share: least share of the points inside the image that are inliers. Of 200 photographs posed rightly,
            hard ones among them, the worst had 0.10; of those posed wrongly by chance or repetition most had 0.01.
        enough_inliers: so many are believed whatever else should be visible: with many references the structure reaches
            far beyond what one photograph can show. Repetition has fooled no more than 23.
        min_hull_share: least share of the image that the inliers' convex hull covers. On the same photographs the worst
            right one had 0.08; a repeated floor tile that fooled 16 matches had 0.03.
    """

    inlier_px: float = 4.0
    loss_scale_px: float = 1.0
    min_iterations: int = 100
    max_iterations: int = 20_000
    max_matches: int = 2000
    min_matches: int = 6
    max_log10_false_alarms: float = -3.0
    min_found_share: float = 0.08
    enough_inliers: int = 100
    min_hull_share: float = 0.04

    def __post_init__(self) -> None:
        shares = (self.min_found_share, self.min_hull_share)
        if not (
            self.inlier_px > 0
            and self.loss_scale_px > 0
            and self.min_matches >= 4
            and 0 <= min(shares) <= max(shares) < 1
        ):
            raise ValueError(f"senseless options: {self}")
        if not 0 < self.min_iterations <= self.max_iterations:
            raise ValueError(f"senseless options: {self}")


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """A pose that is believed.

    Attributes:
        world_from_camera: metric.
        stage: whether it is the refined or the initial pose.
        inliers: (M,) which of the matches agree with it.
        errors_px: (M,) reprojection errors; NaN for points behind the camera.
        covariance: (6, 6), order x y z rx ry rz, fixed world axes, metres and radians.
    """

    world_from_camera: RigidTransform
    stage: PoseStage
    inliers: NDArray[np.bool_]
    errors_px: Array
    covariance: Array


def solve_pose(
    query: View,
    structure: Structure,
    matches: PointMatches,
    world_from_query_initial: RigidTransform,
    options: PnpOptions,
) -> PoseEstimate | Rejection:
    """The query's pose from its matches with the structure.

    Returns:
        The refined or the initial pose, whichever has more inliers (the refined one on a tie). Rejections:
        TOO_FEW_MATCHES, PNP_FAILED when neither pose explains any four, GATE when chance could have done as well.
    """
    if len(matches) < options.min_matches:
        return Rejection(RejectionReason.TOO_FEW_MATCHES, f"{len(matches)} 2D-3D matches, {options.min_matches} needed")
    x_in_world = structure.x_in_world[matches.point]
    pixels = query.features.keypoints[matches.keypoint].astype(np.float64)
    refined = ransac(query.camera, x_in_world, pixels, world_from_query_initial, options)
    candidates = [(PoseStage.REFINED, refined)] if refined else []
    candidates.append((PoseStage.INITIAL, world_from_query_initial))
    errors = [reprojection_errors_px(query.camera, pose, x_in_world, pixels) for _, pose in candidates]
    best = int(np.argmax([(e < options.inlier_px).sum() for e in errors]))
    (stage, pose), inliers = candidates[best], errors[best] < options.inlier_px
    if inliers.sum() < 4:
        message = f"no pose explains more than {inliers.sum()} of {len(matches)} matches"
        return Rejection(RejectionReason.PNP_FAILED, message)
    doubt = doubts(query, structure, matches, pose, inliers, options)
    if doubt:
        return Rejection(RejectionReason.GATE, doubt)
    # Of half-normal lengths in two dimensions the median is sqrt(2 ln 2) sigma.
    sigma_px = max(0.1, float(np.median(errors[best][inliers])) / np.sqrt(2 * np.log(2)))
    hessian = pose_hessian(query.camera, pose, x_in_world[inliers]) / sigma_px**2
    return PoseEstimate(pose, stage, inliers, errors[best], world_covariance(hessian, pose))


def ransac(
    camera: Camera, x_in_world: Array, pixels: Array, world_from_camera: RigidTransform | None, options: PnpOptions
) -> RigidTransform | None:
    """P3P in RANSAC with a final Cauchy refinement, by PoseLib; None without a finite pose.

    The only place that knows PoseLib, which accepts misspelt options without a word.
    """
    step = -(-len(pixels) // options.max_matches)
    pose, _ = poselib.estimate_absolute_pose(
        pixels[::step],
        x_in_world[::step],
        {
            "model": "PINHOLE",
            "width": camera.width_px,
            "height": camera.height_px,
            "params": [camera.focal_x_px, camera.focal_y_px, camera.principal_x_px, camera.principal_y_px],
        },
        {
            "max_reproj_error": options.inlier_px,
            "min_iterations": options.min_iterations,
            "max_iterations": options.max_iterations,
            "seed": 0,
        },
        {"loss_type": "CAUCHY", "loss_scale": options.loss_scale_px},
        None if world_from_camera is None else _poselib_pose(world_from_camera),
    )
    rotation, translation = np.asarray(pose.R), np.asarray(pose.t)
    if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
        return None
    return RigidTransform(rotation, translation).inverse()


def _poselib_pose(world_from_camera: RigidTransform) -> poselib.CameraPose:
    camera_from_world = world_from_camera.inverse()
    q = camera_from_world.quaternion()
    pose = poselib.CameraPose()
    pose.q, pose.t = np.array([q.w, q.x, q.y, q.z]), camera_from_world.translation
    return pose


def reprojection_errors_px(
    camera: Camera, world_from_camera: RigidTransform, x_in_world: Array, pixels: Array
) -> Array:
    """Distances (M,) of projections from pixels; NaN for points that are not in front."""
    projected = camera.project(world_from_camera.inverse().apply(x_in_world))
    return np.asarray(np.linalg.norm(projected - pixels, axis=1))


def doubts(
    query: View,
    structure: Structure,
    matches: PointMatches,
    world_from_camera: RigidTransform,
    inliers: NDArray[np.bool_],
    options: PnpOptions,
) -> str | None:
    """What speaks against a pose, in one sentence; None if nothing does."""
    expected = log10_false_alarms(query.camera, matches, inliers, options)
    count = f"{inliers.sum()} of {len(matches)} matches agree on a pose"
    if expected > options.max_log10_false_alarms:
        return f"{count}, which chance could do (10^{expected:.1f} such poses expected)"
    size = np.array([query.camera.width_px, query.camera.height_px])
    projected = query.camera.project(world_from_camera.inverse().apply(structure.x_in_world))
    visible = int(((projected >= -0.5) & (projected < size - 0.5)).all(axis=1).sum())
    if inliers.sum() < min(options.min_found_share * visible, options.enough_inliers):
        return f"{count}, but it should show {visible} points: repeated structure somewhere else, most likely"
    pixels = query.features.keypoints[matches.keypoint[inliers]]
    hull_share = ConvexHull(pixels, qhull_options="QJ").volume / size.prod()
    if hull_share < options.min_hull_share:
        return f"{count}, but they cover only {100 * hull_share:.1f} % of the image"
    return None


def log10_false_alarms(camera: Camera, matches: PointMatches, inliers: NDArray[np.bool_], options: PnpOptions) -> float:
    """Expected number, as a power of ten, of poses that random matches would support as well.

    Matches found in the whole image hit an inlier's disc by chance with its share of the image; matches searched within
    a radius with its share of that circle. The stronger of the two groups decides.
    """
    disc = options.inlier_px**2
    area = camera.width_px * camera.height_px / np.pi
    guided = matches.guided
    return min(
        false_alarms(int((~guided).sum()), int((inliers & ~guided).sum()), disc / area),
        false_alarms(int(guided.sum()), int((inliers & guided).sum()), disc / max(matches.radius_px**2, disc)),
    )


def false_alarms(match_count: int, inlier_count: int, chance: float) -> float:
    """log10 of (n - 3) C(n, k) C(k, 3) p^(k - 3), at least k of n matches agreeing with a pose through three of them.

    Args:
        match_count: n.
        inlier_count: k.
        chance: p, the probability that a wrong match agrees.
    """
    n, k = match_count, inlier_count
    if k <= 3 or chance >= 1:
        return np.inf
    return float((np.log(n - 3) + _log_choose(n, k) + _log_choose(k, 3) + (k - 3) * np.log(chance)) / np.log(10))


def _log_choose(n: int, k: int) -> float:
    return float(gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1))


def pose_hessian(camera: Camera, world_from_camera: RigidTransform, x_in_world: Array) -> Array:
    """J^T J (6, 6) of the projections in pixels by a left perturbation (v, w) of camera_from_world."""
    x_in_camera = world_from_camera.inverse().apply(x_in_world)
    focal = np.array([camera.focal_x_px, camera.focal_y_px])
    jacobian = (normalize_jacobian(x_in_camera) * focal[:, None]) @ motion_jacobian(x_in_camera)
    return np.asarray(np.einsum("mia,mib->ab", jacobian, jacobian))


def motion_jacobian(x_in_camera: Array) -> Array:
    """Derivative (..., 3, 6) of Exp(v, w) x by the perturbation at zero: [I | -[x]x]."""
    jacobian = np.zeros((*x_in_camera.shape, 6))
    x, y, z = np.moveaxis(x_in_camera, -1, 0)
    jacobian[..., 0, 0] = jacobian[..., 1, 1] = jacobian[..., 2, 2] = 1
    jacobian[..., 0, 4], jacobian[..., 0, 5] = z, -y
    jacobian[..., 1, 3], jacobian[..., 1, 5] = -z, x
    jacobian[..., 2, 3], jacobian[..., 2, 4] = y, -x
    return jacobian


def world_covariance(hessian: Array, world_from_camera: RigidTransform) -> Array:
    """Covariance (6, 6) of world_from_camera, order x y z rx ry rz about fixed world axes.

    Takes the inverse covariance of a left perturbation (v, w) of camera_from_world:
    camera_from_world -> Exp(v, w) camera_from_world moves the centre by -R v and turns the camera by -R w, where R is
    the rotation of world_from_camera; the sign cancels.
    """
    rotate = np.kron(np.eye(2), world_from_camera.rotation)
    covariance = rotate @ np.linalg.pinv(hessian, hermitian=True) @ rotate.T
    return np.asarray((covariance + covariance.T) / 2)
