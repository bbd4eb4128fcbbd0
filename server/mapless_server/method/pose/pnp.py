"""Pose from 2D-3D matches: RANSAC and Levenberg-Marquardt; and the gate, which rejects poses that chance could support.

As in the paper, the refined pose replaces the initial one only if it has at least as many inliers. Priors add
candidates, and terms in the cost (see `with_priors`).

The gate: a pose must have more inliers than wrong matches can be expected to give (a-contrario model estimation, Moisan
and Stival 2004). Wrong matches of repeated texture agree with one another and pass it; `judge` rejects these.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import poselib
from numpy.typing import NDArray
from scipy.special import gammaln

from mapless.geometry import Camera, RigidTransform
from mapless_server.bounds import check_bounds

from ..bundle.estimate import PoseEstimate, PoseStage
from ..bundle.priors import NO_PRIORS, Priors
from ..features.limits import INLIER_PX, LOSS_SCALE_PX, MIN_INLIERS
from ..features.views import View
from ..optim.optimize import pose_hessian, world_covariance
from ..rejection import Rejection, RejectionReason
from ..structure.model import PixelPoints, PointMatches, Structure
from .with_priors import informed_pose

SAMPLE, SAMPLE_INLIERS, SAMPLE_ITERATIONS = 80, 32, 300
"""Matches that RANSAC sees first, the least inliers among them, and the largest number of iterations: so many find a
pose with that share of inliers, but for one case in 10^8."""

LN_10 = math.log(10)
"""From logarithms to base 10 to natural ones."""

MIN_MATCHES = 6
"""Fewer give no pose."""

REFINEMENT = {"loss_type": "CAUCHY", "loss_scale": LOSS_SCALE_PX}
"""PoseLib's options of the refinement after RANSAC. PoseLib silently ignores options that it does not know."""

MAX_LOG10_FALSE_ALARMS = -3.0
"""Largest log10 of the expected number of poses with as many inliers among wrong matches."""

MIN_SIGMA_PX = 0.1
"""Least standard deviation of keypoints in the covariance of a pose that is not adjusted."""

REFINEMENT_STEPS = 3
"""Levenberg-Marquardt steps of each refinement of a pose from a sample."""


@dataclass(frozen=True)
class PnpOptions:
    """Options of the pose solver.

    Attributes:
        inlier_px: largest reprojection error of an inlier.
        min_iterations: least number of RANSAC iterations; enough with an initial pose.
        max_iterations: largest number of RANSAC iterations, reached with 5 % inliers.
        max_matches: largest number of matches, evenly thinned; more are not more accurate, and scoring is linear in it.
    """

    inlier_px: float = INLIER_PX
    min_iterations: int = 100
    max_iterations: int = 20_000
    max_matches: int = 2000

    def __post_init__(self) -> None:
        check_bounds(self, "inlier_px", above=0)
        check_bounds(self, "min_iterations", above=0, at_most=self.max_iterations)


def solve_pose(
    query: View,
    structure: Structure,
    matches: PointMatches,
    world_from_query_initial: RigidTransform,
    options: PnpOptions,
    priors: Priors = NO_PRIORS,
) -> PoseEstimate | Rejection:
    """Estimates the query's pose from its matches with the structure.

    Returns the refined or the initial pose, whichever has more inliers (the refined one on a tie); or a better
    candidate from priors, refined with the consistent priors. Or a rejection: TOO_FEW_MATCHES; PNP_FAILED if no pose
    has four inliers.
    """
    if len(matches) < MIN_MATCHES:
        return Rejection(RejectionReason.TOO_FEW_MATCHES, f"{len(matches)} 2D-3D matches, {MIN_MATCHES} needed")
    seen = matches.seen(query, structure.x_in_world)
    refined = ransac(seen, world_from_query_initial, options)
    candidates = [(PoseStage.REFINED, refined)] if refined else []
    candidates.append((PoseStage.INITIAL, world_from_query_initial))
    stage, pose = max(candidates, key=lambda it: seen.inlier_count(it[1], options.inlier_px))
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
    if inliers.sum() < MIN_INLIERS:
        message = f"no pose explains more than {inliers.sum()} of {len(seen)} matches"
        return Rejection(RejectionReason.PNP_FAILED, message)
    # Of half-normal lengths in two dimensions the median is sqrt(2 ln 2) sigma.
    sigma_px = max(MIN_SIGMA_PX, float(np.median(errors_px[inliers])) / np.sqrt(2 * np.log(2)))
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
        brief = replace(
            options,
            min_iterations=min(options.min_iterations, SAMPLE_ITERATIONS),
            max_iterations=min(options.max_iterations, SAMPLE_ITERATIONS),
        )
        pose, count = _ransac(seen[sample], initial, brief, {"max_iterations": 0})
        pose = _refined(seen, pose, options) if count >= SAMPLE_INLIERS else None
    if pose is None:
        pose, _ = _ransac(seen, initial, options, REFINEMENT)
    return inverse_of(pose)


def _ransac(
    seen: PixelPoints, initial: poselib.CameraPose | None, options: PnpOptions, refinement: Mapping[str, object]
) -> tuple[poselib.CameraPose, int]:
    """PoseLib's RANSAC: the pose, and its number of inliers."""
    pose, found = poselib.estimate_absolute_pose(
        seen.pixels,
        seen.x_in_world,
        poselib_camera(seen.camera),
        {"max_reproj_error": options.inlier_px, **iterations_between(options.min_iterations, options.max_iterations)},
        dict(refinement),
        initial,
    )
    return pose, int(found.get("num_inliers", 0))


def _refined(seen: PixelPoints, pose: poselib.CameraPose, options: PnpOptions) -> poselib.CameraPose:
    """Refines a pose by its inliers, twice: at a pose that rests on a sample some are missing."""
    camera, refinement = poselib_camera(seen.camera), {**REFINEMENT, "max_iterations": REFINEMENT_STEPS}
    for thinning in (2, 1):
        some = seen[::thinning]
        off = seen.camera.project(some.x_in_world @ np.asarray(pose.R).T + np.asarray(pose.t)) - some.pixels
        inliers = some[np.einsum("ni,ni->n", off, off) < options.inlier_px**2]
        pose, _ = poselib.refine_absolute_pose(inliers.pixels, inliers.x_in_world, pose, camera, refinement)
    return pose


def iterations_between(least: int, most: int) -> dict[str, int]:
    """PoseLib's options of a RANSAC with so many iterations; its samples are always the same."""
    return {"min_iterations": least, "max_iterations": most, "seed": 0}


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


def inverse_of(pose: poselib.CameraPose) -> RigidTransform | None:
    """The inverse of a pose in PoseLib's form; None if it is not finite."""
    rotation, translation = np.asarray(pose.R), np.asarray(pose.t)
    if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
        return None
    return RigidTransform(rotation, translation).inverse()


def gate_failure(
    camera: Camera,
    matches: PointMatches,
    inliers: NDArray[np.bool_],
    inlier_px: float,
    log10_chance: float = 0.0,
    named: str = "matches",
) -> str | None:
    """Says in one sentence why a pose fails the gate; None if it passes.

    At least four of the matches with points are `inliers` (M,) of the pose, with errors up to `inlier_px`. For
    `log10_chance` see `Priors.log10_chance`; the sentence has the matches `named` so.
    """
    expected = log10_false_alarms([(camera, matches, inliers)], inlier_px) + log10_chance
    return failure_by_chance(f"{inliers.sum()} of {len(matches)} {named} agree on a pose", expected)


def failure_by_chance(count: str, log10_expected: float) -> str | None:
    """Says, after the `count` of matches that agree, that chance could do it; None if it could not."""
    if log10_expected <= MAX_LOG10_FALSE_ALARMS:
        return None
    return f"{count}, which chance could do ({format_false_alarms(log10_expected, MAX_LOG10_FALSE_ALARMS)})"


def log10_false_alarms(
    photographs: Sequence[tuple[Camera, PointMatches, NDArray[np.bool_]]], inlier_px: float
) -> float:
    """log10 of the expected number of poses with as many inliers among random matches of all photographs.

    These are given by camera, matches and inliers (M,). The chance of an inlier is the share of its disc in the image
    for matches found in the whole image, and in the search circle for guided matches, the largest of any photograph.
    The smaller of the two groups' results is returned.
    """
    disc = inlier_px**2
    guided, inliers = (np.concatenate(it) for it in zip(*((m.guided, i) for _, m, i in photographs), strict=True))
    # Areas in which a match was searched, square pixels divided by pi.
    of_image = min(it.width_px * it.height_px / np.pi for it, _, _ in photographs)
    near_point = min(it.radius_px**2 for _, it, _ in photographs)
    return min(
        false_alarms(int(chosen.sum()), int((inliers & chosen).sum()), disc / max(area, disc))
        for chosen, area in ((~guided, of_image), (guided, near_point))
    )


def disc_chance(camera: Camera, inlier_px: float) -> float:
    """Chance that a wrong match lies within `inlier_px` of a point's projection: a disc's share of the image."""
    return float(min(1.0, np.pi * inlier_px**2 / (camera.width_px * camera.height_px)))


def false_alarms(match_count: int, inlier_count: int, chance: float, sample: int = 3) -> float:
    """log10 of (n - m) C(n, k) C(k, m) p^(k - m): k or more of n matches agree with a pose through a `sample` of m.

    p is the chance that a wrong match agrees.
    """
    n, k, m = match_count, inlier_count, sample
    if k <= m or chance >= 1:
        return np.inf
    return float((np.log(n - m) + _log_choose(n, k) + _log_choose(k, m) + (k - m) * np.log(chance)) / LN_10)


def log10_tail(match_count: int, inlier_count: int, chance: float) -> float:
    """log10 of an upper bound of the probability of k or more inliers of n wrong matches, (n + 1) C(n, k) p^k."""
    n, k = match_count, inlier_count
    return float(min(0.0, (np.log(n + 1) + _log_choose(n, k) + k * np.log(chance)) / LN_10))


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
