"""Options of an audit."""

from dataclasses import dataclass, field

from mapless_server.method.options import check_bounds
from mapless_server.method.structure import StructureOptions

from .resection import ResectionOptions


@dataclass(frozen=True)
class AuditOptions:
    """Options of an audit; measured on six real scenes with 8 to 60 references, unaltered and with planted faults.

    Attributes:
        position_tolerance_m: smaller offsets are no fault. Of unaltered kitchen, fountain, church and office references
            the worst is off by 0.027, and faults of 0.05 are found to be 0.043 to 0.059.
        rotation_tolerance_deg: smaller rotations are no fault: the worst unaltered one is 0.65, and faults of 2 are
            found to be 1.8 to 2.15.
        focal_tolerance: smaller errors of the focal length, as a share, are no fault: the worst unaltered one is 0.007,
            and faults of 0.05 are found to be 0.045 to 0.055.
        significance_sigma: an offset must also exceed this many of its own standard deviations along its direction
            (from the matches, doubled as in the method's final adjustment).
        neighbour_noise: and this many times the median offset of its neighbours: if all poses are off by 10 cm, as at
            one end of a drive with GPS poses, no single one is at fault.
        candidate_count: number of references, nearest by position and heading, that are matched.
        neighbour_count: number of these, with the most matches, that are used. Points need two, a verdict needs more.
        wide_count: number of references that are matched if the nearest by pose do not show what the photograph shows.
        epipolar_px: as for matching references.
        min_inliers: with fewer there is no verdict. Repeated texture has given up to 23 wrong ones.
        max_log10_false_alarms: as in `GateOptions`, with a reserve, since an audit makes thousands of decisions.
        swap_reach: a reference within this many tolerances of where a photograph was taken may be its partner in a
            swap; many, because that pose was fitted to neighbours of the wrong place.
        both_excess: if a changed pose alone and a changed focal length alone leave more robust cost per match than
            this, both are wrong. One true cause leaves up to 0.75, two leave 4.
        same_photograph_px: median shift of the keypoints of one photograph, recompressed, is smaller.
        same_photograph_share: and the share of them that match is larger.
        same_view_share: median shift of the keypoints of equivalent views is smaller, as a share of the image's width,
        same_view_matched_share: and the share of them that match is larger.
        structure: options of the neighbours' points.
        resection: options of the reference's fits.
    """

    position_tolerance_m: float = 0.035
    rotation_tolerance_deg: float = 1.0
    focal_tolerance: float = 0.02
    significance_sigma: float = 3.0
    neighbour_noise: float = 3.0
    candidate_count: int = 12
    neighbour_count: int = 8
    wide_count: int = 64
    epipolar_px: float = 2.0
    min_inliers: int = 25
    max_log10_false_alarms: float = -6.0
    swap_reach: float = 4.0
    both_excess: float = 2.0
    same_photograph_px: float = 0.5
    same_photograph_share: float = 0.7
    same_view_share: float = 0.003
    same_view_matched_share: float = 0.3
    structure: StructureOptions = field(default_factory=StructureOptions)
    resection: ResectionOptions = field(default_factory=ResectionOptions)

    def __post_init__(self) -> None:
        check_bounds(self, "position_tolerance_m rotation_tolerance_deg focal_tolerance epipolar_px", above=0)
        check_bounds(self, "significance_sigma neighbour_noise swap_reach both_excess same_photograph_px", above=0)
        check_bounds(self, "candidate_count wide_count", at_least=1)
        check_bounds(self, "neighbour_count", at_least=2)
        check_bounds(self, "min_inliers", at_least=8)
        check_bounds(self, "same_photograph_share same_view_share same_view_matched_share", above=0, at_most=1)
