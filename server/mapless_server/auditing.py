"""Auditing stored references, and foretelling where one would be localized: what the two need of the library."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mapless.geometry import Camera, RigidTransform
from mapless.names import parse_reference_name, reference_name

from .audit.auditor import Auditor
from .audit.coverage import Coverage, check_coverage
from .audit.neighbourhood import PairMatches
from .audit.options import AuditOptions
from .audit.surroundings import PosedName, Surroundings
from .audit.verdict import ReferenceAudit
from .errors import NotFound
from .library import ReferenceLibrary
from .method.features import FeatureExtractor
from .method.views import PosedView
from .retrieval.descriptor import GlobalDescriptor
from .retrieval.index import Entries, Rows
from .retrieval.ranking import RankOptions, rank_references
from .scene_indexes import SceneIndexes
from .tenancy import SceneKey, scene_id_of
from .turns import Turn

REMEMBERED_VIEWS = 200
"""Loaded references that a call keeps, about 1.2 MB each."""

AS_THEY_COME = RankOptions(apart_m=0.0)
"""Neighbours at one place see the same, which here is what they are wanted for."""


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
    """Knows what is around the references of a scene as it was when first asked; of one thread at a time."""

    def __init__(self, tools: Tools, scene_key: SceneKey) -> None:
        self._tools = tools
        self._scene_key = scene_key
        self._entries: Entries | None = None
        self._auditor: Auditor | None = None
        self._check: Callable[[], None] = lambda: None

    @property
    def generation(self) -> int:
        """Of the scene that is examined; 0 before it was asked."""
        return self._entries.generation if self._entries else 0

    def audit(self, reference_id: str, check: Callable[[], None]) -> ReferenceAudit:
        """What the neighbours of a reference say about it.

        Raises:
            NotFound: there is no such scene or reference.
        """
        self._check = check
        entries = self._read()
        if reference_id not in entries:
            scene_id = scene_id_of(self._scene_key)
            raise NotFound(f"there is no reference {reference_id!r} in scene {scene_id!r}", field="references")
        if self._auditor is None:
            surroundings = self._surroundings(entries.rows())
            self._auditor = Auditor(surroundings, AuditOptions(), self._tools.pairs, lambda: self._check())
        return self._auditor.audit(self._name(reference_id))

    def check_coverage(self, view: Viewpoint, check: Callable[[], None]) -> Coverage:
        """Whether a photograph would be localized that is taken from somewhere. NotFound: there is no such scene."""
        self._check = check
        entries = self._read()
        rows = entries.rows()
        away_m = np.linalg.norm(entries.centres(rows) - view.world_from_camera.translation, axis=1)
        nearest = rows[np.argsort(away_m, kind="stable")[:COVERAGE_CANDIDATES]]
        scale = min(1.0, PROCESSED_SIDE_PX / max(view.camera.width_px, view.camera.height_px))
        width_px, height_px = round(scale * view.camera.width_px), round(scale * view.camera.height_px)
        camera = view.camera.resized(width_px, height_px).pinhole()
        return check_coverage(camera, view.world_from_camera, self._surroundings(nearest), self._tools.pairs)

    def _read(self) -> Entries:
        if self._entries is None:
            self._entries = self._tools.indexes.entries(self._scene_key, Turn(self._check))
        return self._entries

    def _surroundings(self, rows: Rows) -> Surroundings:
        placed = [self._read().reference(row) for row in rows.tolist()]
        poses = [PosedName(self._name(reference_id), pose) for reference_id, _, pose in placed]
        return Surroundings(poses, self._load, self._similar, REMEMBERED_VIEWS)

    def _name(self, reference_id: str) -> str:
        return reference_name(scene_id_of(self._scene_key), reference_id)

    def _load(self, names: Sequence[str]) -> Sequence[PosedView]:
        reference_ids = [parse_reference_name(name)[1] for name in names]
        return self._tools.library.load(self._scene_key, reference_ids, self._tools.extractor, Turn(self._check))[1]

    def _similar(self, name: str, count: int) -> Sequence[str]:
        (reference,) = self._load([name])
        vector = self._tools.descriptor.describe(reference.view)
        ranked = rank_references(self._read(), vector, count, options=AS_THEY_COME)
        return [self._name(it.reference_id) for it in ranked]
