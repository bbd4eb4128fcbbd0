"""A real server on loopback, with a real store and a stand-in for the method."""

import asyncio
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import grpc
import numpy as np
import pytest
from numpy.typing import NDArray

from mapless import Client, MaplessError, NewReference, wire
from mapless.errors import from_rpc_error
from mapless.geometry import Camera, RigidTransform, Similarity, rotation_from_vector
from mapless.v1 import localization_service_pb2 as localization_pb
from mapless.v1.localization_service_pb2_grpc import LocalizationServiceStub
from mapless.v1.reference_service_pb2_grpc import ReferenceServiceStub
from mapless_server.engine.query import Tier
from mapless_server.engine.queue_engine import QueueEngine
from mapless_server.engine.stages import Method
from mapless_server.method.bundle.estimate import PoseStage
from mapless_server.method.features.views import Features, Ignored, PosedView, View
from mapless_server.method.judge.answer import Answer, Localization
from mapless_server.method.judge.hypothesis import Attempt, Found, Solver, found_by
from mapless_server.method.options import DoubtOptions, LocalizeOptions
from mapless_server.method.pipeline import Pipeline
from mapless_server.method.rejection import Rejection, RejectionReason
from mapless_server.method.structure.model import MetricScale, ScaleStage
from mapless_server.observability.metrics import Metrics
from mapless_server.scheduling import Abandoned
from mapless_server.security import RateLimiter
from mapless_server.serve.assembly import Parts, engine_options, engine_over
from mapless_server.serve.opening import MakeEngine, make_engine
from mapless_server.serve.running import Running, running_server
from mapless_server.settings import Settings
from mapless_server.store import Store
from support.images import encode, textured

CAMERA = Camera(96, 64, 80.0, 81.0, 47.5, 31.5)
PHOTO = encode(".png", textured())
BLACK = encode(".png", np.zeros((64, 96, 3), np.uint8))
COVARIANCE = np.diag([0.01, 0.01, 0.01, 1e-4, 1e-4, 1e-4])


def pose(x_m: float) -> RigidTransform:
    return RigidTransform(rotation_from_vector([0.1, x_m / 10, -0.2]), np.array([x_m, 2.0, -1.0]))


@dataclass
class StandInExtractor:
    """Finds one feature in each photograph: where the brightest pixel is; none in a black one."""

    name: str = "stand-in"
    seen: list[NDArray[np.uint8]] = field(default_factory=list)

    def extract(self, image: NDArray[np.uint8], camera: Camera, ignored: Ignored | None = None) -> View:
        self.seen.append(image)
        y, x = np.unravel_index(image.sum(axis=2).argmax(), image.shape[:2])
        count = int(image.any())
        descriptors = np.full((count, 4), 0.5, np.float32)
        features = Features(np.array([[x, y]], np.float32)[:count], descriptors, np.ones(count, np.float32))
        return View(camera.pinhole(), features)


@dataclass
class StandInDescriptor:
    """Sees four times four grey patches: the same photograph resembles itself, and few others do."""

    name: str = "patches"
    dimension: int = 16
    extractor: str | None = None

    def describe(self, view: View) -> NDArray[np.float32]:
        assert view.photograph is not None
        grey = view.photograph.read().mean(axis=2)
        rows, columns = (np.linspace(0, side, 5).astype(int)[:-1] for side in grey.shape)
        patches = np.add.reduceat(np.add.reduceat(grey, rows, axis=0), columns, axis=1).ravel()
        patches -= patches.mean()
        return np.asarray(patches / (np.linalg.norm(patches) + 1e-9), np.float32)


@dataclass(frozen=True)
class StandInReconstructor:
    name: str = "geometric"
    weights_sha256: str = ""
    uses_correspondences: bool = True
    is_batched: bool = False

    def close(self) -> None:
        pass

    def bucket(self, *_: Any) -> Any:
        return "stand-in"

    def reconstruct_many(self, *_: Any) -> Any:
        raise NotImplementedError


@dataclass
class StandInMethod:
    """Answers the first reference's pose.

    Attributes:
        inlier_count: that it claims.
        trust: likewise.
        gate: calls wait here; open unless a test closes it.
        started: released by every call that begins.
        failure: raised instead of an answer.
        options: those of each call.
    """

    inlier_count: int = 90
    trust: float | None = None
    gate: threading.Event = field(default_factory=threading.Event)
    started: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(0))
    failure: Exception | None = None
    call_count: int = 0
    options: list[LocalizeOptions] = field(default_factory=list)

    def __call__(
        self,
        query: View,
        references: Sequence[PosedView],
        pipeline: Pipeline,
        options: LocalizeOptions,
        check: Callable[[], None],
    ) -> Answer:
        self.call_count += 1
        self.options.append(options)
        self.started.release()
        assert self.gate.wait(60)
        if self.failure is not None:
            raise self.failure
        found = Localization(
            references[0].world_from_camera,
            COVARIANCE,
            PoseStage.REFINED,
            self.inlier_count,
            120,
            0.7,
            trust=self.trust,
        )
        counts = tuple(range(len(references)))
        return Answer(
            found,
            MetricScale(2.0, ScaleStage.TRIANGULATION, 0.01, 0, Similarity(2.0, np.eye(3), np.zeros(3)), pose(0.0)),
            {"coarse": 0.1, "pnp": 0.05},
            counts,
            counts,
        )

    @contextmanager
    def held(self) -> Iterator[None]:
        """Calls that begin meanwhile do not end."""
        self.gate.clear()
        try:
            yield
        finally:
            self.gate.set()


def whole(localize: Callable[..., Answer]) -> Method:
    """A method whose work is all done in the last part, by `localize(query, references, pipeline, options, check)`."""

    def prepare(*arguments: Any) -> Any:
        *asked, context, _, _, _ = arguments  # query matches, priors and unit do not matter
        without_depth = SimpleNamespace(has_depth=False)
        return SimpleNamespace(asked=asked, context=context, bucket="stand-in", prepared=without_depth)

    def solve(coarse: Any, attempt: Attempt, doubt: DoubtOptions) -> Found:
        """Wide matches and lines change nothing, so they find nothing else."""
        if attempt.but(matching=attempt.matching.narrow, solver=Solver.POINTS) != attempt:
            return found_by(attempt, Answer(Rejection(RejectionReason.LOW_OVERLAP, "planted")), doubt)
        return found_by(attempt, localize(*coarse.asked, coarse.context.check), replace(doubt, inliers=0))

    def nothing(*_: Any) -> None:
        """Neither a coarse answer nor what a photograph without a pose could give."""

    return Method(prepare, cast(Any, list), solve, nothing, nothing)


COARSE_X_M = 7.0
"""Where the stand-in's coarse pose is; the refined one is the first reference's, at 0 m."""


@dataclass
class Staged:
    """A method with a coarse pose at once, which refines when it is let.

    Attributes:
        gate: refining ends when it is open.
        refining: released by each that begins.
        given_up: released by each that is ended because its caller has left.
        coarse: the coarse pose; None if there is none.
        outcome: refined; None for the first reference's pose.
        outcomes: of the next refinements, before all have that one.
        trust: of that pose.
    """

    gate: threading.Event = field(default_factory=threading.Event)
    refining: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(0))
    given_up: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(0))
    coarse: RigidTransform | None = field(default_factory=lambda: pose(COARSE_X_M))
    outcome: Rejection | None = None
    outcomes: list[Rejection | None] = field(default_factory=list)
    trust: float = 0.9

    def __post_init__(self) -> None:
        self._stand_in = StandInMethod(trust=self.trust)
        self._stand_in.gate.set()

    def reset(self) -> None:
        """As it was at first."""
        self.gate.clear()
        for counted in (self.refining, self.given_up):
            while counted.acquire(blocking=False):
                pass
        self.coarse, self.outcome, self.trust = pose(COARSE_X_M), None, 0.9

    def method(self) -> Method:
        return replace(whole(self._refine), coarse_answer=self._coarse_answer)

    def _refine(self, *asked: Any) -> Answer:
        self.refining.release()
        try:
            while not self.gate.wait(0.005):
                asked[-1]()
        except Abandoned:
            self.given_up.release()
            raise
        self._stand_in.trust = self.trust
        answer = self._stand_in(*asked)
        outcome = self.outcomes.pop(0) if self.outcomes else self.outcome
        return answer if outcome is None else replace(answer, outcome=outcome)

    def _coarse_answer(self, coarse: Any) -> Answer | None:
        if self.coarse is None:
            return None
        query, references, pipeline, options = coarse.asked
        answer = self._stand_in(query, references, pipeline, options, coarse.context.check)
        found = Localization(self.coarse, None, PoseStage.COARSE, 0, 0, 0.0)
        return replace(answer, outcome=found, stage_seconds={"coarse": 0.1})


@dataclass
class RunningServer:
    """A server in a thread of its own."""

    address: str
    metrics_address: str
    method: StandInMethod
    extractors: Sequence[StandInExtractor]
    engine: QueueEngine
    metrics: Metrics
    stop: Callable[[], None]

    def value(self, name: str, **labels: str) -> float:
        """The value of a metric, summed over the labels that are not given."""
        samples = (sample for family in self.metrics.registry.collect() for sample in family.samples)
        return sum(it.value for it in samples if it.name == name and labels.items() <= it.labels.items())


@contextmanager
def listening(settings: Settings, store: Store, make: MakeEngine) -> Iterator[tuple[Running, Callable[[], None]]]:
    """A server in a thread until the block is left, and what makes it drain before that."""
    started: Future[Running] = Future()
    loop = asyncio.new_event_loop()
    stopping = asyncio.Event()

    async def run() -> None:
        async with running_server(settings, make, store) as running:
            started.set_result(running)
            await stopping.wait()

    def run_loop() -> None:
        try:
            loop.run_until_complete(run())
        except BaseException as error:
            if started.done():
                raise
            started.set_exception(error)

    thread = threading.Thread(target=run_loop)
    thread.start()

    def stop() -> None:
        loop.call_soon_threadsafe(stopping.set)

    try:
        yield started.result(60), stop
    finally:
        stop()
        thread.join(30)
        assert not thread.is_alive()
        loop.close()


@contextmanager
def serving(
    data_dir: Path,
    features: Sequence[str] = ("stand-in",),
    descriptor_name: str = "patches",
    store: Store | None = None,
    method: Method | None = None,
    tier: Tier | None = None,
    **options: Any,
) -> Iterator[RunningServer]:
    """A server with the given settings until the block is left, or `stop` is called, which begins to drain it.

    It has a tier of stand-ins for each of the `features`, or the given `tier`, and computes by a StandInMethod, or the
    given `method`. It closes its store, which lies in the folder unless one is given. Its queue is so long that a slow
    machine rejects no call, which other tests are about; so is matching in the background.
    """
    defaults = {"port": 0, "workers": 2, "metrics": False, "warm_up": False, "max_queued_s": 60.0}
    defaults["background_matching"] = False
    settings = Settings(host="127.0.0.1", data_dir=data_dir, **(defaults | options))
    store = store or Store.open(data_dir)
    stand_in, extractors, known = StandInMethod(), [StandInExtractor(name) for name in features], list[Metrics]()
    stand_in.gate.set()

    def make(settings: Settings, store: Store, metrics: Metrics, quota: RateLimiter | None) -> QueueEngine:
        known.append(metrics)
        options, parts = engine_options(settings), Parts(metrics, quota, method or whole(stand_in))
        if tier is not None:
            return engine_over(store, [tier], options, parts)
        tiers = [Tier(extractor, Pipeline(cast(Any, StandInReconstructor()))) for extractor in extractors]
        return engine_over(store, tiers, options, replace(parts, descriptor=StandInDescriptor(descriptor_name)))

    with listening(settings, store, make) as (running, stop):
        try:
            yield RunningServer(
                running.address, running.metrics_address, stand_in, extractors, running.engine, known[0], stop
            )
        finally:
            stand_in.gate.set()


@contextmanager
def serving_really(
    data_dir: Path, store: Store | None = None, make: MakeEngine = make_engine, **options: Any
) -> Iterator[RunningServer]:
    """A server with the real features and the real method, or an engine of the test's own, until the block is left."""
    defaults = {"port": 0, "workers": 2, "metrics": False, "warm_up": False}
    settings, known = Settings(host="127.0.0.1", data_dir=data_dir, **(defaults | options)), list[Metrics]()

    def noted(settings: Settings, store: Store, metrics: Metrics, quota: RateLimiter | None) -> QueueEngine:
        known.append(metrics)
        return make(settings, store, metrics, quota)

    with listening(settings, store or Store.open(data_dir), noted) as (running, stop):
        yield RunningServer(running.address, "", StandInMethod(), (), running.engine, known[0], stop)


def make_scene(client: Client, scene_id: str = "s", count: int = 1) -> str:
    """A scene of references r0, r1, and so on, a metre apart; its id."""
    client.create_scene(scene_id)
    client.add_references(scene_id, [NewReference(f"r{i}", PHOTO, CAMERA, pose(i)) for i in range(count)])
    return scene_id


@dataclass
class Stubs:
    """The generated stubs, for requests that the client would not make."""

    localization: LocalizationServiceStub
    references: ReferenceServiceStub


def failure_of(method: Callable[..., Any], request: Any, **arguments: Any) -> MaplessError:
    """The error that a call ends with."""
    with pytest.raises(grpc.RpcError) as caught:
        method(request, timeout=30, **arguments)
    return from_rpc_error(caught.value)


def ending(call: Any) -> MaplessError:
    """The error that a stream ends with."""
    with pytest.raises(grpc.RpcError) as caught:
        list(call)
    return from_rpc_error(caught.value)


def localize_request(scene_id: str) -> localization_pb.LocalizeRequest:
    """A good request."""
    return localization_pb.LocalizeRequest(
        scene=f"scenes/{scene_id}", image=PHOTO, intrinsics=wire.camera_to_message(CAMERA)
    )
