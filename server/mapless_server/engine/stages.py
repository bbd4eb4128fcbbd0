"""The stages of a query in the work queue: prepare, coarse, refine; and again with stronger features if doubtful.

The method computes the pose, `choosing` finds references and the photograph's features. This module checks the pose
against hard priors, chooses between the answers of two searches, and gives an answer when time runs out.
"""

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from mapless_server.errors import NotFound, Unavailable
from mapless_server.method import localize as method
from mapless_server.method import pipeline
from mapless_server.method.bundle.estimate import Support
from mapless_server.method.judge.answer import Answer, Localization
from mapless_server.method.judge.hints import hinted
from mapless_server.method.judge.judge import trust_in_scene
from mapless_server.method.judge.references import supporters_of, with_contradiction, without_agreement
from mapless_server.method.options import StageContext
from mapless_server.method.pipeline import Coarse, Pipeline, Prepared, tracked_support
from mapless_server.method.rejection import Hint, Hypothesis, Rejection, RejectionReason
from mapless_server.scenes import ANYWHERE, Selection
from mapless_server.scenes.library import FeaturesMissing
from mapless_server.scheduling import Abandoned, Done, Ending, Failure, Fallback, Next, Step

from . import tracking
from .choosing import is_searched, load_chosen, may_be_elsewhere, turned_to_match, with_chosen, with_named
from .failures import failure_of
from .options import EscalationOptions
from .query import (
    COARSE,
    PREPARE,
    REFINE,
    TRACK,
    UNFINISHED,
    Query,
    QueryJob,
    QueryRun,
    QueryStageResult,
    QueryStep,
    Result,
    Tier,
)
from .tiers import (
    better_of,
    inlier_count,
    is_doubtful,
    may_be_turned,
    of_two_places,
    place_of_priors,
    shows_no_more,
    with_untried,
)

log = logging.getLogger(__name__)

MAX_LISTINGS = 3
"""When a reference is deleted while it is used, the scene is listed again; more often than this it is being emptied."""

TIME_SHARE = 0.8
"""Of the remaining time, that a stronger tier may take. After that the first answer is returned, since a doubtful
answer is better than none; the rest of the time suffices to send it."""

REMATCH_SHARE = 0.7
"""Of a tier's time, after which it stops matching the photograph again by a slow network (see `Matcher.rematch`); the
rest is for the pose, which takes a second if matches are few."""

ANSWER_MARGIN_S = 0.05
"""Before the deadline, for an answer that exists to reach its caller."""


@dataclass(frozen=True)
class Method:
    """The parts of the method, see `method.localize`; tests replace them.

    `tracked_support` makes the support that a photograph without a pose can still give to its rig or sequence.
    """

    prepare: Callable[..., Prepared | Answer] = method.prepare
    reconstruct: Callable[[Sequence[Prepared]], list[Coarse | Answer | Exception]] = pipeline.reconstruct
    refine: Callable[[Coarse], Answer] = method.refine
    coarse_answer: Callable[[Coarse], Answer | None] = pipeline.coarse_answer
    tracked_support: Callable[[Prepared], Support | None] = tracked_support


class QueryStages:
    """Computes the three stages; its methods run in the queue's threads."""

    def __init__(
        self,
        tiers: Sequence[Tier],
        escalation: EscalationOptions,
        method: Method | None = None,
        gives_up: Callable[[QueryRun], bool] = lambda run: False,
        is_alone: Callable[[], bool] = lambda: False,
    ) -> None:
        """Uses these tiers, the cheapest first; see `EngineOptions` for the options.

        A further search that `gives_up` is not begun, as if there were no time: where a captured call is replayed. A
        query that `is_alone` may use all threads where otherwise others would wait for one.
        """
        self._tiers = tiers
        self._escalation = escalation
        self._method = method or Method()
        self._gives_up = gives_up
        self._is_alone = is_alone

    def prepare(self, jobs: Sequence[QueryJob]) -> list[QueryStageResult]:
        """Loads references, finds features and computes correspondences."""
        return [self._stage_result(job.step.payload, self._prepare, job) for job in jobs]

    def coarse(self, jobs: Sequence[QueryJob]) -> list[QueryStageResult]:
        """Reconstructs many queries together, and estimates the metric scale of each."""
        runs: list[QueryRun] = [job.step.payload for job in jobs]
        parts = self._method.reconstruct([run.part for run in runs])
        return [self._stage_result(run, self._after_coarse, part) for run, part in zip(runs, parts, strict=True)]

    def refine(self, jobs: Sequence[QueryJob]) -> list[QueryStageResult]:
        """Computes structure, matches and pose."""
        return [self._stage_result(job.step.payload, self._refine) for job in jobs]

    def _stage_result(
        self, run: QueryRun, compute: Callable[..., QueryStageResult], *arguments: Any
    ) -> QueryStageResult:
        """Computes a stage; a failure ends the query, or returns the answer that an earlier tier has given."""
        try:
            return compute(run, *arguments)
        except Exception as error:
            if isinstance(error, Abandoned) or failure_of(error) is Failure.DEVICE_LOST:
                return error
            # A reference deleted since the scene was listed was not the caller's choice: the next list is without it.
            is_outdated = isinstance(error, NotFound) and error.field != "scene" and not run.query.reference_ids
            if is_outdated and run.listings < MAX_LISTINGS:
                return self._next(run, run.but(listings=run.listings + 1, view=None).first_step)
            if run.earlier is None:
                if not is_outdated:
                    return error
                return Unavailable(
                    "the scene's references are being deleted", reason="SCENE_CHANGED", retry_after_s=1.0
                )
            # A failed attempt at a better answer must not cost the first answer.
            if not isinstance(error, FeaturesMissing):
                name = self._tiers[run.tier].features
                log.warning("%s failed; the first answer is given", name, exc_info=error)
            return self._unfinished(run)

    def _prepare(self, run: QueryRun, job: QueryJob) -> QueryStageResult:
        tier, query = self._tiers[run.tier], run.query
        if run.view is not None:  # its first step is done
            return self._matched_further(self._rematched(run) if self._has_time_to_rematch(run, tier) else run)
        run = run.but(context=StageContext(job.check))
        try:
            attributes = run.source.attributes(query.scene_key)
            if query.is_generic:
                attributes = replace(attributes, calibration=None, self_calibrations=())
            if attributes.contradiction:  # radii and trust measured by its references say nothing
                attributes = replace(attributes, self_calibrations=())
            run = run.but(attributes=attributes)
            if run.tries_turns and not run.views.quarter_turns:
                assert run.best is not None
                views = turned_to_match(run, tier)
                if isinstance(views, Rejection) or not views.quarter_turns:
                    spent_s = {f"{tier.features}/{name}": it for name, it in run.context.stage_seconds.items()}
                    best = replace(run.best, stage_seconds=run.best.seconds_with(spent_s))
                    if isinstance(views, Rejection):  # no features see a mirrored photograph better
                        return Done(replace(best, answer=replace(best.answer, outcome=views)), Ending.LOW_CONFIDENCE)
                    return self._stronger(run, query, best)
                run = run.but(views=views)
            tracked = self._tracked(run, tier) if run.tracks else None
            if tracked is not None:
                return tracked
            run = with_chosen(run, tier) if query.chooses else with_named(run, tier)
        finally:
            # Described once and for all: the next queries find the features stored.
            job.unusual_s = run.context.stage_seconds.get("describe", 0.0)
        if not run.references:
            where = "no reference is where the prior says" if is_searched(run) else "the scene has no references"
            if run.choice is not None and run.choice.references:
                where = "what is stored of the references that resemble the photograph is damaged"
            return self._conclude(run, Answer(Rejection(RejectionReason.NO_USABLE_REFERENCES, where)))
        matcher = tier.pipeline.matcher
        if matcher.pair_matching is not None:
            assert run.view is not None
            if run.query_matches is None:
                with run.context.stage("correspond"):
                    matches = matcher.match_quickly(run.view, run.references, run.context.check)
                run = run.but(query_matches=tuple(matches))
            assert run.query_matches is not None
            # The network of a slow matching takes places in the photograph for those in an upright one.
            if not run.views.quarter_turns:
                run = run.but(unmatched=tuple(matcher.to_rematch(run.query_matches)))
        return self._matched_further(run)

    def _rematched(self, run: QueryRun) -> QueryRun:
        """Matches the photograph again with the next reference, or with as many as there are threads if it is alone."""
        assert run.view is not None
        assert run.query_matches is not None
        matcher, matches = self._tiers[run.tier].pipeline.matcher, list(run.query_matches)
        count = matcher.threads if self._is_alone() else 1
        indices, others = run.unmatched[:count], run.unmatched[count:]
        with run.context.stage("rematch"):
            found = matcher.rematch_together(run.view, [run.references[i] for i in indices])
        for i, it in zip(indices, found, strict=True):
            matches[i] = it
        return run.but(query_matches=tuple(matches), unmatched=others)

    def _matched_further(self, run: QueryRun) -> QueryStageResult:
        """Matches the next reference, or goes on with the query if all are matched or no time is left for more."""
        tier, query = self._tiers[run.tier], run.query
        assert run.view is not None
        if self._has_time_to_rematch(run, tier):
            # If the queue finds no time for that, the pose is computed from the matches there are.
            again = Step(PREPARE, f"{run.kind}, rematch", f"{run.kind}, rematch", run, run.kind)
            pose = Step(PREPARE, f"{run.kind}, matched", f"{run.kind}, matched", run.but(unmatched=()), run.kind)
            return self._next(run, again, pose)
        run = run.but(unmatched=())
        pipeline = _pipeline_in(run, tier)
        given = run.view, run.references, pipeline, query.options, run.context, run.query_matches, query.priors
        part = self._method.prepare(*given, not run.attributes.arbitrary_unit)
        if isinstance(part, Answer):
            return self._conclude(run, part)
        return self._next(run, Step(COARSE, run.kind, part.bucket, run.but(part=part)))

    def _has_time_to_rematch(self, run: QueryRun, tier: Tier) -> bool:
        """Whether another reference is left to be matched, and time for it before the tier must compute the pose."""
        if not run.unmatched:
            return False
        until_s = run.give_up_s if run.best is not None else run.deadline_s
        until_s = run.start_s + REMATCH_SHARE * (until_s - run.start_s)
        return time.monotonic() + (tier.pipeline.matcher.pair_s or 0.0) <= until_s

    def _tracked(self, run: QueryRun, tier: Tier) -> QueryStageResult | None:
        """Answers from the references near the pose prior; None if they do not suffice, and notes the time it took."""
        seconds, begin_s = run.context.stage_seconds, time.monotonic()
        found = self._track(run, tier)
        if found is not None:
            return Done(found, Ending.OK)
        kept = {name: seconds[name] for name in ("describe", "decode") if name in seconds}  # the search does not repeat
        seconds.clear()
        seconds |= {TRACK: time.monotonic() - begin_s - sum(kept.values())} | kept
        return None

    def _track(self, run: QueryRun, tier: Tier) -> Result | None:
        query, context, prior = run.query, run.context, run.query.priors.pose
        assert prior is not None
        with context.stage(TRACK):
            selection = Selection(min(tracking.REFERENCES, query.reference_count), near=prior)
            near = run.source.choose(query.scene_key, run.views, selection, context)
        if len(near.references) < 2:
            return None
        generation, references = load_chosen(run, [it.reference_id for it in near.references], tier)
        views = run.views.reduced(tracking.MAX_PIXELS, context)
        tier = tracking.tracking_tier(tier)
        view, pipeline = views.view(tier.extractor, context), _pipeline_in(run, tier)
        answer = tracking.track(view, references, pipeline, query.options, context, query.priors)
        if not tracking.suffices(answer, pipeline.options.weak_inliers, self._doubt_in(run)):
            return None
        selection = Selection(query.reference_count, query.narrowing.limits)
        alike = run.source.choose(query.scene_key, views, selection, context)
        others = [it.reference_id for it in tracking.elsewhere(near, alike)]
        with context.stage(TRACK):
            rivals = load_chosen(run, others, tier)[1] if others else ()
            if tracking.is_contradicted(answer, view, rivals, pipeline.matcher):
                return None
        tracked = run.but(generation=generation, references=references, view=view, choice=near)
        result = replace(self._result(tracked, answer), tier=tier)
        return result if isinstance(result.answer.outcome, Localization) else None

    def _after_coarse(self, run: QueryRun, part: Coarse | Answer | Exception) -> QueryStageResult:
        if isinstance(part, Exception):
            raise part
        if isinstance(part, Answer):
            return self._conclude(run, part)
        kind = run.kind
        step = Step(REFINE, kind, kind, run.but(part=part))
        if run.earlier is not None or not run.query.allow_coarse:
            return self._next(run, step)
        answer = self._method.coarse_answer(part)
        if answer is None or not answer.is_finite:
            return self._next(run, step)
        coarse = self._result(run, answer)
        if run.on_better is not None and isinstance(coarse.answer.outcome, Localization):
            run.on_better(coarse)
        done = Done(coarse, Ending.DEGRADED)
        return Next((step,), Fallback(lambda: done, run.deadline_s - ANSWER_MARGIN_S))

    def _refine(self, run: QueryRun) -> QueryStageResult:
        answer = self._method.refine(run.part)
        if run.query.is_part and answer.support is None:
            answer = replace(answer, support=self._method.tracked_support(run.part.prepared))
        return self._conclude(run, answer)

    def _conclude(self, run: QueryRun, answer: Answer) -> QueryStageResult:
        """Ends a search: returns the better of two answers, or searches elsewhere or in a stronger tier for another."""
        place = None
        if isinstance(answer.outcome, Rejection):
            place = place_of_priors(answer.outcome, run.query.priors)
            if isinstance(place, Hint):
                answer = replace(answer, outcome=replace(answer.outcome, hint=place))
        result, query = self._result(run, answer), run.query
        if isinstance(place, Hypothesis) and len(place.references) < len(run.references):
            return self._at_place(run, place, result)
        if run.narrowed is not None:
            assert run.best is not None
            better = of_two_places(run.best, result)
            if better not in (run.best, result):  # two places: stronger features would search only one of them
                return Done(replace(better, stage_seconds=result.stage_seconds), _ending(better))
            # Stronger features search the whole scene after two rejections, unless the priors' references showed more.
            is_near = isinstance(run.best.answer.outcome, Localization) or inlier_count(run.best) > inlier_count(result)
            query = run.narrowed if better is run.best and is_near else query
            result = replace(better, stage_seconds=result.stage_seconds)
        elif run.best is not None:
            better = better_of(run.best, result)
            if run.tries_turns and better is result and shows_no_more(run.best, result):
                better, run = run.best, run.but(views=run.views.not_turned)
            result = replace(better, stage_seconds=result.stage_seconds)
        elif self._searches_elsewhere(run, answer):
            elsewhere = replace(query, narrowing=query.narrowing.limits)
            return self._search(replace(self._further(run, elsewhere, run.tier, result), narrowed=query))
        is_first = run.tier == 0 and not run.tries_turns
        if is_first and self._tiers[0].upright_only and may_be_turned(result.answer, self._doubt_in(run)):
            return self._search(replace(self._further(run, query, 0, result), tries_turns=True))
        return self._stronger(run, query, result)

    def _stronger(self, run: QueryRun, query: Query, result: Result) -> QueryStageResult:
        """Searches with stronger features if a result is doubtful and there are any, and otherwise returns it."""
        if run.tier + 1 < len(self._tiers) and is_doubtful(result.answer, self._doubt_in(run)):
            return self._search(self._further(run, query, run.tier + 1, result))
        return Done(result, _ending(result))

    def _at_place(self, run: QueryRun, place: Hypothesis, ambiguous: Result) -> QueryStageResult:
        """Computes the pose from the references of one place alone."""
        kept = [i for i, it in enumerate(run.references) if it.name in place.references]
        matches = None if run.query_matches is None else tuple(run.query_matches[i] for i in kept)
        references, give_up_s = tuple(run.references[i] for i in kept), min(run.give_up_s, self._give_up_s(run))
        return self._matched_further(
            run.but(references=references, query_matches=matches, ambiguous=ambiguous, give_up_s=give_up_s)
        )

    def _give_up_s(self, run: QueryRun) -> float:
        now_s = time.monotonic()
        return now_s + TIME_SHARE * (run.deadline_s - now_s)

    def _further(self, run: QueryRun, query: Query, tier: int, best: Result) -> QueryRun:
        """Another search; if it finds nothing better in time, the best result so far is returned."""
        known, found = run.best.answer.outcome if run.best else None, best.answer.outcome
        if run.on_better is not None and isinstance(found, Localization) and found is not known:
            run.on_better(best)
        limits = time.monotonic(), self._give_up_s(run)
        return QueryRun(query, run.source, run.views, run.deadline_s, run.on_better, tier, best, *limits)

    def _search(self, run: QueryRun) -> QueryStageResult:
        return self._unfinished(run) if self._gives_up(run) else self._next(run, run.first_step)

    def _searches_elsewhere(self, run: QueryRun, answer: Answer) -> bool:
        """`may_be_elsewhere`, except that its failure does not cost the answer that there is."""
        try:
            return may_be_elsewhere(run, self._tiers[run.tier], answer)
        except Exception as error:
            if isinstance(error, Abandoned) or failure_of(error) is Failure.DEVICE_LOST:
                raise
            log.warning("references elsewhere could not be compared; the first answer is given", exc_info=error)
            return False

    def _doubt_in(self, run: QueryRun) -> EscalationOptions:
        """Adapts the options to the scene's quantiles of trust, so that the same answers are doubtful in all scenes."""
        options, calibration = self._escalation, run.attributes.self_calibration(self._tiers[run.tier].kind)
        if calibration is None:
            return options
        doubtful_trust = trust_in_scene(options.doubtful_trust, calibration.trust_quantiles)
        return replace(options, doubtful_trust=doubtful_trust)

    def _next(self, run: QueryRun, *steps: QueryStep) -> Next[QueryRun, Result]:
        """Goes on to one of the steps; an earlier tier's answer is returned in time if none leads to a better one."""
        if run.earlier is None:
            return Next(steps)
        return Next(steps, Fallback(lambda: self._unfinished(run), run.give_up_s))

    def _unfinished(self, run: QueryRun) -> Done[Result]:
        assert run.earlier is not None
        unfinished = {f"{self._tiers[run.tier].features}{UNFINISHED}": time.monotonic() - run.start_s}
        answer = with_untried(run, run.earlier.answer, self._tiers[run.tier])
        result = replace(run.earlier, answer=answer, stage_seconds=run.earlier.stage_seconds | unfinished)
        return Done(result, _ending(result))

    def _result(self, run: QueryRun, answer: Answer) -> Result:
        """Makes the result for the caller from a tier's answer, after checking it against hard priors."""
        if not answer.is_finite:  # a pose of NaN must never leave the server
            raise ArithmeticError(f"the method's answer is not finite: {answer.outcome}, {answer.scale}")
        assert run.view is not None
        tier, narrowing = self._tiers[run.tier], run.query.narrowing
        outcome = answer.outcome
        if isinstance(outcome, Localization) and narrowing is not ANYWHERE:
            beyond = narrowing.contradiction(outcome.world_from_camera, run.attributes.unit)
            if beyond:
                answer = replace(answer, outcome=Rejection(RejectionReason.PRIOR_CONFLICT, beyond))
        if run.attributes.contradiction and isinstance(answer.outcome, Localization) and answer.support is not None:
            answer = replace(answer, outcome=without_agreement([supporters_of(answer.support)]) or answer.outcome)
        if isinstance(answer.outcome, Rejection):
            answer = hinted(answer, run.view, run.references, is_searched(run) and not narrowing.is_empty)
        if run.attributes.contradiction and isinstance(answer.outcome, Rejection):
            answer = replace(answer, outcome=with_contradiction(answer.outcome, run.attributes.contradiction))
        seconds = run.context.stage_seconds | answer.stage_seconds
        if run.best is not None:
            seconds = run.best.seconds_with({f"{tier.features}/{name}": it for name, it in seconds.items()})
        used = run.references, run.generation, run.view.camera, run.choice, run.attributes
        return Result(answer, tier, *used, seconds)


def _pipeline_in(run: QueryRun, tier: Tier) -> Pipeline:
    calibration = run.attributes.self_calibration(tier.kind)
    return tier.pipeline.with_trust(calibration.trust_quantiles if calibration else ())


def _ending(result: Result) -> Ending:
    return Ending.OK if isinstance(result.answer.outcome, Localization) else Ending.LOW_CONFIDENCE
