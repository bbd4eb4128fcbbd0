"""The depths that sensors measured with references, at their keypoints."""

from collections.abc import Callable
from dataclasses import replace

from mapless_server.cache import LruCache
from mapless_server.errors import DataLoss, InvalidArgument
from mapless_server.images import ANY_SIZE, decode_depth
from mapless_server.method.features.views import KeypointDepths, PosedView
from mapless_server.method.structure.measured_depth import MeasuredDepth
from mapless_server.store import ReferenceRecord, Store

_CACHE_BYTES = 32 * 2**20
"""Depths at the keypoints of some 2000 references with 2000 keypoints each."""


class MeasuredDepths:
    """Adds measured depths to loaded references, each decoded once as long as it is in memory; thread-safe."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._cache: LruCache[KeypointDepths] = LruCache(_CACHE_BYTES)

    def with_depth(
        self, record: ReferenceRecord, reference: PosedView, extractor: str, is_metric: Callable[[], bool]
    ) -> PosedView:
        """The reference with its depth at the keypoints of an extractor; unchanged without depth.

        A depth whose median is that of another unit than metres is not used where the scene's unit is the metre.
        NotFound if the reference was deleted, DataLoss if its depth is damaged.
        """
        if not record.depth_sha256:
            return reference
        found = self._cache.get((record.key, extractor))
        if found is None:
            found = read_measured(self._store, record).at_keypoints(reference.view)
            self._cache.put((record.key, extractor), found, found.depth.nbytes + found.relative_sigma.nbytes)
        return replace(reference, depths=found) if found.is_plausible or not is_metric() else reference


def read_measured(store: Store, record: ReferenceRecord) -> MeasuredDepth:
    """The depth that was measured with a reference that has one.

    NotFound if the reference was deleted, DataLoss if its depth is damaged.
    """
    image, photo = store.read_depth_of(record.key), record.camera
    try:
        depth = decode_depth(image, (photo.width_px, photo.height_px), ANY_SIZE)
    except InvalidArgument as error:
        raise DataLoss(f"the depth of reference {record.reference_id!r} cannot be read: {error}") from error
    return MeasuredDepth.of(image, depth, photo)
