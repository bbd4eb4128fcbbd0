"""Networks that are made when they are needed first, in the thread that needs them: torch takes seconds to load.

They are named before, by the digest of their weights. RuntimeError where the weights are not those that are named.
"""

from collections.abc import Callable
from threading import Lock
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Camera
from mapless_server.method.features.extractors import FeatureExtractor
from mapless_server.method.features.matching import PairMatching
from mapless_server.method.features.views import Ignored, Matches, View


class Named(Protocol):
    """A value with a name."""

    @property
    def name(self) -> str:
        """Names everything that determines the results."""
        ...


T = TypeVar("T", bound=Named)


class Deferred(Generic[T]):
    """Made once, by the first thread that asks; an error is raised to each that asks."""

    def __init__(self, name: str, make: Callable[[], T]) -> None:
        self.name = name
        self._make = make
        self._made: T | None = None
        self._lock = Lock()

    def made(self) -> T:
        """The value; whatever making it raises, and RuntimeError if it has another name."""
        with self._lock:
            if self._made is None:
                made = self._make()
                if made.name != self.name:
                    raise RuntimeError(f"the weights of {self.name} have changed since the start: they are {made.name}")
                self._made = made
            return self._made


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
