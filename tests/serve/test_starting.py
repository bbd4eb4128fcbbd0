"""Start, health, drain and stop, of the server in this process and of the real command."""

import ctypes
import os
import re
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from grpc_health.v1 import health_pb2
from support.commands import run
from support.programs import real
from support.servers import CAMERA, PHOTO, RunningServer, pose, serving

from mapless import Client, ConnectOptions, NewReference
from mapless_server.observability import logs
from mapless_server.serve import command

SERVING, NOT_SERVING = health_pb2.HealthCheckResponse.SERVING, health_pb2.HealthCheckResponse.NOT_SERVING


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


def test_settings_are_shown_at_the_start(tmp_path: Path) -> None:
    with real(tmp_path / "server", max_batch=7, log_format="text") as server:
        assert server.address
        for shown in (r"max_batch +7  \(flag\)", r"warm_up +False  \(environment\)", r"reflection +True  \(default\)"):
            assert re.search(f"^ +{shown}$", server.log, re.MULTILINE), shown


@pytest.fixture
def refusal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """The one line with which the command says why it does not start; it runs in this process, whose logs stay."""
    for module, name in ((logs, "configure_logging"), (command, "configure_libraries")):
        monkeypatch.setattr(module, name, lambda *_: None)

    def refusal(**settings: object) -> str:
        given = {"port": 0, "metrics_port": 0, "data_dir": tmp_path / "data", "features": "sift"} | settings
        flags = [part for name, it in given.items() for part in (f"--{name.replace('_', '-')}", str(it))]
        done = run("serve", *flags)
        assert (done.exit_code, done.stdout) == (2, ""), done.output
        (line,) = done.stderr.strip().splitlines()
        assert line.startswith("mapless-server: ")
        return line

    return refusal


@pytest.mark.parametrize(("setting", "value"), [("data_dir", "/dev/null/x"), ("features", "nonesuch")])
def test_a_server_that_cannot_start_reports_why(refusal: Callable[..., str], setting: str, value: str) -> None:
    assert value in refusal(**{setting: value})


def test_a_taken_port_is_not_shared(server: RunningServer, refusal: Callable[..., str]) -> None:
    port = server.address.rpartition(":")[2]
    assert f"cannot listen on 127.0.0.1:{port}" in refusal(port=port)


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "malloc_info"), reason="needs glibc")
@pytest.mark.parametrize(
    ("environment", "threads", "heaps"),
    [({}, "1", range(1, 2)), ({"OPENBLAS_NUM_THREADS": "2", "MALLOC_ARENA_MAX": "3"}, "2", range(2, 4))],
)
def test_libraries_have_one_thread_and_heap_unless_set(environment: dict[str, str], threads: str, heaps: range) -> None:
    """The libraries read the environment when they are imported; each heap keeps what threads needed for a moment."""
    program = """if True:
        import ctypes, os, sys, threading
        from mapless_server.serve.libraries import configure_libraries
        from mapless_server.settings import Settings
        import mapless_tools.cli.app
        assert not {"numpy", "scipy", "cv2", "grpc"} & {*sys.modules}
        configure_libraries(Settings())
        print(os.environ["OPENBLAS_NUM_THREADS"], flush=True)
        together = threading.Barrier(4)
        threads = [threading.Thread(target=lambda: bytearray(100_000) and together.wait()) for _ in range(4)]
        [it.start() for it in threads]
        [it.join() for it in threads]
        libc = ctypes.CDLL(None)
        libc.malloc_info(0, ctypes.c_void_p.in_dll(libc, "stdout"))
        libc.fflush(None)
    """
    inherited = {name: it for name, it in os.environ.items() if not re.search("THREADS|MALLOC|GLIBC", name)}
    printed = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, env=inherited | environment
    )
    assert (printed.stdout.splitlines()[0], printed.stderr) == (threads, "")
    assert printed.stdout.count("<heap ") in heaps
