"""Stored references as the pipeline needs them: with the requested features, and with photographs that load lazily.

The first features are computed when a reference is added, the others in the background. A call that needs what a
reference lacks computes it from the stored photograph, and stores it.
"""

import logging
import threading
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from mapless.names import reference_name
from mapless_server.cache import LruCache
from mapless_server.errors import AlreadyExists, DataLoss, InvalidArgument, RequestError, Unavailable
from mapless_server.images import ANY_SIZE, decode_image, decode_mask, upright_of
from mapless_server.images.exif import Exif, read_exif
from mapless_server.method.features.extractors import FeatureExtractor
from mapless_server.method.features.extractors.turned import extract_upright
from mapless_server.method.features.views import Ignored, Photograph, PosedView, View
from mapless_server.method.options import StageContext
from mapless_server.security import SceneKey
from mapless_server.store import DescribedReference, ReferenceRecord, SceneState, Store
from mapless_server.store.records import SceneSnapshot

from .measured import MeasuredDepths
from .stored import DepthFinder

log = logging.getLogger(__name__)

_POLL_S = 0.05
_LONGEST_WAIT_S = 5.0
_REMEMBERED_EXIFS = 20_000
"""Number of references whose EXIF is kept in memory, half a KB each."""

Loaded = tuple[SceneState, tuple[PosedView, ...]]
"""A scene and references of it, read at one moment."""


class FeaturesMissing(Exception):
    """References lack the requested features, and the caller has no time to make them; with their ids."""

    def __init__(self, reference_ids: Collection[str] = ()) -> None:
        super().__init__(f"{len(reference_ids)} references have no such features yet")
        self.reference_ids = frozenset(reference_ids)


class Closed(Exception):
    """The server is being closed, so work in the background ends."""


class KeyedLocks:
    """A lock for each key in use, so that two threads do not compute the same thing."""

    def __init__(self) -> None:
        self._locked: set[tuple[str, str]] = set()
        self._changed = threading.Condition()

    @contextmanager
    def try_lock(self, key: tuple[str, str]) -> Iterator[bool]:
        """Locks a key during the block; False if another thread has it."""
        with self._changed:
            is_mine = key not in self._locked
            self._locked.add(key)
        try:
            yield is_mine
        finally:
            if is_mine:
                with self._changed:
                    self._locked.remove(key)
                    self._changed.notify_all()

    def wait(self, key: tuple[str, str], check: Callable[[], None]) -> None:
        """Returns when the key is not locked; calls `check` repeatedly, which may raise."""
        with self._changed:
            while key in self._locked:
                check()
                self._changed.wait(_POLL_S)


class ReferenceLibrary:
    """Loads references from the store; thread-safe.

    Attributes:
        locks: of what threads are computing, by the reference's key and the name of the extractor or descriptor.
        is_idle: whether the server computes nothing for a caller; what is described in the background waits for it.
    """

    def __init__(self, store: Store, depths: DepthFinder | None = None, locks: KeyedLocks | None = None) -> None:
        """`depths` adds stored depths to references; None adds none. The locks may be those of another library."""
        self._store = store
        self._depths = depths
        self._measured = MeasuredDepths(store)
        self.locks = locks or KeyedLocks()
        self.is_idle: Callable[[], bool] = lambda: True
        self._exifs: LruCache[Exif] = LruCache(_REMEMBERED_EXIFS)
        self._background = ThreadPoolExecutor(1, "describe")
        self._scheduled: set[tuple[str, str]] = set()
        self._scheduling = threading.Lock()
        self._closing = threading.Event()

    def close(self) -> None:
        """Ends the background work after its current reference."""
        self._closing.set()
        self._background.shutdown(wait=True, cancel_futures=True)

    def load(
        self,
        scene_key: SceneKey,
        reference_ids: Sequence[str],
        extractor: FeatureExtractor,
        context: StageContext,
    ) -> Loaded:
        """Loads references of a scene, in the order given, with the scene as it was when they were read.

        References without features of the extractor are described now, one by one, as long as the context has time for
        it, and finished ones are kept if it is cancelled; the others are described in the background, and
        FeaturesMissing is raised. Photographs are read when their pixels are first used. NotFound if there is no such
        scene (field "scene") or reference (field "references[i]"); Abandoned if the context is cancelled; DataLoss if
        stored data of one of them are damaged.
        """
        while True:
            snapshot = self._store.load_references(scene_key, reference_ids, extractor.name)
            if not snapshot.undescribed:
                views = tuple(map(self.posed_view, snapshot.references))
                if self._depths is not None:
                    views = self._depths.with_depths(views, extractor.name)
                return snapshot.scene, self._with_measured_depths(snapshot, views, extractor.name)
            _log_describing(snapshot.undescribed, extractor)
            with context.stage("describe"):
                left = self._describe_all(snapshot.undescribed, extractor, context)
            if left:
                self._describe_later(left, extractor)
                raise FeaturesMissing([it.reference_id for it in left])

    def _with_measured_depths(
        self, snapshot: SceneSnapshot, views: tuple[PosedView, ...], extractor: str
    ) -> tuple[PosedView, ...]:
        """The references with the depths that were measured with them, in place of others."""
        if not any(it.record.depth_sha256 for it in snapshot.references):
            return views
        both = zip(snapshot.references, views, strict=True)
        return tuple(
            self._measured.with_depth(it.record, view, extractor, lambda: not snapshot.scene.attributes.arbitrary_unit)
            for it, view in both
        )

    def _describe_later(self, records: Sequence[ReferenceRecord], extractor: FeatureExtractor) -> None:
        with self._scheduling:
            new = [record for record in records if (record.key, extractor.name) not in self._scheduled]
            self._scheduled |= {(record.key, extractor.name) for record in new}
        if new:
            _log_describing(new, extractor)
        for record in new:
            describe = partial(self._describe_scheduled, record, extractor)
            self.later(record.scene_key, record.reference_id, describe)

    def _describe_scheduled(self, record: ReferenceRecord, extractor: FeatureExtractor) -> None:
        """Describes one reference; one that is damaged is not tried again, one that the store did not take now is."""
        try:
            self._wait_for_callers()
            self._describe_all([record], extractor, StageContext())
        except Unavailable:
            with self._scheduling:
                self._scheduled.discard((record.key, extractor.name))
            raise

    def later(self, scene_key: SceneKey, reference_id: str, describe: Callable[[], None]) -> None:
        """Describes a reference in the background, after what is to be described already."""
        self._background.submit(self._in_background, scene_key, reference_id, describe)

    def _wait_for_callers(self) -> None:
        """Waits until the server computes nothing for callers, but not for long, so that it goes on if it is busy."""
        until_s = time.monotonic() + _LONGEST_WAIT_S
        while not self.is_idle() and time.monotonic() < until_s:
            if self._closing.wait(_POLL_S):
                raise Closed

    def _in_background(self, scene_key: SceneKey, reference_id: str, describe: Callable[[], None]) -> None:
        if self._closing.is_set():
            return
        try:
            describe()
        except Closed:
            pass
        except Exception as error:  # a damaged or deleted reference must not keep the others from being described
            log.warning("reference %s of scene %s is not described: %s", reference_id, scene_key, error)

    def _describe_all(
        self, records: Sequence[ReferenceRecord], extractor: FeatureExtractor, context: StageContext
    ) -> Sequence[ReferenceRecord]:
        """Describes references as long as there is time; returns those that are left.

        Waits for those that other threads are describing, whether they succeed or not.
        """
        elsewhere: list[ReferenceRecord] = []
        took_s = 0.0
        for i, record in enumerate(records):
            context.check()
            if not context.makes(took_s):
                for left in records[i:]:
                    context.lacks("features", extractor.name, left.key, is_made=False)
                return records[i:]
            begin_s = time.monotonic()
            with self.locks.try_lock((record.key, extractor.name)) as is_mine:
                if is_mine:
                    self._describe(record, extractor)
                    context.lacks("features", extractor.name, record.key, is_made=True)
                else:
                    elsewhere.append(record)
            took_s = time.monotonic() - begin_s
        for record in elsewhere:
            self.locks.wait((record.key, extractor.name), context.check)
        return ()

    def _describe(self, record: ReferenceRecord, extractor: FeatureExtractor) -> None:
        # Another thread may have finished between reading the store and taking the lock.
        if not self._store.has_features(record.key, extractor.name):
            with suppress(AlreadyExists):  # another server on the same store was faster
                self._store.add_features(record.key, extractor.name, self.extract(record, extractor))

    def extract(self, record: ReferenceRecord, extractor: FeatureExtractor) -> View:
        """Finds features in the stored photograph; NotFound if the reference was deleted, DataLoss if it is damaged."""
        data = self._store.read_image_of(record.key)
        pixels, ignored = self._decoded(record, data), self._ignored(record)
        return extract_upright(extractor, pixels, record.camera, upright_of(data).clockwise_deg, ignored=ignored)

    def posed_view(self, reference: DescribedReference) -> PosedView:
        """A stored reference as the pipeline needs it; its photograph is read when its pixels are first used."""
        record, view = reference.record, reference.view
        read = partial(self._pixels, record), partial(self._ignored, record), partial(self._exif, record)
        photograph = Photograph(lambda: record.image_sha256, record.camera, *read)
        return PosedView(
            record.key,
            reference_name(record.scene_id, record.reference_id),
            replace(view, photograph=photograph),
            record.world_from_camera,
            provenance=record.provenance,
        )

    def _exif(self, record: ReferenceRecord) -> Exif:
        """Reads the photograph's EXIF, once as long as it is remembered; NotFound if the reference was deleted."""
        known = self._exifs.get(record.key)
        if known is None:
            known = read_exif(self._store.read_image_of(record.key))
            self._exifs.put(record.key, known, 1)
        return known

    def _pixels(self, record: ReferenceRecord) -> NDArray[np.uint8]:
        """Reads the photograph, (H, W, 3) RGB; NotFound if the reference was deleted, DataLoss if it is damaged."""
        return self._decoded(record, self._store.read_image_of(record.key))

    def _decoded(self, record: ReferenceRecord, data: bytes) -> NDArray[np.uint8]:
        try:
            return decode_image(data, ANY_SIZE)
        except InvalidArgument as error:
            raise DataLoss(f"the photograph of reference {record.reference_id!r} cannot be read: {error}") from error

    def _ignored(self, record: ReferenceRecord) -> Ignored | None:
        """Reads the ignored pixels; None if all are used. Raises as `_pixels`."""
        if not record.mask_sha256:
            return None
        data = self._store.read_mask_of(record.key)
        try:
            return decode_mask(data, (record.camera.width_px, record.camera.height_px), ANY_SIZE)
        except InvalidArgument as error:
            raise DataLoss(f"the mask of reference {record.reference_id!r} cannot be read: {error}") from error


def load_usable(
    load: Callable[[Sequence[str]], Loaded],
    reference_ids: Sequence[str],
    unusable: tuple[type[RequestError], ...],
    report: Callable[[str, RequestError], None],
) -> Loaded:
    """Loads references with these ids, in order, except those that cannot be loaded.

    All are read at one moment. If some cannot be loaded, because `load` fails with one of the errors `unusable`, the
    others are read again, also at one moment, and `report` is called for each that is omitted. Errors about the scene
    are raised.
    """

    def is_usable(reference_id: str) -> bool:
        try:
            load([reference_id])
        except unusable as error:
            if error.field == "scene":
                raise
            report(reference_id, error)
            return False
        return True

    try:
        return load(reference_ids)
    except unusable as error:
        if error.field == "scene":
            raise
    return load([it for it in reference_ids if is_usable(it)])


def _log_describing(records: Sequence[ReferenceRecord], extractor: FeatureExtractor) -> None:
    log.info("describing %d references of scene %s with %s", len(records), records[0].scene_key, extractor.name)
