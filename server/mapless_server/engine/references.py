"""The references of all scenes, for the stages of a query, and for what callers ask of references."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapless.geometry import Array
from mapless_server.engine.photo_views import QueryViews, RasterForm
from mapless_server.engine.query import Description, Photo, SceneQuestion
from mapless_server.errors import DataLoss, InvalidArgument, NotFound
from mapless_server.images import ImageLimits, decode_depth
from mapless_server.method.features.extractors import FeatureExtractor
from mapless_server.method.options import StageContext
from mapless_server.method.structure.measured_depth import median_depth
from mapless_server.scenes import Choice, RankedReference, Selection, rank_references
from mapless_server.scenes.audit.scene_auditor import SceneAuditor, SceneTools
from mapless_server.scenes.index_files import again_if_damaged
from mapless_server.scenes.indexes import SceneIndexes
from mapless_server.scenes.later import Pending
from mapless_server.scenes.library import FeaturesMissing
from mapless_server.scenes.retrieval.index import Entries, GlobalDescriptor
from mapless_server.scenes.retrieval.ranking import nearest_references, rank_among
from mapless_server.scenes.scene_agreements import SceneAgreements
from mapless_server.security import SceneKey
from mapless_server.store import GroupedScene

from .query import POSE_PRIOR

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Retrieval:
    """Chooses references: a descriptor made of a photograph's features or pixels, and the scenes' indexes of it.

    Photographs are described with the extractor before.
    """

    descriptor: GlobalDescriptor
    extractor: FeatureExtractor
    indexes: SceneIndexes


class References:
    """The references of all scenes: loaded, chosen, described, audited. Safe to use from several threads.

    `pending` returns what the background has still to make in a scene; it is set where there is a background.
    """

    def __init__(
        self,
        tools: SceneTools,
        retrievals: Sequence[Retrieval],
        limits: ImageLimits,
        agreements: SceneAgreements,
    ) -> None:
        """The first retrieval chooses for features without one; the agreements say which scenes contradict themselves.

        Raises ValueError unless the first descriptor is computed from the first extractor's features.
        """
        descriptor, features = tools.descriptor, retrievals[0].extractor.name
        if descriptor.extractor not in (None, features):
            raise ValueError(f"{descriptor.name} is made of {descriptor.extractor}, not of {features}")
        self.load = tools.library.load
        self.report_damaged = tools.indexes.report_damaged
        self.agreements = agreements
        self.pending: Callable[[SceneKey], Sequence[Pending]] = lambda _: ()
        self._tools = tools
        self.retrievals = retrievals
        self._limits = limits

    def contradiction(self, scene_key: SceneKey) -> str:
        """Returns the sentence that a scene contradicts itself, as far as it is known; else an empty one."""
        return self.agreements.known(scene_key).contradiction

    def choose(
        self,
        scene_key: SceneKey,
        views: QueryViews,
        selection: Selection,
        context: StageContext,
        extractor: FeatureExtractor | None = None,
    ) -> Choice:
        """Chooses references for a photograph by its global descriptor, or near a pose prior without reading it.

        The descriptor is that of the extractor's features if they have one of their own; references that still lack it
        come last, and FeaturesMissing is raised where all do. NotFound if there is no such scene (field "scene") or
        reference, or it is retired (field "references[i]"); DataLoss if it is damaged (same field); InvalidArgument if
        the image is bad.
        """
        return again_if_damaged(lambda: self._choose(scene_key, views, selection, context, extractor))

    def _choose(
        self,
        scene_key: SceneKey,
        views: QueryViews,
        selection: Selection,
        context: StageContext,
        extractor: FeatureExtractor | None,
    ) -> Choice:
        # The scene comes first: a wrong name is found before the photograph is described.
        main, own = self.retrievals[0], self._retrieval_of(extractor)
        entries = main.indexes.entries(scene_key, context)
        if selection.near is not None:
            nearest = nearest_references(entries, selection.near, selection.count)
            return Choice(tuple(nearest), POSE_PRIOR, entries.generation)
        for index, reference_id in enumerate(selection.among):
            if reference_id not in entries:
                raise main.indexes.why_missing(scene_key, reference_id, f"references[{index}]")
        if not len(entries):
            return Choice((), "", entries.generation)
        if own is not main:
            entries = self._described(scene_key, views, selection, context, own)
        view = views.view(own.extractor, context)
        with context.stage("retrieval"):
            vector = own.descriptor.describe(view)
            ranked = rank_references(entries, vector, selection)
        return Choice(tuple(ranked), own.descriptor.name, entries.generation)

    def choose_among(
        self, questions: Sequence[SceneQuestion], views: QueryViews, count: int, context: StageContext
    ) -> Sequence[tuple[SceneQuestion, Sequence[RankedReference]]]:
        """Chooses so many references for a photograph, the most similar of those of several scenes, as over one index.

        Within a scene they are chosen as by `choose`; those of two scenes are never near one another.

        Returns:
            The scenes that exist and can be read, in order, and the references of each, the most similar first.
        """
        return again_if_damaged(lambda: self._choose_among(questions, views, count, context))

    def _choose_among(
        self, questions: Sequence[SceneQuestion], views: QueryViews, count: int, context: StageContext
    ) -> Sequence[tuple[SceneQuestion, Sequence[RankedReference]]]:
        main = self.retrievals[0]
        with context.stage("retrieval"):
            read = [it for question in questions if (it := self._entries_of(question, context)) is not None]
        if not any(len(entries) for _, entries in read):
            return [(question, ()) for question, _ in read]
        view = views.view(main.extractor, context)
        with context.stage("retrieval"):
            vector = main.descriptor.describe(view)
            found = rank_among([(entries, question.narrowing) for question, entries in read], vector, count)
        return [(question, some) for (question, _), some in zip(read, found, strict=True)]

    def extents_m(self, scenes: Sequence[GroupedScene]) -> Array:
        """Distances (N,) of scenes' furthest references from the origins of their worlds; infinite if not known."""
        return self.retrievals[0].indexes.extents_m(scenes)

    def _entries_of(self, question: SceneQuestion, context: StageContext) -> tuple[SceneQuestion, Entries] | None:
        """The references of one of several scenes; None, and a line in the log, if it cannot be read."""
        scene_key, indexes = question.scene_key, self.retrievals[0].indexes
        try:
            entries = indexes.known(scene_key, question.generation)
            return question, indexes.entries(scene_key, context) if entries is None else entries
        except (NotFound, DataLoss) as error:
            log.warning("scene %s is left out among several: %s", question.scene_key, error)
            return None

    def _described(
        self, scene_key: SceneKey, views: QueryViews, selection: Selection, context: StageContext, own: Retrieval
    ) -> Entries:
        """The references by a descriptor that is made in the background; those likely to be chosen are made now.

        As long as the context has time for it. FeaturesMissing if no reference has it.
        """
        main, entries = self.retrievals[0], own.indexes.entries(scene_key, context, waits=False)
        lacking = {key for _, key in entries.undescribed()}
        if not lacking:
            return entries
        # Of the photograph as it is: features of its mirror image, say, are not those of all extractors.
        vector = main.descriptor.describe(views.in_form(RasterForm()).view(main.extractor, context))
        likely = rank_references(main.indexes.entries(scene_key, context), vector, selection)
        own.indexes.describe(scene_key, [(it.reference_id, it.key) for it in likely if it.key in lacking], context)
        entries = own.indexes.entries(scene_key, context, waits=False)
        if len(left := entries.undescribed()) == len(entries):
            raise FeaturesMissing([reference_id for reference_id, _ in left])
        return entries

    def sample(self, scene_key: SceneKey, among: Sequence[str], count: int, context: StageContext) -> list[str]:
        """Ids of so many references at most, evenly spread: of the scene's, or of these that it has.

        NotFound if there is no such scene (field "scene").
        """
        entries = self.retrievals[0].indexes.entries(scene_key, context)
        rows = entries.rows(among or None)
        chosen = rows[np.unique(np.linspace(0, len(rows) - 1, min(count, len(rows))).round().astype(int))]
        return [entries.reference(row)[0] for row in chosen.tolist()]

    def _retrieval_of(self, extractor: FeatureExtractor | None) -> Retrieval:
        own = (it for it in self.retrievals if extractor is not None and it.extractor.name == extractor.name)
        return next(own, self.retrievals[0])

    def describe(self, photo: Photo, check: Callable[[], None]) -> Description:
        """Computes what the first attempt of a query needs of a photograph: the first features and their descriptor.

        The rest is made in the background, or by the first query that needs it. InvalidArgument if the photograph is
        bad, or its mask ignores all of it.
        """
        decoded, context = QueryViews(photo, self._limits), StageContext(check)
        first = self.retrievals[0]
        view = decoded.view(first.extractor, context)
        vectors = {first.descriptor.name: first.descriptor.describe(view)}
        # A batch is held in memory until it is stored, so without its pixels.
        without_pixels = {first.extractor.name: replace(view, photograph=None)}
        share = decoded.ignored_share(context)
        if share == 1:
            message = "the mask ignores the whole image: 0 means ignore, every other value use"
            raise InvalidArgument(message, reason="MASK_IGNORES_ALL", field=photo.mask_field)
        return Description(without_pixels, vectors, share, self._median_depth(photo))

    def _median_depth(self, photo: Photo) -> float | None:
        """Median of a photograph's depth, None without depth; InvalidArgument if it is bad."""
        if photo.depth is None:
            return None
        size, field = (photo.camera.width_px, photo.camera.height_px), photo.field.removesuffix("image") + "depth"
        return median_depth(decode_depth(photo.depth, size, self._limits, field))

    def auditor(self, scene_key: SceneKey, named: Sequence[str] = ()) -> SceneAuditor:
        """Makes an auditor of a scene's references; the caller named those in `named`."""
        return SceneAuditor(self._tools, scene_key, named)

    def forget_scene(self, scene_key: SceneKey) -> None:
        """Frees the memory of a deleted scene."""
        for it in self.retrievals:
            it.indexes.forget(scene_key)
        self.agreements.forget_scene(scene_key)

    @property
    def index_bytes(self) -> int:
        """Memory of the retrieval indexes, bytes."""
        return sum(it.indexes.size_bytes for it in self.retrievals)

    @property
    def index_file_bytes(self) -> list[int]:
        """Sizes of the index files in use, of scenes that are searched approximately, bytes."""
        return [size for it in self.retrievals for size in it.indexes.filed]

    def close(self) -> None:
        """Ends the background work of the indexes, of the library and of the agreements."""
        for it in self.retrievals:
            it.indexes.close()
        self.agreements.close()
        self._tools.library.close()
