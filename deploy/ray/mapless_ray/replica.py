"""One replica: one device, with the whole pipeline and its queue, as a server of mapless's own has."""

from __future__ import annotations

import asyncio
import logging
import socket
import sys
from contextlib import AsyncExitStack, closing
from typing import Any

import ray

from mapless_server.observability.logs import configure_logging
from mapless_server.serve.assembly import MakeEngine, make_engine
from mapless_server.serve.run import SWITCH_INTERVAL_S, exit_failed
from mapless_server.serve.running import running_server
from mapless_server.settings import Settings, load_settings

from .environment import check_environment
from .ingress import Ingress
from .scaling import Reporter

log = logging.getLogger(__name__)

SERVE_HOST = "0.0.0.0"
"""Where Serve's gRPC servers listen, whatever the settings say; what has to be protected is decided by it."""

METRICS_PORTS = 16
"""How many ports, from `metrics_port` on, are tried for the metrics: replicas of one machine each need one."""

HEARTBEAT_LIMIT_S = 5.0
"""A queue that has shown no life for longer makes Serve replace the replica."""


class MaplessReplica:
    """Serve's deployment class; its calls do not come through it but through `ingress`.

    Attributes:
        make: makes the engine; those of tests and measurements compute other things.
    """

    make: MakeEngine = staticmethod(make_engine)

    async def __init__(self, settings: dict[str, Any]) -> None:  # type: ignore[misc]  # Serve awaits it
        """Returns when the first localization has succeeded; only then does Serve send calls.

        Args:
            settings: of mapless, by name; the rest comes from the environment (MAPLESS_...).

        Raises:
            StartupError: it cannot serve; Serve tries again a few times and then tells the operator.
        """
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        loaded = load_settings({**settings, "host": SERVE_HOST})
        check_environment(loaded.settings)
        configure_logging(loaded.settings)
        log.info("mapless on Ray Serve %s\n%s", ray.__version__, loaded)
        # Serve itself keeps a replica that is to go reachable for a while.
        port, self._claim = claim_metrics_port(loaded.settings)
        update = {"metrics_port": port, "drain_delay_s": 0.0}
        own = loaded.settings.model_copy(update=update)
        async with AsyncExitStack() as stack:
            self._running = await stack.enter_async_context(running_server(own, self.make, listen=Ingress))
            self._stack = stack.pop_all()
        self._reporter = Reporter(self._running.engine.queue)
        self._failing = asyncio.ensure_future(self._end_when_broken())

    async def _end_when_broken(self) -> None:
        """Ends the process, which Serve notices at once, rather than wait for its health checks."""
        await asyncio.wait({self._running.failed})
        await exit_failed()

    async def check_health(self) -> None:
        """Serve asks this; raising makes it replace the replica."""
        if not self._running.engine.queue.is_alive_within(HEARTBEAT_LIMIT_S):
            raise RuntimeError("the queue has shown no life for a while")

    async def record_autoscaling_stats(self) -> dict[str, float]:
        """What `scaling` decides by; Serve asks once in `metrics_interval_s`."""
        return self._reporter.report()

    async def __del__(self) -> None:
        """Serve calls this when the gRPC server has been stopped and all calls are answered."""
        self._failing.cancel()
        await self._stack.aclose()


def claim_metrics_port(settings: Settings) -> tuple[int, socket.socket | None]:
    """The first port from `metrics_port` on that nobody has, and what keeps it from other replicas until it is closed.

    A socket without a file is claimed, since several replicas may look at a moment when none of them listens yet.
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
