"""Inputs and results of the engine, and the state of a query between its stages."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from mapless_server import __version__
from mapless_server.method.bundle.priors import NO_PRIORS, Priors
from mapless_server.method.options import StageContext, Variant
from mapless_server.scenes import Selection
from mapless_server.scenes.retrieval.ranking import THINNED_LATER
from mapless_server.scheduling import Job, StageResult, Step
from mapless_server.store import SceneAttributes, calibration_kind

from .photos import Photo, QueryViews

if TYPE_CHECKING:  # services need not load what computes
    from mapless.geometry import Camera
    from mapless_server.method.features.extractors import FeatureExtractor
    from mapless_server.method.features.views import Matches, PosedView, View
    from mapless_server.method.judge.answer import Answer
    from mapless_server.method.options import LocalizeOptions
    from mapless_server.method.pipeline import Pipeline
    from mapless_server.scenes import Choice, Narrowing
    from mapless_server.scenes.library import Loaded
    from mapless_server.scheduling import Flow
    from mapless_server.security import SceneKey

PREPARE, COARSE, REFINE = "prepare", "coarse", "refine"
"""The stages of a query."""

POSE_PRIOR = "pose-prior"
"""`Choice.descriptor` of references that were chosen by a pose prior, not by similarity."""

TRACK = "track"
"""The stage of choosing references by the prior and comparing others; or the whole attempt, if it did not suffice."""

TURN = "turn"
"""The stage of comparing a photograph that was not localized, or with little trust, with its references turned, too."""

UNFINISHED = "/unfinished"
"""Ends the name of a stage: its tier came to no answer, see `Result`."""

MAX_TRACKED_SIGMA_DEG = 20.0
"""Priors of a less certain rotation do not say what the photograph shows."""

DEFAULT_REFERENCE_COUNT = 10
"""References that are chosen where the request does not say how many."""

SHORTLIST = 2
"""So many times the references wanted are matched with a sample of the photograph, and the best of them used (see
BENCHMARKS.md)."""

_COUNTS = (2, 5, 10, 20, 64)
"""Queries with about as many references cost about as much."""


@dataclass(frozen=True, eq=False)
class Tier:
    """Features, with the extractor and the pipeline that use them.

    The pipeline's matcher caches matches of these features, so no other tier may have the same one; tiers may share a
    reconstructor. References of a tier that `uses_depths` are loaded with the depths stored with them. Features that
    are `upright_only` match nothing in a photograph that is turned by 90 or 180 degrees against the references.
    """

    extractor: FeatureExtractor
    pipeline: Pipeline
    uses_depths: bool = False
    upright_only: bool = False

    @property
    def features(self) -> str:
        """Name of the local features with their options, "sift-2048-1024px-0.02"."""
        return self.extractor.name

    @property
    def backend(self) -> str:
        """Name of the coarse stage's backend."""
        return self.pipeline.reconstructor.name

    @property
    def kind(self) -> str:
        """Kind of its answers, see `calibration_kind`."""
        backend = f"{self.backend}+depth" if self.uses_depths else self.backend
        return calibration_kind(self.features, backend, __version__)

    @property
    def weights_sha256(self) -> str:
        """SHA-256 of the backend's weights; empty without any."""
        return self.pipeline.reconstructor.weights_sha256


@dataclass(frozen=True)
class Caller:
    """The caller of the engine: the tenant and its caller, among which the queue shares computing time.

    After `deadline_s`, by `time.monotonic`, the answer is useless.
    """

    flow: Flow
    deadline_s: float


@dataclass(frozen=True, eq=False)
class Query:
    """A photograph to localize.

    Attributes:
        scene_key: the scene.
        reference_ids: references to compare it with; if empty, `reference_count` references of the scene are chosen.
        photo: the photograph.
        narrowing: limits of the camera's pose, for choosing references and for checking the answer.
        reference_count: how many references are chosen.
        options: options of the method.
        allow_coarse: whether the coarse pose is the answer if there is no time to refine it.
        rerank: whether `reference_count` of the named references are chosen.
        priors: priors on the pose, each with its uncertainty, in the scene's world.
        is_part: whether it belongs to a rig or a sequence, which needs its matches even if it cannot be localized
            alone.
    """

    scene_key: SceneKey
    reference_ids: tuple[str, ...]
    photo: Photo
    narrowing: Narrowing
    reference_count: int
    options: LocalizeOptions
    allow_coarse: bool = False
    rerank: bool = False
    priors: Priors = NO_PRIORS
    is_part: bool = False
    is_generic: bool = False

    @property
    def chooses(self) -> bool:
        """Whether the server chooses the references, by their similarity to the photograph."""
        return self.rerank or not self.reference_ids

    @property
    def can_be_tracked(self) -> bool:
        """Whether its prior and options allow tracking, see `tracking`."""
        prior = self.priors.pose
        if prior is None or self.reference_ids or self.is_part or self.options.variant is not Variant.BEST:
            return False
        sigma = math.sqrt(float(np.linalg.eigvalsh(prior.covariance[3:, 3:])[-1]))
        return sigma <= math.radians(MAX_TRACKED_SIGMA_DEG)


@dataclass(frozen=True)
class Tried:
    """One attempt at a pose.

    Attributes:
        rung: the attempt's place among the attempts, such as "wide".
        features: the local features' name with their options.
        outcome: "localized", the value of the rejection's reason, or how it ended without a verdict, such as "failed".
        seconds: its computing time.
        processor_s: its processor time.
        is_chosen: whether the answer came from it.
    """

    rung: str
    features: str
    outcome: str
    seconds: float
    processor_s: float
    is_chosen: bool = False


@dataclass(frozen=True, eq=False)
class Result:
    """The answer to a query, and the data that it was computed from.

    Attributes:
        answer: the answer of the method.
        tier: the tier that computed it.
        references: the references that were used, in order.
        generation: generation of the scene when the references were read.
        processed: the camera of the reduced image that features were found in.
        choice: how the references were chosen; None if the caller named them.
        attributes: attributes of the scene.
        stage_seconds: time of every stage that was computed, in order, of all searches. The name of a stage of a
            further search begins with its extractor's name and a slash. Such a search has only "unfinished" if it
            failed, was ended for lack of time, or its tier has not described the references yet.
        attempts: the attempts that were made, in order.
    """

    answer: Answer
    tier: Tier
    references: tuple[PosedView, ...]
    generation: int
    processed: Camera
    choice: Choice | None = None
    attributes: SceneAttributes = field(default_factory=SceneAttributes)
    stage_seconds: dict[str, float] = field(default_factory=dict)
    attempts: tuple[Tried, ...] = ()

    def seconds_with(self, stage_seconds: Mapping[str, float]) -> dict[str, float]:
        """Time of its stages and of those of a further search with a tier; a tier may search several times."""
        seconds = dict(self.stage_seconds)
        for name, spent_s in stage_seconds.items():
            seconds[name] = seconds.get(name, 0.0) + spent_s
        return seconds

    @property
    def is_tracked(self) -> bool:
        """Whether its references were chosen by a pose prior, see `tracking`."""
        return self.choice is not None and self.choice.descriptor == POSE_PRIOR


class ReferenceSource(Protocol):
    """Source of a query's references: `References`, or recorded or rendered ones."""

    def load(
        self,
        scene_key: SceneKey,
        reference_ids: Sequence[str],
        extractor: FeatureExtractor,
        context: StageContext,
        waits: bool,
    ) -> Loaded:
        """Loads references of a scene, in the order given, with the scene's generation."""
        ...

    def attributes(self, scene_key: SceneKey) -> SceneAttributes:
        """Returns the attributes of a scene."""
        ...

    def choose(self, scene_key: SceneKey, views: QueryViews, selection: Selection, context: StageContext) -> Choice:
        """Chooses references for a photograph."""
        ...

    def report_damaged(self, scene_key: SceneKey, reference_id: str, error: Exception) -> None:
        """Reports that a chosen reference is not used because it is damaged."""
        ...


@dataclass(frozen=True, eq=False)
class QueryRun:
    """The state of a query between its stages, in one tier.

    Attributes:
        query: the query.
        source: source of the references.
        views: the photograph.
        deadline_s: time after which the answer is useless, by `time.monotonic`.
        on_better: called in the computing thread with each result that may be shown before the answer.
        tier: index of the tier that computes.
        best: best result so far; None in the first search of the first tier.
        start_s: when this tier began, by `time.monotonic`.
        give_up_s: time after which `best` is the answer, if this tier has none by then.
        narrowed: the query with the soft priors' choice of references, if references elsewhere are now searched.
        tries_turns: whether the photograph is to be turned as it matches most: as it is, there is no or little trust.
        ambiguous: the rejection as ambiguous, if the references of the place that the priors decided for are now used.
        listings: how often the scene was listed in this tier.
        context: cancels and times this tier's stages; from here on set by the stage `prepare`.
        references: the references that are used, in order.
        generation: generation of the scene when they were read.
        attributes: attributes of the scene.
        view: the photograph with this tier's features; None until the tier's first step has found them.
        choice: how the references were chosen; None if the caller named them.
        query_matches: matches of the photograph with each reference, if references were chosen by these or are matched
            one by one.
        unmatched: indices of the references that the photograph is still to be matched with again (`Matcher.rematch`),
            each in a step of its own, so that a busy server computes for other callers in between.
        part: the method's intermediate result between two stages.
    """

    query: Query
    source: ReferenceSource
    views: QueryViews
    deadline_s: float
    on_better: Callable[[Result], object] | None = None
    tier: int = 0
    best: Result | None = None
    start_s: float = field(default_factory=time.monotonic)
    give_up_s: float = math.inf
    narrowed: Query | None = None
    tries_turns: bool = False
    ambiguous: Result | None = None
    listings: int = 1
    context: StageContext = field(default_factory=StageContext)
    references: tuple[PosedView, ...] = ()
    generation: int = 0
    attributes: SceneAttributes = field(default_factory=SceneAttributes)
    view: View | None = None
    choice: Choice | None = None
    query_matches: tuple[Matches, ...] | None = None
    unmatched: tuple[int, ...] = ()
    part: Any = None

    def but(self, **changes: Any) -> QueryRun:
        """A copy with these values; `dataclasses.replace` takes ten times as long, which six copies a query show."""
        assert vars(self).keys() >= changes.keys()
        copy = object.__new__(QueryRun)
        vars(copy).update(vars(self), **changes)
        return copy

    @property
    def kind(self) -> str:
        """Kind of the query's jobs; jobs of one kind take about the same time."""
        if self.tracks:
            return "tracked"
        ids = self.query.reference_ids
        count = next((count for count in _COUNTS if len(ids) <= count), _COUNTS[-1])
        turned = ", turned" if self.tries_turns else ""
        return f"tier {self.tier}{turned}, {'chosen' if self.query.chooses else f'up to {count}'}"

    @property
    def tracks(self) -> bool:
        """Whether this tier begins with the references near the prior."""
        return self.best is None and self.query.can_be_tracked

    @property
    def earlier(self) -> Result | None:
        """The result if this computation comes to none."""
        return self.best or self.ambiguous

    @property
    def first_step(self) -> Step[QueryRun]:
        """The first step of the query in its tier."""
        kind = self.kind
        return Step(PREPARE, kind, kind, self)

    def choose(self, narrowing: Narrowing) -> Choice:
        """Chooses the shortlist of references within limits and likely values of the pose."""
        query = self.query
        selection = Selection(SHORTLIST * query.reference_count, narrowing, query.reference_ids, THINNED_LATER)
        return self.source.choose(query.scene_key, self.views, selection, self.context)

    def load(self, reference_ids: Sequence[str], tier: Tier) -> Loaded:
        """Loads references with the tier's features."""
        # Only the first tier waits for its references' features: before a stronger one there is an answer.
        waits = self.best is None
        return self.source.load(self.query.scene_key, reference_ids, tier.extractor, self.context, waits)


QueryStep = Step[QueryRun]
QueryJob = Job[QueryRun, Result]
QueryStageResult = StageResult[QueryRun, Result]
"""The queue's types with a query's payload and value."""
