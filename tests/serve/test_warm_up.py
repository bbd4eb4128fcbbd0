"""The warm-up localizes a rendered photograph of known pose; a failure ends the start with one sentence."""

import asyncio
import signal
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, asynccontextmanager, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, cast

import grpc
import numpy as np
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc
from numpy.typing import NDArray
from support.commands import run_client
from support.programs import gated
from support.servers import (
    COVARIANCE,
    StandInExtractor,
    StandInReconstructor,
    Stubs,
    failure_of,
    listening,
    localize_request,
    whole,
)
from support.waiting import wait_until

from bench.load.driving import free_port
from mapless.geometry import RigidTransform
from mapless.v1 import reference_service_pb2 as reference_pb
from mapless.v1.localization_service_pb2_grpc import LocalizationServiceStub
from mapless.v1.reference_service_pb2_grpc import ReferenceServiceStub
from mapless_server.engine.options import EngineOptions
from mapless_server.engine.query import Caller, Result, Tier
from mapless_server.engine.queue_engine import QueueEngine
from mapless_server.engine.search import SearchJob
from mapless_server.engine.stages import Method
from mapless_server.method.bundle.estimate import PoseStage
from mapless_server.method.judge.answer import Answer, Localization
from mapless_server.method.pipeline import Pipeline
from mapless_server.method.rejection import Rejection, RejectionReason
from mapless_server.observability.metrics import Metrics
from mapless_server.scheduling import CostModel, Flow
from mapless_server.security import RateLimiter
from mapless_server.serve.assembly import Parts, engine_options, engine_over
from mapless_server.serve.features import make_tiers
from mapless_server.serve.opening import MakeEngine
from mapless_server.serve.startup import StartupError
from mapless_server.serve.warm_up import ROUNDS, warm_up, warm_up_stronger
from mapless_server.settings import Settings
from mapless_server.store import Store

LIMIT_S = 60.0
TRUTH = np.array([0.25, 0.025, 0.0])
"""Camera centre of the rendered photograph, see `warm_up`."""


@asynccontextmanager
async def warm(folder: Path, tiers: Sequence[Tier], method: Method | None = None) -> AsyncIterator[QueueEngine]:
    """An engine that is about to be warmed up; it is when the block is left."""
    with Store.open(folder) as store:
        engine = engine_over(store, tiers, EngineOptions(), Parts(method=method))
        try:
            yield engine
            await warm_up(engine)
            await warm_up_stronger(engine, quiet_s=0.0)
        finally:
            await engine.close()


async def test_the_real_method_localizes_the_rendered_scene(tmp_path: Path) -> None:
    results: list[Result] = []
    async with warm(tmp_path, make_tiers(Settings(data_dir=tmp_path))) as engine:
        run = engine.run

        async def watched(job: SearchJob) -> Result:
            results.append(await run(job))
            return results[-1]

        engine.run = watched  # type: ignore[method-assign]
    assert len(results) == ROUNDS
    for result in results:
        found = result.answer.outcome
        assert isinstance(found, Localization)
        assert np.linalg.norm(found.world_from_camera.translation - TRUTH) < 0.03
        assert found.inlier_count >= 50  # else stronger features would be tried, and be cold in the first call
        assert found.covariance is not None


async def test_every_tier_describes_the_references(tmp_path: Path) -> None:
    """So that its network is loaded; the second one a pair, the first one also the query."""
    extractors = [StandInExtractor(f"stand-in {i}") for i in range(2)]
    tiers = [Tier(it, Pipeline(cast(Any, StandInReconstructor()))) for it in extractors]
    async with warm(tmp_path, tiers, whole(lambda *_: answer_at(TRUTH))):
        pass
    assert [len(extractor.seen) for extractor in extractors] == [3 + ROUNDS, 2]


async def test_stronger_features_wait_for_an_idle_queue(tmp_path: Path) -> None:
    stronger, ends = StandInExtractor("stronger"), threading.Event()
    tiers = [Tier(it, Pipeline(cast(Any, StandInReconstructor()))) for it in (StandInExtractor(), stronger)]
    with Store.open(tmp_path) as store:
        engine = engine_over(store, tiers, EngineOptions(), Parts(method=whole(lambda *_: answer_at(TRUTH))))
        try:
            await warm_up(engine)
            caller = Caller(Flow("", "robot"), time.monotonic() + LIMIT_S)
            computing = asyncio.ensure_future(engine.join(partial(ends.wait, LIMIT_S), caller))
            loading = asyncio.ensure_future(warm_up_stronger(engine, quiet_s=0.1))
            await asyncio.sleep(0.3)
            assert not stronger.seen
            ends.set()
            assert await computing
            await loading
            assert stronger.seen
        finally:
            await engine.close()


def answer_at(centre: NDArray[np.float64]) -> Answer:
    return Answer(Localization(RigidTransform(np.eye(3), centre), COVARIANCE, PoseStage.REFINED, 90, 120, 0.7))


def engine_of(
    localize: Callable[..., Answer],
    begin: Callable[[], object] = lambda: None,
    stronger: StandInExtractor | None = None,
) -> MakeEngine:
    def make(settings: Settings, store: Store, metrics: Metrics, quota: RateLimiter | None) -> QueueEngine:
        begin()
        extractors = [StandInExtractor(), *([] if stronger is None else [stronger])]
        tiers = [Tier(it, Pipeline(cast(Any, StandInReconstructor()))) for it in extractors]
        return engine_over(store, tiers, engine_options(settings), Parts(metrics, quota, whole(localize)))

    return make


NEW = Flow("", "new")


async def test_the_queue_expects_the_duration_of_the_last_round(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first one compiles kernels and reads pages."""
    seen: list[tuple[str, str, float]] = []
    observe = CostModel.observe

    def watched(costs: CostModel, stage: str, kind: str, flow: Flow, seconds: float, now_s: float) -> None:
        seen.append((stage, kind, seconds))
        observe(costs, stage, kind, flow, seconds, now_s)

    monkeypatch.setattr(CostModel, "observe", watched)

    def localize(*_: Any) -> Answer:
        time.sleep(0.0 if any(stage == "refine" for stage, _, _ in seen) else 0.3)
        return answer_at(TRUTH)

    tiers = [Tier(StandInExtractor(), Pipeline(cast(Any, StandInReconstructor())))]
    async with warm(tmp_path, tiers, whole(localize)) as engine:
        pass
    assert [stage for stage, _, _ in seen] == ["prepare", "coarse", "refine"] * ROUNDS
    for stage, kind, seconds in seen[-3:]:
        assert engine.queue._scheduler.costs.predict(stage, kind, NEW, 0.0) == pytest.approx(seconds)


def test_the_warm_up_is_charged_to_no_tenant(tmp_path: Path) -> None:
    """However little computing a tenant may use, and however long the first photograph takes."""

    def localize(*_: Any) -> Answer:
        time.sleep(0.5)
        return answer_at(TRUTH)

    settings = Settings(
        host="127.0.0.1", port=0, data_dir=tmp_path, metrics=False, tenant_rate_ms=50, tenant_burst_ms=200
    )
    with (
        listening(settings, Store.open(tmp_path), engine_of(localize)) as (running, _),
        grpc.insecure_channel(running.address) as channel,
    ):
        status = health_pb2_grpc.HealthStub(channel).Check(health_pb2.HealthCheckRequest(), timeout=10).status
        assert status == health_pb2.HealthCheckResponse.SERVING


def raising(error: Exception) -> Callable[..., Answer]:
    def localize(*_: Any) -> Answer:
        raise error

    return localize


BROKEN = {
    "raises": (raising(RuntimeError("no kernel image")), "no kernel image"),
    "lost": (raising(RuntimeError("CUDA error: an illegal memory access was encountered")), "about to end"),
    "memory": (raising(MemoryError()), "too little memory"),
    "rejects": (lambda *_: Answer(Rejection(RejectionReason.GATE, "a gate")), "a gate"),
    "off": (lambda *_: answer_at(TRUTH + np.array([0.0, 0.0, 0.2])), "0.20 m off"),
    "nan": (lambda *_: answer_at(TRUTH * np.nan), "not finite"),
}


@pytest.mark.parametrize("way", BROKEN)
def test_a_broken_method_ends_the_start(tmp_path: Path, way: str) -> None:
    localize, message = BROKEN[way]
    settings = Settings(host="127.0.0.1", port=0, data_dir=tmp_path, metrics=False)
    with (
        pytest.raises(StartupError, match="the first localization failed") as caught,
        listening(settings, Store.open(tmp_path), engine_of(localize)),
    ):
        raise AssertionError("it began to serve")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_stronger_features_that_fail_are_logged_while_serving(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    stronger = StandInExtractor("stronger")
    monkeypatch.setattr(stronger, "extract", raising(RuntimeError("no kernel image")))
    monkeypatch.setattr("mapless_server.serve.running.QUIET_S", 0.0)
    settings = Settings(host="127.0.0.1", port=0, data_dir=tmp_path, metrics=False)
    make = engine_of(lambda *_: answer_at(TRUTH), stronger=stronger)
    with listening(settings, Store.open(tmp_path), make) as (running, _):
        wait_until(lambda: "no kernel image" in caplog.text)
        assert not running.failed.done()


@contextmanager
def starting(folder: Path, make: MakeEngine) -> Iterator[tuple[str, Callable[[], None]]]:
    """The address of a server that starts, and a function that waits until it serves."""
    port = free_port()
    settings = Settings(host="127.0.0.1", port=port, data_dir=folder, metrics=False)
    with ThreadPoolExecutor(1) as thread, ExitStack() as stack:
        entering = thread.submit(stack.enter_context, listening(settings, Store.open(folder), make))
        yield f"127.0.0.1:{port}", lambda: (entering.result(LIMIT_S), None)[1]


STEPS = {
    "the engine is made": "it loads its features and their weights",
    "the first photograph is localized": "it localizes its first photograph",
}


@pytest.mark.parametrize("phase", STEPS)
def test_a_starting_server_answers_what_needs_the_store_alone(
    tmp_path: Path, phase: str, capsys: pytest.CaptureFixture[str]
) -> None:
    began, gate = threading.Event(), threading.Event()

    def hold() -> None:
        began.set()
        assert gate.wait(LIMIT_S)

    def localize(*_: Any) -> Answer:
        if phase != "the engine is made":
            hold()
        return answer_at(TRUTH)

    make = engine_of(localize, hold if phase == "the engine is made" else lambda: None)
    with starting(tmp_path, make) as (address, until_started), grpc.insecure_channel(address) as channel:
        try:
            assert began.wait(LIMIT_S)
            health = health_pb2_grpc.HealthStub(channel)
            stubs = Stubs(LocalizationServiceStub(channel), ReferenceServiceStub(channel))
            for service in ("", "mapless.v1.LocalizationService", "mapless.v1.ReferenceService"):
                asked = health.Check(health_pb2.HealthCheckRequest(service=service), timeout=10, wait_for_ready=True)
                assert asked.status == health_pb2.HealthCheckResponse.NOT_SERVING
            error = failure_of(stubs.localization.Localize, localize_request("s"))
            assert (error.code, error.reason) == ("UNAVAILABLE", "STARTING")
            assert (error.message, error.retry_after_s) == (f"the server is starting: {STEPS[phase]}", 1.0)
            stubs.references.CreateScene(reference_pb.CreateSceneRequest(scene_id="early"), timeout=10)
            (scene,) = stubs.references.ListScenes(reference_pb.ListScenesRequest(), timeout=10).scenes
            request = reference_pb.ListReferencesRequest(scene=scene.name)
            assert not stubs.references.ListReferences(request, timeout=10).references
            needs_more = failure_of(stubs.references.GetScene, reference_pb.GetSceneRequest(name=scene.name))
            assert needs_more.reason == error.reason
            _, printed, _ = run_client(capsys, "doctor", "--address", address)
            assert error.message in printed
        finally:
            gate.set()
        until_started()
        status = health.Check(health_pb2.HealthCheckRequest(), timeout=10).status
        assert status == health_pb2.HealthCheckResponse.SERVING
        stubs.references.CreateScene(reference_pb.CreateSceneRequest(scene_id="s"), timeout=10)
        assert failure_of(stubs.localization.Localize, localize_request("absent")).code == "NOT_FOUND"


def test_sigterm_during_the_start_ends_it(tmp_path: Path) -> None:
    with gated(tmp_path / "server", warm_up=True) as server:
        wait_until(lambda: server.began)
        sent_s = time.monotonic()
        server.process.send_signal(signal.SIGTERM)
        assert server.wait() == 0
        assert time.monotonic() - sent_s < 5, "it waited for the thread that computes"
        assert "stopping before the start was over" in server.log
        assert not server.output
