"""The stages of a query in the work queue: prepare, coarse, refine; and again for each further attempt.

`ladder` says which attempt follows, `judge.decide` which of their results is answered, and `material` what an attempt
is computed from. This module computes one attempt after the other, each stage in its turn in the queue, and gives the
best answer so far when time runs out or an attempt fails.
"""

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

from mapless_server.engine.search import Material
from mapless_server.errors import NotFound, RequestError, Unavailable
from mapless_server.method import ladder, pipeline
from mapless_server.method.bundle.estimate import Support
from mapless_server.method.judge.answer import Answer, Localization
from mapless_server.method.judge.decide import decide
from mapless_server.method.judge.hypothesis import AS_IT_IS, Attempt, Doubt, Found, Raster, Solver, Where, found_by
from mapless_server.method.options import DoubtOptions, Variant
from mapless_server.method.pipeline import Coarse, Prepared, tracked_support
from mapless_server.method.rejection import Rejection, RejectionReason
from mapless_server.method.solve import solve
from mapless_server.scenes.library import FeaturesMissing
from mapless_server.scheduling import Abandoned, Done, Ending, Failure, Fallback, Next, Step, processor_s

from . import among, cameras, choosing, cutting
from .failures import failure_of
from .query import COARSE, PREPARE, REFINE, TRACK, CutReason, LadderCut, Result, Tier
from .search import DOUBTFUL, SKIPPED, Search, SearchJob, SearchResult, SearchStep
from .situation import any_roll_of, situation_of
from .tracking import track
from .verdicts import Verdicts

log = logging.getLogger(__name__)

MAX_LISTINGS = 3
"""When a reference is deleted while it is used, the scene is listed again; more often than this it is being emptied."""

TIME_SHARE = 0.8
"""Share of the remaining time that a further attempt may take. After that the best answer so far is returned; the rest
of the time suffices to send it."""

REMATCH_SHARE = 0.7
"""Share of an attempt's time after which it stops matching the photograph by a slow network (see `Matcher.rematch`);
the rest is for the pose, which takes a second if matches are few."""

ANSWER_MARGIN_S = 0.05
"""Before the deadline, for an answer that exists to reach its caller."""


@dataclass(frozen=True)
class Method:
    """The parts of the method, see `method.localize`; tests replace them.

    `tracked_support` makes the support that a photograph without a pose can still give to its rig or sequence.
    """

    prepare: Callable[..., Prepared | Rejection] = pipeline.prepare
    reconstruct: Callable[[Sequence[Prepared]], list[Coarse | Exception]] = pipeline.reconstruct
    solve: Callable[[Coarse, Attempt, DoubtOptions], Found] = solve
    coarse_answer: Callable[[Coarse], Answer | None] = pipeline.coarse_answer
    tracked_support: Callable[[Prepared], Support | None] = tracked_support


class QueryStages:
    """Computes the three stages; its methods run in the queue's threads."""

    def __init__(
        self,
        tiers: Sequence[Tier],
        doubt: DoubtOptions,
        method: Method | None = None,
        is_alone: Callable[[], bool] = lambda: False,
    ) -> None:
        """Uses the features of these tiers, the cheapest first; see `EngineOptions` for the options.

        A query that `is_alone` may use all threads where otherwise others would wait for one.
        """
        self._tiers = tiers
        self._doubt = doubt
        self._verdicts = Verdicts(tiers, doubt)
        self._any_roll = any_roll_of(tiers)
        self._method = method or Method()
        self._is_alone = is_alone

    def prepare(self, jobs: Sequence[SearchJob]) -> list[SearchResult]:
        """Loads references, finds features and computes correspondences."""
        return [self._stage_result(job.step.payload, partial(self._prepare, job=job)) for job in jobs]

    def coarse(self, jobs: Sequence[SearchJob]) -> list[SearchResult]:
        """Reconstructs many queries together, and estimates the metric scale of each."""
        begin_s, start_s = processor_s(), time.monotonic()
        searches = [job.step.payload for job in jobs]
        made: list[Coarse | Exception]
        try:
            made = self._method.reconstruct([it.prepared for it in searches if it.prepared is not None])
        except Exception as error:
            if len(jobs) > 1:  # the queue computes halves of them
                raise
            made = [error]
        share_s = (processor_s() - begin_s) / len(jobs)
        took_s = time.monotonic() - start_s
        spent = [it.but(processor_s=it.processor_s + share_s, computed_s=it.computed_s + took_s) for it in searches]
        return [
            self._stage_result(search, partial(self._reconstructed, coarse=coarse))
            for search, coarse in zip(spent, made, strict=True)
        ]

    def refine(self, jobs: Sequence[SearchJob]) -> list[SearchResult]:
        """Computes structure, matches and pose."""
        return [self._stage_result(job.step.payload, self._refine) for job in jobs]

    def _stage_result(self, search: Search, compute: Callable[[Search], SearchResult]) -> SearchResult:
        """Computes a stage; a failure ends the query with the best answer so far, if there is one."""
        search = search.resumed()
        try:
            return compute(search)
        except Exception as error:  # not kept in a variable, or its traceback would keep what was computed
            return self._failed(search, error)

    def _failed(self, search: Search, failure: Exception) -> SearchResult:
        if isinstance(failure, Abandoned) or failure_of(failure) is Failure.DEVICE_LOST:
            return failure
        # A reference deleted since the scene was listed was not the caller's choice: the next list is without it.
        is_outdated = isinstance(failure, NotFound) and failure.field != "scene" and not search.query.reference_ids
        if is_outdated and search.listings < MAX_LISTINGS:
            again = search.but(listings=search.listings + 1, material=None, coarse=None)
            return self._next(again, again.first_step)
        if search.group is not None and not search.chooses_scenes and among.is_of_scene(failure):
            without = among.without_scene(search, failure)
            if without is None:
                return failure
            cut = without.cut(search.rung, self._verdicts.tier(search.attempt).features, CutReason.FAILED)
            return self._skipped(cut, CutReason.FAILED.value)
        if search.verdict is not None:
            return self._without_attempt(search, failure)
        if not is_outdated:
            return failure
        return Unavailable("the scene's references are being deleted", reason="SCENE_CHANGED", retry_after_s=1.0)

    def _without_attempt(self, search: Search, failure: Exception) -> SearchResult:
        """Goes on without an attempt that failed: it must not cost the answer that there is."""
        if isinstance(failure, FeaturesMissing):  # which the library makes after the call
            features = self._verdicts.tier(search.attempt).features
            return self._skipped(search.cut(search.rung, features, CutReason.FEATURES_MISSING), "unfinished")
        unexpected = None if isinstance(failure, RequestError) else failure
        log.warning(
            "the attempt %r failed: %s; the answer before it is given", search.rung, failure, exc_info=unexpected
        )
        is_full = failure_of(failure) is Failure.OUT_OF_MEMORY
        reason = CutReason.OUT_OF_MEMORY if is_full else CutReason.FAILED
        return self._unfinished(search, reason.value, reason)

    def _prepare(self, search: Search, job: SearchJob) -> SearchResult:
        attempt = search.attempt
        if search.material is None or not search.material.serves(attempt):
            search.context.check = job.check
            try:
                described = self._described(search)
            finally:
                # Described once and for all: the next queries find the features stored.
                job.unusual_s = search.context.stage_seconds.get("describe", 0.0)
            if not isinstance(described, Search):
                return described
            search = described
        elif self._has_time_to_rematch(search):
            search = self._rematched(search)
        return self._matched(search)

    def _described(self, search: Search) -> Search | SearchResult:
        """The search with what its attempt is computed from; or what follows if there is nothing to compute."""
        attempt = search.attempt
        if search.chooses_scenes:
            search = among.with_scenes(search, self._verdicts.tier(attempt))
            return self._next(search, search.first_step)
        if search.is_at_begin:
            search = choosing.turned_by_gravity(search, self._verdicts.tier(attempt))
        if attempt.where is Where.NEAR_PRIOR:
            return self._tracked(search)
        if attempt.raster is Raster.MIRRORED:
            rejection = choosing.mirrored(search, self._verdicts.tier(attempt))
            if rejection is None:
                return self._skipped(search)
            return self._conclude(search, found_by(attempt, Answer(rejection), self._doubt, Doubt.CAMERA))
        material = self._material(search)
        if material is None:
            return self._skipped(search)
        search = search.but(material=material, coarse=None)
        if not material.references:
            rejection = Rejection(RejectionReason.NO_USABLE_REFERENCES, material.missing)
            return self._conclude(search, found_by(search.attempt, Answer(rejection), self._doubt, Doubt.REFERENCES))
        return search

    def _material(self, search: Search) -> Material | None:
        """The photograph and references of the attempt; None if an earlier attempt had the same."""
        attempt, known = search.attempt, search.material
        is_known = known is not None and known.basis == attempt.basis
        material = known if is_known else choosing.described_anew(search, self._verdicts.tier(attempt), self._any_roll)
        if material is None or not attempt.matching.is_strong:
            return material
        assert material.query_matches is not None
        unmatched = tuple(self._verdicts.tier(attempt).pipeline.matcher.to_rematch(material.query_matches))
        return replace(material, is_strong=True, unmatched=unmatched) if unmatched or not is_known else None

    def _rematched(self, search: Search) -> Search:
        """Matches the photograph again with the next reference, or with as many as there are threads if it is alone.

        If it matches none of the most promising references, which come first, it is matched with no others.
        """
        material = search.material
        assert material is not None
        assert material.query_matches is not None
        matcher, matches = self._verdicts.tier(search.attempt).pipeline.matcher, list(material.query_matches)
        count = matcher.threads if self._is_alone() else 1
        indices, others = material.unmatched[:count], material.unmatched[count:]
        with search.context.stage("rematch"):
            found = matcher.rematch_together(material.view, [material.references[i] for i in indices])
        for i, it in zip(indices, found, strict=True):
            matches[i] = it
        rematched = (*material.rematched, *indices)
        if not matcher.is_promising([matches[i] for i in rematched]):
            others = ()
        matched = replace(material, query_matches=tuple(matches), unmatched=others, rematched=rematched)
        return search.but(material=matched)

    def _matched(self, search: Search) -> SearchResult:
        """Matches the next reference, or goes on with the query if all are matched or no time is left for more."""
        material = search.material
        assert material is not None
        matched = search
        if material.unmatched:
            matched = cutting.without_unmatched(search, self._verdicts.tier(search.attempt).features)
        if self._has_time_to_rematch(search):
            # If the queue finds no time for that, the pose is computed from the matches there are.
            names = [f"{search.kind}, {it}" for it in ("rematch", "matched")]
            steps = zip(names, (search, matched), strict=True)
            return self._next(search, *(Step(PREPARE, name, name, it, search.kind) for name, it in steps))
        prepared = self._prepared(search, material)
        if search.query.photo.exif is not None and isinstance(prepared, Prepared):
            read = cameras.with_camera(search, prepared)
            if isinstance(read, Material):
                matched = matched.but(material=read)
                prepared = self._prepared(search, read)
            else:
                prepared = read
        if isinstance(prepared, Rejection):
            return self._conclude(matched, found_by(search.attempt, Answer(prepared), self._doubt))
        matched = matched.but(prepared=prepared)
        return self._next(matched, matched.step(COARSE, prepared.bucket))

    def _prepared(self, search: Search, material: Material) -> Prepared | Rejection:
        """The photograph with its references, matched; with the standard deviations of a camera that was chosen."""
        query, camera = search.query, material.camera
        options = query.options if camera is None else replace(query.options, intrinsics=camera.sigma)
        return self._method.prepare(
            material.view,
            material.references,
            self._verdicts.pipeline(search, self._verdicts.tier(search.attempt)),
            options,
            search.context,
            material.query_matches,
            query.priors,
            not search.attributes.arbitrary_unit,
        )

    def _has_time_to_rematch(self, search: Search) -> bool:
        """Whether another reference is left to be matched, and time for it before the pose must be computed."""
        material = search.material
        if material is None or not material.unmatched:
            return False
        until_s = min(search.give_up_s, search.lacking_until_s)
        until_s = search.start_s + REMATCH_SHARE * (until_s - search.start_s)
        return time.monotonic() + (self._verdicts.tier(search.attempt).pipeline.matcher.pair_s or 0.0) <= until_s

    def _tracked(self, search: Search) -> SearchResult:
        """Answers from the references near the pose prior if that leaves no doubt; else the search begins."""
        seconds, begin_s = search.context.stage_seconds, time.monotonic()
        tracked = track(search, self._verdicts)
        if tracked is not None:
            return self._conclude(*tracked)
        kept = {name: seconds[name] for name in ("describe", "decode") if name in seconds}  # the search does not repeat
        seconds.clear()
        seconds |= {TRACK: time.monotonic() - begin_s - sum(kept.values())} | kept
        return self._skipped(search, DOUBTFUL)

    def _reconstructed(self, search: Search, coarse: Coarse | Exception) -> SearchResult:
        if isinstance(coarse, Exception):
            raise coarse
        search = search.but(coarse=coarse, prepared=None)
        step = search.step(REFINE)
        is_coarse = search.query.options.variant is Variant.COARSE  # then the coarse pose is the answer
        if search.verdict is not None or is_coarse or not search.query.allow_coarse:
            return self._next(search, step)
        answer = self._method.coarse_answer(coarse)
        if answer is None or not answer.is_finite or search.material is None:
            return self._next(search, step)
        search.context.stage_seconds.update(answer.stage_seconds)
        found = self._verdicts.within_limits(search, found_by(search.attempt, answer, self._doubt))
        result = self._verdicts.result(search, found, search.material, found.answer.outcome)
        tried = search.ended("unfinished", self._verdicts.tier(search.attempt).features).attempts
        result = replace(result, attempts=tried)
        if search.on_better is not None and isinstance(result.answer.outcome, Localization):
            search.on_better(result)
        cut = LadderCut(search.rung, self._verdicts.tier(search.attempt).features, CutReason.NO_TIME)
        done = Done(replace(result, cuts=(cut,)), Ending.DEGRADED)
        return Next((step,), Fallback(lambda _: done, search.deadline_s - ANSWER_MARGIN_S), is_admitted=True)

    def _refine(self, search: Search) -> SearchResult:
        coarse, attempt = search.coarse, search.attempt
        assert coarse is not None
        found = self._method.solve(coarse, attempt, self._verdicts.doubt_in(search))
        is_first = attempt.matching.narrow is attempt.matching and attempt.solver is Solver.POINTS
        if search.query.is_part and is_first and found.answer.support is None:
            support = self._method.tracked_support(coarse.prepared)
            found = replace(found, answer=replace(found.answer, support=support))
        return self._conclude(search, found)

    def _conclude(self, search: Search, found: Found) -> SearchResult:
        """The next attempt that can remove a doubt, or the answer."""
        if not found.answer.is_finite:  # a pose of NaN must never leave the server
            raise ArithmeticError(f"the method's answer is not finite: {found.answer.outcome}, {found.answer.scale}")
        search.context.stage_seconds.update(found.answer.stage_seconds)
        found = self._verdicts.within_limits(search, found)
        if search.may_be_elsewhere and choosing.resembles_elsewhere(search, found, self._verdicts.tier(search.attempt)):
            found = replace(found, doubts=found.doubts | Doubt.LIKE_ELSEWHERE)
        search = choosing.compared(search) if found.doubts else search
        found = found if search.group is None else among.doubting(search, found)
        outcome, material = found.answer.outcome, search.material or search.materials[-1]
        ended = "localized" if isinstance(outcome, Localization) else outcome.reason.value
        before = search.verdict
        search = search.ended(ended, self._verdicts.tier(search.attempt).features, has_result=True).but(
            found=(*search.found, found),
            materials=(*search.materials, material),
        )
        verdict = decide(search.found, search.query.priors, search.attributes.unit)
        search = search.but(own=verdict, verdict=verdict)
        if search.group is not None:
            search = search.but(verdict=among.verdict_among(search))
        following = self._climb(search)
        assert search.verdict is not None
        is_better = before is None or search.verdict.outcome is not before.outcome
        is_sent = is_better and isinstance(search.verdict.outcome, Localization) and isinstance(following, Next)
        if is_sent and search.on_better is not None:
            search.on_better(self._verdicts.answer(search))
        return following

    def _climb(self, search: Search) -> SearchResult:
        verdict = search.verdict
        if verdict is None:  # near the prior there was none
            rank = search.group.next_scene(search.tried) if search.group is not None else None
            first = search.to(AS_IT_IS, Attempt(scene=rank or 0), search.give_up_s, self._tiers[0].features)
            return self._next(first, first.first_step)
        if not verdict.doubts:
            return self._done(search)
        search = search.knowing_pending()
        features = self._verdicts.tier(search.attempt).features
        before = search.before or search.attempt
        now_s = time.monotonic()
        give_up_s = min(now_s + TIME_SHARE * (search.deadline_s - now_s), search.ends_s)
        search = search.but(give_up_s=give_up_s)
        if search.group is None:
            situation = situation_of(search, self._tiers, self._doubt.promise)
            following = ladder.further(before, search.tried, verdict.doubts, situation)
        else:
            following = among.following(search, self._tiers, self._doubt.promise)
        search, rungs = cutting.offered(search, following, lambda it: self._verdicts.tier(it).features)
        steps = [chosen.to(rung.name, it, give_up_s, features).first_step for chosen, rung, it in rungs]
        return self._next(steps[0].payload, *steps) if steps else self._done(search)

    def _skipped(self, search: Search, outcome: str = SKIPPED) -> SearchResult:
        """Goes on after an attempt that has no result."""
        return self._climb(search.ended(outcome, self._verdicts.tier(search.attempt).features))

    def _next(self, search: Search, *steps: SearchStep) -> Next[Search, Result]:
        """Goes on to one of these steps; the best answer so far is given in time if none leads to a better one."""
        steps = tuple(replace(it, payload=it.payload.paused(search)) for it in steps)
        if search.verdict is None:
            return Next(steps)
        fallback = Fallback(self._unfinished, min(search.give_up_s, search.ends_s))
        return Next(steps, fallback, has_begun=search.stage_start_s is not None)

    def _done(self, search: Search) -> Done[Result]:
        answered = self._verdicts.answer(search)
        return Done(answered, _ending(answered))

    def _unfinished(self, search: Search, outcome: str = "unfinished", reason: CutReason | None = None) -> Done[Result]:
        reason = reason or search.reason_at(search.ends_s)
        answered = self._verdicts.without_present(search, outcome, reason)
        return Done(answered, _ending(answered))


def _ending(result: Result) -> Ending:
    return Ending.OK if isinstance(result.answer.outcome, Localization) else Ending.LOW_CONFIDENCE
