"""The application that a Serve config names: `import_path: mapless_ray.app:build`."""

from typing import Any

from ray import serve
from ray.serve import Application

from .replica import MaplessReplica

DRAIN_GRACE_S = 60.0
"""Time for the running calls of a replica that ends, after load balancers have removed it."""


def build(settings: dict[str, Any]) -> Application:
    """Makes the application of one deployment; the config's `deployments` sets the replicas and their devices.

    The config's `args` are settings of mapless by name. Secrets belong into the environment instead.
    """
    return deployed(MaplessReplica, settings)


def deployed(replica: type[MaplessReplica], settings: dict[str, Any]) -> Application:
    """The application with replicas of a class."""
    deployment = serve.deployment(
        name="mapless",
        graceful_shutdown_timeout_s=DRAIN_GRACE_S,
        health_check_period_s=2.0,
        health_check_timeout_s=10.0,
    )(replica)
    return deployment.bind(settings)
