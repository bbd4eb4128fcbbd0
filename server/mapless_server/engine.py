"""What the service asks for, computed in the engine's threads: localizing a photograph, describing references.

A query is answered by the first tier of features, and by a stronger one where that answer is not good enough.
"""

from __future__ import annotations

import asyncio
import hashlib
import logging
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from mapless.geometry import Array, Camera

from .decode import ImageLimits, decode_image
from .errors import DeadlineExceeded, FailedPrecondition, NotFound, Unavailable
from .library import NotDescribedYet, ReferenceLibrary
from .method.features import FeatureExtractor
from .method.localize import Answer, Localization, LocalizeOptions, Pipeline, localize
from .method.rejection import Rejection, RejectionReason
from .method.retrieve import choose_references
from .method.views import Photograph, PosedView, View
from .store import Store
from .tiers import Attempt, EscalationOptions, Tier, better_of, is_doubtful
from .turns import Turn, Turns

log = logging.getLogger(__name__)

Localize = Callable[[View, Sequence[PosedView], Pipeline, LocalizeOptions, Callable[[], None]], Answer]

PRIOR_MARGIN_M = 10.0
"""References further from a prior's sphere than this are not considered: they see other things."""

MAX_LISTINGS = 3
"""When a reference goes while it is used, the scene is listed again; more often than this it is being emptied."""


@dataclass(frozen=True)
class EngineOptions:
    """Limits of the engine.

    Attributes:
        workers: threads that compute; one call occupies one.
        max_waiting: calls that may wait for a thread; one more is refused.
        max_candidates: references that are compared with a photograph when the request names none.
        image_limits: what is decoded.
        escalation: when stronger features are tried.
    """

    workers: int = 2
    max_waiting: int = 32
    max_candidates: int = 200
    image_limits: ImageLimits = field(default_factory=ImageLimits)
    escalation: EscalationOptions = field(default_factory=EscalationOptions)

    def __post_init__(self) -> None:
        if self.workers < 1 or self.max_waiting < 0 or self.max_candidates < 1:
            raise ValueError(f"senseless options: {self}")


@dataclass(frozen=True, eq=False)
class Photo:
    """An encoded image and its camera; `field` is its path in the request, for what is wrong with it."""

    image: bytes
    camera: Camera
    field: str


@dataclass(frozen=True, eq=False)
class PositionPrior:
    """The camera is within `radius_m` of `position` (3,), world, metres."""

    position: Array
    radius_m: float

    def distance_m(self, position: Array) -> float:
        """How far from the sphere's surface a position lies; negative inside."""
        return float(np.linalg.norm(position - self.position)) - self.radius_m


@dataclass(frozen=True, eq=False)
class Query:
    """A photograph to localize; no `reference_ids` means that `reference_count` are to be chosen."""

    scene_id: str
    reference_ids: tuple[str, ...]
    photo: Photo
    prior: PositionPrior | None
    reference_count: int
    options: LocalizeOptions


@dataclass(frozen=True, eq=False)
class Result:
    """The attempt that is answered, and where the time went.

    Attributes:
        attempt: of the tier whose answer is the better one.
        stage_seconds: of all that was computed, in order, whichever tier is answered. A stage of another tier than the
            first begins with its extractor's name and a slash. Such a tier has two more: "queue", its waiting for a
            thread, and, alone, "unfinished", if it failed, took too long, or has yet to describe the references.
        queue_s: from admission to the start of the computation.
    """

    attempt: Attempt
    stage_seconds: dict[str, float]
    queue_s: float


class Engine:
    """Owns the tiers and the threads."""

    def __init__(
        self, store: Store, tiers: Sequence[Tier], options: EngineOptions, localize: Localize = localize
    ) -> None:
        """The cheapest tier first; usually there is but one.

        Raises:
            ValueError: no tier, or two with the same extractor or matcher.
        """
        names = {tier.extractor.name for tier in tiers}
        matchers = {id(tier.pipeline.matcher) for tier in tiers}
        if not tiers or not len(names) == len(matchers) == len(tiers):
            raise ValueError("tiers must be one or more, each with an extractor and a matcher of its own")
        self.tiers = tuple(tiers)
        self.options = options
        self.turns = Turns(options.workers, options.max_waiting)
        self._store = store
        self._library = ReferenceLibrary(store)
        self._localize_views = localize

    async def localize(self, query: Query, deadline_s: float) -> Result:
        """Localizes a photograph.

        Args:
            query: the photograph and what to compare it with.
            deadline_s: when the answer is of no use any more, `time.monotonic`.

        Raises:
            RequestError: a bad image, unknown scene or reference, too many candidates, a full queue, a passed deadline.
        """
        views = _QueryViews(query.photo, self.options.image_limits)
        with self.turns.place():
            best = await self._attempt(query, self.tiers[0], views, deadline_s)
            stage_seconds, queue_s = best.stage_seconds, best.queue_s
            for tier in self.tiers[1:]:
                if not is_doubtful(best.answer, self.options.escalation):
                    break
                start_s = time.monotonic()
                stronger = await self._attempt_in_time(query, tier, views, deadline_s)
                if stronger is None:
                    stage_seconds[f"{tier.extractor.name}/unfinished"] = time.monotonic() - start_s
                    break
                seconds = {"queue": stronger.queue_s} | stronger.stage_seconds
                stage_seconds |= {f"{tier.extractor.name}/{stage}": value for stage, value in seconds.items()}
                best = better_of(best, stronger, self.options.escalation)
            return Result(best, stage_seconds, queue_s)

    async def describe(self, photos: Sequence[Photo], deadline_s: float) -> list[dict[str, View]]:
        """What the extractors of all tiers find in photographs, in order, by the extractor's name; without the pixels.

        A batch takes one place in the queue and no more threads than there are.

        Raises:
            RequestError: a bad image, a full queue, a passed deadline.
        """
        threads = asyncio.Semaphore(self.options.workers)

        async def describe_one(photo: Photo) -> dict[str, View]:
            async with threads:
                return await self.turns.run(lambda turn: self._describe(photo, turn), deadline_s)

        with self.turns.place():
            tasks = [asyncio.ensure_future(describe_one(photo)) for photo in photos]
            try:
                return list(await asyncio.gather(*tasks))
            finally:
                for task in tasks:
                    task.cancel()
                await asyncio.gather(*tasks, return_exceptions=True)

    def close(self) -> None:
        """Ends what is being computed at its next step, and drops what waits."""
        self.turns.close()
        self._library.close()
        for tier in self.tiers:
            tier.pipeline.matcher.close()
        shared = {id(tier.pipeline.reconstructor): tier.pipeline.reconstructor for tier in self.tiers}
        for reconstructor in shared.values():
            reconstructor.close()

    def _describe(self, photo: Photo, turn: Turn) -> dict[str, View]:
        views = _QueryViews(photo, self.options.image_limits)
        # A batch is held in memory until it is stored, so without its pixels.
        return {it.extractor.name: replace(views.view(it.extractor, turn), photograph=None) for it in self.tiers}

    async def _attempt_in_time(self, query: Query, tier: Tier, views: _QueryViews, deadline_s: float) -> Attempt | None:
        """A stronger tier's attempt; None if it fails or takes more than its share of the time left.

        It is made for a better answer than the one at hand, so it must never cost that one.
        """
        now_s = time.monotonic()
        share_s = self.options.escalation.time_share * (deadline_s - now_s)
        try:
            # A step may be long: it is not waited for, and its thread finds out at the next one.
            return await asyncio.wait_for(self._attempt(query, tier, views, now_s + share_s), share_s)
        except (asyncio.TimeoutError, DeadlineExceeded, NotDescribedYet):
            return None
        except Exception:
            log.warning("%s failed; the first answer is given", tier.extractor.name, exc_info=True)
            return None

    async def _attempt(self, query: Query, tier: Tier, views: _QueryViews, deadline_s: float) -> Attempt:
        """One tier's answer from the references named, or from those it chooses."""

        def work(turn: Turn) -> Attempt:
            queue_s = time.monotonic() - turn.submitted_s
            turn.check()
            attempt = self._compute(query, tier, views, turn)
            return replace(attempt, stage_seconds=turn.stage_seconds, queue_s=queue_s)

        return await self.turns.run(work, deadline_s)

    def _compute(self, query: Query, tier: Tier, views: _QueryViews, turn: Turn) -> Attempt:
        if query.reference_ids:
            return self._compute_among(query.reference_ids, query, tier, views, turn)
        for _ in range(MAX_LISTINGS):
            near = self._list_near(query)
            # One that was deleted since it was listed was not the caller's choice: the next list is without it.
            with suppress(NotFound):
                return self._compute_among(near, query, tier, views, turn)
        raise Unavailable("the scene's references are being deleted", reason="SCENE_CHANGED", retry_after_s=1.0)

    def _compute_among(
        self, reference_ids: Sequence[str], query: Query, tier: Tier, views: _QueryViews, turn: Turn
    ) -> Attempt:
        # References come first: a name that is wrong is found out before the photograph is described.
        # Only the first tier's references are waited for: there is an answer before the others'.
        generation, references = self._library.load(
            query.scene_id, reference_ids, tier.extractor, turn, waits=tier is self.tiers[0]
        )
        view = views.view(tier.extractor, turn)
        if not query.reference_ids and references:
            with turn.stage("retrieval"):
                ratio = tier.pipeline.matcher.options.query_ratio
                chosen = choose_references(view, references, query.reference_count, ratio=ratio)
            references = tuple(references[i] for i in chosen)
        turn.check()
        if references:
            answer = self._localize_views(view, references, tier.pipeline, query.options, turn.check)
        else:
            where = "the scene has no references" if query.prior is None else "no reference is near the position prior"
            answer = Answer(Rejection(RejectionReason.NO_USABLE_REFERENCES, where), None)
        turn.stage_seconds |= answer.stage_seconds
        return Attempt(tier, _gated(answer, query.prior), references, generation, view.camera)

    def _list_near(self, query: Query) -> list[str]:
        """Ids of the references that come into question."""
        _, poses = self._store.list_poses(query.scene_id)
        prior = query.prior
        near = [
            pose.reference_id
            for pose in poses
            if prior is None or prior.distance_m(pose.world_from_camera.translation) <= PRIOR_MARGIN_M
        ]
        if len(near) > self.options.max_candidates:
            raise FailedPrecondition(
                f"{len(near)} references come into question, at most {self.options.max_candidates} are compared: name "
                "the references to use, or give a position prior",
                reason="TOO_MANY_CANDIDATES",
            )
        return near


class _QueryViews:
    """A photograph as each extractor sees it: decoded once and described once by each, when first asked for."""

    def __init__(self, photo: Photo, limits: ImageLimits) -> None:
        self._photo = photo
        self._limits = limits
        self._photograph: Photograph | None = None
        self._views: dict[str, View] = {}

    def view(self, extractor: FeatureExtractor, turn: Turn) -> View:
        """The view with its photograph; the turn counts the time."""
        if extractor.name not in self._views:
            photograph = self._decoded(turn)
            with turn.stage("features"):
                view = extractor.extract(photograph.read(), photograph.camera)
            self._views[extractor.name] = replace(view, photograph=photograph)
        return self._views[extractor.name]

    def _decoded(self, turn: Turn) -> Photograph:
        if self._photograph is None:
            photo = self._photo
            with turn.stage("decode"):
                pixels = decode_image(photo.image, self._limits, photo.field)
                sha256 = hashlib.sha256(photo.image).hexdigest()
            self._photograph = Photograph(sha256, photo.camera, lambda: pixels)
        return self._photograph


def _gated(answer: Answer, prior: PositionPrior | None) -> Answer:
    """The answer, rejected if its pose contradicts the prior."""
    if prior is None or not isinstance(answer.outcome, Localization):
        return answer
    outside_m = prior.distance_m(answer.outcome.world_from_camera.translation)
    if outside_m <= 0:
        return answer
    message = f"the pose lies {outside_m:.2f} m outside the prior's radius of {prior.radius_m:g} m"
    return replace(answer, outcome=Rejection(RejectionReason.GATE, message))
