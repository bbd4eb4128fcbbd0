"""Audits of references that are all in memory."""

from collections.abc import Callable, Sequence

import numpy as np

from mapless.names import parse_reference_name
from mapless_server.method.features.views import PosedView
from mapless_server.scenes import ReferenceAudit
from mapless_server.scenes.audit.auditor import Auditor
from mapless_server.scenes.audit.finder import ReferenceFinder
from mapless_server.scenes.audit.neighbourhood import PairMatches
from mapless_server.scenes.retrieval.index import Entries, SceneIndex
from mapless_server.store import IndexedReference, SceneChanges

Load = Callable[[Sequence[str]], Sequence[PosedView]]


def entries_of(references: Sequence[PosedView]) -> Entries:
    """Index entries of references without descriptors, at generation 1."""
    index = SceneIndex(1)
    ids = [parse_reference_name(it.name)[1] for it in references]
    added = [
        IndexedReference(reference_id, reference_id, it.world_from_camera, None)
        for reference_id, it in zip(ids, references, strict=True)
    ]
    index.apply(SceneChanges(1, tuple(added), frozenset(), True))
    return index.entries()


def finder_of(references: Sequence[PosedView], load: Load | None = None) -> ReferenceFinder:
    """A finder of references in memory; those similar to one are the nearest."""
    by_name = {it.name: it for it in references}
    centres = np.array([it.world_from_camera.translation for it in references]).reshape(-1, 3)

    def similar(name: str, count: int) -> list[str]:
        away_m = np.linalg.norm(centres - by_name[name].world_from_camera.translation, axis=1)
        return [references[i].name for i in np.argsort(away_m, kind="stable")[:count]]

    entries = entries_of(references)
    scene_id = parse_reference_name(references[0].name)[0] if references else "empty"
    load = load or (lambda names: [by_name[name] for name in names])
    return ReferenceFinder(scene_id, entries, entries.rows(), load, similar, max(1, len(references)))


def audit_references(
    names: Sequence[str], finder: ReferenceFinder, pairs: PairMatches | None = None
) -> list[ReferenceAudit]:
    """Audits references in the order named."""
    auditor = Auditor(finder, pairs or PairMatches())
    return [auditor.audit(name) for name in names]
