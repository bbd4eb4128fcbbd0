"""Rejections: a photograph that cannot be localized is a result, not an error."""

from dataclasses import dataclass
from enum import Enum

from mapless.geometry import Array, RigidTransform


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
    """The kinds of advice after a rejection."""

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
    CHECK_REFERENCE_POSES = "check_reference_poses"
    """The references' poses do not agree with the matches between their photographs."""


class IntrinsicsParameter(str, Enum):
    """Parameters of a photograph's intrinsics that its matches are compared with."""

    FOCAL_LENGTH = "focal_length"
    """Along x; that along y in proportion."""
    PRINCIPAL_X = "principal_x"
    PRINCIPAL_Y = "principal_y"
    K1 = "k1"

    @property
    def field(self) -> str:
        """Its name in requests; for the focal length the one along x."""
        return {"focal_length": "focal_x_px", "k1": "k1"}.get(self.value, f"{self.value}_px")


@dataclass(frozen=True)
class IntrinsicsCheck:
    """Comparison of one intrinsic parameter with the matches' estimate, in pixels of the photograph as it was sent.

    Attributes:
        parameter: the parameter.
        given: its value in the request.
        estimated: its value estimated from the photograph alone, with the other parameters held by their priors.
        estimated_sigma: standard deviation of the estimated value.
        given_sigma: standard deviation of the given one.
        conflict: whether they differ by more than both allow.
        used: whether the pose was computed with the estimated value.
    """

    parameter: IntrinsicsParameter
    given: float
    estimated: float
    estimated_sigma: float
    given_sigma: float
    conflict: bool
    used: bool


@dataclass(frozen=True)
class Hint:
    """Advice after a rejection: what would help.

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
class PoseHypothesis:
    """A pose that explains the photograph, and is not accepted.

    Attributes:
        world_from_camera: metric.
        inlier_count: keypoints of the photograph with an inlier match with any reference.
        references: names of the references that support it; of one of two hypotheses, more than the other.
        covariance: (6, 6) as of `Localization`, of a pose that is only too uncertain; None for one of two.
        world: name of the world that the pose is in, of several scenes: the scene's; empty for one.
    """

    world_from_camera: RigidTransform
    inlier_count: int
    references: tuple[str, ...]
    covariance: Array | None = None
    world: str = ""


@dataclass(frozen=True)
class Rejection:
    """Why a query was not localized.

    Attributes:
        reason: for programs.
        message: one sentence for a person, with the numbers that decided.
        hint: advice on what would help; None until `hints` has added it.
        tried: number of 2D-3D matches that were used; None if there are none yet.
        intrinsics_checks: evidence of the matches about the intrinsics; empty unless a conflict with them is the
            reason.
        hypotheses: the poses that explain it, the better supported first; empty unless AMBIGUOUS.
        imprecise: the pose that is rejected for its radius alone, with covariance; None if there is more against it.
    """

    reason: RejectionReason
    message: str
    hint: Hint | None = None
    hypotheses: tuple[PoseHypothesis, ...] = ()
    tried: int | None = None
    intrinsics_checks: tuple[IntrinsicsCheck, ...] = ()
    imprecise: PoseHypothesis | None = None
