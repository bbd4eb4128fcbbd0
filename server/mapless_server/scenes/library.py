"""The stored references as the pipeline wants them: with the features asked for and, at hand, the photographs.

Features are computed once, when a reference is added. A store that was filled under other features lacks those of a
new extractor: they are then computed from the stored photographs by the first calls that need them, and kept.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from mapless.names import reference_name
from mapless_server.errors import AlreadyExists, DataLoss, InvalidArgument, RequestError
from mapless_server.images.decode import ImageLimits, decode_image
from mapless_server.method.context import StageContext
from mapless_server.method.features import FeatureExtractor
from mapless_server.method.views import Photograph, PosedView
from mapless_server.security.tenancy import SceneKey
from mapless_server.store import DescribedReference, ReferenceRecord, SceneAttributes, Store

from .keyed_locks import Claims

log = logging.getLogger(__name__)

STORED_IMAGES = ImageLimits(max_bytes=2**31, max_pixels=2**30, min_side_px=1, max_side_px=2**20)
"""Stored photographs were let in under the limits of their time; limits set lower since do not make them unreadable."""

Loaded = tuple[int, tuple[PosedView, ...]]
"""A scene's generation, and references of it."""


class NotDescribedYet(Exception):
    """References lack the features asked for, and whoever asked does not wait for them."""


class ReferenceLibrary:
    """Loads references from the store; safe to use from several threads.

    Attributes:
        claims: what threads are describing, by the reference's key and the name of what describes it.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self.claims = Claims()
        self._background = ThreadPoolExecutor(1, "describe")
        self._announced: set[tuple[str, str]] = set()
        self._announcing = threading.Lock()
        self._closing = threading.Event()

    def close(self) -> None:
        """Ends what is done in the background, after the reference that it is at."""
        self._closing.set()
        self._background.shutdown(wait=True, cancel_futures=True)

    def load(
        self,
        scene_key: SceneKey,
        reference_ids: Sequence[str],
        extractor: FeatureExtractor,
        context: StageContext,
        waits: bool = True,
    ) -> Loaded:
        """The scene's generation and references of it, in the order asked for.

        Those without features of the extractor are described now, one by one until the turn is over; what was done by
        then stays done. Who does not wait is told so, and they are described in the background. The photographs of
        references are read when somebody asks for the pixels, not before.

        Raises:
            NotDescribedYet: somebody who does not wait would have to.
            NotFound: there is no such scene (field "scene") or reference (field "references[i]").
            Over: the turn is over.
            DataLoss: what is stored of one of them is damaged.
        """
        while True:
            snapshot = self._store.load_references(scene_key, reference_ids, extractor.name)
            if not snapshot.undescribed:
                return snapshot.generation, tuple(map(self._posed_view, snapshot.references))
            if not waits:
                self._describe_later(snapshot.undescribed, extractor)
                raise NotDescribedYet
            log.info(
                "describing %d references of scene %s with %s", len(snapshot.undescribed), scene_key, extractor.name
            )
            with context.stage("describe"):
                self._describe_all(snapshot.undescribed, extractor, context.check)

    def attributes(self, scene_key: SceneKey) -> SceneAttributes:
        """What is known of a scene as a whole; errors as `Store.get_attributes`."""
        return self._store.get_attributes(scene_key)

    def _describe_later(self, records: Sequence[ReferenceRecord], extractor: FeatureExtractor) -> None:
        with self._announcing:
            new = [record for record in records if (record.key, extractor.name) not in self._announced]
            self._announced |= {(record.key, extractor.name) for record in new}
        if new:
            _announce(new, extractor)
        for record in new:
            self._background.submit(self._describe_unasked, record, extractor)

    def _describe_unasked(self, record: ReferenceRecord, extractor: FeatureExtractor) -> None:
        if self._closing.is_set():
            return
        try:
            self._describe_all([record], extractor, lambda: None)
        except Exception as error:  # one that is damaged or gone must not keep the others from being described
            log.warning("reference %s of scene %s: %s", record.reference_id, record.scene_key, error)

    def _describe_all(
        self, records: Sequence[ReferenceRecord], extractor: FeatureExtractor, check: Callable[[], None]
    ) -> None:
        """Describes references, but those that other threads are at: these it waits for, not for their success."""
        taken: list[ReferenceRecord] = []
        for record in records:
            check()
            with self.claims.claimed((record.key, extractor.name)) as is_mine:
                if is_mine:
                    self._describe(record, extractor)
                else:
                    taken.append(record)
        for record in taken:
            self.claims.wait((record.key, extractor.name), check)

    def _describe(self, record: ReferenceRecord, extractor: FeatureExtractor) -> None:
        # Another thread may have been done with it between our look and our claim.
        if not self._store.has_features(record.key, extractor.name):
            view = extractor.extract(self._pixels(record), record.camera)
            with suppress(AlreadyExists):  # another server on the same store was faster
                self._store.add_features(record.key, extractor.name, view)

    def _posed_view(self, reference: DescribedReference) -> PosedView:
        record = reference.record
        photograph = Photograph(record.image_sha256, record.camera, partial(self._pixels, record))
        return PosedView(
            record.key,
            reference_name(record.scene_id, record.reference_id),
            replace(reference.view, photograph=photograph),
            record.world_from_camera,
        )

    def _pixels(self, record: ReferenceRecord) -> NDArray[np.uint8]:
        """The reference's photograph, (H, W, 3) RGB; NotFound if it was deleted since, DataLoss if it is damaged."""
        data = self._store.read_image_of(record.key)
        try:
            return decode_image(data, STORED_IMAGES)
        except InvalidArgument as error:
            raise DataLoss(f"the photograph of reference {record.reference_id!r} cannot be read: {error}") from error


def load_usable(
    load: Callable[[Sequence[str]], Loaded],
    reference_ids: Sequence[str],
    unusable: tuple[type[RequestError], ...],
    tell: Callable[[str, RequestError], None],
) -> Loaded:
    """References of these ids, in order, less those that cannot be had.

    Where all can be had they are read at one moment, and so are those that are left after a second look.

    Args:
        load: how to load some; it fails if it fails for one of them.
        reference_ids: of the references.
        unusable: what loading one of them raises that is to be left out; about the scene it is let through.
        tell: called for each that is left out.
    """
    try:
        return load(reference_ids)
    except unusable as error:
        if error.field == "scene":
            raise
    return load([it for it in reference_ids if _is_usable(load, it, unusable, tell)])


def _is_usable(
    load: Callable[[Sequence[str]], Loaded],
    reference_id: str,
    unusable: tuple[type[RequestError], ...],
    tell: Callable[[str, RequestError], None],
) -> bool:
    try:
        load([reference_id])
    except unusable as error:
        if error.field == "scene":
            raise
        tell(reference_id, error)
        return False
    return True


def _announce(records: Sequence[ReferenceRecord], extractor: FeatureExtractor) -> None:
    log.info("describing %d references of scene %s with %s", len(records), records[0].scene_key, extractor.name)
