"""The answer "I could not localize this": a result, not an error."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from mapless.geometry import RigidTransform


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
    """A pose that is not to be trusted: chance, or repeated structure, could support it as well."""
    AMBIGUOUS = "ambiguous"
    """Two places explain the photograph about as well."""
    PRIOR_CONFLICT = "prior_conflict"
    """A pose outside what is known of the camera."""


class Advice(str, Enum):
    """What would help."""

    ADD_REFERENCES = "add_references"
    """Name references, or add some to the scene."""
    SPREAD_REFERENCES = "spread_references"
    """References that stand apart from one another, so that depth can be seen."""
    RETAKE_PHOTOGRAPH = "retake_photograph"
    """More light, less blur, something with texture."""
    LOOK_AT_REFERENCE = "look_at_reference"
    """Point the camera at what the best reference shows."""
    CHOOSE_OTHER_REFERENCES = "choose_other_references"
    """References that show what the photograph shows; or the scene where it was taken."""
    CHECK_CALIBRATION = "check_calibration"
    """Much is matched and little agrees: the intrinsics of the photograph, or the references' poses, do not fit."""
    TELL_PLACES_APART = "tell_places_apart"
    """A prior, or a photograph that shows what tells the places apart."""
    CHECK_PRIOR = "check_prior"
    """What was said of the camera contradicts the photograph, or leaves no reference."""


@dataclass(frozen=True)
class Hint:
    """What to do about a rejection.

    Attributes:
        stage: of the method that could not do its work, as the timings call it; empty if none began.
        advice: for programs.
        message: one sentence for a person.
        best_reference: name of the reference that overlaps most with the photograph; None if none does.
    """

    stage: str
    advice: Advice
    message: str
    best_reference: str | None = None


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A place where the photograph may have been taken.

    Attributes:
        world_from_camera: metric.
        inlier_count: keypoints of the photograph whose matches with any reference agree with it.
        references: names of the references that support it rather than another hypothesis.
    """

    world_from_camera: RigidTransform
    inlier_count: int
    references: tuple[str, ...]


@dataclass(frozen=True)
class Rejection:
    """Why a query was not localized.

    Attributes:
        reason: for programs.
        message: one sentence for a person, with the numbers that decided.
        hint: what to do about it; None where nobody has asked (see `hints`).
        tried: matches with points of the references that it was judged by; None where none were made.
        hypotheses: the places between which nothing decides, the better supported first; empty unless AMBIGUOUS.
    """

    reason: RejectionReason
    message: str
    hint: Hint | None = None
    hypotheses: tuple[Hypothesis, ...] = ()
    tried: int | None = None
