"""An engine of two tiers whose method gives planted answers."""

import asyncio
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np

from mapless.geometry import RigidTransform
from mapless_server.engine.options import EngineOptions
from mapless_server.engine.query import Caller, Description, Photo, Query, Result, Tier
from mapless_server.engine.search import SearchJob
from mapless_server.images import ImageLimits, decode_image
from mapless_server.method.bundle.estimate import PoseStage
from mapless_server.method.features.views import Features, PosedView, View
from mapless_server.method.judge.answer import Answer, Localization
from mapless_server.method.judge.judge import JudgeOptions
from mapless_server.method.options import DoubtOptions, LocalizeOptions
from mapless_server.method.pipeline import Pipeline
from mapless_server.method.promise import PromiseOptions
from mapless_server.method.rejection import Hint, Rejection, RejectionReason
from mapless_server.scenes import Narrowing, Sphere
from mapless_server.scheduling import Flow
from mapless_server.security import SceneKey
from mapless_server.serve.assembly import Parts, engine_over
from mapless_server.store import Store
from research.all_features import describe_all
from support.servers import CAMERA, PHOTO, StandInDescriptor, StandInExtractor, StandInReconstructor, pose, whole

SURE_INLIERS, DOUBTFUL_INLIERS = 500, 5
DOUBT = DoubtOptions(trust=0.1, radius_m=0.2, inliers=0, promise=PromiseOptions(least_gain_per_s=0.0))


SCENE = SceneKey("s")


DESCRIPTOR = StandInDescriptor()


PIXELS = decode_image(PHOTO, ImageLimits())


FEATURES = Features(np.zeros((1, 2), np.float32), np.full((1, 4), 0.5, np.float32), np.ones(1, np.float32))


def localized(inliers: int, at: RigidTransform | None = None) -> Answer:
    covariance, trust = np.diag([1e-4] * 3 + [1e-6] * 3), 0.5 if inliers == SURE_INLIERS else 0.01
    found = Localization(at or pose(0.0), covariance, PoseStage.REFINED, inliers, 2 * inliers, 0.7, trust=trust)
    return Answer(found, None, {"coarse": 0.25}, (1, 2), (3, 4))


def rejected(reason: RejectionReason = RejectionReason.TOO_FEW_MATCHES) -> Answer:
    return Answer(Rejection(reason, "planted"), None, {"correspond": 0.125})


Reply = Answer | Callable[[View, Sequence[PosedView], Callable[[], None]], Answer]


def caller(deadline_s: float = 60.0) -> Caller:
    return Caller(Flow("tenant", "client"), time.monotonic() + deadline_s)


@dataclass
class Setting:
    """An engine of named tiers whose method answers what is planted, and which tiers ran."""

    store: Store
    replies: dict[str, Reply] = field(default_factory=dict)
    asked: list[str] = field(default_factory=list)
    seen: list[tuple[View, Sequence[PosedView]]] = field(default_factory=list)
    judges: list[JudgeOptions] = field(default_factory=list)
    names: tuple[str, ...] = ("cheap", "strong")

    def __post_init__(self) -> None:
        self.extractors = {name: StandInExtractor(name) for name in self.names}
        pipelines = {name: Pipeline(cast(Any, StandInReconstructor())) for name in self.extractors}

        def method(
            query: View, references: Sequence[PosedView], pipeline: Pipeline, _: Any, check: Callable[[], None]
        ) -> Answer:
            (name,) = (name for name, it in pipelines.items() if it.reconstructor is pipeline.reconstructor)
            self.judges.append(pipeline.options.judge)
            self.asked.append(name)
            self.seen.append((query, references))
            reply = self.replies[name]
            return reply(query, references, check) if callable(reply) else reply

        self.tiers = [Tier(extractor, pipelines[name]) for name, extractor in self.extractors.items()]
        self.engine = engine_over(
            self.store, self.tiers, EngineOptions(doubt=DOUBT), Parts(method=whole(method), descriptor=DESCRIPTOR)
        )
        self.loop = asyncio.new_event_loop()

    def describe(self, photos: Sequence[Photo]) -> list[Description]:
        return self.loop.run_until_complete(self.engine.describe(photos, caller()))

    def describe_all(self, photos: Sequence[Photo]) -> list[Description]:
        return describe_all(self.engine, photos)

    def close(self) -> None:
        self.loop.run_until_complete(self.engine.close())
        self.loop.close()

    def localize(self, deadline_s: float = 60.0, **changes: Any) -> Result:
        named: dict[str, Any] = {"reference_ids": ("r0", "r1"), "narrowing": Narrowing(), "reference_count": 2}
        values = named | changes
        query = Query(SCENE, photo=Photo(PHOTO, CAMERA, "image"), options=LocalizeOptions(), **values)
        return self.run(query, caller(deadline_s))[0]

    def run(self, query: Query, caller: Caller) -> tuple[Result, SearchJob]:
        job = self.engine.query_job(query, caller)
        return self.loop.run_until_complete(self.engine.run(job)), job


def is_outcome(result: Result, planted: Answer) -> bool:
    """Whether an answer's outcome is given, to a rejection of which a hint is added."""
    given = result.answer.outcome
    if isinstance(given, Rejection):
        return replace(given, hint=None) == planted.outcome
    return given is planted.outcome


NEAR_ORIGIN = Narrowing(Sphere(pose(0.0).translation, 0.5))


def hint_of(result: Result) -> Hint:
    """The hint of a rejection."""
    assert isinstance(result.answer.outcome, Rejection)
    assert result.answer.outcome.hint is not None
    return result.answer.outcome.hint


def query_of(reference_ids: tuple[str, ...]) -> Query:
    photo = Photo(PHOTO, CAMERA, "image")
    return Query(SCENE, reference_ids, photo, Narrowing(), reference_count=2, options=LocalizeOptions())
