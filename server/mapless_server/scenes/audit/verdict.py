"""Results of an audit of a reference, and of a coverage check of a camera at a viewpoint."""

from dataclasses import dataclass
from enum import Enum

from mapless.geometry import Camera, RigidTransform
from mapless.provenance import GIVEN_POSE, Provenance


class AuditVerdict(str, Enum):
    """Faults of a reference, the worst first."""

    SWAPPED_IMAGE = "swapped_image"
    """Its photograph was taken at another reference's pose, and vice versa."""
    WRONG_POSE = "wrong_pose"
    WRONG_INTRINSICS = "wrong_intrinsics"
    WRONG_POSE_AND_INTRINSICS = "wrong_pose_and_intrinsics"
    SCENE_CHANGED = "scene_changed"
    """Pose and intrinsics fit, or cannot be judged, but it does not show what its neighbours show there."""
    WRONG_DEPTH = "wrong_depth"
    """Pose and intrinsics fit, or cannot be judged, but the depth that was measured with it does not."""
    DOUBTFUL_DEPTH = "doubtful_depth"
    """As before, but the neighbours' depth may be the wrong one."""
    DUPLICATE = "duplicate"
    """Nothing is wrong, but another reference is the same photograph, or the same view from the same place."""
    UNVERIFIABLE = "unverifiable"
    """It has too little in common with other references to be judged, or they contradict it too weakly."""
    CONSISTENT = "consistent"

    @property
    def is_alarm(self) -> bool:
        """Whether the reference should be corrected, because it misleads queries that use it."""
        return self in _ALARMS


_ALARMS = frozenset(
    {
        AuditVerdict.SWAPPED_IMAGE,
        AuditVerdict.WRONG_POSE,
        AuditVerdict.WRONG_INTRINSICS,
        AuditVerdict.WRONG_POSE_AND_INTRINSICS,
        AuditVerdict.SCENE_CHANGED,
        AuditVerdict.WRONG_DEPTH,
    }
)


@dataclass(frozen=True)
class ReferenceAudit:
    """The result for one reference.

    Attributes:
        reference: its name.
        verdict: its fault, if any.
        message: the verdict as a sentence, with the numbers.
        neighbour_count: references that it was compared with.
        match_count: matches of its keypoints with points that these references triangulate.
        inlier_count: matches that agree with the best fit.
        error_px: median reprojection error of these inliers with the given pose and intrinsics, pixels of the
            processed image; None without inliers, or if most of their points are behind the camera.
        position_offset_m: distance of the fitted pose from the given one; None if not judged.
        rotation_offset_deg: the same for the rotation.
        focal_ratio: fitted over given focal length; 1 if the given one fits.
        changed_share: share of the image that does not show what it should; None where not judged.
        other: name of the partner of a swap or duplicate; empty if there is none.
        provenance: how its stored pose is known.
    """

    reference: str
    verdict: AuditVerdict
    message: str
    neighbour_count: int = 0
    match_count: int = 0
    inlier_count: int = 0
    error_px: float | None = None
    position_offset_m: float | None = None
    rotation_offset_deg: float | None = None
    focal_ratio: float | None = None
    changed_share: float | None = None
    other: str = ""
    provenance: Provenance = GIVEN_POSE


class CoverageVerdict(str, Enum):
    """Whether a photograph would be localized."""

    LOCALIZABLE = "localizable"
    DOUBTFUL = "doubtful"
    NOT_LOCALIZABLE = "not_localizable"


@dataclass(frozen=True)
class Coverage:
    """The prediction for one pose.

    Attributes:
        verdict: whether a photograph would be localized.
        message: the verdict as a sentence, with the numbers.
        expected_match_count: matches that agree with the pose.
        image_share: share of the image's cells in which at least one is expected.
        position_68_m: position error that is not exceeded in 68 % of cases; None if no pose is expected.
        references: names of the references that would be used, those with the most matches first.
    """

    verdict: CoverageVerdict
    message: str
    expected_match_count: int
    image_share: float
    position_68_m: float | None
    references: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """A camera and its pose world_from_camera, metric."""

    camera: Camera
    world_from_camera: RigidTransform
