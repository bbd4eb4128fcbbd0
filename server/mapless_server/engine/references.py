"""Photographs and references for the stages of a query: decoded and described once, loaded, chosen."""

import hashlib
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Protocol

from mapless.names import reference_name
from mapless_server.errors import DataLoss, NotFound
from mapless_server.images import ImageLimits, decode_image
from mapless_server.method.features import FeatureExtractor
from mapless_server.method.options import StageContext
from mapless_server.method.views import Matches, Photograph, PosedView, View, reduce_image
from mapless_server.scenes import Choice, GlobalDescriptor, Narrowing, Selection, rank_references
from mapless_server.scenes.audit.scene_auditor import AuditTools, SceneAuditor
from mapless_server.scenes.indexes import SceneIndexes
from mapless_server.scenes.library import Loaded, ReferenceLibrary, load_usable
from mapless_server.scenes.retrieval.ranking import THINNED_LATER, nearest_references
from mapless_server.scheduling import Step
from mapless_server.security import SceneKey, scene_id_of
from mapless_server.store import SceneAttributes

from .query import POSE_PRIOR, PREPARE, Description, Photo, Query, Result, Tier
from .tracking import can_track

SHORTLIST = 2
"""So many times the references wanted are matched with a sample of the photograph, and the best of them used (see
BENCHMARKS.md)."""

_COUNTS = (2, 5, 10, 20, 64)
"""Queries with about as many references cost about as much."""


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

    def choose(self, scene_key: SceneKey, views: QueryViews, selection: Selection, context: StageContext) -> Choice:
        """Chooses references for a photograph."""
        ...

    def report_damaged(self, scene_key: SceneKey, reference_id: str, error: Exception) -> None:
        """Reports that a chosen reference is not used because it is damaged."""
        ...


@dataclass(frozen=True, eq=False)
class QueryRun:
    """The state of a query between its stages, in one tier.

    Attributes:
        query: the query.
        source: source of the references.
        views: the photograph.
        deadline_s: time after which the answer is useless, by `time.monotonic`.
        on_coarse: called with the first tier's coarse result as soon as there is one, in the computing thread.
        tier: index of the tier that computes.
        best: best result so far; None in the first search of the first tier.
        start_s: when this tier began, by `time.monotonic`.
        give_up_s: time after which `best` is the answer, if this tier has none by then.
        narrowed: the query with the soft priors' choice of references, if references elsewhere are now searched.
        ambiguous: the rejection as ambiguous, if the references of the place that the priors decided for are now used.
        listings: how often the scene was listed in this tier.
        context: cancels and times this tier's stages; from here on set by the stage `prepare`.
        references: the references that are used, in order.
        generation: generation of the scene when they were read.
        attributes: attributes of the scene.
        view: the photograph with this tier's features; None until the tier's first step has found them.
        choice: how the references were chosen; None if the caller named them.
        query_matches: matches of the photograph with each reference, if references were chosen by these or are matched
            one by one.
        unmatched: indices of the references that the photograph is still to be matched with again (`Matcher.rematch`),
            each in a step of its own, so that a busy server computes for other callers in between.
        part: the method's intermediate result between two stages.
    """

    query: Query
    source: ReferenceSource
    views: QueryViews
    deadline_s: float
    on_coarse: Callable[[Result], object] | None = None
    tier: int = 0
    best: Result | None = None
    start_s: float = field(default_factory=time.monotonic)
    give_up_s: float = math.inf
    narrowed: Query | None = None
    ambiguous: Result | None = None
    listings: int = 1
    context: StageContext = field(default_factory=StageContext)
    references: tuple[PosedView, ...] = ()
    generation: int = 0
    attributes: SceneAttributes = field(default_factory=SceneAttributes)
    view: View | None = None
    choice: Choice | None = None
    query_matches: tuple[Matches, ...] | None = None
    unmatched: tuple[int, ...] = ()
    part: Any = None

    def but(self, **changes: Any) -> "QueryRun":
        """A copy with these values; `dataclasses.replace` takes ten times as long, which six copies a query show."""
        assert vars(self).keys() >= changes.keys()
        copy = object.__new__(QueryRun)
        vars(copy).update(vars(self), **changes)
        return copy

    @property
    def kind(self) -> str:
        """Kind of the query's jobs; jobs of one kind take about the same time."""
        if self.tracks:
            return "tracked"
        ids = self.query.reference_ids
        count = next((count for count in _COUNTS if len(ids) <= count), _COUNTS[-1])
        return f"tier {self.tier}, {'chosen' if self.query.chooses else f'up to {count}'}"

    @property
    def tracks(self) -> bool:
        """Whether this tier begins with the references near the prior."""
        return self.best is None and can_track(self.query)

    @property
    def earlier(self) -> Result | None:
        """The result if this computation comes to none."""
        return self.best or self.ambiguous

    @property
    def first_step(self) -> Step:
        """The first step of the query in its tier."""
        kind = self.kind
        return Step(PREPARE, kind, kind, self)

    def choose(self, narrowing: Narrowing) -> Choice:
        """Chooses the shortlist of references within limits and likely values of the pose."""
        query = self.query
        selection = Selection(SHORTLIST * query.reference_count, narrowing, query.reference_ids, THINNED_LATER)
        return self.source.choose(query.scene_key, self.views, selection, self.context)

    def load(self, reference_ids: Sequence[str], tier: Tier) -> Loaded:
        """Loads references with the tier's features."""
        # Only the first tier waits for its references' features: before a stronger one there is an answer.
        waits = self.best is None
        return self.source.load(self.query.scene_key, reference_ids, tier.extractor, self.context, waits)

    def load_chosen(self, reference_ids: Sequence[str], tier: Tier) -> Loaded:
        """Loads chosen references without damaged ones; a damaged reference that the caller named is an error."""
        if self.query.reference_ids:
            return self.load(reference_ids, tier)
        report = partial(self.source.report_damaged, self.query.scene_key)
        return load_usable(lambda some: self.load(some, tier), reference_ids, (DataLoss,), report)


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
        self.load, self.attributes = library.load, library.attributes
        self.report_damaged = indexes.report_damaged
        self._library = library
        self._indexes = indexes
        self._descriptor = descriptor
        self._extractors = extractors
        self._audit_tools = audit_tools
        self._limits = limits

    def choose(self, scene_key: SceneKey, views: QueryViews, selection: Selection, context: StageContext) -> Choice:
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
