"""Auditing stored references, and foretelling where one would be localized: what the two need of the library."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from mapless.geometry import Camera, RigidTransform
from mapless.names import parse_reference_name, reference_name
from mapless_server.errors import DataLoss, NotFound, RequestError, Unavailable
from mapless_server.method.context import StageContext
from mapless_server.method.features import FeatureExtractor
from mapless_server.method.views import PosedView
from mapless_server.security.tenancy import SceneKey, scene_id_of

from .audit.auditor import Auditor
from .audit.coverage import Coverage, check_coverage
from .audit.neighbourhood import PairMatches
from .audit.options import AuditOptions
from .audit.surroundings import Gone, Places, Surroundings
from .audit.verdict import ReferenceAudit, Verdict
from .indexes import SceneIndexes
from .library import Loaded, ReferenceLibrary, load_usable
from .retrieval.descriptor import GlobalDescriptor
from .retrieval.index import Entries, Rows
from .retrieval.ranking import RankOptions, rank_references

Outcome = TypeVar("Outcome")

REMEMBERED_VIEWS = 200
"""Loaded references that a call keeps, about 1.2 MB each."""

SAME_PLACE_WELCOME = RankOptions(apart_m=0.0)
"""Neighbours at one place see the same, which here is what they are wanted for."""

MAX_READINGS = 3
"""When a reference goes while it is looked at, the scene is read again; more often than this it is being emptied."""

DAMAGED = "is damaged in the store: delete it and add it again"

COVERAGE_CANDIDATES = 500
"""References nearest to a pose, of which its neighbours are chosen."""

PROCESSED_SIDE_PX = 1024
"""Of the longer side of the image that features are found in."""


@dataclass(frozen=True, eq=False)
class Tools:
    """What examining takes.

    Attributes:
        library: loads references.
        indexes: of all scenes.
        descriptor: what they hold.
        extractor: of the first tier, whose features every reference has.
        pairs: remembers matches, for all calls together.
    """

    library: ReferenceLibrary
    indexes: SceneIndexes
    descriptor: GlobalDescriptor
    extractor: FeatureExtractor
    pairs: PairMatches


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """A camera and where it would be: world_from_camera, metric."""

    camera: Camera
    world_from_camera: RigidTransform


class SceneExaminer:
    """Knows what is around the references of a scene as it was when first asked; of one thread at a time.

    When a reference goes meanwhile that is looked at, it reads the scene again.
    """

    def __init__(self, tools: Tools, scene_key: SceneKey, named: Sequence[str] = ()) -> None:
        """`named` are ids of references that a caller named, so that it is an error if one of them is not there."""
        self._tools = tools
        self._scene_key = scene_key
        self._named = named
        self._entries: Entries | None = None
        self._auditor: Auditor | None = None
        self._check: Callable[[], None] = lambda: None

    @property
    def generation(self) -> int:
        """Of the scene that is examined; 0 before it was asked."""
        return self._entries.generation if self._entries else 0

    def audit(self, reference_id: str, check: Callable[[], None]) -> ReferenceAudit | None:
        """What the neighbours of a reference say about it; None if it is not there and nobody named it.

        Raises:
            NotFound: there is no such scene (field "scene") or reference that was named (field "references[i]").
            Unavailable: the scene is being emptied.
        """
        self._check = check
        return self._steadily(lambda: self._audit(reference_id))

    def _audit(self, reference_id: str) -> ReferenceAudit | None:
        entries = self._read()
        name = self._name(reference_id)
        try:
            self._tools.library.load(self._scene_key, [reference_id], self._tools.extractor, StageContext(self._check))
        except DataLoss:
            return ReferenceAudit(name, Verdict.UNVERIFIABLE, DAMAGED)
        except NotFound as error:
            self._let_pass(error, reference_id)
            return None
        if reference_id not in entries:
            if self._tools.indexes.is_damaged(self._scene_key, reference_id):
                return ReferenceAudit(name, Verdict.UNVERIFIABLE, DAMAGED)
            raise Gone(name)  # added since the scene was read
        if self._auditor is None:
            surroundings = self._surroundings(entries.rows())
            self._auditor = Auditor(surroundings, AuditOptions(), self._tools.pairs, lambda: self._check())
        return self._auditor.audit(name)

    def check_coverage(self, view: Viewpoint, check: Callable[[], None]) -> Coverage:
        """Whether a photograph would be localized that is taken from somewhere.

        Raises:
            NotFound: there is no such scene (field "scene").
            Unavailable: the scene is being emptied.
        """
        self._check = check
        return self._steadily(lambda: self._check_coverage(view))

    def _check_coverage(self, view: Viewpoint) -> Coverage:
        entries = self._read()
        rows = entries.rows()
        away_m = np.linalg.norm(entries.centres(rows) - view.world_from_camera.translation, axis=1)
        nearest = np.sort(rows[np.argsort(away_m, kind="stable")[:COVERAGE_CANDIDATES]])
        scale = min(1.0, PROCESSED_SIDE_PX / max(view.camera.width_px, view.camera.height_px))
        width_px, height_px = round(scale * view.camera.width_px), round(scale * view.camera.height_px)
        camera = view.camera.resized(width_px, height_px).pinhole()
        return check_coverage(camera, view.world_from_camera, self._surroundings(nearest), self._tools.pairs)

    def _let_pass(self, error: NotFound, reference_id: str) -> None:
        """Raises it, unless it is about a reference that nobody named."""
        if error.field == "scene":
            raise error
        if reference_id in self._named:
            field = f"references[{self._named.index(reference_id)}]"
            raise NotFound(str(error), field=field) from error

    def _read(self) -> Entries:
        if self._entries is None:
            self._entries = self._tools.indexes.entries(self._scene_key, StageContext(self._check))
        return self._entries

    def _steadily(self, examine: Callable[[], Outcome]) -> Outcome:
        """What is found out in a scene that stays as it is meanwhile."""
        for _ in range(MAX_READINGS):
            with suppress(Gone):
                return examine()
            self._entries = self._auditor = None
        raise Unavailable("the scene's references are being deleted", reason="SCENE_CHANGED", retry_after_s=1.0)

    def _surroundings(self, rows: Rows) -> Surroundings:
        """Of these rows (N,), ascending."""
        entries = self._read()

        def row_of(name: str) -> int:
            (row,) = entries.rows([parse_reference_name(name)[1]])
            return int(np.searchsorted(rows, row))

        places = Places(
            entries.centres(rows),
            entries.axes(rows),
            lambda row: self._name(entries.reference(int(rows[row]))[0]),
            row_of,
            lambda row: entries.reference(int(rows[row]))[2],
        )
        return Surroundings(places, self._load, self._similar, REMEMBERED_VIEWS)

    def _name(self, reference_id: str) -> str:
        return reference_name(scene_id_of(self._scene_key), reference_id)

    def _load(self, names: Sequence[str]) -> Sequence[PosedView]:
        """Those of them that are there still and not damaged."""

        def load(reference_ids: Sequence[str]) -> Loaded:
            return self._tools.library.load(
                self._scene_key, reference_ids, self._tools.extractor, StageContext(self._check)
            )

        reference_ids = [parse_reference_name(name)[1] for name in names]
        try:
            return load_usable(load, reference_ids, (DataLoss, NotFound), self._tell)[1]
        except NotFound as error:  # again one, between the two looks
            if error.field == "scene":
                raise
            raise Gone(str(error)) from error

    def _tell(self, reference_id: str, error: RequestError) -> None:
        if isinstance(error, DataLoss):
            self._tools.indexes.tell_damaged(self._scene_key, reference_id, error)

    def _similar(self, name: str, count: int) -> Sequence[str]:
        references = self._load([name])
        if not references:
            raise Gone(name)
        vector = self._tools.descriptor.describe(references[0].view)
        ranked = rank_references(self._read(), vector, count, options=SAME_PLACE_WELCOME)
        return [self._name(it.reference_id) for it in ranked]
