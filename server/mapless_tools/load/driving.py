"""The real server with a scene, and calls to it: concurrent ones, as fast as possible, or at a rate."""

import itertools
import socket
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractAsyncContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path

from mapless import Client
from mapless_tools.child import CONNECT, child_server
from mapless_tools.demo import Place
from mapless_tools.progress import Progress

from .calls import CallRecord, Fate, Mix, Requests, Times, plan_calls, poisson_times
from .requests import requests_for, store_references
from .sender import Target, send_open_loop
from .step import Step, closed_loop_step, run_step
from .watch import ServerUnderLoad, priority_over

_RAMP_GAIN = 1.03
"""Twice as many calls side by side give so much more, or the server is saturated."""


@dataclass(frozen=True)
class LoadedServer:
    """The address of a server with a scene; its process, metrics and store; and serialized requests to it."""

    address: str
    under_load: ServerUnderLoad
    requests: Requests


@contextmanager
def server_with_scene(
    place: Place, progress: Progress, environment: Mapping[str, str] | None = None, log: Path | None = None
) -> Iterator[LoadedServer]:
    """Starts a server, stores the references of a place, and has it answer every query once.

    It uses the settings of the environment, to which `environment` is added. Its log is appended to the file `log`.
    """
    port = free_port()
    with tempfile.TemporaryDirectory(prefix="mapless-load-") as data_dir:
        flags = {"--metrics-port": str(port), "--metrics-host": "127.0.0.1"}
        with child_server(Path(data_dir), flags, environment, log) as server:
            with Client(server.address, CONNECT) as client:
                progress("storing references", 0, len(place.references))
                store_references(client, place.references)
                progress("first answers", 0, len(place.queries))
                requests = requests_for(client, place.queries)
            with priority_over(server.process_id):
                under_load = ServerUnderLoad(server.process_id, f"127.0.0.1:{port}", Path(data_dir))
                yield LoadedServer(server.address, under_load, requests)


def free_port() -> int:
    """A port of the loopback interface that is free now."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


async def find_saturation(
    server: LoadedServer, target: Target, seconds: float, progress: Progress
) -> tuple[list[Step], float]:
    """Increases the number of concurrent calls until the rate stops to grow; also returns the largest rate."""
    steps: list[Step] = []
    best_per_s = 0.0
    for power in itertools.count(1):
        concurrency = 2**power
        progress(f"saturation, {concurrency} calls side by side", 0, 1)
        name, requests = f"{concurrency} at a time", server.requests.good
        step = await closed_loop_step(name, server.under_load, target, requests, concurrency, seconds)
        steps.append(step)
        per_s = step.account.completed_per_s
        if per_s < _RAMP_GAIN * best_per_s or step.account.count(Fate.REFUSED) or step.answers == 0:
            best_per_s = max(best_per_s, per_s)
            break
        best_per_s = per_s
    if best_per_s == 0:
        raise RuntimeError(f"the server answered nothing: {dict(steps[-1].account.outcomes)}")
    return steps, best_per_s


async def open_step(
    name: str,
    server: LoadedServer,
    target: Target,
    rate_per_s: float,
    seconds: float,
    *,
    settle_s: float,
    seed: int,
    mix: Mix | None = None,
    requests: Requests | None = None,
    beside: Callable[[], AbstractAsyncContextManager[object]] = nullcontext,
    times: Times = poisson_times,
) -> Step:
    """Runs a step of arrivals that no answer influences; the requests are the server's or others."""
    asked = requests or server.requests
    plan = plan_calls(rate_per_s, seconds, len(target.methods), asked, mix or Mix(), seed, times)

    async def send() -> list[CallRecord]:
        async with beside():
            return await send_open_loop(target, plan)

    return await run_step(
        name,
        server.under_load,
        send,
        seconds,
        asked_per_s=rate_per_s,
        settle_s=settle_s,
    )
