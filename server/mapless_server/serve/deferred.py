"""Networks that are made when they are needed first, in the thread that needs them: torch takes seconds to load.

They are named before, by the digest of their weights. RuntimeError where they cannot be loaded, or the weights are not
those that are named.
"""

import logging
import math
import time
from collections.abc import Callable
from concurrent.futures import Future
from threading import Lock
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Camera
from mapless_server.method.features.extractors import FeatureExtractor
from mapless_server.method.features.matching import PairMatching
from mapless_server.method.features.views import Ignored, Matches, View

log = logging.getLogger(__name__)


class Named(Protocol):
    """A value with a name."""

    @property
    def name(self) -> str:
        """Names everything that determines the results."""
        ...


T = TypeVar("T", bound=Named)


FAILED_S = 300.0
"""A value that could not be made is made again only after so long: until then its error is raised at once."""


class Deferred(Generic[T]):
    """Made once, by the first thread that asks; those that ask meanwhile wait for it.

    An error is raised to all of them, and to each that asks within `FAILED_S`.
    """

    def __init__(self, name: str, make: Callable[[], T]) -> None:
        self.name = name
        self._make = make
        self._making: Future[T] | None = None
        self._failed_s = -math.inf
        self._lock = Lock()

    def made(self) -> T:
        """The value; RuntimeError with the reason if it cannot be made, or has another name."""
        with self._lock:
            making = self._making
            if making is None or (making.done() and making.exception() and self._has_rested()):
                mine = self._making = Future[T]()
            else:
                mine = None
        if mine is None:
            assert making is not None
            return self._value(making)
        try:
            mine.set_result(self._made())
        except BaseException as error:  # else those that wait would wait for ever
            self._failed_s = time.monotonic()
            log.warning("%s cannot be loaded, and is tried again after %.0f s: %s", self.name, FAILED_S, error)
            mine.set_exception(error)
        return self._value(mine)

    def _has_rested(self) -> bool:
        return time.monotonic() >= self._failed_s + FAILED_S

    def _made(self) -> T:
        made = self._make()
        if made.name != self.name:
            raise RuntimeError(f"the weights of {self.name} have changed since the start: they are {made.name}")
        return made

    def _value(self, making: Future[T]) -> T:
        # A new error for each thread: a traceback that they share would grow, and keep what they compute with.
        if (error := making.exception()) is not None:
            raise RuntimeError(f"{self.name} cannot be loaded: {error}") from error
        return making.result()


class DeferredExtractor(Deferred[FeatureExtractor]):
    """A `FeatureExtractor`."""

    def extract(self, image: NDArray[np.uint8], camera: Camera, ignored: Ignored | None = None) -> View:
        """See FeatureExtractor.extract."""
        return self.made().extract(image, camera, ignored)


class DeferredPairMatching(Deferred[PairMatching]):
    """A `PairMatching`."""

    def match_one(self, first: View, second: View, pause: Callable[[], None] = lambda: None) -> Matches:
        """See PairMatching.match_one."""
        return self.made().match_one(first, second, pause)
