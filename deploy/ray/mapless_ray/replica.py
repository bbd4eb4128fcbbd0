"""One replica: a device with its own queue and pipeline, as in a plain server."""

import asyncio
import logging
import socket
import sys
from contextlib import AsyncExitStack, closing
from typing import Any

import ray

from mapless_server.observability.logs import configure_logging
from mapless_server.serve.opening import MakeEngine, make_engine
from mapless_server.serve.run import SWITCH_INTERVAL_S, exit_failed
from mapless_server.serve.running import running_server
from mapless_server.settings import Settings, load_settings

from .environment import check_environment
from .ingress import Ingress
from .scaling import Reporter

log = logging.getLogger(__name__)

SERVE_HOST = "0.0.0.0"
"""Address of Serve's gRPC servers, whatever the settings say; the check for missing protection uses it."""

METRICS_PORTS = 16
"""Ports, from `metrics_port` on, for the metrics of the replicas of one machine."""

HEARTBEAT_LIMIT_S = 5.0
"""Serve replaces a replica whose queue is silent for longer."""


class MaplessReplica:
    """Serve's deployment class; calls come through `ingress`, not through its methods.

    `make` makes the engine; tests and measurements replace it.
    """

    make: MakeEngine = staticmethod(make_engine)

    async def __init__(self, settings: dict[str, Any]) -> None:  # type: ignore[misc]  # Serve awaits it
        """Returns when the first localization has succeeded; then Serve sends calls.

        Settings that are not given come from the environment (MAPLESS_...). StartupError if the replica cannot serve;
        Serve tries again a few times, and then reports it to the operator.
        """
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        loaded = load_settings({**settings, "host": SERVE_HOST})
        check_environment(loaded.settings)
        configure_logging(loaded.settings)
        log.info("mapless on Ray Serve %s\n%s", ray.__version__, loaded)
        # Serve itself keeps a replica that ends reachable for a while.
        port, self._claim = claim_metrics_port(loaded.settings)
        update = {"metrics_port": port, "drain_delay_s": 0.0}
        own = loaded.settings.model_copy(update=update)
        async with AsyncExitStack() as stack:
            self._running = await stack.enter_async_context(running_server(own, self.make, listen=Ingress))
            self._stack = stack.pop_all()
        self._reporter = Reporter(self._running.engine.queue)
        self._failing = asyncio.ensure_future(self._exit_when_failed())

    async def _exit_when_failed(self) -> None:
        """Ends the process, which Serve detects at once, before its health checks do."""
        await asyncio.wait({self._running.failed})
        await exit_failed()

    async def check_health(self) -> None:
        """Called by Serve, which replaces the replica if this raises."""
        if not self._running.engine.queue.is_alive_within(HEARTBEAT_LIMIT_S):
            raise RuntimeError(f"the queue has been silent for more than {HEARTBEAT_LIMIT_S:g} s")

    async def record_autoscaling_stats(self) -> dict[str, float]:
        """The figures for `scaling`; called by Serve once in `metrics_interval_s`."""
        return self._reporter.report()

    async def __del__(self) -> None:
        """Called by Serve when the gRPC server has stopped and all calls are answered."""
        self._failing.cancel()
        await self._stack.aclose()


def claim_metrics_port(settings: Settings) -> tuple[int, socket.socket | None]:
    """The first free port from `metrics_port` on, and a socket that reserves it among the replicas until it is closed.

    The reservation is an abstract Unix socket, because several replicas may search before one of them listens.
    """
    if not settings.metrics_port:
        return 0, None
    for port in range(settings.metrics_port, settings.metrics_port + METRICS_PORTS):
        claim = socket.socket(socket.AF_UNIX)
        try:
            claim.bind(f"\0mapless-metrics-{port}")
        except OSError:
            claim.close()
            continue
        with closing(socket.socket()) as probe:
            if probe.connect_ex(("127.0.0.1", port)):
                return port, claim
        claim.close()
    return settings.metrics_port, None
