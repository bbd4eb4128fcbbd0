"""The result of an audit, from the comparison that it is based on, with a sentence for the operator."""

from dataclasses import dataclass

import numpy as np

from .change import Change
from .comparison import Comparison
from .resection import Free
from .verdict import AuditVerdict, ReferenceAudit

_REPORTED_SHARE = 0.15
"""Share of the image; 1 of 149 unaltered photographs has as much."""


def report(
    comparison: Comparison,
    verdict: AuditVerdict,
    other: str = "",
    is_same_photograph: bool = False,
    change: Change | None = None,
) -> ReferenceAudit:
    """Makes the result for a reference, from the comparison on which the verdict is based.

    `other` is the partner of a swap or duplicate, or the neighbour that it contradicts; `is_same_photograph` whether a
    duplicate is more than the same view; `change` the scene's, if one was searched for.
    """
    fit = _fitted(comparison, verdict)
    best = comparison.fits.get(Free.BOTH)
    return ReferenceAudit(
        reference=comparison.subject.name,
        verdict=verdict,
        message=_message(comparison, verdict, fit, other, is_same_photograph, change),
        neighbour_count=len(comparison.neighbourhood.references),
        match_count=len(comparison.points),
        inlier_count=best.inlier_count if best else 0,
        error_px=fit.error_px if fit else None,
        position_offset_m=fit.offset_m if fit else None,
        rotation_offset_deg=fit.turn_deg if fit else None,
        focal_ratio=fit.focal_ratio if fit else None,
        changed_share=change.changed_share if change else None,
        other=other,
    )


@dataclass(frozen=True)
class _Fitted:
    """Differences between the given camera and the fit that a verdict is based on; see `ReferenceAudit`."""

    error_px: float
    offset_m: float
    turn_deg: float
    focal_ratio: float


def _fitted(comparison: Comparison, verdict: AuditVerdict) -> _Fitted | None:
    if not comparison.is_usable:
        return None
    best, given = comparison.fits[Free.BOTH], comparison.fits[Free.NOTHING]
    error_px = float(np.median(np.nan_to_num(given.error_px[best.inliers], nan=1e6)))
    if verdict is AuditVerdict.WRONG_INTRINSICS:
        return _Fitted(error_px, 0.0, 0.0, comparison.focal_ratio)
    if verdict is AuditVerdict.WRONG_POSE_AND_INTRINSICS:
        ratio = best.camera.focal_x_px / comparison.subject.view.camera.focal_x_px
        return _Fitted(error_px, *comparison.distance(best.world_from_camera), ratio)
    return _Fitted(error_px, comparison.offset_m, comparison.turn_deg, 1.0)


def _message(
    comparison: Comparison,
    verdict: AuditVerdict,
    fit: _Fitted | None,
    other: str,
    is_same_photograph: bool,
    change: Change | None,
) -> str:
    best, neighbour_count = comparison.fits.get(Free.BOTH), len(comparison.neighbourhood.references)
    matches = f"{best.inlier_count if best else 0} of {len(comparison.points)} matches"
    seen = f"{matches} with {neighbour_count} neighbours agree"
    if verdict is AuditVerdict.UNVERIFIABLE and other:
        return f"contradicts {other}, and no other neighbours show which of the two is wrong"
    if verdict is AuditVerdict.UNVERIFIABLE and not (fit and comparison.verdict().is_alarm):
        return f"too little in common with {neighbour_count} neighbours to judge: {seen}"
    if verdict is AuditVerdict.SCENE_CHANGED:
        assert change is not None
        return (
            f"does not show what its neighbours show: {change.found_count} of {change.expected_count} points that"
            f" should be seen are found, and {100 * change.changed_share:.0f} % of the image in one piece has few"
        )
    if verdict is AuditVerdict.SWAPPED_IMAGE:
        return f"the photograph fits the pose of {other}, and that one's fits here: swapped; {seen}"
    if verdict is AuditVerdict.DUPLICATE:
        kind = "the same photograph as" if is_same_photograph else "the same view from the same place as"
        return f"{kind} {other}"
    assert fit is not None
    where = f"{_length(fit.offset_m)} and {fit.turn_deg:.2f} degrees from where its neighbours see it"
    if verdict is AuditVerdict.UNVERIFIABLE:
        return f"{where}, which are off by as much themselves: fix what is wrong with others, then audit it again"
    pose = f"the given pose is {_length(fit.offset_m)} from and turned by {fit.turn_deg:.2f} degrees against"
    pose = f"{pose} the one that fits its matches"
    # The error of the given value is the inverse of its correction.
    focal = f"the given focal length is off by {100 * (1 / (fit.focal_ratio or 1.0) - 1):+.1f} %"
    if verdict is AuditVerdict.WRONG_POSE:
        twin = f"; the same photograph is stored as {other}" if other else ""
        return f"{pose}; {seen}{twin}"
    if verdict is AuditVerdict.WRONG_INTRINSICS:
        return f"{focal}; the pose is right; {seen}"
    if verdict is AuditVerdict.WRONG_POSE_AND_INTRINSICS:
        return f"{pose}, and {focal}; {seen}"
    missing = ""
    if change is not None and change.changed_share >= _REPORTED_SHARE:
        missing = f"; {100 * change.changed_share:.0f} % of the image in one piece shows few of its neighbours' points"
    return f"consistent: {where}; {seen}{missing}"


def _length(metres: float) -> str:
    return f"{100 * metres:.1f} cm" if metres < 1 else f"{metres:.2f} m"
