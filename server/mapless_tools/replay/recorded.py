"""The inputs that a captured call recorded, in place of the store: references, and the choice among them."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapless.names import reference_name
from mapless_server.engine.query import POSE_PRIOR
from mapless_server.engine.references import QueryViews
from mapless_server.errors import DataLoss
from mapless_server.images import decode_image
from mapless_server.method.features import FeatureExtractor
from mapless_server.method.options import StageContext
from mapless_server.method.views import Photograph, PosedView, View
from mapless_server.scenes import Choice, Selection
from mapless_server.scenes.library import STORED_IMAGES, Loaded
from mapless_server.security import SceneKey, scene_id_of
from mapless_server.services.capture.calls import CapturedCall, CapturedPart, CapturedReference, DamagedCapture
from mapless_server.services.capture.files import blob_path
from mapless_server.store import LruCache, SceneAttributes, codec

RETRIEVAL = "retrieval"
"""The stage in which references are chosen."""

_CACHE_BYTES = 512 * 2**20


class Blobs:
    """Photographs and features of references in a capture folder, cached for the next call.

    `found_anew` are the keys of references whose captured features this program cannot read.
    """

    def __init__(self, folder: Path) -> None:
        self.found_anew: set[str] = set()
        self._folder = folder
        self._views: LruCache[View] = LruCache(_CACHE_BYTES)

    def view(self, tenant: str, reference: CapturedReference, extractor: FeatureExtractor) -> View:
        """The features of a reference: the captured ones, or else extracted again.

        They are extracted again if this extractor's features were not captured, or if another version wrote them in a
        form that this one cannot read; the latter is added to `found_anew`. DamagedCapture if they are missing or
        damaged.
        """
        known = (reference.key, extractor.name)
        view = self._views.get(known)
        if view is None:
            view = self._read_view(tenant, reference, extractor)
            self._views.put(known, view, view.features.size_bytes)
        return view

    def pixels(self, tenant: str, reference: CapturedReference) -> NDArray[np.uint8]:
        """A reference's photograph, (H, W, 3) RGB; DamagedCapture if it is missing or damaged."""
        return decode_image(self._read(tenant, reference.image_sha256), STORED_IMAGES)

    def _read_view(self, tenant: str, reference: CapturedReference, extractor: FeatureExtractor) -> View:
        if extractor.name in reference.views:
            data = self._read(tenant, reference.views[extractor.name])
            try:
                return codec.decode_view("", data, codec.sha256_for("", data))
            except codec.Damaged:  # its bytes are as written, so it is the form that is unknown
                self.found_anew.add(reference.key)
        return extractor.extract(self.pixels(tenant, reference), reference.camera)

    def _read(self, tenant: str, sha256: str) -> bytes:
        try:
            data = blob_path(self._folder, tenant, sha256).read_bytes()
        except OSError as error:
            raise DamagedCapture(f"blob {sha256}: {error.strerror}") from error
        if hashlib.sha256(data).hexdigest() != sha256:
            raise DamagedCapture(f"blob {sha256} is not what was written")
        return data


@dataclass(frozen=True, eq=False)
class RecordedSource:
    """References of one photograph of a captured call and their choice; see `ReferenceSource`.

    `is_described` says whether the photograph was described for the choice, which takes a reference to compare it with.
    """

    call: CapturedCall
    part: CapturedPart
    blobs: Blobs
    extractor: FeatureExtractor
    is_described: bool

    def load(
        self,
        scene_key: SceneKey,
        reference_ids: Sequence[str],
        extractor: FeatureExtractor,
        context: StageContext,
        waits: bool,
    ) -> Loaded:
        """Implements ReferenceSource with the captured references; others could not be read then either."""
        by_id = {it.reference_id: it for it in self.part.references}
        for index, reference_id in enumerate(reference_ids):
            if reference_id not in by_id:
                raise DataLoss(f"reference {reference_id!r} was not captured", field=f"references[{index}]")
        wanted = [by_id[reference_id] for reference_id in reference_ids]
        return self.part.generation, tuple(self._posed_view(it, extractor, scene_key) for it in wanted)

    def attributes(self, scene_key: SceneKey) -> SceneAttributes:
        """Implements ReferenceSource."""
        return self.call.attributes

    def choose(
        self,
        scene_key: SceneKey,
        views: QueryViews,
        selection: Selection,
        context: StageContext,
    ) -> Choice:
        """Implements ReferenceSource with the captured choice; DamagedCapture if there is none.

        For any arguments, but that references near a prior are none unless the captured ones were chosen so.
        """
        if selection.near is not None and (self.part.choice is None or self.part.choice.descriptor != POSE_PRIOR):
            return Choice((), POSE_PRIOR, self.part.generation)
        if self.part.choice is None:
            raise DamagedCapture("no choice of references was captured")
        if self.is_described and selection.near is None:
            views.view(self.extractor, context)
            with context.stage(RETRIEVAL):  # it takes no time, but the answer lists it
                pass
        return self.part.choice

    def report_damaged(self, scene_key: SceneKey, reference_id: str, error: Exception) -> None:
        """Implements ReferenceSource: the reference was left out in the captured call, too."""

    def _posed_view(self, reference: CapturedReference, extractor: FeatureExtractor, scene_key: SceneKey) -> PosedView:
        tenant = self.call.tenant
        view = self.blobs.view(tenant, reference, extractor)
        read = partial(self.blobs.pixels, tenant, reference)
        photograph = Photograph(lambda: reference.image_sha256, reference.camera, read)
        name = reference_name(scene_id_of(scene_key), reference.reference_id)
        return PosedView(reference.key, name, replace(view, photograph=photograph), reference.world_from_camera)
