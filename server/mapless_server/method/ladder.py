"""The ladder: which attempt follows another, and for which doubts, as a table.

A rung changes the attempt before it. The rungs are tried in the order of the table, the first one first that changes it
to an attempt that was not tried yet; so after stronger features, or other references, those above them are tried again.
"""

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass

from .judge.hypothesis import Attempt, Doubt, Raster, Solver, Where
from .pairs.pair import Matching
from .promise import PROMISE, UNKNOWN, Known, PromiseOptions


@dataclass(frozen=True)
class Situation:
    """Properties of a photograph, its request and the server, on which rungs depend.

    Attributes:
        is_best: whether the variant of the method is the best one; the paper's has one attempt.
        reference_count: number of references that the attempt before was reconstructed with.
        may_be_elsewhere: whether references elsewhere would be chosen without soft priors.
        has_place: whether the priors exclude one of two places that explain the photograph.
        can_match_strongly: for each features, whether a network can match them.
        any_roll: index of the features that match however the camera is rolled; None if there are none.
        angles_deg: by how much to turn the photograph, clockwise, so that references are upright in one of its rasters;
            empty if they are in the photograph as it is, or if that is unknown.
        has_depth: whether the photograph, or one of the references, has depth.
        other_scene: of several scenes, the rank of the next one whose references match the photograph; None if none.
        known, promise: what is known of the photograph, and when an attempt is worth its time by that.
    """

    is_best: bool = True
    reference_count: int = 2
    may_be_elsewhere: bool = False
    has_place: bool = False
    can_match_strongly: tuple[bool, ...] = (False,)
    any_roll: int | None = None
    angles_deg: tuple[float, ...] = ()
    has_depth: bool = False
    other_scene: int | None = None
    known: Known = UNKNOWN
    promise: PromiseOptions = PROMISE


@dataclass(frozen=True)
class Rung:
    """A way to change an attempt.

    Attributes:
        name: in diagnostics and metrics.
        changes: what it changes, in words.
        doubts: it is tried on any of these.
        needs: what it needs, in words.
        cost: what it computes again.
        untried: says in a rejection that it was not finished.
        change: makes the attempt from the one before.
        is_possible: whether an attempt can be changed so.
        is_cheap: whether it costs about as much as the first attempt, so that also those get it who have to wait for
            others.
    """

    name: str
    changes: str
    doubts: Doubt
    needs: str
    cost: str
    untried: str
    change: Callable[[Attempt, Situation], Attempt]
    is_possible: Callable[[Attempt, Situation], bool]
    is_cheap: bool = False


STRENGTHENED = (
    Doubt.STARVED | Doubt.CHANCE | Doubt.TWO_PLACES | Doubt.BEYOND_LIMITS | Doubt.LOW_TRUST | Doubt.WIDE_RADIUS
)
"""Doubts that better matches can remove."""


def _with_features(features: int, before: Attempt, situation: Situation) -> Attempt:
    """Features of the photograph, turned if they must be upright and are known not to be."""
    where = Where.LIKELY if before.where is Where.ONE_PLACE else before.where
    # A raster of stronger features costs as much as all attempts before, so there is one: that of most matches.
    angles_deg = situation.angles_deg if features == 0 else situation.angles_deg[:1]
    if features == situation.any_roll or angles_deg in ((), (0.0,)):
        return Attempt(features, where=where, scene=before.scene)
    return Attempt(features, Raster.TURNED, angles_deg, where, scene=before.scene)


def _next_stronger(before: Attempt, situation: Situation) -> int:
    """Index of the next stronger features after those of an attempt; those for any roll have a rung of their own."""
    following = before.features + 1
    return following + 1 if following == situation.any_roll else following


def _on_points(attempt: Attempt, situation: Situation) -> bool:
    return situation.is_best and situation.reference_count >= 2


RUNGS = (
    Rung(
        "depth",
        "the pose is found from matches with depths of the photograph, or of references",
        Doubt.STARVED | Doubt.CHANCE | Doubt.WIDE_RADIUS | Doubt.REFERENCES,
        "depth of the photograph or of references",
        "a pose from depths",
        "from depths",
        lambda before, it: before.but(solver=Solver.DEPTHS),
        lambda before, it: it.is_best and it.has_depth and before.solver is Solver.POINTS,
        is_cheap=True,
    ),
    Rung(
        "mirrored",
        "the photograph's mirror image is matched",
        Doubt.STARVED | Doubt.CHANCE | Doubt.LOW_TRUST,
        "features for any roll, which found no good pose",
        "matches",
        "mirrored",
        lambda before, it: before.basis.but(raster=Raster.MIRRORED),
        lambda before, it: before.features == it.any_roll and before.raster is Raster.AS_IS,
        is_cheap=True,
    ),
    Rung(
        "rematched",
        "the photograph is matched by a network",
        STRENGTHENED,
        "a network that matches these features",
        "matches with each reference, a step of the queue each; structure and pose",
        "with matches of a network",
        lambda before, it: before.basis.but(matching=Matching.STRONG),
        lambda before, it: it.can_match_strongly[before.features],
    ),
    Rung(
        "wide",
        "matches of references also where a third one is needed to confirm them",
        Doubt.STARVED | Doubt.CHANCE | Doubt.FEW_INLIERS,
        "two references",
        "matches of pairs of references, which are stored; structure and pose",
        "with wide matches",
        lambda before, it: before.but(matching=before.matching.widened, solver=Solver.POINTS),
        _on_points,
        is_cheap=True,
    ),
    Rung(
        "lines",
        "the pose is found from matches with single references, too",
        Doubt.STARVED,
        "two references",
        "a pose from epipolar lines",
        "from epipolar lines",
        lambda before, it: before.but(matching=before.matching.widened, solver=Solver.LINES),
        _on_points,
        is_cheap=True,
    ),
    Rung(
        "one place",
        "references of one of two places",
        Doubt.TWO_PLACES,
        "priors that exclude the other place",
        "structure and pose",
        "with references of one of the places",
        lambda before, it: before.basis.but(where=Where.ONE_PLACE),
        lambda before, it: it.has_place,
        is_cheap=True,
    ),
    Rung(
        "elsewhere",
        "references anywhere in the scene",
        Doubt.STARVED | Doubt.CHANCE | Doubt.TWO_PLACES | Doubt.BEYOND_LIMITS | Doubt.REFERENCES | Doubt.LIKE_ELSEWHERE,
        "soft priors that keep references out that resemble the photograph",
        "matches with other references, structure and pose",
        "with references of the whole scene",
        lambda before, it: before.basis.but(where=Where.ANYWHERE),
        lambda before, it: it.may_be_elsewhere,
        is_cheap=True,
    ),
    Rung(
        "other scene",
        "references of the scene that matches second best",
        Doubt.STARVED
        | Doubt.CHANCE
        | Doubt.TWO_PLACES
        | Doubt.BEYOND_LIMITS
        | Doubt.REFERENCES
        | Doubt.CAMERA
        | Doubt.OTHER_SCENE,
        "several scenes; matches with references of another one",
        "matches with other references, structure and pose",
        "in another scene",
        lambda before, it: Attempt(scene=it.other_scene or 0),
        lambda before, it: it.other_scene is not None,
        is_cheap=True,
    ),
    Rung(
        "turned",
        "features of the photograph turned until it is upright in the references",
        Doubt.STARVED | Doubt.CHANCE,
        "features that match only what is upright; a roll that matches, or priors, show",
        "everything",
        "turned",
        lambda before, it: _with_features(0, before, it),
        lambda before, it: bool(it.angles_deg) and it.any_roll != 0,
        is_cheap=True,
    ),
    Rung(
        "any roll",
        "features that match however the camera is rolled",
        STRENGTHENED,
        "such features",
        "everything",
        "with features for any roll",
        lambda before, it: _with_features(it.any_roll or 0, before, it),
        lambda before, it: before.features < (it.any_roll or 0),
        is_cheap=True,
    ),
    Rung(
        "stronger",
        "the next stronger features",
        STRENGTHENED,
        "further features",
        "everything",
        "with stronger features",
        lambda before, it: _with_features(_next_stronger(before, it), before, it),
        lambda before, it: _next_stronger(before, it) < len(it.can_match_strongly),
    ),
)
"""The rungs in the order in which they are tried, after the first attempt: near a pose prior, or as it is."""

NAMES = tuple(it.name for it in RUNGS)
"""Their names, in this order. Evidence: rungs."""


def further(
    before: Attempt, tried: Collection[Attempt], doubts: Doubt, situation: Situation
) -> Iterator[tuple[Rung, Attempt]]:
    """The attempts that can remove one of the doubts, and are worth their time, in order.

    Args:
        before: the last attempt.
        tried: all attempts so far.
        doubts: what they leave in doubt.
        situation: on which rungs are possible.
    """
    if Doubt.CAMERA in doubts:
        doubts = Doubt.CAMERA
    for rung in RUNGS:
        if not (rung.doubts & doubts and rung.is_possible(before, situation)):
            continue
        attempt = rung.change(before, situation)
        if attempt not in tried:
            # After upright features, those for any roll find less of what is upright than as the first ones.
            at_any_roll = attempt.features == situation.any_roll == before.features > 0
            name = f"{rung.name} at any roll" if at_any_roll else rung.name
            if situation.known.is_worth(name, situation.promise):
                yield rung, attempt
