"""The parts a server needs before it listens: the store, and who makes the engine. Nothing here imports what computes.

Imports take most of the time of a start: numpy, SQLAlchemy, gRPC and messages 0.4 s, scipy and the method 0.3 s. What
computes is imported, and its weights loaded, by `make_engine` in a thread; calls that need the store are answered.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from mapless_server.observability.metrics import Metrics
from mapless_server.scenes.observer import BackgroundObserver
from mapless_server.security import RateLimiter
from mapless_server.settings import Settings
from mapless_server.store import Store, StoreError

from .startup import StartupError

if TYPE_CHECKING:
    from mapless_server.engine.queue_engine import QueueEngine

    from .adoption.adopter import Adopter

log = logging.getLogger(__name__)

MakeEngine = Callable[[Settings, Store, Metrics, "RateLimiter | None"], "QueueEngine"]
MakeAdopter = Callable[["QueueEngine", Store, BackgroundObserver, float], "Adopter"]
"""Makes what considers photographs as references, which keeps these for so many hours."""


def open_store(settings: Settings) -> Store:
    """Opens the store of the settings' database or data folder; StartupError if it cannot be opened."""
    cache_bytes = settings.reference_cache_mib * 2**20
    try:
        if settings.database_url is not None:
            return Store.connect(settings.database_url.get_secret_value(), cache_bytes)
        return Store.open(settings.data_dir, cache_bytes)
    except StoreError as error:
        raise StartupError(str(error)) from error


def make_engine(settings: Settings, store: Store, metrics: Metrics, quota: RateLimiter | None) -> QueueEngine:
    """Makes the engine of the settings as `assembly.make_engine`, which it imports; logs what either took."""
    begin_s = time.monotonic()
    from . import assembly

    imported_s = time.monotonic()
    engine = assembly.make_engine(settings, store, metrics, quota)
    words = "what computes was imported in %.2f s; features and weights were loaded in %.2f s"
    log.info(words, imported_s - begin_s, time.monotonic() - imported_s)
    return engine


def make_adopter(engine: QueueEngine, store: Store, observer: BackgroundObserver, hours: float) -> Adopter:
    """Makes an adopter that goes by the clock of this machine; what it imports is loaded with the engine."""
    from .adoption.adopter import Adopter

    return Adopter(engine, store, observer, hours)
