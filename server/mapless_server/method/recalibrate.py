"""Intrinsics that the photograph contradicts are estimated together with the pose.

First all together, which shows the wrong ones; then these alone, the most significant one first. The photograph is read
again with each value.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array

from .bundle import BundleProblem
from .intrinsics import PRINCIPAL, ContradictionOptions, IntrinsicsEvidence, corrected_view
from .perturbation import reprojection_errors_px
from .pose_problem import (
    AdjustOptions,
    adjusted_estimate,
    errors_of_pose,
    optimum,
    pose_problem,
    shares_camera,
    with_intrinsics,
)
from .priors.known import Priors
from .results import PointMatches, PoseEstimate, Structure
from .unknowns import Bundle
from .views import PosedView, View

WIDE_SIGMA = np.array([0.3, 0.3, 0.3, 1.0])
"""Of an estimated parameter: focal length and k1, and principal point as a share of the width."""
MAX_HELD = 3.0
"""An estimate that leaves the prior by more standard deviations has diverged."""
LINEAR_CHANGE = np.array([0.01, 0.01, 0.01, 0.02])
"""Changes, in the units of `WIDE_SIGMA`, below which keypoints move in proportion to them, to a tenth of a pixel."""
LEAST_MATCHES = 20
"""For a pose and intrinsics."""
ROUGHLY = 2.0
"""Factor on `AdjustOptions.min_motion_sigma` before the photograph is read again."""

Solved = tuple[BundleProblem, Bundle, NDArray[np.intp]]
"""A problem, its solution, and the indices of the matches that it uses."""


def recalibrated(
    query: View,
    references: Sequence[PosedView],
    structure: Structure,
    matches: PointMatches,
    found: PoseEstimate,
    options: AdjustOptions,
    priors: Priors,
    usual: Array,
    solved: Solved,
) -> PoseEstimate:
    """The estimate with the parameters that the photograph contradicts; the one found if it contradicts none.

    `solved` is where the estimate was found.
    """
    held, untried = usual, np.ones(4, bool)
    wide = np.maximum(usual, WIDE_SIGMA * np.array([1, query.camera.width_px, query.camera.width_px, 1]))
    if not is_suspicious(found, options):
        return found
    # With all estimated, the wrong ones stand out: an error that is held looks like errors of the others.
    given = query, references, structure, matches
    guide = _with_errors(*given, found, options, priors, usual, wide, solved) or found
    while (worst := _contradicted(guide, options.suspicion, untried)) is not None:
        untried[list(worst)] = False
        freed = held.copy()
        freed[list(worst)] = wide[list(worst)]
        better = _with_errors(*given, guide, options, priors, usual, freed)
        if better is None or better.intrinsics is None:
            continue
        if better.intrinsics.contradicted(options.contradiction)[list(worst)].any():
            guide, found, held = better, better, freed
        elif better.intrinsics.contradicted(options.suspicion)[list(worst)].any():
            found = _doubted(found, better.intrinsics, worst, shares_camera(query, references))
    return found


def is_suspicious(found: PoseEstimate, options: AdjustOptions) -> bool:
    """Whether the photograph may contradict its intrinsics: one seems wrong, or few matches agree."""
    if found.intrinsics is None:
        return False
    is_wrong = _contradicted(found, options.trial, np.ones(4, bool)) is not None
    return is_wrong or bool(found.inliers.mean() < options.agreeing_share)


def _doubted(
    found: PoseEstimate, estimated: IntrinsicsEvidence, parameters: tuple[int, ...], is_shared: bool
) -> PoseEstimate:
    """The estimate with a covariance that contains these errors, which are suspected, in full.

    The points of references of the same camera share errors of its focal length and principal point.
    """
    assert found.intrinsics is not None
    errors = np.zeros(4)
    errors[list(parameters)] = (estimated.value - found.intrinsics.removed)[list(parameters)]
    if is_shared:
        errors[:3] = 0.0
    moved = found.intrinsics.motion @ errors
    evidence = replace(found.intrinsics, value=estimated.value, sigma=estimated.sigma)
    return replace(found, covariance=found.covariance + np.outer(moved, moved), intrinsics=evidence)


def _contradicted(
    found: PoseEstimate, options: ContradictionOptions, among: NDArray[np.bool_]
) -> tuple[int, ...] | None:
    """The parameter, or both of the principal point, that the photograph contradicts most, among these (4,)."""
    evidence = found.intrinsics
    if evidence is None:
        return None
    wrong = evidence.contradicted(options) & among
    worst = int(np.argmax(np.where(wrong, np.abs(evidence.value) / evidence.sigma, 0.0)))
    if not wrong[worst]:
        return None
    return PRINCIPAL if worst in PRINCIPAL else (worst,)


def _with_errors(
    query: View,
    references: Sequence[PosedView],
    structure: Structure,
    matches: PointMatches,
    found: PoseEstimate,
    options: AdjustOptions,
    priors: Priors,
    usual: Array,
    held: Array,
    solved: Solved | None = None,
) -> PoseEstimate | None:
    """The estimate with intrinsics as unknowns of prior standard deviations `held`; None if it fails."""
    assert found.intrinsics is not None
    errors, pose, view = found.intrinsics.removed, found.world_from_camera, found.view or query
    small = LINEAR_CHANGE * np.array([1, query.camera.width_px, query.camera.width_px, 1])
    rough = replace(options, min_motion_sigma=ROUGHLY * options.min_motion_sigma)
    moved, bundle, change, information = structure, None, None, None
    for left in reversed(range(options.rounds)):
        if solved is None:
            pixels = view.features.keypoints[matches.keypoint].astype(np.float64)
            errors_px = reprojection_errors_px(view.camera, pose, structure.x_in_world[matches.point], pixels)
            used = np.flatnonzero(errors_px < options.max_error_px)
        else:
            problem, start, used = solved
        if len(used) < LEAST_MATCHES:
            return None
        if solved is None:
            problem, start = pose_problem(view, references, moved, matches, used, pose, options, information)
            start = start if bundle is None else replace(start, poses=bundle.poses)
        solved = None
        problem = problem.replaced(priors=priors, prior_weight=options.error_inflation**2)
        if not left or (change is not None and (np.abs(change) < small).all()):
            break
        wider, there = with_intrinsics(problem, start, view)
        wider = wider.replaced(intrinsics_information=held**-2.0, intrinsics_offset=errors)
        bundle = optimum(wider, there, rough)
        pose, change, information = bundle.world_from_query, bundle.intrinsics, problem.information
        errors = errors + change
        if np.abs(errors / held).max() > MAX_HELD:
            return None
        view, points = corrected_view(query, errors), moved.x_in_world.copy()
        points[np.unique(matches.point[used])] = bundle.points
        moved = replace(structure, x_in_world=points)
    terms = (query, errors, usual, held)
    before = replace(found, inliers=errors_px < options.inlier_px)
    bundle = optimum(problem, start, options)
    its_errors = errors_of_pose(view, problem, bundle, options, terms)
    better = adjusted_estimate(view, structure, matches, used, before, bundle, options, its_errors)
    return better and replace(better, view=view)
