"""Further features in the background: in order, once, also after a restart."""

import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import text
from support.images import encode, textured
from support.servers import CAMERA, StandInDescriptor, StandInExtractor, pose
from support.stores import damage

from mapless_server.errors import NetworkNotLoaded
from mapless_server.method.features.extractors import FeatureExtractor
from mapless_server.method.features.matching import CorrespondOptions
from mapless_server.method.features.views import View
from mapless_server.method.pairs.correspond import Matcher
from mapless_server.method.pairs.pair import Matching
from mapless_server.scenes.background import BackgroundMatching, SceneWork
from mapless_server.scenes.indexes import SceneIndexes
from mapless_server.scenes.later import LaterFeatures, Pending, in_order
from mapless_server.scenes.library import ReferenceLibrary
from mapless_server.scenes.observer import BackgroundObserver
from mapless_server.scenes.stored import PairFinder, TierMatching
from mapless_server.security import SceneKey
from mapless_server.store import NewReference, Store
from mapless_server.store.pairs import PairStore

SCENE = SceneKey("s")
FIRST, LATER = StandInExtractor("first"), "later"
VECTORS = StandInDescriptor("of first"), StandInDescriptor("of later")
IMAGES = [textured(seed=i) for i in range(3)]


def new(i: int) -> NewReference:
    views = {FIRST.name: FIRST.extract(IMAGES[i], CAMERA)}
    return NewReference(
        f"r{i}", encode(".png", IMAGES[i]), CAMERA, pose(float(i)), views, {VECTORS[0].name: np.eye(16, dtype="f4")[i]}
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    with Store.open(tmp_path) as store:
        store.create_scene(SCENE)
        store.add_references(SCENE, [new(i) for i in range(3)])
    return tmp_path


@pytest.fixture
def store(folder: Path) -> Iterator[Store]:
    with Store.open(folder) as store:
        yield store


def background_of(store: Store, extractor: FeatureExtractor) -> BackgroundMatching:
    library = ReferenceLibrary(store)
    first, later = (
        SceneIndexes(store, library, vectors, it, 2**20)
        for vectors, it in zip(VECTORS, (FIRST, extractor), strict=True)
    )
    finder = PairFinder(PairStore(store.database), FIRST.name, BackgroundObserver())
    matchings = {TierMatching(FIRST, Matcher(CorrespondOptions()), Matching.STRICT): finder}
    work = SceneWork(features=[LaterFeatures(extractor, later)])
    return BackgroundMatching(store, first, matchings, lambda: True, BackgroundObserver(), work)


@dataclass
class Ended(StandInExtractor):
    """Ends the background, as a server that is killed does, after so many references."""

    left: int = 2

    def extract(self, *arguments: Any) -> View:
        if self.left == 0:
            raise SystemExit
        self.left -= 1
        return super().extract(*arguments)


def test_features_go_on_after_the_server_was_killed(folder: Path) -> None:
    killed, again = Ended(LATER), StandInExtractor(LATER)
    with Store.open(folder) as store, pytest.raises(SystemExit):
        background_of(store, killed).match_waiting()
    with Store.open(folder) as store:
        # The claim of the one that was killed ends by itself.
        with store.database.write() as connection:
            connection.execute(text("UPDATE reference_matching SET due_time_us = 0 WHERE due_time_us IS NOT NULL"))
        background_of(store, again).match_waiting()
        records = store.load_references(SCENE, None, LATER)
        assert not records.undescribed
        assert len(store.load_descriptors([it.record.key for it in records.references], VECTORS[1].name)) == 3
    assert (len(killed.seen), len(again.seen)) == (2, 1)


def test_what_is_left_is_named_until_nothing_is(store: Store) -> None:
    damage(store, SCENE, "r1", "image")
    background = background_of(store, StandInExtractor(LATER))
    assert background.pending(SCENE) == [], "nothing is made before it is started"
    background._thread, background._makes_pairs = threading.Thread(), True
    assert background.pending(SCENE) == [Pending("matches", "first (nearest)", 3), Pending("features", LATER, 3)]
    background.match_waiting()
    assert background.pending(SCENE) == [], "the damaged one is not waited for"


class NotThere(StandInExtractor):
    def extract(self, *arguments: Any) -> View:
        super().extract(*arguments)
        raise NetworkNotLoaded("later cannot be loaded: no file", 300.0)


def test_a_network_that_is_not_loaded_is_asked_once(store: Store, caplog: pytest.LogCaptureFixture) -> None:
    extractor = NotThere(LATER)
    background = background_of(store, extractor)
    background._thread, background._makes_pairs = threading.Thread(), True
    for _ in range(3):
        background.match_waiting()
    assert (len(extractor.seen), caplog.text.count("cannot be loaded"), caplog.text.count("Traceback")) == (1, 1, 0)
    assert background.pending(SCENE) == [Pending("features", LATER, 3)]
    background._rests_until_s.clear()  # the time has passed
    background.match_waiting()
    assert len(extractor.seen) == 2


def test_an_unexpected_failure_is_still_waited_for(store: Store) -> None:
    class Fails(StandInExtractor):
        def extract(self, *arguments: Any) -> View:
            raise ValueError("a fault")

    background = background_of(store, Fails(LATER))
    background._thread, background._makes_pairs = threading.Thread(), True
    background.match_waiting()
    assert background.pending(SCENE) == [Pending("features", LATER, 3)]


def test_matches_of_first_features_precede_later_ones() -> None:
    first, later = (TierMatching(StandInExtractor(it), Matcher(), Matching.STRICT) for it in ("first", "later"))
    wide = TierMatching(first.extractor, first.matcher, Matching.WIDE)
    own, strong = LaterFeatures(StandInExtractor("any roll"), object()), LaterFeatures(later.extractor)  # type: ignore[arg-type]
    urgent, others = in_order([first, wide, later], [strong, own])
    assert urgent == [first, own, strong, wide]
    assert others == [later]
