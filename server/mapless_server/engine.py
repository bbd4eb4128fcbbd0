"""Where computing happens: a bounded queue before a pool of threads, so that the event loop never computes.

A call that finds the queue full is refused at once, with an estimate of when to come back. A call whose deadline has
passed or whose caller has gone is not computed when its turn comes, and stops between steps when it already is.
"""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np

from mapless.geometry import Array, Camera

from .decode import ImageLimits, decode_image
from .errors import DeadlineExceeded, FailedPrecondition, NotFound, Overloaded, Unavailable
from .features import FeatureExtractor
from .localize import Answer, Localization, LocalizeOptions, Pipeline, localize
from .rejection import Rejection, RejectionReason
from .retrieve import choose_references
from .store import SceneSnapshot, Store
from .views import PosedView, View

T = TypeVar("T")
Localize = Callable[[View, Sequence[PosedView], Pipeline, LocalizeOptions, Callable[[], None]], Answer]

PRIOR_MARGIN_M = 10.0
"""References further from a prior's sphere than this are not considered: they see other things."""

MAX_LISTINGS = 3
"""When a reference goes between list and read, the scene is listed again; more often than this it is being emptied."""


@dataclass(frozen=True)
class EngineOptions:
    """Limits of the engine.

    Attributes:
        workers: threads that compute; one call occupies one.
        max_waiting: calls that may wait for a thread; one more is refused.
        max_candidates: references that are compared with a photograph when the request names none.
        image_limits: what is decoded.
    """

    workers: int = 2
    max_waiting: int = 32
    max_candidates: int = 200
    image_limits: ImageLimits = field(default_factory=ImageLimits)

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
    """An answer and what it was computed from.

    Attributes:
        processed: the camera of the reduced image that features were found in.
        stage_seconds: decoding, features and retrieval before the answer's own.
        queue_s: from admission to the start of the computation.
    """

    answer: Answer
    references: tuple[PosedView, ...]
    generation: int
    processed: Camera
    stage_seconds: dict[str, float]
    queue_s: float


class _Turn:
    """One piece of work: asked between its steps whether anybody still wants the result."""

    def __init__(self, deadline_s: float) -> None:
        self.submitted_s = time.monotonic()
        self.abandoned = threading.Event()
        self.stage_seconds: dict[str, float] = {}
        self._deadline_s = deadline_s

    def check(self) -> None:
        """Raises when the result is of no use any more."""
        if self.abandoned.is_set() or time.monotonic() > self._deadline_s:
            raise DeadlineExceeded("the deadline passed while the call waited or was computed")

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Checks, then times one step."""
        self.check()
        start_s = time.perf_counter()
        yield
        self.stage_seconds[name] = time.perf_counter() - start_s


class Engine:
    """Owns the feature extractor, the pipeline and the threads."""

    def __init__(
        self,
        store: Store,
        extractor: FeatureExtractor,
        pipeline: Pipeline,
        options: EngineOptions,
        localize: Localize = localize,
    ) -> None:
        self.extractor = extractor
        self.pipeline = pipeline
        self.options = options
        self._store = store
        self._localize_views = localize
        self._pool = ThreadPoolExecutor(options.workers, thread_name_prefix="engine")
        self._turns: set[_Turn] = set()
        self._admitted_count = 0
        self._typical_call_s = 1.0

    async def localize(self, query: Query, deadline_s: float) -> Result:
        """Localizes a photograph.

        Args:
            query: the photograph and what to compare it with.
            deadline_s: when the answer is of no use any more, `time.monotonic`.

        Raises:
            RequestError: a bad image, unknown scene or reference, too many candidates, a full queue, a passed deadline.
        """
        with self._place():
            return await self._run(lambda turn: self._compute(query, turn), deadline_s)

    async def describe(self, photos: Sequence[Photo], deadline_s: float) -> list[View]:
        """Views of photographs, in order. A batch takes one place in the queue and no more threads than there are.

        Raises:
            RequestError: a bad image, a full queue, a passed deadline.
        """
        threads = asyncio.Semaphore(self.options.workers)

        async def describe_one(photo: Photo) -> View:
            async with threads:
                return await self._run(lambda turn: self._extract(photo, turn), deadline_s)

        with self._place():
            tasks = [asyncio.ensure_future(describe_one(photo)) for photo in photos]
            try:
                return list(await asyncio.gather(*tasks))
            finally:
                for task in tasks:
                    task.cancel()
                await asyncio.gather(*tasks, return_exceptions=True)

    def close(self) -> None:
        """Ends what is being computed at its next step, and drops what waits."""
        for turn in list(self._turns):
            turn.abandoned.set()
        self._pool.shutdown(wait=True, cancel_futures=True)
        self.pipeline.matcher.close()

    @contextmanager
    def _place(self) -> Iterator[None]:
        """A place in the queue until the answer is there; runs on the event loop, so the counter needs no lock."""
        workers = self.options.workers
        if self._admitted_count >= workers + self.options.max_waiting:
            retry_after_s = max(0.1, self._typical_call_s * self._admitted_count / workers)
            raise Overloaded(f"{self._admitted_count} calls are in progress or wait", retry_after_s=retry_after_s)
        self._admitted_count += 1
        start_s = time.monotonic()
        try:
            yield
        finally:
            waiting_ahead = max(1.0, self._admitted_count / workers)
            self._typical_call_s += 0.1 * ((time.monotonic() - start_s) / waiting_ahead - self._typical_call_s)
            self._admitted_count -= 1

    async def _run(self, work: Callable[[_Turn], T], deadline_s: float) -> T:
        turn = _Turn(deadline_s)
        self._turns.add(turn)
        try:
            # Cancelling the wrapper takes work that has not begun out of the pool's queue.
            return await asyncio.wrap_future(self._pool.submit(work, turn))
        finally:
            turn.abandoned.set()
            self._turns.discard(turn)

    def _extract(self, photo: Photo, turn: _Turn) -> View:
        with turn.stage("decode"):
            pixels = decode_image(photo.image, self.options.image_limits, photo.field)
        with turn.stage("features"):
            return self.extractor.extract(pixels, photo.camera)

    def _compute(self, query: Query, turn: _Turn) -> Result:
        queue_s = time.monotonic() - turn.submitted_s
        turn.check()
        snapshot = self._load(query)
        view = self._extract(query.photo, turn)
        references = snapshot.references
        if not query.reference_ids and references:
            with turn.stage("retrieval"):
                chosen = choose_references(view, references, query.reference_count)
            references = tuple(references[i] for i in chosen)
        turn.check()
        if references:
            answer = self._localize_views(view, references, self.pipeline, query.options, turn.check)
        else:
            where = "the scene has no references" if query.prior is None else "no reference is near the position prior"
            answer = Answer(Rejection(RejectionReason.NO_USABLE_REFERENCES, where), None)
        stage_seconds = turn.stage_seconds | answer.stage_seconds
        return Result(_gated(answer, query.prior), references, snapshot.generation, view.camera, stage_seconds, queue_s)

    def _load(self, query: Query) -> SceneSnapshot:
        """The references named, or all that come into question."""
        if query.reference_ids:
            return self._store.load_references(query.scene_id, query.reference_ids, self.extractor.name)
        for _ in range(MAX_LISTINGS):
            near = self._list_near(query)
            # One that was deleted since it was listed was not the caller's choice: the next list is without it.
            with suppress(NotFound):
                return self._store.load_references(query.scene_id, near, self.extractor.name)
        raise Unavailable("the scene's references are being deleted", reason="SCENE_CHANGED", retry_after_s=1.0)

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


def _gated(answer: Answer, prior: PositionPrior | None) -> Answer:
    """The answer, rejected if its pose contradicts the prior."""
    if prior is None or not isinstance(answer.outcome, Localization):
        return answer
    outside_m = prior.distance_m(answer.outcome.world_from_camera.translation)
    if outside_m <= 0:
        return answer
    message = f"the pose lies {outside_m:.2f} m outside the prior's radius of {prior.radius_m:g} m"
    return replace(answer, outcome=Rejection(RejectionReason.GATE, message))
