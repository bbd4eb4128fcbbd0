"""Clients that disappear, misbehave or flood; methods that raise, hang or return nonsense; processes that are killed.

The other callers are answered, each call ends once, and what was acknowledged is stored.
"""

import random
import signal
import socket
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc
from support import raw_http2
from support.images import encode
from support.programs import gated, program, real
from support.servers import (
    CAMERA,
    PHOTO,
    RunningServer,
    StandInMethod,
    Stubs,
    failure_of,
    localize_request,
    make_scene,
    pose,
    serving,
    whole,
)
from support.waiting import wait_until

from bench.load.watch import Scrape, read_metrics
from mapless import (
    Client,
    ConnectOptions,
    DeadlineExceeded,
    Internal,
    LocalizationResult,
    MaplessError,
    NewReference,
    Unavailable,
)
from mapless.geometry import Camera
from mapless.v1 import reference_service_pb2 as reference_pb
from mapless_server.method.judge.answer import Answer, Localization
from mapless_server.rpc import receiving
from mapless_server.serve import listening

ONCE = ConnectOptions(max_attempts=1)
SERVING, NOT_SERVING = health_pb2.HealthCheckResponse.SERVING, health_pb2.HealthCheckResponse.NOT_SERVING


def scraped(address: str) -> Scrape:
    scrape = read_metrics(address)
    assert scrape is not None
    return scrape


def is_served(client: Client, scene: str) -> bool:
    return client.is_serving() and isinstance(client.localize(PHOTO, CAMERA, scene), LocalizationResult)


class TestClients:
    @pytest.mark.nightly("pings")
    @pytest.mark.parametrize("has_call", [True, False])
    def test_pings_every_ten_seconds_end_nothing(self, server: RunningServer, client: Client, has_call: bool) -> None:
        """The least that gRPC's clients allow; with a call that is quiet, or without any."""
        with raw_http2.connect(server.address) as pinging:
            watch = raw_http2.call(1, "/grpc.health.v1.Health/Watch", b"") if has_call else b""
            pinging.sendall(raw_http2.hello() + watch)
            for _ in range(5):
                time.sleep(9.9)
                pinging.sendall(raw_http2.ping())
            pinging.settimeout(1.0)
            received = b""
            with suppress(TimeoutError):
                while part := pinging.recv(65536):
                    received += part
        assert b"too_many_pings" not in received
        assert received.count(raw_http2.ping(is_answer=True)) == 5

    def test_a_caller_that_never_reads_delays_no_other(self, server: RunningServer, client: Client, scene: str) -> None:
        camera = Camera(800, 600, 700.0, 700.0, 399.5, 299.5)
        noise = np.random.default_rng(0).integers(0, 256, (600, 800, 3)).astype(np.uint8)
        client.add_reference(scene, NewReference("large", encode(".png", noise), camera, pose(9)))
        asked = reference_pb.GetReferenceRequest(name=f"scenes/{scene}/references/large", include_image=True)
        with ExitStack() as stack:
            for window_bytes in (0, 65_535):
                slow = stack.enter_context(raw_http2.connect(server.address))
                slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
                calls = (
                    raw_http2.call(stream, "/mapless.v1.ReferenceService/GetReference", asked.SerializeToString())
                    for stream in range(1, 40, 2)
                )
                slow.sendall(raw_http2.hello(window_bytes) + b"".join(calls))
            for _ in range(5):
                assert is_served(client, scene)
                assert len(client.get_reference(scene, "large", include_image=True).image or b"") > 1_000_000

    def test_callers_that_never_send_block_no_other(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """Open methods take no token, so these callers are unknown; a tenth of the real numbers."""
        for module, name in (
            (listening, "MAX_CONCURRENT_RPCS"),
            (receiving, "MAX_OPEN_WAITING"),
            (receiving, "MAX_OPEN_STREAMS"),
        ):
            monkeypatch.setattr(module, name, getattr(module, name) // 10)
        with serving(tmp_path) as server, Client(server.address) as client, ExitStack() as stack:
            make_scene(client)
            methods = [f"/grpc.health.v1.Health/{it}" for it in ("Check", "Watch")]
            for _ in range(5):
                stranger = stack.enter_context(raw_http2.connect(server.address))
                calls = (raw_http2.begin(stream, methods[stream % 4 == 1]) for stream in range(1, 2 * 100, 2))
                stranger.sendall(raw_http2.hello() + b"".join(calls))
                assert is_served(client, "s")
            assert is_served(client, "s")

    def test_a_flood_of_garbage(self, server: RunningServer, client: Client, scene: str) -> None:
        noise = random.Random(0)
        starts = [b"", raw_http2.PREFACE, raw_http2.hello(), b"GET / HTTP/1.1\r\n\r\n", b"\x16\x03\x01\x02\x00\x01"]
        for i in range(150):
            said = starts[i % len(starts)] + noise.randbytes(noise.randrange(5000))
            # The server may close the connection before all is sent.
            with raw_http2.connect(server.address) as garbage, suppress(ConnectionResetError, BrokenPipeError):
                garbage.sendall(said)
            if i % 50 == 0:
                assert is_served(client, scene)
        assert is_served(client, scene)

    def test_metadata_over_the_limit(self, stubs: Stubs, scene: str) -> None:
        too_much = [(f"x-padding-{i}", "x" * 4000) for i in range(20)]
        error = failure_of(stubs.localization.Localize, localize_request(scene), metadata=too_much)
        assert error.code == "RESOURCE_EXHAUSTED"
        assert stubs.localization.Localize(localize_request(scene), timeout=30).HasField("localization")


class TestMethods:
    def test_a_backend_with_invalid_output_is_an_internal_error(self, tmp_path: Path) -> None:
        def spoil(answer: Answer) -> Answer:
            assert isinstance(answer.outcome, Localization)
            return replace(answer, outcome=replace(answer.outcome, reprojection_error_px=np.nan))

        stand_in = StandInMethod()
        stand_in.gate.set()
        method = whole(lambda *asked: spoil(stand_in(*asked)))
        with serving(tmp_path, method=method) as server, Client(server.address) as client:
            make_scene(client)
            with pytest.raises(Internal):
                client.localize(PHOTO, CAMERA, "s")
            assert client.is_serving()

    def test_one_that_hangs_ends_the_process_and_every_call(self, tmp_path: Path) -> None:
        with (
            gated(tmp_path / "server", "hangs", workers=1, stall_limit_s=2.5) as server,
            Client(server.address, ONCE) as client,
            grpc.insecure_channel(server.address) as channel,
            ThreadPoolExecutor(2) as pool,
        ):
            make_scene(client)
            watch = health_pb2_grpc.HealthStub(channel).Watch(health_pb2.HealthCheckRequest(), timeout=60)
            assert next(watch).status == SERVING
            hangs = pool.submit(client.localize, PHOTO, CAMERA, "s", timeout_s=1.0)
            wait_until(lambda: server.began)
            waits = pool.submit(client.localize, PHOTO, CAMERA, "s", timeout_s=60.0)
            assert isinstance(hangs.exception(30), DeadlineExceeded)
            failed = waits.exception(30)
            assert isinstance(failed, Unavailable)
            assert failed.reason == "SERVER_FAILED"
            assert next(watch).status == NOT_SERVING
            assert server.wait() == 70
            assert "the stage refine has computed for" in server.log
            assert "the server ends after an unrecoverable failure" in server.log
            with pytest.raises(grpc.RpcError, match="UNAVAILABLE"):
                next(watch)

    @pytest.mark.nightly
    def test_one_that_hangs_during_the_drain_is_a_failure_too(self, tmp_path: Path) -> None:
        with (
            gated(tmp_path / "server", "hangs", workers=1, stall_limit_s=2.5, drain_grace_s=50) as server,
            Client(server.address, ONCE) as client,
            ThreadPoolExecutor(1) as pool,
        ):
            make_scene(client)
            hangs = pool.submit(client.localize, PHOTO, CAMERA, "s", timeout_s=60.0)
            wait_until(lambda: server.began)
            server.process.send_signal(signal.SIGTERM)
            assert server.wait() == 70
            assert isinstance(hangs.exception(30), Unavailable)
            assert "the server ends after an unrecoverable failure" in server.log

    def test_one_that_hangs_keeps_no_server_from_stopping(self, tmp_path: Path) -> None:
        """Not noticed as hanging; and with the real limit, in the time that deploy/kubernetes gives."""
        folder = tmp_path / "server"
        script = f"""if True:
            from pathlib import Path
            from support import programs
            from mapless_server.serve import run
            run.CLOSING_LIMIT_S = 0.5
            programs._main(Path({str(folder)!r}), "hangs", ["workers=1", "drain_grace_s=0.1"])
        """
        with (
            program(folder, ["-c", script]) as server,
            Client(server.address, ONCE) as client,
            ThreadPoolExecutor(1) as pool,
        ):
            make_scene(client)
            hangs = pool.submit(client.localize, PHOTO, CAMERA, "s", timeout_s=60.0)
            wait_until(lambda: server.began)
            server.process.send_signal(signal.SIGTERM)
            assert server.wait() == 70
            assert isinstance(hangs.exception(30), MaplessError)
            assert "the server hangs" in server.log


def code_of(call: Callable[[], object]) -> str:
    """How a call ends."""
    try:
        call()
    except MaplessError as error:
        return error.code
    return "OK"


class TestProcess:
    @pytest.mark.parametrize(
        "signals", [[signal.SIGTERM], pytest.param([signal.SIGINT, signal.SIGTERM], marks=pytest.mark.nightly)]
    )
    def test_a_signal_drains_in_order(self, tmp_path: Path, signals: list[signal.Signals]) -> None:
        """Health first, while calls are still taken; then none; what runs and what waits is answered; exit code 0."""
        settings: dict[str, Any] = {
            "workers": 1,
            "drain_delay_s": 2.0,
            "drain_grace_s": 50,
            "metrics": True,
            "metrics_port": 0,
        }
        with (
            gated(tmp_path / "server", **settings) as server,
            Client(server.address, ONCE) as client,
            grpc.insecure_channel(server.address) as channel,
            ThreadPoolExecutor(2) as pool,
        ):
            make_scene(client)
            watch = health_pb2_grpc.HealthStub(channel).Watch(health_pb2.HealthCheckRequest(), timeout=60)
            assert next(watch).status == SERVING
            calls = [pool.submit(client.localize, PHOTO, CAMERA, "s") for _ in range(2)]
            wait_until(lambda: server.began == 1 and scraped(server.metrics_address).started == 2)
            for sent in signals:
                server.process.send_signal(sent)
            assert next(watch).status == NOT_SERVING
            watch.cancel()
            assert client.get_scene("s").reference_count == 1
            assert not client.is_serving()
            codes = ["OK"]

            def is_refused() -> bool:
                codes.append(code_of(lambda: client.get_scene("s")))
                return codes[-1] == "UNAVAILABLE"

            wait_until(is_refused)
            # A call that arrives in the moment of the shutdown is cancelled by grpc itself: grpc/grpc#41785.
            assert set(codes) <= {"OK", "CANCELLED", "UNAVAILABLE"}
            assert not any(call.done() for call in calls)
            assert server.began == 1
            server.open_gate()
            for call in calls:
                assert isinstance(call.result(30), LocalizationResult)
            assert server.began == 2
            assert server.wait() == 0

    def test_a_port_of_the_metrics_that_is_taken(self, tmp_path: Path) -> None:
        with socket.socket() as taken:
            taken.bind(("127.0.0.1", 0))
            taken.listen()
            port = taken.getsockname()[1]
            with real(tmp_path / "server", metrics_port=port, log_level="error") as server:
                assert server.wait() == 2
                (line,) = server.log.strip().splitlines()
        assert line.startswith(f"mapless-server: cannot serve metrics on 127.0.0.1:{port}: ")
