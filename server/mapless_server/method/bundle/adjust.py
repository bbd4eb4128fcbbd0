"""Adjustment, the last refinement, not in the paper: the query, its points and the references together.

The paper fixes the points before it solves for the query, and never moves the references. But the query observes the
points too, and reference poses have noise, and errors of the lens model. So all are adjusted (see `pose_problem`).

Where references are few and far apart, most keypoints that the query shares with one of them are in no other: no point
can be triangulated without the query. With the query's pose one can, and after its elimination it is an equation of
the pose, the epipolar one of both keypoints (see `two_view`). Where these are many they are adjusted with the others.
They are no inliers: whether the pose is accepted depends on them only by its radius, which they make smaller.

The query's intrinsics stay as given: where they are right, poses are more accurate without these four unknowns. What
the photograph says of their errors follows from the same normal equations, and the pose's covariance contains them (see
`intrinsics`). Parameters that the photograph contradicts are estimated with the pose: first all together, which shows
the wrong ones; then these alone, the most significant one first. The photograph is read again with each value.
Intrinsics that are a guess, of a photograph that came without, are estimated with the pose, all within their prior.

Priors on the query's pose add their terms, unless the photograph alone contradicts them.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..features.limits import MIN_INLIERS
from ..features.tracks import Tracks
from ..features.views import PosedView
from ..structure.model import MetricScale
from ..structure.structure import query_tracks, with_query_points
from .dispersion import scale_covariance
from .estimate import PosedSupport, PoseEstimate, PoseStage, with_information
from .intrinsics import (
    DOUBTED_SIGMAS,
    PRINCIPAL,
    ContradictionOptions,
    IntrinsicsEvidence,
    IntrinsicsTerms,
    corrected_view,
)
from .pose_problem import (
    AdjustInput,
    AdjustOptions,
    PoseUncertainty,
    Solved,
    adjusted_estimate,
    errors_of_pose,
    optimum,
    pose_problem,
    shares_camera,
    with_intrinsics,
)
from .priors import NO_PRIORS, IntrinsicsSigma, Priors

WIDE_SIGMA = np.array([0.3, 0.3, 0.3, 1.0])
"""Least standard deviations of an estimated parameter's prior: focal length, k1, and shares of the width."""
LINEAR_CHANGE = np.array([0.01, 0.01, 0.01, 0.02])
"""Changes, in the units of `WIDE_SIGMA`, below which keypoints move in proportion to them, to a tenth of a pixel."""
LEAST_MATCHES = 20
"""Fewer do not determine a pose and intrinsics or a motion, nor decide between cameras."""
GUESS_INFLATION = 1.5
"""Factor on standard deviations of intrinsics that are estimated with the pose. Evidence: unknown-camera."""
ROUGHLY = 2.0
"""Factor on `AdjustOptions.min_motion_sigma` before the photograph is read again."""


def recalibrated(solved: Solved, found: PoseEstimate, priors: Priors, terms: IntrinsicsTerms) -> PoseEstimate:
    """The estimate with the parameters that the photograph contradicts; the one found if it contradicts none.

    `solved` is where the estimate was found, with the intrinsics as given.
    """
    given, query, options, usual = solved.given, solved.given.query, solved.given.options, terms.prior_sigma
    held, untried = usual, np.ones(4, bool)
    if _are_guessed(given):
        if (estimated := _with_errors(given, found, priors, terms, solved)) is not None:
            return _inflated(estimated)
        untried[:3] = False  # a guess of these has the widest prior already: only a lens may be beyond it
    wide = np.maximum(usual, WIDE_SIGMA * np.array([1, query.camera.width_px, query.camera.width_px, 1]))
    wide = np.where(untried, wide, usual)
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


def _are_guessed(given: AdjustInput) -> bool:
    return given.intrinsics is not None and given.intrinsics.is_guess


def _inflated(found: PoseEstimate) -> PoseEstimate:
    """The estimate with larger standard deviations of the intrinsics that were estimated with it."""
    assert found.intrinsics is not None
    evidence, factor = found.intrinsics, GUESS_INFLATION**2
    covariance = found.covariance + (factor - 1) * evidence.pose_covariance
    return replace(found, covariance=covariance, intrinsics=replace(evidence, covariance=factor * evidence.covariance))


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
        if np.abs(errors / terms.held_sigma).max() > DOUBTED_SIGMAS:
            return None
        read = replace(given, query=corrected_view(query, errors))
        moved = replace(moved.with_points(used, bundle.points), query=read.query)
    before = replace(found, inliers=errors_px < options.inlier_px)
    solved = Solved(read, problem, optimum(problem, start, options), used)
    better = adjusted_estimate(solved, before, errors_of_pose(solved, replace(terms, removed=errors)))
    return better and replace(better, view=read.query)


SHARED_CAMERA = 0.03
"""Share of the intrinsics' usual errors that differ between photographs of one camera, by focus and stabilization. What
they share is in the references' points too, and moves the pose but little. Evidence: adjustment."""


def adjust_pose(given: AdjustInput, estimate: PoseEstimate, priors: Priors = NO_PRIORS) -> PoseEstimate:
    """Refines an estimate, whose errors select the matches, together with its points and the references.

    Each prior on the query's pose is checked against the pose from the photograph alone; only consistent ones are used.
    Returns the estimate with a refined pose and its covariance; unchanged if the adjustment fails.
    """
    # If no prior is used, the answer is bit-identical to the one without priors.
    without_priors = estimate.without_priors or estimate
    alone, where = _adjusted(given, without_priors, NO_PRIORS) or (None, None)
    if not priors:
        return alone or without_priors
    checks = priors.check(alone.world_from_camera, alone.covariance) if alone else estimate.prior_checks
    used = priors.consistent(checks)
    answer = alone or without_priors
    if used:
        informed = _with_priors(alone, where, used) if alone and where else None
        answer = informed or (_adjusted(given, estimate, used) or (estimate, None))[0]
    return replace(answer, prior_checks=checks)


def _with_priors(alone: PoseEstimate, where: Solved, priors: Priors) -> PoseEstimate | None:
    """The estimate with priors that are consistent with the one without, from whose optimum it starts.

    What the photograph says of the pose's errors is computed there.
    """
    options = where.given.options
    with_priors = replace(where.problem, priors=priors, prior_weight=options.error_inflation**2)
    solved = replace(where, there=optimum(with_priors, where.there, options))
    found = adjusted_estimate(solved, alone, PoseUncertainty.of(alone))
    return found and _sharpened(_of_matches(found, len(alone.inliers)), priors)


def _sharpened(found: PoseEstimate, priors: Priors) -> PoseEstimate:
    if not priors:
        return found
    return with_information(found, priors.gradient_and_information(found.world_from_camera)[1])


def _of_matches(found: PoseEstimate, count: int) -> PoseEstimate:
    """The estimate without the matches that were added to the first ones."""
    return replace(found, inliers=found.inliers[:count], errors_px=found.errors_px[:count])


def _adjusted(given: AdjustInput, estimate: PoseEstimate, priors: Priors) -> tuple[PoseEstimate, Solved | None] | None:
    """Returns the estimate at the optimum with priors, and where that is; None if it diverges or has too few matches.

    Points of the query's own are chosen at its pose, with whatever error the intrinsics give it, so they hide a part
    of this error: intrinsics that seem wrong with them are judged, and estimated, without them.
    """
    terms = intrinsics_terms(given)
    own = _own_tracks(given, estimate)
    is_agreeing = estimate.inliers.mean() >= given.options.agreeing_share and not _are_guessed(given)
    first = _at_optimum(given, estimate, priors, terms, own) if own and is_agreeing else None
    if first and not is_suspicious(first[0], given.options):
        return _sharpened(first[0], priors), first[1]
    plain = _at_optimum(given, estimate, priors, terms)
    if plain is None:
        return None
    found, where = plain
    better = recalibrated(where, found, priors, terms)
    if better is found and own:
        more, where = first or _at_optimum(given, found, priors, terms, own) or plain
        better = replace(more, intrinsics=found.intrinsics)
    return _sharpened(better, priors), where if better.view is None else None


def _own_tracks(given: AdjustInput, estimate: PoseEstimate) -> Tracks | None:
    """Tracks of the query's keypoints that match references but no point; None if these are few."""
    free = np.ones(len(given.query.features), bool)
    free[given.matches.keypoint] = False
    tracks = query_tracks(given.references, given.structure, given.query_matches, free)
    is_many = tracks.point_count > 0 and tracks.point_count >= given.options.min_added_share * estimate.inliers.sum()
    return tracks if is_many else None


def _at_optimum(
    given: AdjustInput,
    estimate: PoseEstimate,
    priors: Priors,
    terms: IntrinsicsTerms,
    own: Tracks | None = None,
) -> tuple[PoseEstimate, Solved] | None:
    """The estimate at the optimum, with points of the query's own tracks, and where it was found."""
    count, pose, options = len(given.matches), estimate.world_from_camera, given.options
    if own:
        query = PosedView("", "", given.query, pose)
        structure, matches = with_query_points(
            query, given.references, given.structure, given.matches, own, options.query_points
        )
        given = replace(given, structure=structure, matches=matches)
    errors_px = np.concatenate([estimate.errors_px, given.errors_px(pose, slice(count, None))])
    start_inliers = np.concatenate([estimate.inliers, np.ones(len(given.matches) - count, bool)])
    used = np.flatnonzero(errors_px < options.max_error_px)
    if len(used) < 3:  # two equations each, for six unknowns
        return None
    problem, start = pose_problem(given, used, pose)
    with_priors = replace(problem, priors=priors, prior_weight=options.error_inflation**2)
    solved = Solved(given, problem, optimum(with_priors, start, options), used)
    before = replace(estimate, inliers=start_inliers, errors_px=errors_px)
    found = adjusted_estimate(solved, before, errors_of_pose(solved, terms))
    found = found and _of_matches(found, count)
    # The query's own points can hold a pose that hardly any of the others agree with.
    return None if found is None or found.inliers.sum() < MIN_INLIERS else (found, solved)


def intrinsics_terms(given: AdjustInput) -> IntrinsicsTerms:
    """The query's intrinsics as they are known without its matches."""
    usual = (given.intrinsics or IntrinsicsSigma()).of(given.query.camera)
    is_shared = given.intrinsics is None and shares_camera(given.query, given.references)
    return IntrinsicsTerms(given.query, usual, SHARED_CAMERA * usual if is_shared else usual)


def with_covariance(
    support: PosedSupport,
    scale: MetricScale,
    options: AdjustOptions,
    priors: Priors = NO_PRIORS,
    points_are_predicted: bool = False,
) -> PoseEstimate:
    """The estimate of a support, of any stage, with its pose's covariance and the evidence of errors of its intrinsics.

    The deviation of the metric scale is its relative standard deviation; it counts for initial poses, and where points
    are predicted by the reconstruction rather than triangulated. Priors that were used reduce the covariance.
    """
    estimate, references = support.estimate, support.references
    if estimate.is_adjusted:
        return estimate
    used = np.flatnonzero(estimate.errors_px < options.max_error_px)
    if len(used) < 3:
        return estimate
    pose, is_initial = estimate.world_from_camera, estimate.stage is PoseStage.INITIAL
    given = AdjustInput.of(support, options)
    problem, there = pose_problem(given, used, pose)
    solved, terms = Solved(given, problem, there, used), intrinsics_terms(given)
    errors = errors_of_pose(solved, terms, is_initial)
    if errors is None:
        return estimate
    covariance = errors.covariance
    if is_initial or points_are_predicted:
        centroid = np.mean([it.world_from_camera.translation for it in references], axis=0)
        covariance = covariance + scale_covariance(pose, centroid, scale.deviation)
    found = _sharpened(replace(errors, covariance=covariance).on(estimate), priors.consistent(estimate.prior_checks))
    if errors.intrinsics is None:
        return found
    # The pose stays as it is; but an error is not seen in full before it is estimated.
    estimated = recalibrated(solved, found, NO_PRIORS, terms).intrinsics
    if estimated is not None and estimated.contradicted(options.contradiction, terms.prior_sigma).any():
        found = replace(found, intrinsics=estimated)
    return found
