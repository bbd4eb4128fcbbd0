"""Audit and coverage of a stored scene, whose references may be deleted or damaged meanwhile."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from mapless.names import parse_reference_name, reference_name
from mapless_server.errors import DataLoss, NotFound, Unavailable
from mapless_server.method.features.extractors import FeatureExtractor
from mapless_server.method.features.views import PosedView
from mapless_server.method.options import StageContext
from mapless_server.security import SceneKey, scene_id_of

from ..depth_checks import DepthChecks
from ..indexes import SceneIndexes
from ..library import ReferenceLibrary
from ..retrieval.index import Entries, GlobalDescriptor, Rows
from ..retrieval.ranking import RankOptions, Selection, rank_references
from .auditor import Auditor
from .coverage import check_coverage
from .finder import ReferenceFinder, ReferenceGone
from .neighbourhood import PairMatches
from .verdict import AuditVerdict, Coverage, ReferenceAudit, Viewpoint

ResultT = TypeVar("ResultT")

CACHED_VIEWS = 200
"""Loaded references that a call keeps, about 1.2 MB each."""

UNTHINNED = RankOptions(apart_m=0.0)
"""Neighbours at one place see the same, which is what an audit needs."""

MAX_READINGS = 3
"""If a reference is deleted while it is used, the scene is read again; more often than this it is being emptied."""

DAMAGED = "is damaged in the store: delete it and add it again"

COVERAGE_CANDIDATES = 500
"""References nearest to a pose, among which its neighbours are chosen."""

PROCESSED_SIDE_PX = 1024
"""Longer side of the image that features are found in."""


@dataclass(frozen=True, eq=False)
class SceneTools:
    """The tools that choose, load and compare the references of all scenes.

    The extractor is the first tier's, whose features every reference has; `pairs` caches matches, for all calls
    together. `depths` checks measured depths; None checks none.
    """

    library: ReferenceLibrary
    indexes: SceneIndexes
    descriptor: GlobalDescriptor
    extractor: FeatureExtractor
    pairs: PairMatches
    depths: DepthChecks | None = None


class SceneAuditor:
    """Audits references of a scene as it was when first used; for use by one thread at a time.

    If a reference that it uses is deleted meanwhile, it reads the scene again.
    """

    def __init__(self, tools: SceneTools, scene_key: SceneKey, named: Sequence[str] = ()) -> None:
        """`named` has the ids that the caller named; it is an error if one of these references is missing."""
        self._tools = tools
        self._scene_key = scene_key
        self._named = named
        self._entries: Entries | None = None
        self._auditor: Auditor | None = None
        self._check: Callable[[], None] = lambda: None

    @property
    def generation(self) -> int:
        """Generation of the scene as it was read; 0 before that."""
        return self._entries.generation if self._entries else 0

    def audit(self, reference_id: str, check: Callable[[], None]) -> ReferenceAudit | None:
        """Audits a reference; None if it is missing and was not named.

        NotFound if there is no such scene (field "scene") or reference that was named (field "references[i]");
        Unavailable if the scene is being emptied.
        """
        self._check = check
        return self._retried(lambda: self._audit(reference_id))

    def check_coverage(self, view: Viewpoint, check: Callable[[], None]) -> Coverage:
        """Predicts whether a photograph taken at a viewpoint would be localized.

        NotFound if there is no such scene (field "scene"); Unavailable if the scene is being emptied.
        """
        self._check = check
        return self._retried(lambda: self._check_coverage(view))

    def _retried(self, compute: Callable[[], ResultT]) -> ResultT:
        for _ in range(MAX_READINGS):
            with suppress(ReferenceGone):
                return compute()
            self._entries = self._auditor = None
        raise Unavailable("the scene's references are being deleted", reason="SCENE_CHANGED", retry_after_s=1.0)

    def _audit(self, reference_id: str) -> ReferenceAudit | None:
        entries = self._read()
        name = self._name(reference_id)
        try:
            tools, context = self._tools, StageContext(self._check)
            scene, (view,) = tools.library.load(self._scene_key, [reference_id], tools.extractor, context)
        except DataLoss:
            return ReferenceAudit(name, AuditVerdict.UNVERIFIABLE, DAMAGED)
        except NotFound as error:
            if error.field == "scene":
                raise
            if reference_id in self._named:
                field = f"references[{self._named.index(reference_id)}]"
                raise NotFound(str(error), field=field, resource=error.resource) from error
            return None
        if reference_id not in entries:
            if self._tools.indexes.is_damaged(self._scene_key, reference_id):
                return ReferenceAudit(name, AuditVerdict.UNVERIFIABLE, DAMAGED)
            raise ReferenceGone(name)  # added since the scene was read
        if self._auditor is None:
            finder = self._finder(entries.rows())
            self._auditor = Auditor(finder, self._tools.pairs, lambda: self._check())
        found = replace(self._auditor.audit(name), provenance=view.provenance)
        try:
            is_arbitrary = scene.attributes.arbitrary_unit
        except DataLoss:  # its unit may be arbitrary
            is_arbitrary = True
        return found if is_arbitrary else self._with_depth(found, reference_id)

    def _with_depth(self, found: ReferenceAudit, reference_id: str) -> ReferenceAudit:
        """The audit of a reference with what is wrong with its measured depth, unless a worse fault explains it."""
        depths = self._tools.depths
        if found.verdict.is_alarm or depths is None:
            return found
        checked = depths.check(self._scene_key, reference_id, self._check)
        if checked is not None and checked.verdict.mistake:
            return replace(found, verdict=AuditVerdict.WRONG_DEPTH, message=f"its depth: {checked.verdict.mistake}")
        if checked is not None and checked.doubt:
            for it in checked.neighbours:
                other = depths.check(self._scene_key, it, self._check)
                if other is not None and other.verdict.mistake:  # this explains the doubt
                    return found
            text = "; ".join(it for it in (found.message, checked.doubt) if it)
            return replace(found, verdict=AuditVerdict.DOUBTFUL_DEPTH, message=text)
        return found

    def _check_coverage(self, view: Viewpoint) -> Coverage:
        entries = self._read()
        rows = entries.rows()
        away_m = np.linalg.norm(entries.centres(rows) - view.world_from_camera.translation, axis=1)
        nearest = np.sort(rows[np.argsort(away_m, kind="stable")[:COVERAGE_CANDIDATES]])
        scale = min(1.0, PROCESSED_SIDE_PX / max(view.camera.width_px, view.camera.height_px))
        width_px, height_px = round(scale * view.camera.width_px), round(scale * view.camera.height_px)
        camera = view.camera.resized(width_px, height_px).pinhole()
        return check_coverage(camera, view.world_from_camera, self._finder(nearest), self._tools.pairs)

    def _read(self) -> Entries:
        if self._entries is None:
            self._entries = self._tools.indexes.entries(self._scene_key, StageContext(self._check))
        return self._entries

    def _finder(self, rows: Rows) -> ReferenceFinder:
        scene_id = scene_id_of(self._scene_key)
        return ReferenceFinder(scene_id, self._read(), rows, self._load, self._similar, CACHED_VIEWS)

    def _name(self, reference_id: str) -> str:
        return reference_name(scene_id_of(self._scene_key), reference_id)

    def _load(self, names: Sequence[str]) -> Sequence[PosedView]:
        """Loads the references of these names that exist and are not damaged."""
        reference_ids = [parse_reference_name(name)[1] for name in names]
        try:
            tools, context = self._tools, StageContext(self._check)
            return tools.indexes.load_existing(tools.library, self._scene_key, reference_ids, tools.extractor, context)
        except NotFound as error:  # another one was deleted between the two readings
            if error.field == "scene":
                raise
            raise ReferenceGone(str(error)) from error

    def _similar(self, name: str, count: int) -> Sequence[str]:
        references = self._load([name])
        if not references:
            raise ReferenceGone(name)
        vector = self._tools.descriptor.describe(references[0].view)
        ranked = rank_references(self._read(), vector, Selection(count, options=UNTHINNED))
        return [self._name(it.reference_id) for it in ranked]
