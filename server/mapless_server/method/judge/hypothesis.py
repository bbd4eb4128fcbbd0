"""An attempt at a photograph's pose, its result, and the doubts that it leaves.

The result is a hypothesis, which has a pose, or a failure without one.
"""

from dataclasses import dataclass, replace
from enum import Enum, Flag, auto

import numpy as np

from mapless.geometry import Array, RigidTransform

from ..bundle.estimate import PosedSupport, accuracy_from_covariance
from ..options import DoubtOptions
from ..pairs.pair import Matching
from ..rejection import Rejection, RejectionReason
from .answer import Answer, Localization


class Raster(Enum):
    """The raster of the photograph in which features are found."""

    AS_IS = "as is"
    REDUCED = "reduced"
    TURNED = "turned"
    MIRRORED = "mirrored"
    """Exchanged left and right: what matches so has no pose."""


class Where(Enum):
    """The references that are used."""

    LIKELY = "likely"
    """Those that the caller names, or those that resemble the photograph, where soft priors say that it is."""
    NEAR_PRIOR = "near the prior"
    ONE_PLACE = "one place"
    """Those of the only one of two places that the priors allow."""
    ANYWHERE = "anywhere"
    """Those that resemble the photograph, whatever soft priors say."""


class Solver(Enum):
    """The matches that give the pose."""

    POINTS = "points"
    """2D-3D matches; with one reference, those with the depths of a network."""
    LINES = "lines"
    """Matches with single references and 2D-3D matches together, see `pose.two_view`."""
    DEPTHS = "depths"
    """Matches with depths in the photograph or in references, see `pose.by_depths`."""


@dataclass(frozen=True)
class Attempt:
    """One way to compute a photograph's pose; equal attempts give the same result.

    Attributes:
        features: index of the features, the cheapest first.
        raster: where they are found in the photograph.
        angles_deg: by how much the raster is turned clockwise; several if references are rolled against one another.
        where: the references that are used.
        matching: how the photographs are matched.
        solver: the matches that give the pose.
        scene: the scene that the references are of: its rank among several, 0 for the first or only one.
    """

    features: int = 0
    raster: Raster = Raster.AS_IS
    angles_deg: tuple[float, ...] = ()
    where: Where = Where.LIKELY
    matching: Matching = Matching.STRICT
    solver: Solver = Solver.POINTS
    scene: int = 0

    @property
    def basis(self) -> "Attempt":
        """The attempt whose photographs and features it uses: attempts of one basis differ in what follows."""
        return Attempt(self.features, self.raster, self.angles_deg, self.where, scene=self.scene)

    def but(self, **changes: object) -> "Attempt":
        """A copy with these values."""
        return replace(self, **changes)  # type: ignore[arg-type]


TRACKED, AS_IT_IS = "tracked", "as it is"
"""The rungs that begin."""


def first_attempt(can_be_tracked: bool) -> tuple[str, Attempt]:
    """The rung's name and the attempt that begins; near a pose prior, if there is one that says what is near."""
    if can_be_tracked:
        return TRACKED, Attempt(raster=Raster.REDUCED, where=Where.NEAR_PRIOR)
    return AS_IT_IS, Attempt()


class Doubt(Flag):
    """Why a further attempt could give a better answer, or why none can."""

    NONE = 0
    STARVED = auto()
    """Too few matches for a pose."""
    CHANCE = auto()
    """The evidence for the pose does not suffice."""
    TWO_PLACES = auto()
    BEYOND_LIMITS = auto()
    """The pose is where the caller says that the camera is not."""
    LOW_TRUST = auto()
    WIDE_RADIUS = auto()
    FEW_INLIERS = auto()
    LIKE_ELSEWHERE = auto()
    """References elsewhere share much with the photograph that does not fit the pose."""
    OTHER_SCENE = auto()
    """References of another scene match the photograph, too."""
    CAMERA = auto()
    """The photograph contradicts its camera: no other attempt changes that."""
    REFERENCES = auto()
    """There are no references, or they were taken from one place: no other features change that."""


_OF_REASON = {
    RejectionReason.NO_USABLE_REFERENCES: Doubt.STARVED,
    RejectionReason.DEGENERATE_REFERENCES: Doubt.REFERENCES,
    RejectionReason.GATE: Doubt.CHANCE,
    RejectionReason.AMBIGUOUS: Doubt.TWO_PLACES,
    RejectionReason.PRIOR_CONFLICT: Doubt.BEYOND_LIMITS,
}
"""Doubts that rejections leave; those for other reasons leave `STARVED`."""


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A pose that an attempt found, accepted or not.

    Attributes:
        attempt: how it was found.
        answer: its outcome is the accepted pose, or the rejection that says why it is not.
        doubts: the doubts that it leaves.
        world_from_camera: the pose in the caller's world, metric.
        covariance: (6, 6) as of `Localization`, without what halves of the data that disagree add to it; zeros for a
            pose that nothing has checked.
        distance_m: median distance of what supports it; 0 if that is unknown.
        inlier_count: number of inliers.
    """

    attempt: Attempt
    answer: Answer
    doubts: Doubt
    world_from_camera: RigidTransform
    covariance: Array
    distance_m: float
    inlier_count: int

    @property
    def is_accepted(self) -> bool:
        """Whether the attempt's judge accepted it."""
        return isinstance(self.answer.outcome, Localization)


@dataclass(frozen=True, eq=False)
class Failed:
    """An attempt that found no pose; the outcome of its answer is a rejection."""

    attempt: Attempt
    answer: Answer
    doubts: Doubt


Found = Hypothesis | Failed


def found_by(attempt: Attempt, answer: Answer, options: DoubtOptions, doubts: Doubt = Doubt.NONE) -> Found:
    """Makes the result of an attempt from its answer; `doubts` are left beside those that the answer says."""
    doubts |= doubts_of(answer, options)
    outcome, support = answer.outcome, answer.support
    if isinstance(support, PosedSupport):
        pose, covariance = support.estimate.world_from_camera.shifted(support.origin), support.estimate.covariance
        return Hypothesis(attempt, answer, doubts, pose, covariance, support.distance_m(), support.inlier_count())
    if isinstance(outcome, Localization):
        covariance = np.zeros((6, 6)) if outcome.covariance is None else outcome.covariance
        return Hypothesis(attempt, answer, doubts, outcome.world_from_camera, covariance, 0.0, outcome.inlier_count)
    return Failed(attempt, answer, doubts)


def doubts_of(answer: Answer, options: DoubtOptions) -> Doubt:
    """The doubts that an answer leaves; none for a pose that nothing has checked (`Variant.COARSE`)."""
    outcome = answer.outcome
    if isinstance(outcome, Rejection):
        return doubt_of(outcome)
    if outcome.covariance is None or outcome.trust is None:
        return Doubt.NONE
    is_wide = not accuracy_from_covariance(outcome.covariance).position_68_m <= options.radius_m
    doubts = Doubt.LOW_TRUST if outcome.trust < options.trust else Doubt.NONE
    doubts |= Doubt.WIDE_RADIUS if is_wide else Doubt.NONE
    return doubts | (Doubt.FEW_INLIERS if outcome.inlier_count < options.inliers else Doubt.NONE)


def doubt_of(rejection: Rejection) -> Doubt:
    """The doubt that a rejection leaves."""
    return Doubt.CAMERA if rejection.intrinsics_checks else _OF_REASON.get(rejection.reason, Doubt.STARVED)
