"""Decides in which of several worlds a photograph was taken: what `decide` does with places, among scenes.

In each world `decide` has chosen a place, or none. The place that is answered is found by the same rule: by the scores
of their poses, each on the matches with the references of its own world, as log10 of chances. Only matches of features
count that the photograph was tried with in all worlds, since those of more features have larger scores. Poses in two
worlds are one place if both worlds are known to be where they agree on the Earth.

So the answer is that of a world by itself, or the photograph is ambiguous.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from mapless.geometry import RigidTransform

from ..bundle.priors import Priors
from ..rejection import PoseHypothesis, Rejection, RejectionReason
from .answer import Localization
from .decide import (
    PLACES,
    Place,
    PlaceOptions,
    Verdict,
    at_one_place,
    conflicts,
    matches_of,
    place_of_priors,
    places_of,
    score,
)
from .hypothesis import Doubt, Found, Hypothesis


@dataclass(frozen=True, eq=False)
class World:
    """The results of a photograph's attempts in one of several worlds.

    Attributes:
        key: name of the world, in hypotheses.
        name: the same in messages.
        found: the results, in order, at least one.
        verdict: what `decide` says of them.
        priors: the photograph's priors, in this world.
        ecef_from_world: the pose of the world on the Earth; None if it is not known.
    """

    key: str
    name: str
    found: Sequence[Found]
    verdict: Verdict
    priors: Priors
    ecef_from_world: RigidTransform | None = None

    @property
    def is_accepted(self) -> bool:
        """Whether a pose in it would be answered without the other worlds."""
        return isinstance(self.verdict.outcome, Localization)

    def best_place(self, options: PlaceOptions) -> Place | None:
        """The place that is answered without the other worlds, or would be if its poses were accepted; None if none."""
        poses = [it for it in self.found if isinstance(it, Hypothesis) and Doubt.BEYOND_LIMITS not in it.doubts]
        places = places_of(poses, self.found, options)
        return next((it for it in places if self.verdict.chosen in it.poses), next(iter(places), None))

    def named(self) -> Verdict:
        """The verdict, whose hypotheses name the world."""
        outcome = self.verdict.outcome
        if not isinstance(outcome, Rejection):
            return self.verdict
        hypotheses = tuple(replace(it, world=self.key) for it in outcome.hypotheses)
        imprecise = outcome.imprecise and replace(outcome.imprecise, world=self.key)
        return replace(self.verdict, outcome=replace(outcome, hypotheses=hypotheses, imprecise=imprecise))


@dataclass(frozen=True, eq=False)
class _Rival:
    """The best place of a world, and its score on the matches of features that all worlds were tried with."""

    world: World
    place: Place
    score: float

    @property
    def pose(self) -> Hypothesis:
        return next(iter(self.place.accepted), self.place.poses[0])

    def as_hypothesis(self) -> PoseHypothesis:
        return replace(self.place.as_hypothesis(), world=self.world.key)

    def is_one_place_with(self, other: "_Rival", options: PlaceOptions) -> bool:
        """Whether poses of both agree on the Earth."""
        ours, theirs = self.world.ecef_from_world, other.world.ecef_from_world
        if ours is None or theirs is None:
            return False
        pose = ours.inverse().compose(theirs).compose(other.pose.world_from_camera)
        return at_one_place(self.pose, replace(other.pose, world_from_camera=pose), options)


def decide_among(worlds: Sequence[World]) -> Verdict:
    """Returns the verdict of one of some worlds, or that two of them explain the photograph.

    Those whose references match the photograph best come first.
    """
    if not any(it.is_accepted for it in worlds):
        return max(worlds, key=_names_two).named()
    best, *others = _rivals(worlds, PLACES)
    if not others:
        return best.world.named()
    rivals = [best, *others]
    places, priors = [it.as_hypothesis() for it in rivals], [it.world.priors for it in rivals]
    decided = place_of_priors(places, [it.score for it in rivals], priors, PLACES)
    if isinstance(decided, int):
        return rivals[decided].world.named()
    first, second = places[:2]
    one, other = (it.world.name for it in rivals[:2])
    message = (
        f"poses in two scenes explain the photograph: one in {one!r} with {first.inlier_count} inliers, one in "
        f"{other!r} with {second.inlier_count}"
    )
    rejection = Rejection(RejectionReason.AMBIGUOUS, message, decided, hypotheses=(first, second))
    return Verdict(best.pose, rejection, Doubt.TWO_PLACES)


def _names_two(world: World) -> bool:
    outcome = world.verdict.outcome
    return isinstance(outcome, Rejection) and bool(outcome.hypotheses)


def _rivals(worlds: Sequence[World], options: PlaceOptions) -> list[_Rival]:
    """The worlds between whose places scores do not decide, the best first; of one place on the Earth the best one.

    A place that contradicts the priors is never answered where an accepted pose in another world agrees with them.
    """
    found = sorted(_scored(worlds, options), key=lambda it: (-it.score, not it.world.is_accepted))
    places: list[list[_Rival]] = []
    for rival in found:
        same = next((it for it in places if it[0].is_one_place_with(rival, options)), None)
        if same is None:
            places.append([rival])
        else:
            same.append(rival)
    best, *others = (next((it for it in place if it.world.is_accepted), place[0]) for place in places)
    rivals = [it for it in others if options.clearly_more * it.score > best.score]
    if not rivals and conflicts(best.pose, best.world.priors):
        rivals = [it for it in others if it.world.is_accepted and not conflicts(it.pose, it.world.priors)][:1]
    return [best, *rivals]


def _scored(worlds: Sequence[World], options: PlaceOptions) -> list[_Rival]:
    tried = [{it.attempt.features for it in world.found} for world in worlds]
    common = set.intersection(*tried)
    places = [(world, place) for world in worlds if (place := world.best_place(options)) is not None]
    if len(places) == 1:
        return [_Rival(*places[0], 0.0)]
    matches = [list(matches_of([it for it in world.found if it.attempt.features in common])) for world, _ in places]
    if not any(matches):
        return [_Rival(world, place, float(place.poses[0].inlier_count)) for world, place in places]
    of_poses = ([score(it, known) for it in place.poses] for (_, place), known in zip(places, matches, strict=True))
    return [_Rival(*it, max(scores)) for it, scores in zip(places, of_poses, strict=True)]
