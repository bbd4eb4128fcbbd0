"""Auditing stored references: what the audit needs of the library, for some references of a scene at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from mapless.names import parse_reference_name, reference_name

from .audit.auditor import Auditor
from .audit.neighbourhood import PairMatches
from .audit.options import AuditOptions
from .audit.surroundings import PosedName, Surroundings
from .audit.verdict import ReferenceAudit
from .errors import NotFound
from .library import ReferenceLibrary
from .method.views import PosedView
from .retrieval.descriptor import GlobalDescriptor
from .retrieval.index import Entries
from .retrieval.ranking import RankOptions, rank_references
from .scene_indexes import SceneIndexes
from .tenancy import SceneKey, scene_id_of
from .tiers import Tier
from .turns import Turn

REMEMBERED_VIEWS = 200
"""Loaded references that a call keeps, about 1.2 MB each."""

AS_THEY_COME = RankOptions(apart_m=0.0)
"""Neighbours at one place see the same, which here is what they are wanted for."""


class SceneAudit:
    """Audits references of a scene as it is when the first one is; of one thread at a time."""

    def __init__(
        self,
        library: ReferenceLibrary,
        indexes: SceneIndexes,
        descriptor: GlobalDescriptor,
        tier: Tier,
        scene_key: SceneKey,
    ) -> None:
        """The tier is the first: every reference has its features."""
        self._library = library
        self._indexes = indexes
        self._descriptor = descriptor
        self._extractor = tier.extractor
        self._ratio = tier.pipeline.matcher.options.reference_ratio
        self._scene_key = scene_key
        self._auditor: Auditor | None = None
        self._entries: Entries | None = None
        self._check: Callable[[], None] = lambda: None

    @property
    def generation(self) -> int:
        """Of the scene that is audited; 0 before the first."""
        return self._entries.generation if self._entries else 0

    def audit(self, reference_id: str, check: Callable[[], None]) -> ReferenceAudit:
        """What the neighbours of a reference say about it.

        Raises:
            NotFound: there is no such scene or reference.
        """
        self._check = check
        if self._auditor is None:
            self._auditor = self._make_auditor(Turn(check))
        assert self._entries is not None
        if reference_id not in self._entries:
            scene_id = scene_id_of(self._scene_key)
            raise NotFound(f"there is no reference {reference_id!r} in scene {scene_id!r}", field="references")
        return self._auditor.audit(self._name(reference_id))

    def _make_auditor(self, turn: Turn) -> Auditor:
        self._entries = entries = self._indexes.entries(self._scene_key, turn)
        placed = [entries.reference(row) for row in entries.rows().tolist()]
        poses = [PosedName(self._name(reference_id), pose) for reference_id, _, pose in placed]
        surroundings = Surroundings(poses, self._load, self._similar, remembered_views=REMEMBERED_VIEWS)
        return Auditor(surroundings, AuditOptions(), PairMatches(self._ratio), lambda: self._check())

    def _name(self, reference_id: str) -> str:
        return reference_name(scene_id_of(self._scene_key), reference_id)

    def _load(self, names: Sequence[str]) -> Sequence[PosedView]:
        reference_ids = [parse_reference_name(name)[1] for name in names]
        return self._library.load(self._scene_key, reference_ids, self._extractor, Turn(self._check))[1]

    def _similar(self, name: str, count: int) -> Sequence[str]:
        assert self._entries is not None
        (reference,) = self._load([name])
        vector = self._descriptor.describe(reference.view)
        ranked = rank_references(self._entries, vector, count, options=AS_THEY_COME)
        return [self._name(it.reference_id) for it in ranked]
