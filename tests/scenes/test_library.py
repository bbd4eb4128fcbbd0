"""References are loaded with the requested features, described once, and with photographs that are read when used."""

import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.images import encode, textured
from support.servers import CAMERA, StandInExtractor, pose
from support.stores import damage

from mapless.geometry import Camera
from mapless_server.errors import DataLoss, NotFound, RequestError
from mapless_server.images import ANY_SIZE, ImageLimits
from mapless_server.method.features.views import Ignored, View
from mapless_server.method.options import StageContext
from mapless_server.scenes.library import FeaturesMissing, Loaded, ReferenceLibrary, load_usable
from mapless_server.security import SceneKey
from mapless_server.store import NewReference, Store

SCENE = SceneKey("s")
IDS = [f"r{i}" for i in range(4)]
PIXELS = {it: textured(seed=i) for i, it in enumerate(IDS)}
OLD = StandInExtractor("old")


class CountingStore(Store):
    """Counts the photographs that are read."""

    images_read: int

    def read_image_of(self, key: str) -> bytes:
        self.images_read += 1
        return super().read_image_of(key)


class SlowExtractor(StandInExtractor):
    """Takes long enough for threads to meet."""

    def extract(self, *arguments: Any) -> Any:
        time.sleep(0.02)
        return super().extract(*arguments)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[CountingStore]:
    """Four references with features of the old extractor."""
    opened = Store.open(tmp_path)
    store = CountingStore(opened.database, opened.reference_cache)
    store.images_read = 0
    with store:
        store.create_scene(SCENE)
        news = [
            NewReference(it, encode(".png", PIXELS[it]), CAMERA, pose(i), {"old": OLD.extract(PIXELS[it], CAMERA)})
            for i, it in enumerate(IDS)
        ]
        store.add_references(SCENE, news)
        yield store


class Abandoned(Exception):
    """The result is not wanted any more."""


def context(seconds: float = 60.0, is_abandoned: Callable[[], bool] = lambda: False) -> StageContext:
    deadline_s = time.monotonic() + seconds

    def check() -> None:
        if is_abandoned() or time.monotonic() > deadline_s:
            raise Abandoned

    return StageContext(check)


class TestPhotographs:
    def test_are_read_on_first_use(self, store: CountingStore) -> None:
        scene, references = ReferenceLibrary(store).load(SCENE, IDS[::-1], OLD, context())
        assert scene.generation == store.get_scene(SCENE).generation
        assert [it.name for it in references] == [f"scenes/s/references/{it}" for it in IDS[::-1]]
        assert store.images_read == 0
        for count, (reference_id, reference) in enumerate(zip(IDS[::-1], references, strict=True), start=1):
            photograph = reference.view.photograph
            assert photograph is not None
            assert photograph.camera == CAMERA
            assert photograph.sha256 == store.get_reference(SCENE, reference_id).image_sha256
            np.testing.assert_array_equal(photograph.read(), PIXELS[reference_id])
            assert store.images_read == count

    def test_stay_those_of_the_reference_while_the_scene_changes(self, store: CountingStore) -> None:
        _, (kept, gone) = ReferenceLibrary(store).load(SCENE, ["r0", "r1"], OLD, context())
        assert kept.view.photograph is not None
        assert gone.view.photograph is not None
        store.delete_reference(SCENE, "r1")
        other = encode(".png", textured(seed=9))
        store.add_references(SCENE, [NewReference("r1", other, CAMERA, pose(1.0), {"old": gone.view})])
        np.testing.assert_array_equal(kept.view.photograph.read(), PIXELS["r0"])
        with pytest.raises(NotFound, match="deleted"):
            gone.view.photograph.read()

    def test_undecodable_references_are_data_loss_and_no_misuse(self, store: CountingStore) -> None:
        view = OLD.extract(PIXELS["r0"], CAMERA)
        store.add_references(SCENE, [NewReference("odd", b"no image", CAMERA, pose(0.0), {"old": view})])
        _, (reference,) = ReferenceLibrary(store).load(SCENE, ["odd"], OLD, context())
        assert reference.view.photograph is not None
        with pytest.raises(DataLoss, match="'odd'"):
            reference.view.photograph.read()

    def test_todays_limits_do_not_shut_out_what_was_let_in_before(self) -> None:
        assert ANY_SIZE.max_bytes >= 1024 * 2**20, "the largest message that can be set"
        assert ANY_SIZE.max_pixels >= 268_000_000, "the largest image that can be set"
        assert ANY_SIZE.max_side_px >= ImageLimits().max_side_px


class TestDescribing:
    def test_a_store_with_other_features_describes_references_once(self, store: CountingStore) -> None:
        """Whatever calls ask for, in whatever order, and however often."""
        new, generation = StandInExtractor("new"), store.get_scene(SCENE).generation
        expected = {it: new.extract(PIXELS[it], CAMERA).features.keypoints for it in IDS}
        new.seen.clear()
        for ids, described in ((["r2"], 1), (["r2", "r1"], 2), (IDS, 4), (IDS[::-1], 4)):
            library = ReferenceLibrary(store)  # what is known is in the store
            call = context()
            scene, references = library.load(SCENE, ids, new, call)
            assert scene.generation == generation == store.get_scene(SCENE).generation, (
                "features are no change of the scene"
            )
            assert [it.name.rpartition("/")[2] for it in references] == ids
            for reference_id, reference in zip(ids, references, strict=True):
                np.testing.assert_array_equal(reference.view.features.keypoints, expected[reference_id])
            assert len(new.seen) == store.images_read == described
        assert call.stage_seconds == {}, "nothing is described when everything is"
        assert "describe" not in call.stage_seconds

    def test_one_damaged_photograph_does_not_delay_the_others(
        self, store: CountingStore, caplog: pytest.LogCaptureFixture
    ) -> None:
        class Picky(StandInExtractor):
            def extract(self, image: NDArray[np.uint8], camera: Camera, ignored: Ignored | None = None) -> View:
                if np.array_equal(image, PIXELS["r1"]):
                    raise ValueError("not this one")
                return super().extract(image, camera, ignored)

        new, library = Picky("new"), ReferenceLibrary(store)
        for _ in range(3):
            with pytest.raises(FeaturesMissing):
                library.load(SCENE, IDS, new, StageContext(make_until_s=-math.inf))
        others = [it for it in IDS if it != "r1"]
        for _ in range(500):
            with suppress(FeaturesMissing):
                library.load(SCENE, others, new, StageContext(make_until_s=-math.inf))
                break
            time.sleep(0.01)
        library.close()
        assert len(new.seen) == len(others)
        assert caplog.text.count("not this one") == 1

    def test_threads_share_the_work_and_do_nothing_twice(self, store: CountingStore) -> None:
        new, library = SlowExtractor("new"), ReferenceLibrary(store)
        together = threading.Barrier(6, timeout=20)

        def load(order: int) -> list[str]:
            together.wait()
            _, references = library.load(SCENE, IDS[::order], new, context())
            return sorted(it.name for it in references)

        with ThreadPoolExecutor(6) as pool:
            assert len({tuple(names) for names in pool.map(load, [1, -1] * 3)}) == 1
        assert len(new.seen) == len(IDS)

    def test_after_an_error_a_waiting_thread_takes_over(self, store: CountingStore) -> None:
        """The first thread to describe r0 fails; the other one, which waited for it, does it."""
        library, entered, fail = ReferenceLibrary(store), threading.Event(), threading.Event()

        class Failing(StandInExtractor):
            def extract(self, *arguments: Any) -> Any:
                entered.set()
                assert fail.wait(20)
                raise MemoryError("planted")

        with ThreadPoolExecutor(2) as pool:
            failing = pool.submit(library.load, SCENE, ["r0"], Failing("new"), context())
            assert entered.wait(20)
            good = StandInExtractor("new")
            waiting = pool.submit(library.load, SCENE, ["r0"], good, context())
            with pytest.raises(Abandoned):
                library.load(SCENE, ["r0"], good, context(0.05))
            assert not good.seen
            fail.set()
            with pytest.raises(MemoryError):
                failing.result(20)
            assert len(waiting.result(20)[1]) == len(good.seen) == 1

    def test_a_deadline_between_two_keeps_what_is_done(self, store: CountingStore) -> None:
        new, library = StandInExtractor("new"), ReferenceLibrary(store)
        begun = threading.Event()

        class Abandoning(StandInExtractor):
            def extract(self, *arguments: Any) -> Any:
                begun.set()
                return super().extract(*arguments)

        with pytest.raises(Abandoned):
            library.load(SCENE, IDS, Abandoning("new"), context(is_abandoned=begun.is_set))
        assert len(store.load_references(SCENE, IDS, "new").references) == 1
        library.load(SCENE, IDS, new, context())
        assert len(new.seen) == len(IDS) - 1

    def test_a_reference_that_goes_meanwhile_is_not_found(self, store: CountingStore) -> None:
        class Deleting(StandInExtractor):
            def extract(self, *arguments: Any) -> Any:
                store.delete_reference(SCENE, "r0")
                return super().extract(*arguments)

        with pytest.raises(NotFound):
            ReferenceLibrary(store).load(SCENE, IDS, Deleting("new"), context())


class TestUsable:
    """Those that cannot be loaded are omitted; unexpected errors are raised."""

    def load(
        self, store: CountingStore, ids: list[str], unusable: tuple[type[RequestError], ...], scene: SceneKey = SCENE
    ) -> tuple[list[str], list[str]]:
        library, omitted = ReferenceLibrary(store), list[str]()

        def load(reference_ids: Sequence[str]) -> Loaded:
            return library.load(scene, reference_ids, OLD, context())

        _, references = load_usable(load, ids, unusable, lambda reference_id, _: omitted.append(reference_id))
        return [it.name.rpartition("/")[2] for it in references], omitted

    def test_damaged_and_deleted_ones_are_skipped_and_reported(self, store: CountingStore) -> None:
        damage(store, SCENE, "r1", "features")
        store.delete_reference(SCENE, "r2")
        assert self.load(store, IDS[::-1], (DataLoss, NotFound)) == (["r3", "r0"], ["r2", "r1"])
        with pytest.raises(NotFound):
            self.load(store, IDS, (DataLoss,))
        with pytest.raises(DataLoss):
            self.load(store, IDS, (NotFound,))

    def test_a_scene_that_is_not_there_is_an_error(self, store: CountingStore) -> None:
        with pytest.raises(NotFound) as caught:
            self.load(store, IDS, (DataLoss, NotFound), SceneKey("nowhere"))
        assert caught.value.field == "scene"
