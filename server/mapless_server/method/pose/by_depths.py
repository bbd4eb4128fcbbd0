"""The pose from matches with depths, which a sensor measured or a network predicts: one reference is enough.

The matches with one reference determine the rotation and the direction of the step from one camera to the other; the
length of the step follows from the depths. Both are one problem of six unknowns: each match is a point at its depth,
whose error moves its projection along the epipolar line, so the covariance of a residual is

    sigma^2 I + s_d^2 j j^T,    j the derivative of the projection by the logarithm of the depth,

where sigma and s_d, the errors of keypoints and of single depths, are estimated from the residuals. Those of depths are
at least as stated, and as stated where the step is too small to show them. An error that all depths share, of the
sensor's or the network's metre, changes no residual: it moves the camera along the step, and the covariance of the pose
contains it as s^2 d d^T, with d the step and s its relative standard deviation. Neither do errors of the reference's
pose, whose usual size the covariance contains.

A match whose reference has no depth is a point of the photograph's own depth, in the photograph's frame, that the
reference sees: the same problem turned around. The factor that these depths share is an unknown with its prior, since
several references, or depths of both sides, show it. The scene's unit remains that of the references' poses. A few
matches that agree by chance would give the factor any value, so only references with enough inliers for a pose count.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform

from ..bundle.dispersion import scale_covariance
from ..bundle.estimate import PosedSupport, PoseEstimate, PoseStage
from ..features.tracks import Tracks
from ..features.views import Matches, PosedView, View
from ..pairs.stationary import StationaryOptions, are_moved
from ..rejection import Rejection, RejectionReason
from ..structure.model import DepthPlanes, PixelPoints, PointMatches, Structure
from ..structure.observations import FIRST_GUESS
from .depth_problem import (
    MIN_INLIERS,
    DepthProblem,
    DepthSolution,
    covariance_of_errors,
    excess_of,
    factor_covariance,
    linearize,
    noise,
    reference_covariance,
    score_of,
    solve,
)
from .turned import TurnedMatches


@dataclass(frozen=True, eq=False)
class MatchedDepths:
    """Depths of the keypoints of a reference that M matches have.

    Attributes:
        depth: (M,) in the unit of the reference's pose; NaN where unknown.
        sigma: relative standard deviation of a depth; None if it is not stated.
        common_sigma: relative standard deviation of the factor that they share.
    """

    depth: Array
    sigma: float | None
    common_sigma: float


@dataclass(frozen=True, eq=False)
class Found:
    """A pose from one reference.

    Attributes:
        support: support with the estimate; its points have their depths.
        score: the larger, the less likely are so many inliers among wrong matches.
        moved_score: the same for those matches that are at other pixels than in the reference; see `judge.references`.
        own_covariance: (6, 6) by the errors that the matches show: without those that depths share, or may have.
        excess: ratio of the depths' errors, by the residuals, to those stated; at least 1.
        carried: points of V matches, each by its own reference alone; those of several references may contradict.
        carried_view: (V,) index of the reference of each.
        carried_keypoint: (V,) index of the query's keypoint of each; several references may share it.
    """

    support: PosedSupport
    score: float
    moved_score: float
    own_covariance: Array
    excess: float
    carried: PixelPoints
    carried_view: NDArray[np.intp]
    carried_keypoint: NDArray[np.intp]


def solve_by_depths(
    query: View,
    references: Sequence[PosedView],
    query_matches: Sequence[Matches],
    depths: Sequence[MatchedDepths],
    initial: RigidTransform | None,
    origin: Array,
    stationary: StationaryOptions,
) -> Found | Rejection:
    """Estimates the pose of a query from its matches (M, 2) with references, one or more, of which a side has a depth.

    TOO_FEW_MATCHES or PNP_FAILED if there is none. `depths` are those of the references' keypoints that the matches
    have; the query's own, if any, make the points of the other matches. `initial` is a pose to begin with; `origin`
    (3,) is that of the references' world in the caller's world; `stationary` says what is at the same pixels.
    """
    problem, view, matches = _problem_of(query, references, query_matches, depths)
    if len(matches) < MIN_INLIERS:
        message = f"{len(matches)} matches with a depth, {MIN_INLIERS} needed with one reference"
        return Rejection(RejectionReason.TOO_FEW_MATCHES, message)
    solved = solve(problem, initial)
    count = 0 if solved is None else int(solved.inliers.sum())
    if solved is None or count < MIN_INLIERS:
        message = f"no pose explains more than {count} of {len(matches)} matches, {MIN_INLIERS} needed"
        return Rejection(RejectionReason.PNP_FAILED, message)
    pose = solved.world_from_camera
    nearest = int(np.bincount(view[solved.inliers], minlength=len(references)).argmax())
    centre = references[nearest].world_from_camera.translation
    covariance = covariance_of_errors(problem, solved) + reference_covariance(problem, solved, centre)
    if problem.turned is None:
        covariance += scale_covariance(pose, centre, depths[nearest].common_sigma)
    else:
        covariance += factor_covariance(problem, problem.turned, solved, [it.common_sigma for it in depths])
    _, shown_sigma = noise(linearize(problem, pose, solved.log_factor), solved.inliers, None)
    as_shown = replace(solved, depth_sigma=min(solved.depth_sigma, shown_sigma))
    own = covariance_of_errors(problem, as_shown) + reference_covariance(problem, solved, centre)
    estimate = PoseEstimate(pose, PoseStage.REFINED, solved.inliers, solved.errors_px, covariance)
    rows = np.arange(len(matches))
    structure = Structure(
        problem.points(solved),
        Tracks(rows, view, matches[:, 1].astype(np.intp)),
        replace(FIRST_GUESS, level_px=solved.sigma_px),
        None if problem.depth_sigma is None else _planes(problem, solved, references, view, depths),
    )
    found = PointMatches(rows, matches[:, 0].astype(np.intp), np.zeros(len(rows), bool), 0.0)
    used = tuple(matches[view == i] for i in range(len(references)))
    support = PosedSupport(query, tuple(references), structure, found, origin, used, estimate=estimate)
    moved = np.ones(len(matches), bool)
    for i, (reference, its) in enumerate(zip(references, used, strict=True)):
        moved[view == i] = are_moved(query, reference, its, its, stationary)
    some = replace(solved, inliers=solved.inliers[moved], errors_px=solved.errors_px[moved])
    excess = excess_of(problem, solved)
    carried = _carried(query, references, query_matches, depths, solved.log_factor)
    return Found(support, score_of(problem, solved), score_of(problem[moved], some), own, excess, *carried)


def _problem_of(
    query: View,
    references: Sequence[PosedView],
    query_matches: Sequence[Matches],
    depths: Sequence[MatchedDepths],
) -> tuple[DepthProblem, NDArray[np.intp], Matches]:
    """The problem of the matches with a depth, with the index (M,) of each one's reference, and the matches (M, 2).

    A keypoint has one point at most by depths of references: that of the reference with most matches with a depth.
    """
    view, matches, points = _all_points(references, query_matches, depths)
    known: NDArray[np.bool_] = np.asarray(np.isfinite(points).all(axis=1))
    stated = [it.sigma for it in depths if it.sigma is not None]
    sigma = float(np.median(stated)) if len(stated) > 1 else next(iter(stated), None)
    centres = np.array([it.world_from_camera.translation for it in references])
    own = np.zeros_like(known)
    if query.depths is not None:
        own = ~known & np.isfinite(query.depths.depth[matches[:, 0]])
    counts, keys = np.bincount(view[known], minlength=len(references)), [it.key for it in references]
    rank = np.argsort(sorted(range(len(references)), key=lambda i: (-counts[i], keys[i])))
    at = np.flatnonzero(known)
    at = at[np.argsort(rank[view[at]], kind="stable")]
    known[np.delete(at, np.unique(matches[at, 0], return_index=True)[1])] = False
    seen = PixelPoints(query.camera, points[known], query.features.pixels(matches[known, 0]))
    problem = DepthProblem(seen, centres[view[known]], sigma, view[known])
    if query.depths is None or not own.any():
        return problem, view[known], matches[known]
    turned = TurnedMatches.of(query, query.depths, references, view[own], matches[own])
    sigma, view = turned.depth_sigma if sigma is None else sigma, np.concatenate([view[known], view[own]])
    problem = replace(problem, depth_sigma=sigma, view=view, turned=turned)
    return problem, view, np.concatenate([matches[known], matches[own]])


def _all_points(
    references: Sequence[PosedView], query_matches: Sequence[Matches], depths: Sequence[MatchedDepths]
) -> tuple[NDArray[np.intp], Matches, Array]:
    """All matches (V, 2), the index (V,) of each one's reference, and its point (V, 3) by the depth of that."""
    view = np.repeat(np.arange(len(references)), [len(it) for it in query_matches])
    points = np.concatenate([_points(*it) for it in zip(references, depths, query_matches, strict=True)])
    return view, np.concatenate(query_matches), points


def _carried(
    query: View,
    references: Sequence[PosedView],
    query_matches: Sequence[Matches],
    depths: Sequence[MatchedDepths],
    log_factor: float,
) -> tuple[PixelPoints, NDArray[np.intp], NDArray[np.intp]]:
    """The matches carried to points by their own references alone, the reference (V,) and the keypoint (V,) of each.

    With the query's depths a reference alone has a pose among these, and so the depths of its own keypoints.
    """
    view, matches, points = _all_points(references, query_matches, depths)
    if query.depths is not None:
        own = ~np.isfinite(points).all(axis=1) & np.isfinite(query.depths.depth[matches[:, 0]])
        if own.any():
            turned = TurnedMatches.of(query, query.depths, references, view[own], matches[own])
            points[own] = turned.carried(log_factor)
    known = np.isfinite(points).all(axis=1)
    keypoint = matches[known, 0].astype(np.intp)
    return PixelPoints(query.camera, points[known], query.features.pixels(keypoint)), view[known], keypoint


def _points(reference: PosedView, depths: MatchedDepths, matches: Matches) -> Array:
    """Points (M, 3) in the world at the depths (M,) of the reference's keypoints; NaN without a depth."""
    rays, depth = reference.view.camera.rays(reference.view.features.pixels(matches[:, 1])), depths.depth
    points = rays / rays[:, 2:] * np.where(depth > 0, depth, np.nan)[:, None]
    return np.asarray(reference.world_from_camera.apply(points))


def _planes(
    problem: DepthProblem,
    solved: DepthSolution,
    references: Sequence[PosedView],
    view: NDArray[np.intp],
    depths: Sequence[MatchedDepths],
) -> DepthPlanes:
    """Planes of the points at the references' depths; those at the query's are near none."""
    count = len(problem.seen)
    normal = np.array([it.world_from_camera.rotation[:, 2] for it in references])[view[:count]]
    depth = (normal * (problem.seen.x_in_world - problem.reference_centre)).sum(axis=1)
    offset = depth + (normal * problem.reference_centre).sum(axis=1)
    common = np.zeros((count, 2))
    common[:, 0] = np.array([it.common_sigma for it in depths])[view[:count]] * depth
    planes = DepthPlanes(normal, offset, (solved.depth_sigma * depth) ** -2.0, view[:count], common)
    return planes.and_last(DepthPlanes.unknown(len(view) - count))
