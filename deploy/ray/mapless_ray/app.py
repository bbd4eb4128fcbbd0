"""The application that a Serve config names: `import_path: mapless_ray.app:build`."""

from __future__ import annotations

from typing import Any

from ray import serve
from ray.serve import Application

from .replica import MaplessReplica

REPLICA_ENVIRONMENT = {
    # The replica lives in the event loop in which its gRPC server calls it.
    "RAY_SERVE_RUN_USER_CODE_IN_SEPARATE_THREAD": "0",
}

DRAIN_GRACE_S = 60.0
"""For calls that run when a replica is to go, beyond the time in which load balancers forget it."""


def build(settings: dict[str, Any]) -> Application:
    """One deployment; how many replicas it has and what device each gets, the config's `deployments` says.

    Args:
        settings: the config's `args`: settings of mapless by name. Secrets belong into the environment instead.
    """
    deployment = serve.deployment(
        name="mapless",
        ray_actor_options={"runtime_env": {"env_vars": REPLICA_ENVIRONMENT}},
        graceful_shutdown_timeout_s=DRAIN_GRACE_S,
        health_check_period_s=2.0,
        health_check_timeout_s=10.0,
    )(MaplessReplica)
    return deployment.bind(settings)
