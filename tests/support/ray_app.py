"""Replicas for tests: everything is real except the features and the method.

How the method behaves is in the position of the query's first reference: x is how long it takes, seconds; y is how it
ends, see `FAILS`. Which process answered is what it claims for inliers.
"""

import os
import threading
import time
from typing import Any, cast

import numpy as np
from ray.serve import Application

from mapless.geometry import Similarity
from mapless_ray.app import deployed
from mapless_ray.replica import MaplessReplica
from mapless_server.engine.query import Tier
from mapless_server.engine.queue_engine import QueueEngine
from mapless_server.method.bundle.estimate import PoseStage
from mapless_server.method.judge.answer import Answer, Localization
from mapless_server.method.pipeline import Pipeline
from mapless_server.method.structure.model import MetricScale, ScaleStage
from mapless_server.observability.metrics import Metrics
from mapless_server.security import RateLimiter
from mapless_server.serve.assembly import Parts, engine_options, engine_over
from mapless_server.settings import Settings
from mapless_server.store import Store
from support.servers import COVARIANCE, StandInDescriptor, StandInExtractor, StandInReconstructor, pose, whole

FAILS, HANGS, ENDS = -1.0, -2.0, -3.0
"""With an exception; never; and the process with it."""
SECRET = "the password is swordfish"


def localize(*arguments: Any) -> Answer:
    _, references, _, _, check = arguments
    x_s, how, _ = references[0].world_from_camera.translation
    end_s = time.monotonic() + max(x_s, 0.0)
    while time.monotonic() < end_s:
        time.sleep(0.01)
        check()
    if how == FAILS:
        raise RuntimeError(SECRET)
    if how == HANGS:
        threading.Event().wait()
    if how == ENDS:
        os.kill(os.getpid(), 9)
    process = os.getpid()
    found = Localization(references[0].world_from_camera, COVARIANCE, PoseStage.REFINED, process, process, 0.7)
    scale = MetricScale(2.0, ScaleStage.TRIANGULATION, 0.01, 0, Similarity(2.0, np.eye(3), np.zeros(3)), pose(0.0))
    counts = tuple(range(len(references)))
    return Answer(found, scale, {"coarse": 0.1, "pnp": 0.05}, counts, counts)


def make(settings: Settings, store: Store, metrics: Metrics, quota: RateLimiter | None) -> QueueEngine:
    tiers = [Tier(StandInExtractor(), Pipeline(cast(Any, StandInReconstructor())))]
    return engine_over(
        store, tiers, engine_options(settings), Parts(metrics, quota, whole(localize), StandInDescriptor())
    )


class StandInReplica(MaplessReplica):
    make = staticmethod(make)


def build(settings: dict[str, Any]) -> Application:
    return deployed(StandInReplica, {"warm_up": False, **settings})
