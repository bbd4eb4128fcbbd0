"""A temporary Ray cluster on this machine, with Serve's ingress, HAProxy, in front of replicas of mapless.

It has its own processes, ports and folder, so that it affects neither the program that starts it nor another cluster;
all of it is deleted when the block is left. Ray and HAProxy listen on loopback, except for the replicas' own servers
and HAProxy's statistics, which cannot be configured to.
"""

import json
import os
import re
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bench.search_path import with_search_path
from mapless_ray.environment import variables

START_LIMIT_S = 120.0
END_LIMIT_S = 20.0
LEAVING_S = 2.0
"""Short, because on one machine HAProxy learns of changes at once, and tests wait for it."""
CPUS = 4
"""Number that Ray assumes."""
PORTS = 200
"""Ports of replicas, for each of two protocols; a port is reused only minutes after its replica ended."""
_MARK = "TRIAL_CLUSTER"
_POLL_S = 0.1
_SERVER = re.compile(r"^ *server SERVE_REPLICA_mapless-mapless-(\w+) .* proto h2", re.MULTILINE)
Json = dict[str, Any]


class ClusterFailed(Exception):
    """The cluster or the application did not start; the message ends with the last lines of the logs."""


@dataclass(frozen=True)
class Replica:
    """A replica that receives calls: Serve's name, and the "host:port" of its own gRPC server, behind the ingress."""

    name: str
    process_id: int
    address: str


@dataclass
class Cluster:
    """A running cluster: its ingress's "host:port", the folder of logs and configurations, the last application."""

    address: str
    folder: Path
    application: Json = field(default_factory=dict)
    _process: subprocess.Popen[str] = field(kw_only=True, repr=False)
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    def deploy(self, application: Mapping[str, Any], limit_s: float = START_LIMIT_S) -> None:
        """Deploys an application of a Serve config until exactly its replicas run; ClusterFailed beyond the limit."""
        self.application = dict(application)
        self._ask({"deploy": self.application, "limit_s": limit_s})
        give_up_s = time.monotonic() + limit_s
        while {it.name for it in self.replicas()} != set(re.findall(_SERVER, self.balancer_config())):
            if time.monotonic() > give_up_s:
                raise ClusterFailed(f"HAProxy's configuration does not have the replicas\n{self.logged()}")
            time.sleep(_POLL_S)

    def replicas(self) -> list[Replica]:
        """The replicas that receive calls now."""
        found = self._ask({"replicas": True})["replicas"]
        return [Replica(it["name"], it["process_id"], f"127.0.0.1:{it['port']}") for it in found]

    def balancer_config(self) -> str:
        """HAProxy's latest configuration, written by Serve."""
        (path,) = self.folder.glob("ha/*/haproxy.cfg")
        return path.read_text(encoding="utf-8")

    def balancer_processes(self) -> list[int]:
        """HAProxy's processes, with those of earlier configurations that still have calls."""
        config = f"{self.folder}/ha/".encode()
        return [it for it in _processes(f"{_MARK}={self.folder}") if config in _read(it, "cmdline")]

    def logged(self) -> str:
        """The last 2,000 characters of the cluster's output and of each log of Serve and the replicas."""
        logs = self.folder / "ray" / "session_latest" / "logs"
        paths = [self.folder / "log", *sorted(logs.glob("serve/*.log")), *sorted(logs.glob("worker-*.err"))]
        texts = [path.read_text(encoding="utf-8", errors="replace")[-2000:] for path in paths]
        return "\n".join(f"--- {path.name}\n{text}" for path, text in zip(paths, texts, strict=True) if text)

    def _ask(self, command: Json) -> Json:
        assert self._process.stdin is not None
        with self._lock:
            try:
                self._process.stdin.write(json.dumps(command) + "\n")
                self._process.stdin.flush()
            except BrokenPipeError:
                raise ClusterFailed(self.logged()) from None
            return self._answer()

    def _answer(self) -> Json:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise ClusterFailed(self.logged())
        answer: Json = json.loads(line)
        if "error" in answer:
            raise ClusterFailed(f"{answer['error']}\n{self.logged()}")
        return answer


def application(
    settings: Mapping[str, Any],
    replicas: int = 2,
    *,
    import_path: str = "mapless_ray.app:build",
    environment: Mapping[str, str] | None = None,
    **deployment: Any,
) -> Json:
    """An application of a Serve config whose replicas need no device of their own."""
    return {
        "name": "mapless",
        "route_prefix": "/",
        "import_path": import_path,
        "args": dict(settings),
        "runtime_env": {"env_vars": dict(environment or {})},
        "deployments": [
            {"name": "mapless", "num_replicas": replicas, "ray_actor_options": {"num_cpus": 0.1}, **deployment}
        ],
    }


@contextmanager
def running_cluster(environment: Mapping[str, str] | None = None) -> Iterator[Cluster]:
    """A cluster without an application, with variables for all its processes; ClusterFailed if it did not start."""
    # It holds sockets, whose paths are limited to 107 bytes.
    folder = Path(tempfile.mkdtemp(prefix="mr-", dir="/tmp"))
    with _bound([0] * 8) as sockets:
        ports = [it.getsockname()[1] for it in sockets]
    given = os.environ | variables(leaving_s=LEAVING_S) | _own_places(folder, ports) | with_search_path(environment)
    options = {"folder": str(folder / "ray"), "cpus": CPUS, "http_port": ports[0], "grpc_port": ports[1]}
    with (folder / "log").open("w") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "bench.load_ray.host", json.dumps(options)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            env=given,
            start_new_session=True,  # so that only this process receives Ctrl-C
        )
    deadline = threading.Timer(START_LIMIT_S, process.kill)
    deadline.start()
    try:
        found = Cluster(f"127.0.0.1:{ports[1]}", folder, _process=process)
        found._answer()
        deadline.cancel()
        yield found
    finally:
        deadline.cancel()
        _end(process, f"{_MARK}={folder}")
        shutil.rmtree(folder, ignore_errors=True)


def _own_places(folder: Path, ports: list[int]) -> dict[str, str]:
    """Variables that separate Ray and HAProxy from those of another cluster."""
    http, grpc = _free_block(PORTS), _free_block(PORTS)
    return {
        _MARK: str(folder),
        "RAY_AUTH_MODE": "token",
        "RAY_AUTH_TOKEN": secrets.token_hex(32),
        "RAY_USAGE_STATS_ENABLED": "0",
        "RAY_SERVE_HAPROXY_CONFIG_FILE_LOC": str(folder / "ha" / "haproxy.cfg"),
        "RAY_SERVE_HAPROXY_SOCKET_PATH": str(folder / "ha" / "a"),
        "RAY_SERVE_HAPROXY_SERVER_STATE_BASE": str(folder / "ha"),
        "RAY_SERVE_HAPROXY_SERVER_STATE_FILE": str(folder / "ha" / "state"),
        "RAY_SERVE_HAPROXY_METRICS_SOCKET_PATH": str(folder / "ha" / "m"),
        "RAY_SERVE_HAPROXY_STATS_PORT": str(ports[2]),
        "RAY_SERVE_HAPROXY_METRICS_PORT": str(ports[3]),
        "RAY_SERVE_FALLBACK_PROXY_HTTP_PORT": str(ports[4]),
        "RAY_SERVE_FALLBACK_PROXY_GRPC_PORT": str(ports[5]),
        "RAY_SERVE_DIRECT_INGRESS_MIN_HTTP_PORT": str(http),
        "RAY_SERVE_DIRECT_INGRESS_MAX_HTTP_PORT": str(http + PORTS),
        "RAY_SERVE_DIRECT_INGRESS_MIN_GRPC_PORT": str(grpc),
        "RAY_SERVE_DIRECT_INGRESS_MAX_GRPC_PORT": str(grpc + PORTS),
        # A busy machine is slow.
        "RAY_SERVE_PROXY_READY_CHECK_TIMEOUT_S": "60",
        "RAY_SERVE_PROXY_HEALTH_CHECK_TIMEOUT_S": "60",
        # One thread, to leave the cores to the replicas.
        "RAY_SERVE_HAPROXY_NBTHREAD": "1",
    }


def _free_block(count: int) -> int:
    """The first of `count` free ports in a row, below those that the system assigns."""
    for _ in range(100):
        first = 10_000 + secrets.randbelow(20_000)
        with suppress(OSError), _bound(range(first, first + count + 1)):
            return first
    raise ClusterFailed(f"there are no {count} free ports in a row")


@contextmanager
def _bound(ports: Any) -> Iterator[list[socket.socket]]:
    sockets: list[socket.socket] = []
    try:
        for port in ports:
            sockets.append(socket.socket())
            sockets[-1].bind(("127.0.0.1", port))
        yield sockets
    finally:
        for it in sockets:
            it.close()


def _end(process: subprocess.Popen[str], mark: str) -> None:
    """Ends the cluster; kills the processes that remain after the limit."""
    assert process.stdin is not None
    assert process.stdout is not None
    with suppress(BrokenPipeError):
        process.stdin.close()
    with suppress(subprocess.TimeoutExpired):
        process.wait(END_LIMIT_S)
    give_up_s = time.monotonic() + END_LIMIT_S
    while (left := _processes(mark)) and time.monotonic() < give_up_s:
        for process_id in left:
            with suppress(ProcessLookupError):
                os.kill(process_id, signal.SIGKILL)
        time.sleep(0.05)
    process.wait(END_LIMIT_S)
    process.stdout.close()


def _processes(mark: str) -> list[int]:
    """Processes, without zombies, with this in their environment, which all processes of a cluster inherit."""
    wanted = mark.encode()
    return [
        int(it.name)
        for it in Path("/proc").iterdir()
        if it.name.isdigit() and wanted in _read(int(it.name), "environ").split(b"\0")
    ]


def _read(process_id: int, what: str) -> bytes:
    try:
        return Path(f"/proc/{process_id}/{what}").read_bytes()
    except OSError:
        return b""
