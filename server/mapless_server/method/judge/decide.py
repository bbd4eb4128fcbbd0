"""Decides which of all results of a photograph's attempts is its answer: one rule for all of them.

All poses that were found, accepted or not, are scored on the same matches (`pose.relative.score`): all that any of the
features tried have with any reference. Poses near one another are one place, whose score is that of its best pose. The
place with the best score is answered, by its accepted pose with the best score or by what was found wrong with its
poses, if it has 1.5 times the score of any other. Otherwise priors decide if they exclude all places but one; if they
do not, the photograph is ambiguous. PoseLib's RANSAC loop does the same with samples: generate models, score all of
them on the same data, keep the best.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import and_, or_

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform, rotation_angle_deg
from mapless_server.bounds import check_bounds

from ..bundle.estimate import PosedSupport, Support, accuracy_from_covariance
from ..bundle.priors import Priors
from ..pose import relative
from ..pose.pnp import disc_chance
from ..pose.two_view_matches import TwoViewMatches
from ..rejection import Advice, Hint, PoseHypothesis, Rejection, RejectionReason
from .answer import Localization
from .evidence import Votes, votes_of
from .hypothesis import Doubt, Failed, Found, Hypothesis, Raster, Solver


@dataclass(frozen=True)
class PlaceOptions:
    """When poses are of one place, and when a place is clearly better than another.

    Poses of one place are no further apart than their radii together, or one of these; radii do not include errors of
    the references' poses, so they can be too small for this test.

    Attributes:
        same_position_m, same_rotation_deg: distance and angle. Evidence: same-place.
        same_share: distance as a share of that to what the photograph shows, since a right pose may be so far off.
        clearly_more: a place is clearly better if its score is this many times as large. Evidence: clearly-more.
    """

    same_position_m: float = 0.1
    same_rotation_deg: float = 2.0
    same_share: float = 0.05
    clearly_more: float = 1.5

    def __post_init__(self) -> None:
        check_bounds(self, "same_position_m same_rotation_deg same_share", above=0)
        check_bounds(self, "clearly_more", at_least=1)


PLACES = PlaceOptions()


@dataclass(frozen=True, eq=False)
class Verdict:
    """The answer after the attempts so far.

    Attributes:
        chosen: the attempt's result that is answered, or whose data go with a rejection.
        outcome: the pose, or why there is none.
        doubts: why another attempt could change it.
        place: the place that the priors decide for, if the chosen attempt alone cannot tell it from another.
        kinds: number of kinds of features that have found a pose at the place that is answered.
    """

    chosen: Found
    outcome: Localization | Rejection
    doubts: Doubt
    place: PoseHypothesis | None = None
    kinds: int = 1


@dataclass(frozen=True, eq=False)
class Place:
    """Poses that are near one another, the best score first."""

    poses: Sequence[Hypothesis]
    score: float

    @property
    def accepted(self) -> Sequence[Hypothesis]:
        """Those that were accepted."""
        return [it for it in self.poses if it.is_accepted]

    def as_hypothesis(self) -> PoseHypothesis:
        """Its best pose, an accepted one if there is one, and the references that support it."""
        best = next(iter(self.accepted), self.poses[0])
        support = best.answer.support
        counts = [] if support is None else list(zip(support.references, support.inliers_by_reference(), strict=True))
        names = tuple(reference.name for reference, count in counts if count)
        return PoseHypothesis(best.world_from_camera, best.inlier_count, names)


def decide(found: Sequence[Found], priors: Priors, unit: str = "m", options: PlaceOptions = PLACES) -> Verdict:
    """Returns the verdict after at least one attempt.

    Args:
        found: the attempts' results, in order; poses beyond the caller's limits are rejections that say so.
        priors: the photograph's priors, in the caller's world.
        unit: unit of the scene's lengths, in messages.
        options: when poses are of one place.
    """
    failed = [it for it in found if isinstance(it, Failed)]
    if wrong := [it for it in failed if Doubt.CAMERA in it.doubts]:  # mirrored
        return Verdict(wrong[0], wrong[0].answer.outcome, Doubt.CAMERA)
    within = [it for it in found if isinstance(it, Hypothesis) and Doubt.BEYOND_LIMITS not in it.doubts]
    if not any(it.is_accepted for it in within):
        return _rejected(found, within, priors, options)
    rivals = _rivals(places_of(within, found, options), priors, options)
    if len(rivals) == 1:
        return _at(rivals[0])
    places, scores = [it.as_hypothesis() for it in rivals], [it.score for it in rivals]
    decided = place_of_priors(places, scores, [priors] * len(rivals), options)
    return _at(rivals[decided]) if isinstance(decided, int) else _ambiguous(rivals, decided, unit)


def at_one_place(first: Hypothesis, second: Hypothesis, options: PlaceOptions = PLACES) -> bool:
    """Whether two poses are of one place: no further apart than both may be off."""
    radii = [accuracy_from_covariance(it.covariance) for it in (first, second)]
    share_m = options.same_share * min(first.distance_m, second.distance_m)
    reach_m = max(options.same_position_m, share_m, sum(it.position_95_m for it in radii))
    reach_deg = max(options.same_rotation_deg, sum(it.rotation_95_deg for it in radii))
    apart_m, apart_deg = _apart(first.world_from_camera, second.world_from_camera)
    return apart_m <= reach_m and apart_deg <= reach_deg


def place_of_priors(
    places: Sequence[PoseHypothesis], scores: Sequence[float], priors: Sequence[Priors], options: PlaceOptions = PLACES
) -> int | Hint | None:
    """Index of the only place that the priors do not exclude, or a hint why they do not decide; None without priors.

    They decide if all of them agree with one place and exclude the others, unless another has clearly more. The priors
    are those in each place's world.
    """
    if not any(priors):
        return None
    # Hypotheses are not refined. Their assumed error is such that two of one place still agree at two sigma.
    sigmas = [options.same_position_m / 2] * 3 + [math.radians(options.same_rotation_deg) / 2] * 3
    covariance = np.diag(np.square(sigmas))
    checks = [of_one.check(it.world_from_camera, covariance) for it, of_one in zip(places, priors, strict=True)]
    left = [i for i, of_one in enumerate(checks) if not any(it.conflict for it in of_one)]
    best = next(iter(places[0].references), None)
    if not left:
        return Hint("judge", Advice.CHECK_PRIOR, "Check the prior: it fits neither of the two places.", best)
    if len(left) > 1:
        message = (
            "Take a photograph that shows where the two places differ, or give a prior with smaller standard "
            "deviations: the one given fits both; if there is one place only, check the references' poses."
        )
        return Hint("judge", Advice.TELL_PLACES_APART, message, best)
    if not all(it.is_likely for it in checks[left[0]]):
        return Hint("judge", Advice.CHECK_PRIOR, "Check the prior: it fits neither of the two places well.", best)
    if max(scores) >= options.clearly_more * scores[left[0]]:
        message = "Check the prior: the photograph shows more of the other place."
        return Hint("judge", Advice.CHECK_PRIOR, message, best)
    return left[0]


def places_of(hypotheses: Sequence[Hypothesis], found: Sequence[Found], options: PlaceOptions) -> list[Place]:
    """The places of the poses, the best score first."""
    scores = _scores(hypotheses, found)
    order = sorted(range(len(hypotheses)), key=lambda i: (-scores[i], -hypotheses[i].attempt.features))
    places: list[tuple[float, list[Hypothesis]]] = []
    for i in order:
        pose = hypotheses[i]
        near = next((poses for _, poses in places if at_one_place(poses[0], pose, options)), None)
        if near is None:
            places.append((scores[i], [pose]))
        else:
            near.append(pose)
    return [Place(poses, score) for score, poses in places]


def _rivals(places: Sequence[Place], priors: Priors, options: PlaceOptions) -> list[Place]:
    """The places between which scores do not decide, the best first.

    A place that contradicts the priors is never answered where an accepted pose agrees with them.
    """
    best = places[0]
    rivals = [it for it in places if options.clearly_more * it.score > best.score or it is best]
    if len(rivals) == 1 and priors and _conflicts(best, priors):
        rivals += [it for it in places[1:] if it.accepted and not _conflicts(it, priors)][:1]
    return rivals


def _conflicts(place: Place, priors: Priors) -> bool:
    return conflicts(next(iter(place.accepted), place.poses[0]), priors)


def conflicts(pose: Hypothesis, priors: Priors) -> bool:
    """Whether one of the priors contradicts a pose."""
    return any(it.conflict for it in priors.check(pose.world_from_camera, pose.covariance))


def _scores(hypotheses: Sequence[Hypothesis], found: Sequence[Found]) -> list[float]:
    """The scores of the poses on the same matches, and on the depth of the photograph, as log10 of chances.

    Their numbers of inliers, if no matches are known.
    """
    if len(hypotheses) == 1:
        return [0.0]
    matches = list(matches_of(found))
    if not matches:
        return [float(it.inlier_count) for it in hypotheses]
    return [score(it, matches) for it in hypotheses]


def score(pose: Hypothesis, matches: Sequence["Scored"]) -> float:
    """The score of a pose on matches with references of its world, and on the depth of the photograph."""
    return sum(it.score(pose.world_from_camera) for it in matches) - _by_depth(pose)


def _by_depth(pose: Hypothesis) -> float:
    """log10 of the chance that the photograph's depth agrees so with a pose; 0 without."""
    support = pose.answer.support
    return support.estimate.depth_log10_chance if isinstance(support, PosedSupport) else 0.0


@dataclass(frozen=True, eq=False)
class Scored:
    """Matches of a photograph with some references: as lines, and where they lead to a point, as points.

    The points are those before the vote for a keypoint's point, which removes those of a weaker place; of a keypoint's
    points the best one counts. `origin` (3,) is that of their world.
    """

    lines: relative.Evidence
    votes: Votes
    origin: Array

    @classmethod
    def of(cls, support: Support, is_used: NDArray[np.bool_]) -> "Scored":
        """The matches of a support with these of its references (K,)."""
        lines = TwoViewMatches.of(support.query, support.references, support.query_matches)
        votes, none = votes_of(support), np.empty(0, np.intp)
        used = lines[is_used[lines.reference]]
        evidence = relative.Evidence(support.query, support.references, used, np.empty((0, 3)), none)
        return cls(evidence, votes[is_used[votes.reference]], support.origin)

    def score(self, world_from_camera: RigidTransform) -> float:
        """The score of a pose in the caller's world, see `pose.relative`."""
        pose, inlier_px = world_from_camera.shifted(-self.origin), relative.PNP.inlier_px
        errors = np.nan_to_num(self.votes.seen.errors_px(pose) / inlier_px, nan=np.inf)
        best = np.zeros(len(self.lines.query.features))
        np.maximum.at(best, self.votes.keypoint, np.clip(1 - errors**2, 0, None))
        disc = disc_chance(self.lines.query.camera, inlier_px)
        return relative.score(self.lines, pose) - float(np.log10(disc) * best.sum())


def matches_of(found: Sequence[Found]) -> Iterator[Scored]:
    """All matches with any reference, those of each features once: of the photograph turned they are others."""
    seen: set[tuple[int, Raster, tuple[float, ...], str]] = set()
    for result in reversed(found):
        attempt, support = result.attempt, result.answer.support
        if support is None:
            continue
        keys = [(attempt.features, attempt.raster, attempt.angles_deg, it.key) for it in support.references]
        is_new = np.array([key not in seen for key in keys])
        if is_new.any():
            seen.update(keys)
            yield Scored.of(support, is_new)


def _at(place: Place) -> Verdict:
    """The verdict for one place."""
    accepted = place.accepted
    chosen, counted = (accepted[0], accepted) if accepted else (place.poses[0], place.poses)
    kinds = len({it.attempt.features for it in place.poses})
    return Verdict(chosen, chosen.answer.outcome, reduce(and_, (it.doubts for it in counted)), kinds=kinds)


def _rejected(found: Sequence[Found], within: Sequence[Hypothesis], priors: Priors, options: PlaceOptions) -> Verdict:
    """The rejection that says most, with all doubts: the strongest features' first, unless one names a cause.

    After those with a cause comes that of a pose that only its radius speaks against.
    """

    def says(result: Found) -> tuple[bool, int, bool, bool]:
        outcome = result.answer.outcome
        assert isinstance(outcome, Rejection)
        names_two = bool(outcome.hypotheses) or Doubt.CAMERA in result.doubts
        by_depth = result.attempt.solver is Solver.DEPTHS and isinstance(result, Hypothesis)
        return names_two, result.attempt.features, outcome.hint is not None, by_depth

    chosen, imprecise = max(found, key=says), _imprecise(within, found, priors, options)
    if imprecise is not None and not says(chosen)[0]:
        chosen = imprecise
    outcome, doubts = chosen.answer.outcome, reduce(or_, (it.doubts for it in found))
    assert isinstance(outcome, Rejection)
    if chosen is not imprecise:
        outcome = replace(outcome, imprecise=None)
    verdict = Verdict(chosen, outcome, Doubt.CAMERA if Doubt.CAMERA in chosen.doubts else doubts)
    if len(outcome.hypotheses) != 2 or outcome.hint is not None:
        return verdict
    counts = [float(it.inlier_count) for it in outcome.hypotheses]
    decided = place_of_priors(outcome.hypotheses, counts, [priors] * len(counts), options)
    if isinstance(decided, Hint):
        return replace(verdict, outcome=replace(outcome, hint=decided))
    return verdict if decided is None else replace(verdict, place=outcome.hypotheses[decided])


def _imprecise(
    within: Sequence[Hypothesis], found: Sequence[Found], priors: Priors, options: PlaceOptions
) -> Hypothesis | None:
    """The pose that would be answered but for its radius; None without one, or if a place or a prior contradicts it."""
    offered = [it for it in within if isinstance(it.answer.outcome, Rejection) and it.answer.outcome.imprecise]
    if not offered:
        return None
    place, *others = _rivals(places_of(within, found, options), priors, options)
    if others or _conflicts(place, priors):
        return None
    return next((it for it in place.poses if it in offered), None)


def _ambiguous(rivals: Sequence[Place], hint: Hint | None, unit: str) -> Verdict:
    first, second = (it.as_hypothesis() for it in rivals[:2])
    apart_m, apart_deg = _apart(first.world_from_camera, second.world_from_camera)
    message = (
        f"two poses {apart_m:.2f} {unit} and {apart_deg:.0f} degrees apart explain the photograph, found by different "
        f"attempts: one with {first.inlier_count} inliers, the other with {second.inlier_count}"
    )
    rejection = Rejection(RejectionReason.AMBIGUOUS, message, hint, hypotheses=(first, second))
    chosen = next(iter(rivals[0].accepted), rivals[0].poses[0])
    return Verdict(chosen, rejection, Doubt.TWO_PLACES)


def _apart(first: RigidTransform, second: RigidTransform) -> tuple[float, float]:
    """Distance of two poses, metres, and the angle between them, degrees."""
    apart_m = float(np.linalg.norm(first.translation - second.translation))
    return apart_m, rotation_angle_deg(first.rotation.T @ second.rotation)
