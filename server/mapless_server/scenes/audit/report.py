"""What an audit found, told to people."""

from __future__ import annotations

import numpy as np

from .change import Change
from .look import Look
from .resection import Freedom
from .verdict import ReferenceAudit, Verdict

_WORTH_MENTIONING = 0.15
"""Share of the image; of 149 unaltered photographs 1 has as much."""


def describe(
    look: Look, verdict: Verdict, other: str = "", same: bool = False, change: Change | None = None
) -> ReferenceAudit:
    """The audit of a reference from the look that decided on it."""
    numbers = _Numbers(look, verdict)
    return ReferenceAudit(
        reference=look.subject.name,
        verdict=verdict,
        message=_message(numbers, verdict, other, same, change),
        neighbour_count=len(look.neighbourhood.references),
        match_count=len(look.observed),
        inlier_count=numbers.inlier_count,
        error_px=numbers.error_px,
        position_offset_m=numbers.offset_m,
        rotation_offset_deg=numbers.turn_deg,
        position_sigma_m=look.sigma_m if look.is_usable else None,
        focal_ratio=numbers.focal_ratio,
        changed_share=change.changed_share if change else None,
        other=other,
    )


class _Numbers:
    """Of the explanation that a verdict rests on."""

    def __init__(self, look: Look, verdict: Verdict) -> None:
        self.match_count = len(look.observed)
        self.neighbour_count = len(look.neighbourhood.references)
        self.inlier_count = look.explanations[Freedom.BOTH].inlier_count if look.explanations else 0
        self.error_px = self.offset_m = self.turn_deg = self.focal_ratio = None  # type: float | None
        self.stands_out = look.is_usable and look.verdict().is_alarm
        if not look.is_usable:
            return
        best, given = look.explanations[Freedom.BOTH], look.explanations[Freedom.NOTHING]
        self.error_px = float(np.median(np.nan_to_num(given.error_px[best.inliers], nan=1e6)))
        if verdict is Verdict.WRONG_INTRINSICS:
            self.offset_m, self.turn_deg, self.focal_ratio = 0.0, 0.0, look.focal_ratio
        elif verdict is Verdict.WRONG_POSE_AND_INTRINSICS:
            pose = best.world_from_camera
            self.offset_m, self.turn_deg = look.distance(pose)
            self.focal_ratio = best.camera.focal_x_px / look.subject.view.camera.focal_x_px
        else:
            self.offset_m, self.turn_deg, self.focal_ratio = look.offset_m, look.turn_deg, 1.0


def _message(numbers: _Numbers, verdict: Verdict, other: str, same: bool, change: Change | None) -> str:
    seen = f"{numbers.inlier_count} of {numbers.match_count} matches with {numbers.neighbour_count} neighbours agree"
    if verdict is Verdict.UNVERIFIABLE:
        if other:
            return f"contradicts {other}, and no other neighbours can tell which of the two is wrong"
        if numbers.stands_out:
            off = f"{_length(numbers.offset_m)} and {numbers.turn_deg:.2f} degrees from where its neighbours see it"
            return f"{off}, which are off by as much themselves: mend what is wrong with others, then audit it again"
        return f"too little in common with {numbers.neighbour_count} neighbours to judge: {seen}"
    if verdict is Verdict.SCENE_CHANGED:
        assert change is not None
        return (
            f"does not show what its neighbours show: {change.found_count} of {change.expected_count} points that"
            f" should be seen are found, and {100 * change.changed_share:.0f} % of the image in one piece has few"
        )
    pose = f"{_length(numbers.offset_m)} from and turned by {numbers.turn_deg:.2f} degrees against"
    # What is told is what is wrong with the given value, so the inverse of what would put it right.
    given_focal = f"{100 * (1 / (numbers.focal_ratio or 1.0) - 1):+.1f} %"
    if verdict is Verdict.SWAPPED_IMAGE:
        return f"the photograph fits the pose of {other}, and that one's fits here: swapped; {seen}"
    if verdict is Verdict.WRONG_POSE:
        twin = f"; the same photograph is stored as {other}" if other else ""
        return f"the given pose is {pose} the one that explains its matches; {seen}{twin}"
    if verdict is Verdict.WRONG_INTRINSICS:
        return f"the given focal length is off by {given_focal}; the pose is right; {seen}"
    if verdict is Verdict.WRONG_POSE_AND_INTRINSICS:
        return (
            f"the given pose is {pose} the one that explains its matches, and the given focal length is off by"
            f" {given_focal}; {seen}"
        )
    if verdict is Verdict.DUPLICATE:
        return f"{'the same photograph as' if same else 'the same view from the same place as'} {other}"
    where = f"{_length(numbers.offset_m)} and {numbers.turn_deg:.2f} degrees from where its neighbours see it"
    missing = ""
    if change is not None and change.changed_share >= _WORTH_MENTIONING:
        missing = f"; {100 * change.changed_share:.0f} % of the image in one piece shows few of its neighbours' points"
    return f"consistent: {where}; {seen}{missing}"


def _length(metres: float | None) -> str:
    metres = metres or 0.0
    return f"{100 * metres:.1f} cm" if metres < 1 else f"{metres:.2f} m"
