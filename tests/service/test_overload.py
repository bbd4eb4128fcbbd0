"""More calls than the server can compute: some are refused at once with a time to retry after, the others are answered.

The caller and the server count each of them once.
"""

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, suppress
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
from support.servers import (
    CAMERA,
    COARSE_X_M,
    PHOTO,
    RunningServer,
    Staged,
    StandInMethod,
    localize_request,
    make_scene,
    pose,
    serving,
    whole,
)
from support.waiting import wait_until, with_enough_time

from mapless import Client, ConnectOptions, DeadlineExceeded, LocalizationResult, Rejected, ResourceExhausted
from mapless.errors import from_rpc_error
from mapless.v1.localization_service_pb2_grpc import LocalizationServiceStub
from mapless_server.engine.stages import Method
from mapless_server.method.judge.answer import Answer

COST_S = 0.04
WORKERS = 2


def overloaded(data_dir: Path, method: Method, **options: Any) -> AbstractContextManager[RunningServer]:
    """A server with this method."""
    return serving(data_dir, method=method, **({"workers": WORKERS, "max_queued_s": 2.0} | options))


def slow(seconds: float) -> Method:
    """Takes so long for every query, whatever else goes on."""
    stand_in = StandInMethod()
    stand_in.gate.set()

    def localize(*asked: Any) -> Answer:
        time.sleep(seconds)
        return stand_in(*asked)

    return whole(localize)


def learn(client: Client, calls: int = 10) -> None:
    """A scene "s", and calls by which the queue learns what to expect."""
    make_scene(client)
    for _ in range(calls):
        client.localize(PHOTO, CAMERA, "s")


def test_triple_load_is_answered_or_refused_and_counted(tmp_path: Path) -> None:
    sent, rate = 300, 3 * WORKERS / COST_S
    request = localize_request("s")
    with overloaded(tmp_path, slow(COST_S), max_queued_s=1.0) as server, ExitStack() as stack:
        with Client(server.address) as client:
            learn(client)
        # Four robots have four connections, each with its own limit of calls.
        own_connection = [("grpc.use_local_subchannel_pool", 1)]
        channels = [grpc.insecure_channel(server.address, own_connection) for _ in range(4)]
        stubs = [LocalizationServiceStub(stack.enter_context(channel)) for channel in channels]
        before = {code: calls_handled(server, code) for code in ("OK", "RESOURCE_EXHAUSTED")}
        start_s, calls = time.monotonic(), []
        for i in range(sent):
            time.sleep(max(0.0, start_s + i / rate - time.monotonic()))
            metadata = [("x-client-id", f"robot-{i % 4}")]
            calls.append(stubs[i % 4].Localize.future(request, timeout=20, metadata=metadata))
        errors = [from_rpc_error(call.exception()) for call in calls if call.exception() is not None]
        answered, refused = sent - len(errors), len(errors)
        assert {error.code for error in errors} == {"RESOURCE_EXHAUSTED"}
        for error in errors:
            assert error.reason in ("QUEUE_FULL", "DEADLINE_INFEASIBLE")
            assert error.retry_after_s is not None
            assert 0 < error.retry_after_s < 20
        # A full queue keeps all threads busy: what was answered is at least what they can do in that time.
        assert answered > 0.2 * sent
        assert refused > 0.2 * sent
        wait_until(lambda: calls_handled(server) == sent + 10)
        assert calls_handled(server, "OK") - before["OK"] == answered
        assert calls_handled(server, "RESOURCE_EXHAUSTED") - before["RESOURCE_EXHAUSTED"] == refused
        assert server.value("mapless_admission_rejected_total") == refused
        of_localize = [
            server.value("mapless_jobs_terminated_total", stage=it) for it in ("prepare", "coarse", "refine")
        ]
        assert sum(of_localize) == answered + 10
        assert server.value("mapless_jobs_terminated_total", outcome="expired") == 0
        assert server.engine.queue.job_count == 0


def calls_handled(server: RunningServer, code: str | None = None) -> float:
    labels = {"grpc_method": "Localize"} | ({} if code is None else {"grpc_code": code})
    return server.value("grpc_server_handled_total", **labels)


def test_a_modest_caller_is_served_while_another_floods(tmp_path: Path) -> None:
    stop, refused, answers = threading.Event(), threading.Event(), list[LocalizationResult | Rejected]()

    def flood(client: Client) -> None:
        while not stop.is_set():
            with suppress(ResourceExhausted):
                answers.append(client.localize(PHOTO, CAMERA, "s"))
                continue
            refused.set()
            stop.wait(0.2)

    with (
        overloaded(tmp_path, slow(COST_S), max_queued_s=0.5) as server,
        Client(server.address, ConnectOptions(client_id="heavy", max_attempts=1)) as heavy,
        Client(server.address, ConnectOptions(client_id="light")) as light,
        ThreadPoolExecutor(40) as pool,
    ):
        learn(light)
        floods = [pool.submit(flood, heavy) for _ in range(40)]
        try:
            assert refused.wait(30)
            before = len(answers)
            for _ in range(10):
                assert isinstance(light.localize(PHOTO, CAMERA, "s"), LocalizationResult)
            # While one of it waits: what runs, a turn of 0.2 s and what was overdrawn, and not all that wait.
            assert len(answers) - before < 10 * 12
        finally:
            stop.set()
        for it in floods:
            assert it.exception(30) is None


def test_the_coarse_pose_is_answered_if_refining_has_no_time(tmp_path: Path) -> None:
    staged = Staged()
    with overloaded(tmp_path, staged.method()) as server, Client(server.address) as client:
        make_scene(client)
        coarse = with_enough_time(
            lambda limit_s: client.localize(PHOTO, CAMERA, "s", allow_coarse=True, timeout_s=limit_s), DeadlineExceeded
        )
        assert isinstance(coarse, LocalizationResult)
        assert (coarse.pose_stage, coarse.covariance, coarse.accuracy) == ("COARSE", None, None)
        np.testing.assert_allclose(coarse.world_from_camera.matrix(), pose(COARSE_X_M).matrix(), atol=1e-9)
        with pytest.raises(DeadlineExceeded):
            client.localize(PHOTO, CAMERA, "s", timeout_s=1.0)
        assert staged.refining.acquire(blocking=False)
        wait_until(lambda: server.value("mapless_jobs_terminated_total", outcome="degraded"))


def test_a_stage_predicted_to_be_late_is_not_begun(tmp_path: Path) -> None:
    staged = Staged()
    with overloaded(tmp_path, staged.method()) as server, Client(server.address) as client:
        make_scene(client)
        threading.Timer(2.5, staged.gate.set).start()
        full = client.localize(PHOTO, CAMERA, "s", allow_coarse=True, timeout_s=20.0)
        assert isinstance(full, LocalizationResult)
        assert full.pose_stage == "REFINED"
        coarse = with_enough_time(
            lambda limit_s: client.localize(PHOTO, CAMERA, "s", allow_coarse=True, timeout_s=limit_s), DeadlineExceeded
        )
        assert isinstance(coarse, LocalizationResult)
        assert coarse.pose_stage == "COARSE"
        assert [staged.refining.acquire(blocking=False) for _ in range(2)] == [True, False]
