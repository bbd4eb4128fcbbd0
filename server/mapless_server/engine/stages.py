"""A query's way through the work queue: prepare, coarse, refine; and again with stronger features where it is doubtful.

What is computed is the method's. Here is what surrounds it: the references, the photograph's features, the prior, the
choice between the answers of two tiers, and what is given when time runs out.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Generic, Protocol, TypeVar

from mapless_server.errors import DataLoss, NotFound, Unavailable
from mapless_server.method import localize as method
from mapless_server.method.features import FeatureExtractor
from mapless_server.method.groups.tracked import tracked_support
from mapless_server.method.hints import hinted
from mapless_server.method.localize import Answer, Coarse, Localization, Prepared
from mapless_server.method.rejection import Rejection, RejectionReason
from mapless_server.method.retrieve import spread_choice
from mapless_server.method.support import Support
from mapless_server.method.turns import Turn
from mapless_server.method.views import Matches, PosedView, View
from mapless_server.scenes.library import Loaded, NotDescribedYet, load_usable
from mapless_server.scenes.retrieval.chosen import Choice
from mapless_server.scenes.retrieval.narrowing import Narrowing
from mapless_server.scenes.retrieval.ranking import RankOptions
from mapless_server.scheduling import Abandoned, Done, Ending, Failure, Fallback, Job, Next, StageResult, Step
from mapless_server.security.tenancy import SceneKey
from mapless_server.store import SceneAttributes

from .failures import failure_of
from .query import UNFINISHED, Query, Result
from .tiers import Attempt, EscalationOptions, Tier, better_of, is_doubtful
from .views import QueryViews

log = logging.getLogger(__name__)

P = TypeVar("P", Prepared, Coarse)

PREPARE, COARSE, REFINE = "prepare", "coarse", "refine"

SHORTLIST = 2
"""So many times the references wanted are matched with the photograph, and the best of them used (see BENCHMARKS.md).
Those that are chosen would have been matched anyhow."""

THINNED_LATER = RankOptions(nearby_weight=1.0)
"""What is near one another is thinned out by matches, which tell better what is worth it."""

MAX_LISTINGS = 3
"""When a reference goes while it is used, the scene is listed again; more often than this it is being emptied."""

ANSWER_MARGIN_S = 0.05
"""Before the deadline, for an answer at hand to reach its caller."""

_COUNTS = (2, 5, 10, 20, 64)
"""Queries with about as many references cost about as much."""


@dataclass(frozen=True)
class Method:
    """The three parts of the method, and what is known after the second; see `method.localize`.

    `tracked_support` is what a photograph without a pose can still give to the others of its rig or walk.
    """

    prepare: Callable[..., Prepared | Answer] = method.prepare
    reconstruct: Callable[..., list[Coarse | Answer | Exception]] = method.reconstruct
    refine: Callable[..., Answer] = method.refine
    coarse_answer: Callable[[Coarse], Answer | None] = method.coarse_answer
    tracked_support: Callable[..., Support | None] = tracked_support


class ReferenceSource(Protocol):
    """Where references come from; see `ReferenceLibrary`."""

    def load(
        self, scene_key: SceneKey, reference_ids: Sequence[str], extractor: FeatureExtractor, turn: Turn, waits: bool
    ) -> tuple[int, tuple[PosedView, ...]]:
        """The scene's generation and references of it, in the order asked for."""
        ...

    def attributes(self, scene_key: SceneKey) -> SceneAttributes:
        """What is known of a scene as a whole."""
        ...


class Chooser(Protocol):
    """Chooses references for photographs; see `ReferenceChooser`."""

    def choose(
        self,
        scene_key: SceneKey,
        views: QueryViews,
        count: int,
        narrowing: Narrowing,
        among: Sequence[str],
        turn: Turn,
        options: RankOptions | None = None,
    ) -> Choice:
        """At most `count` references for a photograph."""
        ...

    def tell_damaged(self, scene_key: SceneKey, reference_id: str, error: Exception) -> None:
        """One that was chosen is not used."""
        ...


@dataclass(frozen=True, eq=False)
class Work:
    """A query in one tier.

    Attributes:
        query: what is asked.
        source: of the references.
        views: the photograph.
        deadline_s: when the answer is of no use any more, `time.monotonic`.
        tier: which of the engine's tiers tries to answer.
        best: the answer of the tiers before; None in the first.
        seconds_before: where the time went in them.
        start_s: when this tier began, `time.monotonic`.
        give_up_s: when `best` is answered, if this tier has no answer by then.
        listings: how often the scene was listed in this tier.
        tell_coarse: told the first tier's coarse pose as soon as there is one, in the thread that computes; None where
            nobody wants it before the answer.
    """

    query: Query
    source: ReferenceSource
    views: QueryViews
    deadline_s: float
    tier: int = 0
    best: Attempt | None = None
    seconds_before: dict[str, float] = field(default_factory=dict)
    start_s: float = field(default_factory=time.monotonic)
    give_up_s: float = math.inf
    listings: int = 1
    tell_coarse: Callable[[Result], None] | None = None

    @property
    def kind(self) -> str:
        """Queries of one kind take about as long."""
        ids = self.query.reference_ids
        count = next((count for count in _COUNTS if len(ids) <= count), _COUNTS[-1])
        return f"tier {self.tier}, {'chosen' if self.query.chooses else f'up to {count}'}"


@dataclass(frozen=True, eq=False)
class Found:
    """What is known before the method begins.

    Attributes:
        references: that it is to use, in order.
        generation: of the scene when they were read.
        attributes: of the scene.
        view: the photograph.
        seconds: where the time went.
        choice: how they were chosen; None if they were used as they were named.
        query_matches: of the photograph with each, where they were chosen by these.
    """

    references: tuple[PosedView, ...]
    generation: int
    attributes: SceneAttributes
    view: View
    seconds: dict[str, float]
    choice: Choice | None = None
    query_matches: tuple[Matches, ...] | None = None


@dataclass(frozen=True, eq=False)
class Underway(Generic[P]):
    """A query between two stages: what is known of it, and what the stage before made of that."""

    work: Work
    found: Found
    part: P


class QueryStages:
    """Computes the three stages; its methods run in the queue's threads."""

    def __init__(
        self,
        tiers: Sequence[Tier],
        chooser: Chooser,
        escalation: EscalationOptions,
        method: Method | None = None,
    ) -> None:
        """The tiers, the cheapest first; see `EngineOptions`."""
        self._tiers = tiers
        self._chooser = chooser
        self._escalation = escalation
        self._method = method or Method()

    @staticmethod
    def first_step(work: Work) -> Step:
        """What a query needs first in its tier."""
        return Step(PREPARE, work.kind, work.kind, work)

    def prepare(self, jobs: Sequence[Job]) -> list[StageResult]:
        """References, features and correspondences."""
        return [self._verdict(job.step.payload, self._prepare, job.step.payload, job) for job in jobs]

    def coarse(self, jobs: Sequence[Job]) -> list[StageResult]:
        """The reconstruction and its metric scale, of many queries in one go."""
        batch: list[Underway[Prepared]] = [job.step.payload for job in jobs]
        parts = self._method.reconstruct([it.part for it in batch], [job.check for job in jobs])
        return [self._verdict(it.work, self._after_coarse, it, part) for it, part in zip(batch, parts, strict=True)]

    def refine(self, jobs: Sequence[Job]) -> list[StageResult]:
        """Structure, matches, pose."""
        return [self._verdict(job.step.payload.work, self._refine, job.step.payload, job) for job in jobs]

    def _verdict(self, work: Work, compute: Callable[..., StageResult], *arguments: Any) -> StageResult:
        """What is computed, or what its failure means for a query that may have an answer already."""
        try:
            return compute(*arguments)
        except Exception as error:
            if isinstance(error, Abandoned) or failure_of(error) is Failure.DEVICE_LOST:
                return error
            # One that was deleted since it was listed was not the caller's choice: the next list is without it.
            is_outdated = isinstance(error, NotFound) and error.field != "scene" and not work.query.reference_ids
            if is_outdated and work.listings < MAX_LISTINGS:
                return self._next(work, self.first_step(replace(work, listings=work.listings + 1)))
            if work.best is None:
                return _emptied() if is_outdated else error
            # What fails was to be better than the answer at hand, so it must not cost that one.
            if not isinstance(error, NotDescribedYet):
                name = self._tiers[work.tier].extractor.name
                log.warning("%s failed; the first answer is given", name, exc_info=error)
            return self._unfinished(work)

    def _prepare(self, work: Work, job: Job) -> StageResult:
        tier = self._tiers[work.tier]
        turn = Turn(job.check)
        try:
            found = self._find(work, tier, turn)
        finally:
            # Once and for all: the queries to come find them described.
            job.unusual_s = turn.stage_seconds.get("describe", 0.0)
        if not found.references:
            unknown = work.query.narrowing.is_empty
            where = "the scene has no references" if unknown else "no reference is where the prior says"
            if found.choice is not None and found.choice.references:
                where = "what is stored of the references that resemble the photograph is damaged"
            return self._conclude(work, found, Answer(Rejection(RejectionReason.NO_USABLE_REFERENCES, where)))
        part = self._method.prepare(
            found.view,
            found.references,
            tier.pipeline,
            work.query.options,
            job.check,
            found.query_matches,
            work.query.priors,
        )
        if isinstance(part, Answer):
            return self._conclude(work, found, part)
        return self._next(work, Step(COARSE, work.kind, str(part.bucket), Underway(work, found, part)))

    def _find(self, work: Work, tier: Tier, turn: Turn) -> Found:
        """The references that are named, or those that the photograph resembles most."""
        query = work.query
        attributes = work.source.attributes(query.scene_key)
        if query.chooses:
            return self._choose(work, attributes, tier, turn)
        # References come first: a name that is wrong is found out before the photograph is described.
        generation, references = self._load(work, query.reference_ids, tier, turn)
        return Found(references, generation, attributes, work.views.view(tier.extractor, turn), turn.stage_seconds)

    def _choose(self, work: Work, attributes: SceneAttributes, tier: Tier, turn: Turn) -> Found:
        """The references that have the most feature matches, among those that resemble the photograph most."""
        query = work.query
        choice = self._chooser.choose(
            query.scene_key,
            work.views,
            SHORTLIST * query.reference_count,
            query.narrowing,
            query.reference_ids,
            turn,
            THINNED_LATER,
        )
        ranked = [chosen.reference_id for chosen in choice.references]
        generation, shortlist = self._load_chosen(work, ranked, tier, turn)
        view = work.views.view(tier.extractor, turn)
        with turn.stage("shortlist"):
            matches = tier.pipeline.matcher.match_query(view, shortlist, turn.check)
            centres = [reference.world_from_camera.translation for reference in shortlist]
            order = spread_choice([len(it) for it in matches], centres, query.reference_count)
        references, query_matches = tuple(shortlist[i] for i in order), tuple(matches[i] for i in order)
        return Found(references, generation, attributes, view, turn.stage_seconds, choice, query_matches)

    def _load_chosen(self, work: Work, reference_ids: Sequence[str], tier: Tier, turn: Turn) -> Loaded:
        """Without those that are damaged, which were not the caller's choice; unless the caller named them."""
        if work.query.reference_ids:
            return self._load(work, reference_ids, tier, turn)
        tell = partial(self._chooser.tell_damaged, work.query.scene_key)
        return load_usable(lambda some: self._load(work, some, tier, turn), reference_ids, (DataLoss,), tell)

    def _load(self, work: Work, reference_ids: Sequence[str], tier: Tier, turn: Turn) -> Loaded:
        # Only the first tier's references are waited for: there is an answer before the others'.
        waits = work.best is None
        return work.source.load(work.query.scene_key, reference_ids, tier.extractor, turn, waits=waits)

    def _after_coarse(self, underway: Underway[Prepared], part: Coarse | Answer | Exception) -> StageResult:
        if isinstance(part, Exception):
            raise part
        work, found = underway.work, underway.found
        if isinstance(part, Answer):
            return self._conclude(work, found, part)
        step = Step(REFINE, work.kind, work.kind, Underway(work, found, part))
        coarse = self._coarse_result(work, found, part)
        if coarse is None:
            return self._next(work, step)
        if work.tell_coarse is not None and isinstance(coarse.attempt.answer.outcome, Localization):
            work.tell_coarse(coarse)
        if not work.query.allow_coarse:
            return self._next(work, step)
        done = Done(coarse, Ending.DEGRADED)
        return Next(step, Fallback(lambda: done, work.deadline_s - ANSWER_MARGIN_S))

    def _coarse_result(self, work: Work, found: Found, part: Coarse) -> Result | None:
        """The answer if no more is computed, where somebody may want it and the first tier has one."""
        if work.best is not None or not (work.query.allow_coarse or work.tell_coarse is not None):
            return None
        coarse = self._method.coarse_answer(part)
        if coarse is None or not _is_finite(coarse):
            return None
        return self._result(work, self._attempt(work, found, coarse), found, coarse)

    def _refine(self, underway: Underway[Coarse], job: Job) -> StageResult:
        answer = self._method.refine(underway.part, job.check)
        if underway.work.query.is_part and answer.support is None:
            support = self._method.tracked_support(underway.part.prepared, job.check)
            answer = replace(answer, support=support)
        return self._conclude(underway.work, underway.found, answer)

    def _conclude(self, work: Work, found: Found, answer: Answer) -> StageResult:
        """A tier has its answer: the better one is given, or tried to be bettered once more."""
        attempt = self._attempt(work, found, answer)
        best = attempt if work.best is None else better_of(work.best, attempt, self._escalation)
        result = self._result(work, best, found, answer)
        if work.tier + 1 < len(self._tiers) and is_doubtful(best.answer, self._escalation):
            now_s = time.monotonic()
            stronger = replace(
                work,
                tier=work.tier + 1,
                best=best,
                seconds_before=result.stage_seconds,
                start_s=now_s,
                listings=1,
                give_up_s=now_s + self._escalation.time_share * (work.deadline_s - now_s),
            )
            return self._next(stronger, self.first_step(stronger))
        return Done(result, _ending(best))

    def _next(self, work: Work, step: Step) -> Next:
        """Where there is an answer, it is given in time if the step does not lead to a better one."""
        if work.best is None:
            return Next(step)
        return Next(step, Fallback(lambda: self._unfinished(work), work.give_up_s))

    def _unfinished(self, work: Work) -> Done:
        assert work.best is not None
        unfinished = {f"{self._tiers[work.tier].extractor.name}{UNFINISHED}": time.monotonic() - work.start_s}
        return Done(Result(work.best, work.seconds_before | unfinished), _ending(work.best))

    def _attempt(self, work: Work, found: Found, answer: Answer) -> Attempt:
        _check_finite(answer)
        query = work.query
        answer = _gated(answer, query.narrowing)
        answer = hinted(answer, found.view, found.references, not query.narrowing.is_empty)
        tier, camera = self._tiers[work.tier], found.view.camera
        return Attempt(tier, answer, found.references, found.generation, camera, found.choice, found.attributes)

    def _result(self, work: Work, best: Attempt, found: Found, answer: Answer) -> Result:
        prefix = "" if work.best is None else f"{self._tiers[work.tier].extractor.name}/"
        seconds = {f"{prefix}{stage}": value for stage, value in (found.seconds | answer.stage_seconds).items()}
        return Result(best, work.seconds_before | seconds)


def _emptied() -> Unavailable:
    return Unavailable("the scene's references are being deleted", reason="SCENE_CHANGED", retry_after_s=1.0)


def _ending(attempt: Attempt) -> Ending:
    return Ending.OK if isinstance(attempt.answer.outcome, Localization) else Ending.LOW_CONFIDENCE


def _check_finite(answer: Answer) -> None:
    """A pose of NaN must never leave the server: ArithmeticError."""
    if not _is_finite(answer):
        raise ArithmeticError(f"the method's answer is not finite: {answer.outcome}, {answer.scale}")


def _is_finite(answer: Answer) -> bool:
    numbers = [] if answer.scale is None else [answer.scale.metres_per_unit, answer.scale.deviation]
    if isinstance(answer.outcome, Localization):
        outcome = answer.outcome
        covariance = [] if outcome.covariance is None else outcome.covariance.ravel().tolist()
        numbers += [*outcome.world_from_camera.matrix().ravel(), *covariance, outcome.reprojection_error_px]
    return all(map(math.isfinite, numbers))


def _gated(answer: Answer, narrowing: Narrowing) -> Answer:
    """The answer, rejected if its pose contradicts what is known of the camera."""
    if not isinstance(answer.outcome, Localization):
        return answer
    contradiction = narrowing.contradiction(answer.outcome.world_from_camera)
    if not contradiction:
        return answer
    return replace(answer, outcome=Rejection(RejectionReason.PRIOR_CONFLICT, contradiction))
