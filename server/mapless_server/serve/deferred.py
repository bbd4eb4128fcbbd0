"""Networks that are made when they are needed first, in the thread that needs them: torch takes seconds to load.

They are named before, by the digest of their weights. NetworkNotLoaded where they cannot be loaded, or the weights are
not those that are named.
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
from mapless_server.engine.failures import failure_of
from mapless_server.errors import NetworkNotLoaded
from mapless_server.method.features.extractors import FeatureExtractor
from mapless_server.method.features.matching import PairMatching
from mapless_server.method.features.views import Ignored, Matches, View
from mapless_server.scheduling import Failure

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

    An error is raised to all of them, and to each that asks within `FAILED_S`. Memory that does not suffice is not
    remembered: others may free it at any time.
    """

    def __init__(self, name: str, make: Callable[[], T]) -> None:
        self.name = name
        self._make = make
        self._making: Future[T] | None = None
        self._failed_s = -math.inf
        self._lock = Lock()

    def made(self) -> T:
        """The value.

        NetworkNotLoaded with the reason if it cannot be made, or has another name; MemoryError if memory, also that of
        the device, does not suffice.
        """
        with self._lock:
            making = self._making
            if making is None or (making.done() and making.exception() and not self._rest_s()):
                mine = self._making = Future[T]()
            else:
                mine = None
        if mine is None:
            assert making is not None
            return self._value(making)
        try:
            mine.set_result(self._made())
        except Exception as error:
            if failure_of(error) is not Failure.OUT_OF_MEMORY:
                self._failed_s = time.monotonic()
                log.warning("%s cannot be loaded, and is tried again after %.0f s: %s", self.name, FAILED_S, error)
            mine.set_exception(error)
        except BaseException as error:  # the thread ends; those that wait would wait for ever
            mine.set_exception(error)
            raise
        return self._value(mine)

    def _rest_s(self) -> float:
        """Seconds until it is tried again after a failure."""
        return max(0.0, self._failed_s + FAILED_S - time.monotonic())

    def _made(self) -> T:
        made = self._make()
        if made.name != self.name:
            raise RuntimeError(f"the weights of {self.name} have changed since the start: they are {made.name}")
        return made

    def _value(self, making: Future[T]) -> T:
        # A new error for each thread: a traceback that they share would grow, and keep what they compute with.
        if (error := making.exception()) is None:
            return making.result()
        message = f"{self.name} cannot be loaded: {error or type(error).__name__}"
        if failure_of(error) is Failure.OUT_OF_MEMORY:
            raise MemoryError(message) from error
        raise NetworkNotLoaded(message, self._rest_s()) from error


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
