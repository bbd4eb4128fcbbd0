"""Scenes in memory: references with their features, retrieval indexes, audits.

May import store, security, method, networks and images. Begin with `library` (loads references), `indexes` and
`retrieval` (choose references), and `audit`.
"""

from .audit.coverage import Coverage, CoverageVerdict
from .audit.neighbourhood import PairMatches
from .audit.scene_auditor import AuditTools, SceneAuditor, Viewpoint
from .audit.verdict import AuditVerdict, ReferenceAudit
from .indexes import SceneIndexes
from .library import STORED_IMAGES, FeaturesMissing, Loaded, ReferenceLibrary, load_usable
from .retrieval.descriptor import GlobalDescriptor, Vector
from .retrieval.narrowing import Cone, Narrowing, Sphere
from .retrieval.ranking import Choice, RankedReference, RankOptions, Selection, rank_references
from .retrieval.vlad import VladDescriptor

__all__ = [
    "STORED_IMAGES",
    "AuditTools",
    "AuditVerdict",
    "Choice",
    "Cone",
    "Coverage",
    "CoverageVerdict",
    "FeaturesMissing",
    "GlobalDescriptor",
    "Loaded",
    "Narrowing",
    "PairMatches",
    "RankOptions",
    "RankedReference",
    "ReferenceAudit",
    "ReferenceLibrary",
    "SceneAuditor",
    "SceneIndexes",
    "Selection",
    "Sphere",
    "Vector",
    "Viewpoint",
    "VladDescriptor",
    "load_usable",
    "rank_references",
]
