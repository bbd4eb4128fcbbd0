"""Replicas that compute nothing, to measure the cost of serving."""

from typing import Any

from ray.serve import Application

from bench.load.no_op import make_no_op_engine
from mapless_ray.app import deployed
from mapless_ray.replica import MaplessReplica


class NoOpReplica(MaplessReplica):
    """A replica with another engine."""

    make = staticmethod(make_no_op_engine)


def build(settings: dict[str, Any]) -> Application:
    """Makes the application, as `mapless_ray.app.build` does."""
    return deployed(NoOpReplica, {"warm_up": False, **settings})
