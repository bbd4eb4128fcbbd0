"""Photographs and references for the stages of a query: decoded and described once, loaded, chosen."""

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Protocol

from mapless.names import reference_name
from mapless_server.errors import DataLoss, NotFound
from mapless_server.images import ImageLimits, decode_image
from mapless_server.method.features import FeatureExtractor
from mapless_server.method.options import StageContext
from mapless_server.method.views import Photograph, View, reduce_image
from mapless_server.scenes import Choice, GlobalDescriptor, Selection, rank_references
from mapless_server.scenes.audit.scene_auditor import AuditTools, SceneAuditor
from mapless_server.scenes.indexes import SceneIndexes
from mapless_server.scenes.library import Loaded, ReferenceLibrary
from mapless_server.scenes.retrieval.ranking import nearest_references
from mapless_server.security import SceneKey, scene_id_of
from mapless_server.store import SceneAttributes

from .query import POSE_PRIOR, Description, Photo


class QueryViews:
    """Decodes a photograph once, and describes it once with each extractor, when first needed."""

    def __init__(self, photo: Photo, limits: ImageLimits) -> None:
        self._photo = photo
        self._limits = limits
        self._photograph: Photograph | None = None
        self._views: dict[str, View] = {}
        self._max_pixels: int | None = None

    def view(self, extractor: FeatureExtractor, context: StageContext) -> View:
        """The photograph's view with this extractor's features; InvalidArgument if the image is bad."""
        if extractor.name not in self._views:
            photograph = self._decoded(context)
            with context.stage("features"):
                pixels, camera = photograph.read(), photograph.camera
                if self._max_pixels is not None:
                    share = min(1.0, math.sqrt(self._max_pixels / (camera.width_px * camera.height_px)))
                    pixels, camera = reduce_image(pixels, camera, round(share * max(camera.width_px, camera.height_px)))
                view = extractor.extract(pixels, camera)
            self._views[extractor.name] = replace(view, photograph=photograph)
        return self._views[extractor.name]

    def reduced(self, max_pixels: int, context: StageContext) -> "QueryViews":
        """The same photograph, decoded once, whose features are found in a reduced image with about so many pixels."""
        views = QueryViews(self._photo, self._limits)
        views._photograph, views._max_pixels = self._decoded(context), max_pixels
        return views

    def _decoded(self, context: StageContext) -> Photograph:
        if self._photograph is None:
            photo = self._photo
            with context.stage("decode"):
                pixels = decode_image(photo.image, self._limits, photo.field)
            identify = lambda: hashlib.sha256(photo.image).hexdigest()  # noqa: E731
            self._photograph = Photograph(identify, photo.camera, lambda: pixels)
        return self._photograph


class ReferenceSource(Protocol):
    """Source of a query's references: `References`, or recorded or rendered ones."""

    def load(
        self,
        scene_key: SceneKey,
        reference_ids: Sequence[str],
        extractor: FeatureExtractor,
        context: StageContext,
        waits: bool,
    ) -> Loaded:
        """Loads references of a scene, in the order given, with the scene's generation."""
        ...

    def attributes(self, scene_key: SceneKey) -> SceneAttributes:
        """Returns the attributes of a scene."""
        ...

    def choose(
        self,
        scene_key: SceneKey,
        views: QueryViews,
        selection: Selection,
        context: StageContext,
    ) -> Choice:
        """Chooses references for a photograph."""
        ...

    def report_damaged(self, scene_key: SceneKey, reference_id: str, error: Exception) -> None:
        """Reports that a chosen reference is not used because it is damaged."""
        ...


class References:
    """The references of all scenes: loaded, chosen, described, audited. Safe to use from several threads."""

    def __init__(
        self,
        library: ReferenceLibrary,
        indexes: SceneIndexes,
        descriptor: GlobalDescriptor,
        extractors: Sequence[FeatureExtractor],
        audit_tools: AuditTools,
        limits: ImageLimits,
    ) -> None:
        """Raises ValueError unless the descriptor is computed from the first extractor's features."""
        if descriptor.extractor not in (None, extractors[0].name):
            raise ValueError(f"{descriptor.name} is made of {descriptor.extractor}, not of {extractors[0].name}")
        self._library = library
        self._indexes = indexes
        self._descriptor = descriptor
        self._extractors = extractors
        self._audit_tools = audit_tools
        self._limits = limits

    def load(
        self,
        scene_key: SceneKey,
        reference_ids: Sequence[str],
        extractor: FeatureExtractor,
        context: StageContext,
        waits: bool = True,
    ) -> Loaded:
        """See `ReferenceLibrary.load`."""
        return self._library.load(scene_key, reference_ids, extractor, context, waits)

    def attributes(self, scene_key: SceneKey) -> SceneAttributes:
        """Returns the attributes of a scene."""
        return self._library.attributes(scene_key)

    def choose(
        self,
        scene_key: SceneKey,
        views: QueryViews,
        selection: Selection,
        context: StageContext,
    ) -> Choice:
        """Chooses references for a photograph by its global descriptor, or near a pose prior without reading it.

        NotFound if there is no such scene (field "scene") or reference (field "references[i]"); DataLoss if a named
        reference is damaged (same field); InvalidArgument if the image is bad.
        """
        # The scene comes first: a wrong name is found before the photograph is described.
        entries = self._indexes.entries(scene_key, context)
        if selection.near is not None:
            nearest = nearest_references(entries, selection.near, selection.count)
            return Choice(tuple(nearest), POSE_PRIOR, entries.generation)
        for index, reference_id in enumerate(selection.among):
            if reference_id not in entries:
                if self._indexes.is_damaged(scene_key, reference_id):
                    message = f"reference {reference_id!r} is damaged in the store: delete it and add it again"
                    raise DataLoss(message, field=f"references[{index}]")
                scene_id = scene_id_of(scene_key)
                message = f"there is no reference {reference_id!r} in scene {scene_id!r}"
                name = reference_name(scene_id, reference_id)
                raise NotFound(message, field=f"references[{index}]", resource=name)
        if not len(entries):
            return Choice((), "", entries.generation)
        view = views.view(self._extractors[0], context)
        with context.stage("retrieval"):
            vector = self._descriptor.describe(view)
            ranked = rank_references(entries, vector, selection)
        return Choice(tuple(ranked), self._descriptor.name, entries.generation)

    def report_damaged(self, scene_key: SceneKey, reference_id: str, error: Exception) -> None:
        """Logs that a chosen reference is not used because it is damaged; once while the scene is in memory."""
        self._indexes.report_damaged(scene_key, reference_id, error)

    def describe(self, photo: Photo, check: Callable[[], None]) -> Description:
        """Computes all that the store keeps of a photograph, every tier's features; InvalidArgument if it is bad."""
        decoded, context = QueryViews(photo, self._limits), StageContext(check)
        views = {it.name: decoded.view(it, context) for it in self._extractors}
        vector = self._descriptor.describe(views[self._extractors[0].name])
        # A batch is held in memory until it is stored, so without its pixels.
        without_pixels = {name: replace(view, photograph=None) for name, view in views.items()}
        return Description(without_pixels, {self._descriptor.name: vector})

    def auditor(self, scene_key: SceneKey, named: Sequence[str] = ()) -> SceneAuditor:
        """Makes an auditor of a scene's references; the caller named those in `named`."""
        return SceneAuditor(self._audit_tools, scene_key, named)

    def forget_scene(self, scene_key: SceneKey) -> None:
        """Frees the memory of a deleted scene."""
        self._indexes.forget(scene_key)

    @property
    def index_bytes(self) -> int:
        """Memory of the retrieval indexes, bytes."""
        return self._indexes.size_bytes

    def close(self) -> None:
        """Ends the background work of the library."""
        self._library.close()
