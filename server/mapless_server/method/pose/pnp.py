"""Pose from 2D-3D matches: RANSAC and Levenberg-Marquardt; and the gate, which rejects poses that chance could support.

As in the paper, the refined pose replaces the initial one only if it has at least as many inliers. Priors add
candidates, and terms in the cost (see `informed`).

A pose must have more inliers than wrong matches can be expected to give (a-contrario model estimation, Moisan and
Stival 2004). This gate is a cheap first test, which means the same for every scene; wrong matches of repeated texture
agree with one another and pass it. `judge` computes the trust of poses that pass.
"""

from dataclasses import dataclass, replace

import numpy as np
import poselib
from numpy.typing import NDArray
from scipy.special import gammaln

from mapless.geometry import Camera, RigidTransform
from mapless_server.bounds import check_bounds

from ..bundle.estimate import PoseEstimate, PoseStage
from ..bundle.priors import NO_PRIORS, Priors
from ..features.views import View
from ..optim.optimize import pose_hessian, world_covariance
from ..rejection import Rejection, RejectionReason
from ..structure.model import PixelPoints, PointMatches, Structure
from .with_priors import informed_pose

SAMPLE, SAMPLE_INLIERS, SAMPLE_ITERATIONS = 80, 32, 300
"""Matches that RANSAC sees first, the least inliers among them, and the largest number of iterations: so many find a
pose with that share of inliers, but for one case in 10^8. All of 600 matches take three times as long."""

MAX_LOG10_FALSE_ALARMS = -3.0
"""Largest log10 of the expected number of poses with as many inliers among wrong matches."""

REFINEMENT_STEPS = 3
"""Levenberg-Marquardt steps of each refinement of a pose from a sample."""


@dataclass(frozen=True)
class PnpOptions:
    """Options of the pose solver.

    Attributes:
        inlier_px: largest reprojection error of an inlier.
        loss_scale_px: scale of the Cauchy loss in the final refinement; about the error of a good keypoint.
        min_iterations: least number of RANSAC iterations; enough with an initial pose.
        max_iterations: largest number of RANSAC iterations, reached with 5 % inliers.
        max_matches: largest number of matches, evenly thinned; more are not more accurate, and scoring is linear in it.
        min_matches: fewer give no pose.
    """

    inlier_px: float = 4.0
    loss_scale_px: float = 1.0
    min_iterations: int = 100
    max_iterations: int = 20_000
    max_matches: int = 2000
    min_matches: int = 6

    def __post_init__(self) -> None:
        check_bounds(self, "inlier_px loss_scale_px", above=0)
        check_bounds(self, "min_iterations", above=0, at_most=self.max_iterations)
        check_bounds(self, "min_matches", at_least=4)


def solve_pose(
    query: View,
    structure: Structure,
    matches: PointMatches,
    world_from_query_initial: RigidTransform,
    options: PnpOptions,
    priors: Priors = NO_PRIORS,
) -> PoseEstimate | Rejection:
    """Estimates the query's pose from its matches with the structure.

    Returns:
        The refined or the initial pose, whichever has more inliers (the refined one on a tie); or a better candidate
        from priors, refined with the consistent priors. Or a rejection: TOO_FEW_MATCHES; PNP_FAILED if no pose has four
        inliers.
    """
    if len(matches) < options.min_matches:
        return Rejection(RejectionReason.TOO_FEW_MATCHES, f"{len(matches)} 2D-3D matches, {options.min_matches} needed")
    seen = matches.seen(query, structure.x_in_world)
    refined = ransac(seen, world_from_query_initial, options)
    candidates = [(PoseStage.REFINED, refined)] if refined else []
    candidates.append((PoseStage.INITIAL, world_from_query_initial))
    inlier_counts = [(seen.errors_px(pose) < options.inlier_px).sum() for _, pose in candidates]
    stage, pose = candidates[int(np.argmax(inlier_counts))]
    if not priors:
        return _estimate(seen, stage, pose, options)
    informed = informed_pose(seen, pose, priors, options.inlier_px)
    assert informed  # `pose` at the least
    if informed.without_priors is not pose:
        stage = PoseStage.REFINED
    without_priors = _estimate(seen, stage, informed.without_priors, options)
    if isinstance(without_priors, Rejection):
        return without_priors
    if not informed.used:
        return replace(without_priors, prior_checks=informed.checks)
    found = _estimate(seen, PoseStage.REFINED, informed.world_from_camera, options)
    if isinstance(found, Rejection):
        return found
    covariance = informed.used.sharpened(found.covariance, found.world_from_camera)
    return replace(found, covariance=covariance, prior_checks=informed.checks, without_priors=without_priors)


def _estimate(
    seen: PixelPoints, stage: PoseStage, pose: RigidTransform, options: PnpOptions
) -> PoseEstimate | Rejection:
    """The estimate of a pose, with inliers, errors and covariance; PNP_FAILED for fewer than four inliers."""
    errors_px = seen.errors_px(pose)
    inliers = errors_px < options.inlier_px
    if inliers.sum() < 4:
        message = f"no pose explains more than {inliers.sum()} of {len(seen)} matches"
        return Rejection(RejectionReason.PNP_FAILED, message)
    # Of half-normal lengths in two dimensions the median is sqrt(2 ln 2) sigma.
    sigma_px = max(0.1, float(np.median(errors_px[inliers])) / np.sqrt(2 * np.log(2)))
    covariance = world_covariance(pose_hessian(seen.camera, pose, seen.x_in_world[inliers]) / sigma_px**2, pose)
    return PoseEstimate(pose, stage, inliers, errors_px, covariance)


def ransac(seen: PixelPoints, world_from_camera: RigidTransform | None, options: PnpOptions) -> RigidTransform | None:
    """Estimates a pose by P3P in RANSAC with a final Cauchy refinement (PoseLib); None without a finite pose.

    Of many matches RANSAC sees a sample first. If enough of it agrees with a pose, all its inliers refine that pose;
    otherwise RANSAC sees all matches.
    """
    seen = seen[:: -(-len(seen) // options.max_matches)]
    initial = None if world_from_camera is None else poselib_pose(world_from_camera.inverse())
    pose = None
    if len(seen) >= 2 * SAMPLE:
        sample = np.arange(SAMPLE) * len(seen) // SAMPLE
        pose, count = _ransac(seen[sample], initial, options, SAMPLE_ITERATIONS, 0)
        pose = _refined(seen, pose, options) if count >= SAMPLE_INLIERS else None
    if pose is None:
        pose, _ = _ransac(seen, initial, options, options.max_iterations)
    rotation, translation = np.asarray(pose.R), np.asarray(pose.t)
    if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
        return None
    return RigidTransform(rotation, translation).inverse()


def _ransac(
    seen: PixelPoints,
    initial: poselib.CameraPose | None,
    options: PnpOptions,
    max_iterations: int,
    refinement_steps: int = 100,
) -> tuple[poselib.CameraPose, int]:
    """PoseLib's RANSAC: the pose, and its number of inliers. PoseLib silently ignores options that it does not know."""
    ransac_options = {
        "max_reproj_error": options.inlier_px,
        "min_iterations": min(options.min_iterations, max_iterations),
        "max_iterations": min(options.max_iterations, max_iterations),
        "seed": 0,
    }
    camera, refinement = poselib_camera(seen.camera), _refinement(options, refinement_steps)
    pose, found = poselib.estimate_absolute_pose(
        seen.pixels, seen.x_in_world, camera, ransac_options, refinement, initial
    )
    return pose, int(found.get("num_inliers", 0))


def _refined(seen: PixelPoints, pose: poselib.CameraPose, options: PnpOptions) -> poselib.CameraPose:
    """Refines a pose by its inliers, twice: at a pose that rests on a sample some are missing."""
    camera, refinement = poselib_camera(seen.camera), _refinement(options, REFINEMENT_STEPS)
    for thinning in (2, 1):
        some = seen[::thinning]
        off = seen.camera.project(some.x_in_world @ np.asarray(pose.R).T + np.asarray(pose.t)) - some.pixels
        inliers = some[np.einsum("ni,ni->n", off, off) < options.inlier_px**2]
        pose, _ = poselib.refine_absolute_pose(inliers.pixels, inliers.x_in_world, pose, camera, refinement)
    return pose


def _refinement(options: PnpOptions, steps: int) -> dict[str, object]:
    return {"loss_type": "CAUCHY", "loss_scale": options.loss_scale_px, "max_iterations": steps}


def poselib_camera(camera: Camera) -> dict[str, object]:
    """A pinhole camera in PoseLib's form."""
    return {
        "model": "PINHOLE",
        "width": camera.width_px,
        "height": camera.height_px,
        "params": [camera.focal_x_px, camera.focal_y_px, camera.principal_x_px, camera.principal_y_px],
    }


def poselib_pose(target_from_source: RigidTransform) -> poselib.CameraPose:
    """A pose in PoseLib's form; a camera's pose is camera_from_world."""
    q = target_from_source.quaternion()
    pose = poselib.CameraPose()
    pose.q, pose.t = np.array([q.w, q.x, q.y, q.z]), target_from_source.translation
    return pose


def gate_failure(
    camera: Camera,
    matches: PointMatches,
    inliers: NDArray[np.bool_],
    inlier_px: float,
    log10_chance: float = 0.0,
) -> str | None:
    """Says in one sentence why a pose fails the gate; None if it passes.

    Args:
        camera: camera of the photograph.
        matches: matches of the photograph with the points of a structure.
        inliers: (M,) which of them are inliers of the pose; at least four.
        inlier_px: largest reprojection error of an inlier.
        log10_chance: see `Priors.log10_chance`.
    """
    expected = log10_false_alarms(camera, matches, inliers, inlier_px) + log10_chance
    if expected <= MAX_LOG10_FALSE_ALARMS:
        return None
    count = f"{inliers.sum()} of {len(matches)} matches agree on a pose"
    return f"{count}, which chance could do ({format_false_alarms(expected, MAX_LOG10_FALSE_ALARMS)})"


def log10_false_alarms(camera: Camera, matches: PointMatches, inliers: NDArray[np.bool_], inlier_px: float) -> float:
    """log10 of the expected number of poses with as many inliers among random matches.

    The chance of an inlier is the share of its disc in the image for matches found in the whole image, and in the
    search circle for guided matches. The smaller of the two groups' results is returned.
    """
    disc = inlier_px**2
    area = camera.width_px * camera.height_px / np.pi
    guided = matches.guided
    return min(
        false_alarms(int((~guided).sum()), int((inliers & ~guided).sum()), disc / area),
        false_alarms(int(guided.sum()), int((inliers & guided).sum()), disc / max(matches.radius_px**2, disc)),
    )


def false_alarms(match_count: int, inlier_count: int, chance: float, sample: int = 3) -> float:
    """Log10 of (n - m) C(n, k) C(k, m) p^(k - m): at least k of n matches agree with a pose through m of them.

    Args:
        match_count: n.
        inlier_count: k.
        chance: p, the probability that a wrong match agrees.
        sample: m, the number of matches that determine a pose.
    """
    n, k, m = match_count, inlier_count, sample
    if k <= m or chance >= 1:
        return np.inf
    return float((np.log(n - m) + _log_choose(n, k) + _log_choose(k, m) + (k - m) * np.log(chance)) / np.log(10))


def log10_tail(match_count: int, inlier_count: int, chance: float) -> float:
    """log10 of an upper bound of the probability of k or more inliers of n wrong matches, (n + 1) C(n, k) p^k."""
    n, k = match_count, inlier_count
    return float(min(0.0, (np.log(n + 1) + _log_choose(n, k) + k * np.log(chance)) / np.log(10)))


def format_false_alarms(log10_expected: float, log10_allowed: float) -> str:
    """Formats the expected number and its bound; it is infinite for three matches, which agree by construction."""
    expected, allowed = (
        f"{float(f'{10**it:.2g}'):g}" if -4 <= it < 5 else f"10^{it:.1f}".removesuffix(".0")
        for it in (log10_expected, log10_allowed)
    )
    if log10_expected == np.inf:
        expected = "many"
    return f"{expected} such poses expected by chance, at most {allowed} allowed"


def _log_choose(n: int, k: int) -> float:
    return float(gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1))
