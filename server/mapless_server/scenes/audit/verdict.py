"""What an audit says of a reference, in numbers and in one sentence."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Verdict(str, Enum):
    """What is the matter with a reference; the worst first."""

    SWAPPED_IMAGE = "swapped_image"
    """Its photograph was taken at another reference's pose, and that one's at its."""
    WRONG_POSE = "wrong_pose"
    WRONG_INTRINSICS = "wrong_intrinsics"
    WRONG_POSE_AND_INTRINSICS = "wrong_pose_and_intrinsics"
    SCENE_CHANGED = "scene_changed"
    """Pose and intrinsics fit, or cannot be judged, but it does not show what its neighbours show there."""
    DUPLICATE = "duplicate"
    """Nothing is wrong, but another reference is the same photograph, or the same view from the same place."""
    UNVERIFIABLE = "unverifiable"
    """Too little is seen in common with other references to judge."""
    CONSISTENT = "consistent"

    @property
    def is_alarm(self) -> bool:
        """Whether somebody should act: the reference misleads whoever is localized with it."""
        return self in ALARMS


ALARMS = frozenset(
    {
        Verdict.SWAPPED_IMAGE,
        Verdict.WRONG_POSE,
        Verdict.WRONG_INTRINSICS,
        Verdict.WRONG_POSE_AND_INTRINSICS,
        Verdict.SCENE_CHANGED,
    }
)


@dataclass(frozen=True)
class ReferenceAudit:
    """What is known of one reference.

    Attributes:
        reference: its name.
        verdict: see there.
        message: the same for people, with the numbers.
        neighbour_count: references that it was compared with.
        match_count: of its keypoints with points that these triangulate.
        inlier_count: matches that agree with the best explanation.
        error_px: median reprojection error of these inliers under the given pose and intrinsics, pixels of the
            processed image; None without inliers.
        position_offset_m: how far the pose that explains the matches is from the given one; None where not judged.
        rotation_offset_deg: the same for its rotation.
        position_sigma_m: standard deviation of the position offset, along it.
        focal_ratio: focal length that explains the matches by the given one; 1 where the given one does.
        changed_share: share of the image that does not show what it should; None where not judged.
        other: name of the partner of a swap or duplicate; empty if there is none.
    """

    reference: str
    verdict: Verdict
    message: str
    neighbour_count: int = 0
    match_count: int = 0
    inlier_count: int = 0
    error_px: float | None = None
    position_offset_m: float | None = None
    rotation_offset_deg: float | None = None
    position_sigma_m: float | None = None
    focal_ratio: float | None = None
    changed_share: float | None = None
    other: str = ""

    @property
    def severity(self) -> tuple[int, float]:
        """To sort by, the worst first."""
        return list(Verdict).index(self.verdict), -(self.position_offset_m or 0.0)
