"""Audits references against their neighbours, and determines which of them is wrong.

A first comparison is with the neighbours that share the most matches, which tolerates a few wrong ones among them. If
it finds a fault, three other causes are excluded before the reference is reported:

* the neighbours are wrong. Those whose own first comparison finds a fault are left out of a second one; a fault that
  disappears with them was theirs.
* all poses there are noisy. An offset must exceed the neighbours' own.
* the photographs of two references are swapped, which shows when each fits the other's pose.

If the neighbours by pose do not see what the photograph shows, references that look similar are used.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapless_server.method.features.views import PosedView
from mapless_server.method.pairs.readings.repeats import pose_difference
from mapless_server.store import LruCache

from .change import SAME_VIEWPOINT, SEEN_ALIKE, Change, find_change
from .comparison import (
    POSITION_TOLERANCE_M,
    ROTATION_TOLERANCE_DEG,
    SIGNIFICANCE_SIGMA,
    Comparison,
    Likeness,
    compare,
    likeness,
)
from .finder import ReferenceFinder
from .neighbourhood import PairMatches
from .resection import Free
from .verdict import AuditVerdict, ReferenceAudit

CANDIDATE_COUNT = 12
"""References, nearest by position and heading, that are matched."""
NEIGHBOUR_COUNT = 8
"""Those of them, with the most matches, that are used. Points need two, a verdict needs more."""
_WIDE_COUNT = 64
"""References that are matched if the nearest by pose do not show what the photograph shows."""
_SWAP_REACH = 4.0
"""A reference within this many tolerances of where a photograph was taken may be its partner in a swap; many, because
that pose was fitted to neighbours of the wrong place."""
_CACHED_COMPARISONS = 10
_CACHED_FINDINGS = 3000


@dataclass(frozen=True)
class _Finding:
    """The part of a first comparison that is cached, and whether its verdict is an alarm.

    The comparison itself takes megabytes. Values are zeros if it is not usable.
    """

    is_usable: bool
    is_alarm: bool
    offset_m: float = 0.0
    turn_deg: float = 0.0
    excess: float = 0.0

    @staticmethod
    def of(found: Comparison) -> "_Finding":
        is_alarm = found.verdict().is_alarm
        if not found.is_usable:
            return _Finding(False, is_alarm)
        return _Finding(True, is_alarm, found.offset_m, found.turn_deg, found.excess(Free.NOTHING))


@dataclass(frozen=True)
class _Twin:
    """The reference most like another one, among those that it was compared with; an empty name if there is none."""

    name: str = ""
    likeness: Likeness = Likeness.DIFFERENT


class Auditor:
    """Audits references; for use by one thread. A verdict does not depend on which other references are audited.

    Neighbours are compared again and again, so findings of first comparisons are cached, some hundred bytes each. The
    last few comparisons are cached whole, about 2 MiB each with their references; the finder caches more references.
    """

    def __init__(self, finder: ReferenceFinder, pairs: PairMatches, check: Callable[[], None] = lambda: None) -> None:
        """Makes the auditor of a scene; `check` is called before each comparison, and may raise.

        The pairs cache matches between calls.
        """
        self._finder, self._pairs, self._check = finder, pairs, check
        self._findings: LruCache[_Finding] = LruCache(_CACHED_FINDINGS)
        self._comparisons: LruCache[tuple[Comparison, _Twin]] = LruCache(_CACHED_COMPARISONS)

    def audit(self, name: str) -> ReferenceAudit:
        """Audits one reference; raises ReferenceGone if it or a neighbour cannot be loaded any more."""
        found, twin = self._first_comparison(name)
        is_wide = False
        if not found.is_usable:
            similar = self._finder.similar(name, _WIDE_COUNT)
            found, wide_twin = self._compare(name, similar)
            twin, is_wide = max(twin, wide_twin, key=lambda it: it.likeness.value), True
        verdict, contradicted = self._judge(found), ""
        if verdict.is_alarm:
            found, verdict, contradicted = self._without_suspects(found, verdict, is_wide)
        if verdict in (AuditVerdict.WRONG_POSE, AuditVerdict.WRONG_POSE_AND_INTRINSICS):
            partner = self._swapped_with(found)
            if partner:
                return _report(found, AuditVerdict.SWAPPED_IMAGE, other=partner)
        is_same_photograph = twin.likeness is Likeness.SAME_PHOTOGRAPH
        if verdict is not AuditVerdict.CONSISTENT and found.is_usable and (objection := found.objection(verdict)):
            return _report(found, AuditVerdict.UNVERIFIABLE, objection=objection)
        if verdict.is_alarm:
            return _report(found, verdict, other=twin.name if is_same_photograph else "")
        if verdict is AuditVerdict.CONSISTENT and found.verdict() is not AuditVerdict.CONSISTENT:
            # It is off by too much, and so are its neighbours: which of them is wrong is not decidable.
            return _report(found, AuditVerdict.UNVERIFIABLE)
        change = None if contradicted else self._find_change(found, verdict)
        if change is not None and change.is_alarm:
            return _report(found, AuditVerdict.SCENE_CHANGED, change=change)
        if verdict is AuditVerdict.UNVERIFIABLE:
            return _report(found, verdict, other=contradicted)
        if twin.name:
            return _report(found, AuditVerdict.DUPLICATE, twin.name, is_same_photograph, change)
        return _report(found, AuditVerdict.CONSISTENT, change=change)

    def _first_comparison(self, name: str) -> tuple[Comparison, _Twin]:
        cached = self._comparisons.get(name)
        if cached is None:
            cached = self._compare(name, self._finder.near(name, CANDIDATE_COUNT))
            self._comparisons.put(name, cached)
        return cached

    def _finding(self, name: str) -> _Finding:
        """Finding of the first comparison; cached."""
        finding = self._findings.get(name)
        if finding is None:
            finding = _Finding.of(self._first_comparison(name)[0])
            self._findings.put(name, finding)
        return finding

    def _compare(self, name: str, candidates: Sequence[str]) -> tuple[Comparison, _Twin]:
        """Compares a reference with the candidates that share the most matches, except copies of its photograph."""
        self._check()
        subject, twin = self._finder.view(name), _Twin()
        counts: dict[str, int] = {}
        for other in self._finder.views(candidates):
            matches = self._pairs.match(subject, other)
            alike = likeness(subject, other, matches)
            twin = max(twin, _Twin(other.name, alike), key=lambda it: it.likeness.value)
            if alike is not Likeness.SAME_PHOTOGRAPH:
                counts[other.name] = len(matches)
        chosen = sorted(counts, key=lambda n: -counts[n])[:NEIGHBOUR_COUNT]
        return compare(subject, self._finder.views(chosen), self._pairs), twin

    def _judge(self, found: Comparison) -> AuditVerdict:
        """The verdict of a comparison, tolerating the median offset of the neighbours."""
        verdict = found.verdict()
        if verdict is AuditVerdict.CONSISTENT or not found.is_usable:
            return verdict
        findings = [self._finding(reference.name) for reference in found.neighbourhood.references]
        usable = [other for other in findings if other.is_usable]
        if not usable:
            return verdict
        noise_m = float(np.median([other.offset_m for other in usable]))
        noise_deg = float(np.median([other.turn_deg for other in usable]))
        return found.verdict(noise_m, noise_deg)

    def _without_suspects(
        self, found: Comparison, verdict: AuditVerdict, is_wide: bool
    ) -> tuple[Comparison, AuditVerdict, str]:
        """Comparison and verdict without neighbours that seem wrong; if too few are left, also the worst of those."""
        names = [reference.name for reference in found.neighbourhood.references]
        suspects = [name for name in names if self._finding(name).is_alarm]
        if not suspects:
            return found, verdict, ""
        rest = [name for name in names if name not in suspects]
        if not is_wide:
            wider = self._finder.near(found.subject.name, 2 * CANDIDATE_COUNT)
            spare = [view.name for view in self._finder.views([n for n in wider if n not in names])]
            rest += [n for n in spare if not self._finding(n).is_alarm]
        second, _ = self._compare(found.subject.name, rest)
        if second.is_usable:
            return second, self._judge(second), ""
        worst = max(suspects, key=lambda n: self._finding(n).excess)
        if self._finding(worst).excess < found.excess(Free.NOTHING):
            return found, verdict, ""
        return second, AuditVerdict.UNVERIFIABLE, worst

    def _swapped_with(self, found: Comparison) -> str:
        """The reference with which this one has swapped its photograph; empty if there is none."""
        reach_m = _SWAP_REACH * max(POSITION_TOLERANCE_M, SIGNIFICANCE_SIGMA * found.largest_sigma_m)
        reach_deg = _SWAP_REACH * max(ROTATION_TOLERANCE_DEG, SIGNIFICANCE_SIGMA * found.sigma_deg)
        for name in self._finder.near_pose(found.world_from_camera, 4, found.subject.name):
            apart_m, apart_deg = pose_difference(found.world_from_camera, self._finder.pose(name))
            if apart_m > reach_m or apart_deg > reach_deg:
                continue
            for partner in self._finder.views([name]):
                if self._fits(found.subject, partner) and self._fits(partner, found.subject):
                    return name
        return ""

    def _fits(self, photographed: PosedView, posed: PosedView) -> bool:
        """Whether one reference's photograph fits another's pose, judged by the neighbours of that pose."""
        names = self._finder.near(posed.name, CANDIDATE_COUNT)
        others = [view for view in self._finder.views(names) if view.name != photographed.name]
        others.sort(key=lambda other: -len(self._pairs.match(photographed, other)))
        moved = replace(photographed, world_from_camera=posed.world_from_camera)
        found = compare(moved, others[:NEIGHBOUR_COUNT], self._pairs)
        return self._judge(found) is AuditVerdict.CONSISTENT

    def _find_change(self, found: Comparison, verdict: AuditVerdict) -> Change | None:
        """Finds which part of the image does not show what the neighbours show; None if that cannot be decided."""
        subject, limits = found.subject, SEEN_ALIKE
        if verdict is AuditVerdict.UNVERIFIABLE:
            nearest = self._finder.views(self._finder.near(subject.name, NEIGHBOUR_COUNT))
            found, limits = compare(subject, nearest, self._pairs), SAME_VIEWPOINT
        change = find_change(found, limits)
        if change is None or not change.is_alarm:
            return change
        # Points of neighbours with wrong poses are in wrong places.
        references = found.neighbourhood.references
        trusted = [reference for reference in references if not self._finding(reference.name).is_alarm]
        if len(trusted) == len(references):
            return change
        return find_change(compare(subject, trusted, self._pairs), limits)


_REPORTED_SHARE = 0.15
"""Share of the image; 1 of 149 unaltered photographs has as much."""


def _report(
    comparison: Comparison,
    verdict: AuditVerdict,
    other: str = "",
    is_same_photograph: bool = False,
    change: Change | None = None,
    objection: str = "",
) -> ReferenceAudit:
    """Makes the result for a reference, from the comparison on which the verdict is based.

    `other` is the partner of a swap or duplicate, or the neighbour that it contradicts; `is_same_photograph` whether a
    duplicate is more than the same view; `change` the scene's, if one was searched for; `objection` why the camera that
    contradicts the given one is not believed.
    """
    fit = _fitted(comparison, verdict)
    best = comparison.fits.get(Free.BOTH)
    return ReferenceAudit(
        reference=comparison.subject.name,
        verdict=verdict,
        message=_message(comparison, verdict, fit, other, is_same_photograph, change, objection),
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

    error_px: float | None
    offset_m: float
    turn_deg: float
    focal_ratio: float


def _fitted(comparison: Comparison, verdict: AuditVerdict) -> _Fitted | None:
    if not comparison.is_usable:
        return None
    best, given = comparison.fits[Free.BOTH], comparison.fits[Free.NOTHING]
    median_px = float(np.median(np.nan_to_num(given.error_px[best.inliers], nan=np.inf)))
    error_px = median_px if np.isfinite(median_px) else None
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
    objection: str,
) -> str:
    best, neighbour_count = comparison.fits.get(Free.BOTH), len(comparison.neighbourhood.references)
    matches = f"{best.inlier_count if best else 0} of {len(comparison.points)} matches"
    seen = f"{matches} with {neighbour_count} neighbours agree"
    if verdict is AuditVerdict.UNVERIFIABLE and other:
        return f"contradicts {other}, and no other neighbours show which of the two is wrong"
    if objection:
        return f"contradicted, too weakly to say that it is wrong: {objection}"
    if verdict is AuditVerdict.UNVERIFIABLE and not (fit and comparison.verdict() is not AuditVerdict.CONSISTENT):
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
