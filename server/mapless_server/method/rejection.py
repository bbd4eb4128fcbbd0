"""Rejections: a photograph that cannot be localized is a result, not an error."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from mapless.geometry import RigidTransform


class RejectionReason(str, Enum):
    """Reasons of rejections, in the order of the stages."""

    NO_USABLE_REFERENCES = "no_usable_references"
    DEGENERATE_REFERENCES = "degenerate_references"
    LOW_TEXTURE = "low_texture"
    LOW_OVERLAP = "low_overlap"
    SCALE_UNRELIABLE = "scale_unreliable"
    TOO_FEW_MATCHES = "too_few_matches"
    PNP_FAILED = "pnp_failed"
    GATE = "gate"
    """The evidence for a pose does not suffice; the message says which test failed, the gate or one of the judge."""
    AMBIGUOUS = "ambiguous"
    """Two places explain the photograph about as well."""
    PRIOR_CONFLICT = "prior_conflict"
    """A pose outside the hard priors."""


class Advice(str, Enum):
    """What would help after a rejection."""

    ADD_REFERENCES = "add_references"
    """Name references, or add some to the scene."""
    SPREAD_REFERENCES = "spread_references"
    """Use references at different places, so that points can be triangulated."""
    RETAKE_PHOTOGRAPH = "retake_photograph"
    """Retake it with more light, less blur, more texture."""
    LOOK_AT_REFERENCE = "look_at_reference"
    """Point the camera at what the best reference shows."""
    CHOOSE_OTHER_REFERENCES = "choose_other_references"
    """Use references that show the same as the photograph; or the scene in which it was taken."""
    CHECK_CALIBRATION = "check_calibration"
    """Many matches and few inliers: check the intrinsics of the photograph and the references' poses."""
    TELL_PLACES_APART = "tell_places_apart"
    """Use a prior, or a photograph that shows what distinguishes the places."""
    CHECK_PRIOR = "check_prior"
    """The prior contradicts the photograph, or leaves no reference."""


@dataclass(frozen=True)
class Hint:
    """What would help after a rejection.

    Attributes:
        stage: the stage that failed, named as in the timings; empty if none began.
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
    """One of several poses that explain the photograph.

    Attributes:
        world_from_camera: metric.
        inlier_count: keypoints of the photograph with an inlier match with any reference.
        references: names of the references that support it more than the other hypothesis.
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
        hint: what would help; None until `hints` has added it.
        tried: number of 2D-3D matches that were used; None if there are none yet.
        focal_ratio: the focal length that the matches give over that of the intrinsics; None unless it is the reason.
        hypotheses: the poses that explain it, the better supported first; empty unless AMBIGUOUS.
    """

    reason: RejectionReason
    message: str
    hint: Hint | None = None
    hypotheses: tuple[Hypothesis, ...] = ()
    tried: int | None = None
    focal_ratio: float | None = None
