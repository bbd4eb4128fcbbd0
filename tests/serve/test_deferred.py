"""Networks that are made when they are needed first: once, by their name."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from threading import Barrier
from time import sleep

import numpy as np
import pytest
from support.scenes import CAMERA, make_scene, random_for

from mapless.geometry import Camera
from mapless_server.engine.failures import failure_of
from mapless_server.errors import NetworkNotLoaded
from mapless_server.method.features.views import Features, Matches, View
from mapless_server.scheduling import Failure
from mapless_server.serve import deferred
from mapless_server.serve.deferred import DeferredExtractor, DeferredPairMatching

VIEW = View(CAMERA, Features(np.zeros((0, 2), np.float32), np.zeros((0, 64), np.float32), np.zeros(0, np.float32)))


@dataclass
class Finds:
    name: str = "finds-1"

    def extract(self, image: object, camera: Camera, ignored: object = None) -> View:
        return VIEW


@dataclass
class Pairs:
    name: str = "pairs-1"

    def match_one(self, first: View, second: View, pause: Callable[[], None] = lambda: None) -> Matches:
        return np.array([[len(first.features), len(second.features)]], np.int32)


def test_threads_that_ask_together_make_it_once() -> None:
    made: list[str] = []

    def make() -> Finds:
        sleep(0.05)
        made.append("once")
        return Finds()

    extractor = DeferredExtractor("finds-1", make)
    assert (extractor.name, made) == ("finds-1", [])
    with ThreadPoolExecutor(4) as pool:
        views = list(pool.map(lambda _: extractor.extract(np.zeros((4, 4, 3), np.uint8), CAMERA), range(8)))
    assert all(it is VIEW for it in views)
    assert made == ["once"]


def test_weights_that_changed_since_the_start_are_named() -> None:
    with pytest.raises(RuntimeError, match="the weights of finds-2 have changed since the start: they are finds-1"):
        DeferredExtractor("finds-2", Finds).made()


def test_a_failure_is_remembered_for_a_time_then_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    failures = [OSError("no file")]

    def make() -> Pairs:
        if failures:
            raise failures.pop()
        return Pairs()

    matching = DeferredPairMatching("pairs-1", make)
    scene = make_scene(random_for("deferred"))
    for _ in range(3):
        with pytest.raises(RuntimeError, match="pairs-1 cannot be loaded: no file"):
            matching.match_one(scene.query, VIEW)
    monkeypatch.setattr(deferred, "FAILED_S", 0.0)
    assert matching.match_one(scene.query, VIEW).tolist() == [[len(scene.query.features), 0]]


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("CUDA out of memory. Tried to allocate 20.00 MiB")])
def test_too_little_memory_is_said_and_not_remembered(error: Exception) -> None:
    failures = [error]

    def make() -> Finds:
        if failures:
            raise failures.pop()
        return Finds()

    extractor = DeferredExtractor("finds-1", make)
    with pytest.raises(MemoryError, match="finds-1 cannot be loaded") as failed:
        extractor.made()
    assert failure_of(failed.value) is Failure.OUT_OF_MEMORY
    assert extractor.made().name == "finds-1"


@pytest.mark.parametrize("end", [SystemExit, KeyboardInterrupt])
def test_the_end_of_a_thread_stays_one(end: type[BaseException]) -> None:
    ends = [end()]

    def make() -> Finds:
        if ends:
            raise ends.pop()
        return Finds()

    extractor = DeferredExtractor("finds-1", make)
    with pytest.raises(end):
        extractor.made()
    assert extractor.made().name == "finds-1"


def test_a_failure_says_how_long_it_lasts() -> None:
    extractor = DeferredExtractor("finds-2", Finds)
    for _ in range(2):
        with pytest.raises(NetworkNotLoaded) as failed:
            extractor.made()
        assert deferred.FAILED_S - 60 < failed.value.retry_after_s <= deferred.FAILED_S


def test_threads_that_wait_for_a_failure_get_it_together() -> None:
    begun, made = Barrier(4, timeout=20), list[str]()

    def make() -> Finds:
        made.append("once")
        sleep(0.1)
        raise OSError("no file")

    def ask(extractor: DeferredExtractor) -> str:
        begun.wait()
        with pytest.raises(RuntimeError, match="no file") as failed:
            extractor.made()
        return str(failed.value)

    with ThreadPoolExecutor(4) as pool:
        assert len(set(pool.map(ask, [DeferredExtractor("finds-1", make)] * 4))) == 1
    assert made == ["once"]
