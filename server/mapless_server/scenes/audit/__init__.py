"""Audit and coverage: whether the references are right, and where one would be localized with them.

Pure analysis of posed views, which knows nothing of grpc or storage.
"""

from .auditor import audit_references
from .coverage import Coverage, CoverageOptions, CoverageVerdict, check_coverage
from .neighbourhood import PairMatches
from .options import AuditOptions
from .surroundings import PosedName, Surroundings, surroundings_of
from .verdict import ALARMS, ReferenceAudit, Verdict

__all__ = [
    "ALARMS",
    "AuditOptions",
    "Coverage",
    "CoverageOptions",
    "CoverageVerdict",
    "PairMatches",
    "PosedName",
    "ReferenceAudit",
    "Surroundings",
    "Verdict",
    "audit_references",
    "check_coverage",
    "surroundings_of",
]
