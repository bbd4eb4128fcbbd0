"""Start, health, drain and stop, of the server in this process and of the real command."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import grpc
import numpy as np
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc
from support.images import encode
from support.servers import CAMERA, PHOTO, RunningServer, pose, serving

from mapless import Client, ConnectOptions, LocalizationResult, NewReference, Unavailable
from mapless.geometry import Camera

SERVICES = ["", "mapless.v1.LocalizationService", "mapless.v1.ReferenceService"]
SERVING, NOT_SERVING = health_pb2.HealthCheckResponse.SERVING, health_pb2.HealthCheckResponse.NOT_SERVING


def test_health_of_every_service(server: RunningServer) -> None:
    with grpc.insecure_channel(server.address) as channel:
        stub = health_pb2_grpc.HealthStub(channel)
        for service in SERVICES:
            assert stub.Check(health_pb2.HealthCheckRequest(service=service), timeout=10).status == SERVING
        with pytest.raises(grpc.RpcError, match="NOT_FOUND"):
            stub.Check(health_pb2.HealthCheckRequest(service="mapless.v1.Absent"), timeout=10)


def refused_soon(client: Client) -> bool:
    """Whether calls come to be answered UNAVAILABLE."""
    for _ in range(500):
        try:
            client.get_scene("s")
        except Unavailable:
            return True
        time.sleep(0.01)
    return False


def test_draining_finishes_what_runs_and_takes_nothing_new(tmp_path: Path) -> None:
    with (
        serving(tmp_path) as server,
        Client(server.address, ConnectOptions(max_attempts=1)) as client,
        grpc.insecure_channel(server.address) as channel,
        ThreadPoolExecutor(1) as thread,
    ):
        client.create_scene("s")
        client.add_reference("s", NewReference("r", PHOTO, CAMERA, pose(0)))
        watch = health_pb2_grpc.HealthStub(channel).Watch(health_pb2.HealthCheckRequest(), timeout=30)
        assert next(watch).status == SERVING
        with server.method.held():
            running = thread.submit(client.localize, PHOTO, CAMERA, "s")
            assert server.method.started.acquire(timeout=20)
            server.stop()
            assert next(watch).status == NOT_SERVING
            watch.cancel()
            assert refused_soon(client)
        assert isinstance(running.result(30), LocalizationResult)


def test_calls_that_outlast_the_grace_are_cut_off(tmp_path: Path) -> None:
    with (
        serving(tmp_path, drain_grace_s=0.2) as server,
        Client(server.address, ConnectOptions(max_attempts=1)) as client,
        ThreadPoolExecutor(1) as thread,
    ):
        client.create_scene("s")
        client.add_reference("s", NewReference("r", PHOTO, CAMERA, pose(0)))
        with server.method.held():
            running = thread.submit(client.localize, PHOTO, CAMERA, "s")
            assert server.method.started.acquire(timeout=20)
            server.stop()
            with pytest.raises(Exception, match=r".") as caught:
                running.result(20)
        assert getattr(caught.value, "code", None) in {"UNAVAILABLE", "CANCELLED"}


@dataclass
class Command:
    """`mapless-server serve` as a process of its own."""

    process: subprocess.Popen[str]
    address: str
    log: Path

    def stop(self, number: signal.Signals) -> int:
        """The exit code after a signal."""
        self.process.send_signal(number)
        return self.process.wait(60)


@contextmanager
def command(data_dir: Path, *arguments: str, **environment: str) -> Iterator[Command]:
    log = data_dir.with_suffix(".log")
    flags = ["--port", "0", "--metrics-port", "0", "--data-dir", str(data_dir), *arguments]
    with log.open("w") as stderr:
        process = subprocess.Popen(
            [sys.executable, "-m", "mapless_tools", "serve", *flags],
            stdout=subprocess.PIPE,
            stderr=stderr,
            text=True,
            env={**os.environ, **environment},
        )
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        prefix = "mapless-server listening on "
        assert line.startswith(prefix), log.read_text()
        yield Command(process, line.removeprefix(prefix).strip(), log)
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate(timeout=30)


def noise_photo(seed: int) -> bytes:
    """A photograph that keeps a feature extractor busy."""
    noise = np.random.default_rng(seed).integers(0, 256, (768, 1024, 3)).astype(np.uint8)
    return encode(".jpg", np.asarray(cv2.GaussianBlur(noise, (0, 0), 1.5), np.uint8))


def test_sigterm_finishes_a_running_call_and_exits_with_0(tmp_path: Path) -> None:
    camera = Camera(1024, 768, 900.0, 900.0, 511.5, 383.5)
    references = [NewReference(f"r{i}", noise_photo(i), camera, pose(i)) for i in range(6)]
    data_dir = tmp_path / "data"
    with (
        command(data_dir, "--workers", "1", "--drain-grace-s", "60", "--log-level", "debug") as server,
        Client(server.address) as client,
        ThreadPoolExecutor(1) as thread,
    ):
        client.create_scene("s")
        upload = thread.submit(client.add_references, "s", references)
        while "BatchCreateReferences begins" not in server.log.read_text():
            time.sleep(0.01)
        server.process.send_signal(signal.SIGTERM)
        assert not upload.done()
        assert len(upload.result(60)) == 6
        assert server.process.wait(60) == 0
    with command(data_dir) as server, Client(server.address) as client:
        assert client.get_scene("s").reference_count == 6
        assert server.stop(signal.SIGINT) == 0


def test_settings_are_shown_at_the_start(tmp_path: Path) -> None:
    with command(tmp_path / "data", "--max-batch", "7", "--log-format", "text", MAPLESS_WORKERS="1") as server:
        assert server.stop(signal.SIGTERM) == 0
        log = server.log.read_text()
    for shown in (r"max_batch +7  \(flag\)", r"workers +1  \(environment\)", r"reflection +True  \(default\)"):
        assert re.search(f"^ +{shown}$", log, re.MULTILINE), shown


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--data-dir", "/dev/null/x"], "/dev/null/x"),
        (["--config", "absent.toml"], "absent.toml"),
        (["--workers", "0"], "workers"),
        (["--backend", "nonesuch"], "nonesuch"),
        (["--features", "nonesuch"], "nonesuch"),
        (["--host", "192.0.2.1"], "192.0.2.1"),
    ],
)
def test_a_server_that_cannot_start_says_why_in_one_line(tmp_path: Path, arguments: list[str], told: str) -> None:
    given = {"--port": "0", "--data-dir": str(tmp_path), "--log-level": "error"}
    given |= dict(zip(arguments[::2], arguments[1::2], strict=True))
    flat = [part for pair in given.items() for part in pair]
    done = subprocess.run(
        [sys.executable, "-m", "mapless_server", "--no-metrics", *flat],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 2, done.stderr
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith("mapless-server: ")
    assert told in line
    assert not done.stdout


def test_a_taken_port_is_not_shared(server: RunningServer, tmp_path: Path) -> None:
    port = server.address.rpartition(":")[2]
    done = subprocess.run(
        [sys.executable, "-m", "mapless_server", "--no-metrics", "--port", port, "--data-dir", str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 2
    assert f"cannot listen on 127.0.0.1:{port}" in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(("environment", "threads"), [({}, 1), ({"OPENBLAS_NUM_THREADS": "2"}, 2)])
def test_a_product_uses_one_thread_unless_set_otherwise(environment: dict[str, str], threads: int) -> None:
    """The libraries read the environment when they are imported, so the command line must not import them."""
    program = """if True:
        import sys
        from mapless_server.serve.libraries import configure_libraries
        from mapless_server.settings import Settings
        import mapless_tools.cli.app
        assert not {"numpy", "scipy", "cv2", "grpc"} & {*sys.modules}
        configure_libraries(Settings())
        import os
        print(os.environ["OPENBLAS_NUM_THREADS"])
    """
    inherited = {name: value for name, value in os.environ.items() if "THREADS" not in name}
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        env=inherited | environment,
    )
    assert (done.stdout.strip(), done.stderr) == (str(threads), "")
