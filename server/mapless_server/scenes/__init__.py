"""Scenes in memory: references with their features, retrieval indexes, audits.

May import store, security, method, networks and images. Begin with `library` (loads references), `indexes` and
`retrieval` (choose references), `background` (matches references ahead of queries), `audit`, `plausibility`,
`depth_checks`, `adoption` (which photographs become references) and `report` (how photographs were answered). The
package itself has the values that other rooms exchange with it.
"""

from .audit.verdict import AuditVerdict, Coverage, CoverageVerdict, ReferenceAudit, Viewpoint
from .retrieval.narrowing import ANYWHERE, Cone, Narrowing, Sphere
from .retrieval.ranking import Choice, RankedReference, RankOptions, Selection, rank_references
