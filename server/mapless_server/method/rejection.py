"""The answer "I could not localize this": a result, not an error."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class RejectionReason(str, Enum):
    """Why, one for each stage that can fail, in the order of the stages."""

    NO_USABLE_REFERENCES = "no_usable_references"
    DEGENERATE_REFERENCES = "degenerate_references"
    LOW_TEXTURE = "low_texture"
    LOW_OVERLAP = "low_overlap"
    SCALE_UNRELIABLE = "scale_unreliable"
    TOO_FEW_MATCHES = "too_few_matches"
    PNP_FAILED = "pnp_failed"
    GATE = "gate"


@dataclass(frozen=True)
class Rejection:
    """Why a query was not localized.

    Attributes:
        reason: for programs.
        message: one sentence for a person, with the numbers that decided.
    """

    reason: RejectionReason
    message: str
