"""Intrinsics that the photograph contradicts are estimated together with the pose.

First all together, which shows the wrong ones; then these alone, the most significant one first. The photograph is read
again with each value.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .estimate import PoseEstimate
from .intrinsics import PRINCIPAL, ContradictionOptions, IntrinsicsEvidence, IntrinsicsTerms, corrected_view
from .pose_problem import (
    AdjustInput,
    AdjustOptions,
    Solved,
    adjusted_estimate,
    errors_of_pose,
    optimum,
    pose_problem,
    shares_camera,
    with_intrinsics,
)
from .priors import Priors

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


def recalibrated(solved: Solved, found: PoseEstimate, priors: Priors, terms: IntrinsicsTerms) -> PoseEstimate:
    """The estimate with the parameters that the photograph contradicts; the one found if it contradicts none.

    `solved` is where the estimate was found, with the intrinsics as given.
    """
    given, query, options, usual = solved.given, solved.given.query, solved.given.options, terms.prior_sigma
    held, untried = usual, np.ones(4, bool)
    wide = np.maximum(usual, WIDE_SIGMA * np.array([1, query.camera.width_px, query.camera.width_px, 1]))
    if not is_suspicious(found, options):
        return found
    # With all estimated, the wrong ones stand out: an error that is held looks like errors of the others.
    guide = _with_errors(given, found, priors, replace(terms, held_sigma=wide), solved) or found
    while (worst := _contradicted(guide, options.suspicion, untried)) is not None:
        untried[list(worst)] = False
        freed = held.copy()
        freed[list(worst)] = wide[list(worst)]
        better = _with_errors(given, guide, priors, replace(terms, held_sigma=freed))
        if better is None or better.intrinsics is None:
            continue
        if better.intrinsics.contradicted(options.contradiction)[list(worst)].any():
            guide, found, held = better, better, freed
        elif better.intrinsics.contradicted(options.suspicion)[list(worst)].any():
            found = _doubted(found, better.intrinsics, worst, shares_camera(query, given.references))
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
    given: AdjustInput, found: PoseEstimate, priors: Priors, terms: IntrinsicsTerms, solved: Solved | None = None
) -> PoseEstimate | None:
    """The estimate with intrinsics as unknowns, which the terms hold; None if it fails."""
    assert found.intrinsics is not None
    query, options, errors, pose = given.query, given.options, found.intrinsics.removed, found.world_from_camera
    small = LINEAR_CHANGE * np.array([1, query.camera.width_px, query.camera.width_px, 1])
    rough = replace(options, min_motion_sigma=ROUGHLY * options.min_motion_sigma)
    read = replace(given, query=found.view or query)  # the photograph as it is read with these errors removed
    moved, change, known = read, None, None
    for left in reversed(range(options.rounds)):
        if solved is None:
            errors_px = read.errors_px(pose)
            used = np.flatnonzero(errors_px < options.max_error_px)
        else:
            problem, start, used = solved.problem, solved.there, solved.used
        if len(used) < LEAST_MATCHES:
            return None
        if solved is None:
            problem, start = pose_problem(moved, used, pose, known)
        solved = None
        problem = replace(problem, priors=priors, prior_weight=options.error_inflation**2)
        if not left or (change is not None and (np.abs(change) < small).all()):
            break
        wider, there = with_intrinsics(problem, start.bundle, read.query)
        wider = replace(wider, intrinsics_information=terms.held_sigma**-2.0, intrinsics_offset=errors)
        bundle = optimum(wider, wider.at(there), rough).bundle
        pose, change, known = bundle.world_from_query, bundle.intrinsics, (problem.information, bundle.poses)
        errors = errors + change
        if np.abs(errors / terms.held_sigma).max() > MAX_HELD:
            return None
        read = replace(given, query=corrected_view(query, errors))
        moved = replace(moved.with_points(used, bundle.points), query=read.query)
    before = replace(found, inliers=errors_px < options.inlier_px)
    solved = Solved(read, problem, optimum(problem, start, options), used)
    better = adjusted_estimate(solved, before, errors_of_pose(solved, replace(terms, removed=errors)))
    return better and replace(better, view=read.query)
