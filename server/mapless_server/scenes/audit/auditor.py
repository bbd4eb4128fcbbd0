"""Examines references against their neighbours, and finds out who is at fault.

A first look judges a reference from the neighbours that share the most matches with it, which are robust against a few
wrong ones among them. Where it finds a fault there are three suspicions to clear before anybody is blamed:

* the neighbours are at fault. Those whose own first look finds a fault are left out of a second look; a fault that goes
  away with them was theirs.
* all poses there are noisy. An offset must stand out from the neighbours' own.
* the photographs of two references are swapped, which shows when each fits the other's pose.

Where the neighbours by pose do not see what the photograph shows, others are asked that look like it.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapless_server.method.views import PosedView

from .change import SAME_VIEWPOINT, Change, ChangeOptions, changed_region
from .duplicates import Likeness, likeness
from .look import Look, look_at, pose_difference
from .neighbourhood import PairMatches
from .options import AuditOptions
from .report import describe
from .resection import Freedom
from .surroundings import Surroundings
from .verdict import ReferenceAudit, Verdict

_WHOLE_LOOKS = 10
"""First looks that are kept whole."""


def audit_references(
    names: Sequence[str],
    surroundings: Surroundings,
    options: AuditOptions | None = None,
    pairs: PairMatches | None = None,
    check: Callable[[], None] = lambda: None,
) -> list[ReferenceAudit]:
    """Audits references of a scene, in the order named; the verdicts do not depend on who else is named.

    Args:
        names: references of the surroundings.
        surroundings: all references of the scene.
        options: see there.
        pairs: remembers matches between calls; with the ratio of the features.
        check: called before each look, and lets what it raises through.
    """
    auditor = Auditor(surroundings, options or AuditOptions(), pairs or PairMatches(), check)
    return [auditor.audit(name) for name in names]


@dataclass(frozen=True)
class _Finding:
    """What is remembered of a first look, which itself takes megabytes.

    Attributes:
        is_usable, offset_m, turn_deg, excess: as of the look; zeros where it is not usable.
        is_alarm: whether its verdict is.
    """

    is_usable: bool
    is_alarm: bool
    offset_m: float = 0.0
    turn_deg: float = 0.0
    excess: float = 0.0

    @staticmethod
    def of(look: Look) -> _Finding:
        if not look.is_usable:
            return _Finding(False, look.verdict().is_alarm)
        return _Finding(True, look.verdict().is_alarm, look.offset_m, look.turn_deg, look.excess(Freedom.NOTHING))


class Auditor:
    """Audits references; of one thread.

    Neighbours are asked again and again, so what first looks found is remembered, in some hundred bytes each. The last
    few looks are kept whole, at about 2 MiB each and the references that they look at; beyond these it takes what
    its surroundings remember.
    """

    def __init__(
        self,
        surroundings: Surroundings,
        options: AuditOptions,
        pairs: PairMatches,
        check: Callable[[], None] = lambda: None,
        remembered_findings: int = 3000,
    ) -> None:
        self._around, self._options, self._pairs, self._check = surroundings, options, pairs, check
        self._remembered_findings = remembered_findings
        self._findings: OrderedDict[str, _Finding] = OrderedDict()
        self._looks: OrderedDict[str, tuple[Look, tuple[str, Likeness]]] = OrderedDict()

    def audit(self, name: str) -> ReferenceAudit:
        """The verdict on one reference. Raises Gone if one cannot be loaded any more that could be before."""
        look, twin = self._first_look(name)
        is_wide = False
        if not look.is_usable:
            look, twin = self._wide_look(name, twin)
            is_wide = True
        verdict, blamed = self._judge(look), ""
        if verdict.is_alarm:
            look, verdict, blamed = self._without_suspects(look, verdict, is_wide)
        if verdict in (Verdict.WRONG_POSE, Verdict.WRONG_POSE_AND_INTRINSICS):
            partner = self._swapped_with(look)
            if partner:
                return describe(look, Verdict.SWAPPED_IMAGE, other=partner)
        if verdict.is_alarm:
            return describe(look, verdict, other=twin[0] if twin[1] is Likeness.SAME_PHOTOGRAPH else "")
        if verdict is Verdict.CONSISTENT and look.verdict().is_alarm:
            # It is off by too much, and so are its neighbours: nobody can tell who is right.
            return describe(look, Verdict.UNVERIFIABLE)
        change = None if blamed else self._change(look, verdict)
        if change is not None and change.is_alarm:
            return describe(look, Verdict.SCENE_CHANGED, change=change)
        if verdict is Verdict.UNVERIFIABLE:
            return describe(look, verdict, other=blamed)
        if twin[0]:
            return describe(
                look, Verdict.DUPLICATE, other=twin[0], same=twin[1] is Likeness.SAME_PHOTOGRAPH, change=change
            )
        return describe(look, Verdict.CONSISTENT, change=change)

    def _first_look(self, name: str) -> tuple[Look, tuple[str, Likeness]]:
        """From the neighbours by pose, and the reference most like it among them; the last few are remembered."""
        if name not in self._looks:
            self._looks[name] = self._look(name, self._around.near(name, self._options.candidate_count))
            while len(self._looks) > _WHOLE_LOOKS:
                self._looks.popitem(last=False)
        self._looks.move_to_end(name)
        return self._looks[name]

    def _finding(self, name: str) -> _Finding:
        """What the first look found; remembered."""
        if name not in self._findings:
            self._findings[name] = _Finding.of(self._first_look(name)[0])
            while len(self._findings) > self._remembered_findings:
                self._findings.popitem(last=False)
        self._findings.move_to_end(name)
        return self._findings[name]

    def _wide_look(self, name: str, twin: tuple[str, Likeness]) -> tuple[Look, tuple[str, Likeness]]:
        """From those that look like it."""
        look, wide_twin = self._look(name, self._around.alike(name, self._options.wide_count))
        return look, max(twin, wide_twin, key=lambda t: t[1].value)

    def _look(self, name: str, candidates: Sequence[str]) -> tuple[Look, tuple[str, Likeness]]:
        """From the candidates that share the most matches.

        Copies of the same photograph bear no witness: what is wrong with one is wrong with the other.
        """
        self._check()
        subject, twin = self._around.view(name), ("", Likeness.DIFFERENT)
        counts: dict[str, int] = {}
        for other in self._around.views(candidates):
            matches = self._pairs.match(subject, other)
            alike = likeness(subject, other, matches, self._options)
            twin = max(twin, (other.name, alike), key=lambda t: t[1].value)
            if alike is not Likeness.SAME_PHOTOGRAPH:
                counts[other.name] = len(matches)
        chosen = sorted(counts, key=lambda n: -counts[n])[: self._options.neighbour_count]
        return look_at(subject, self._around.views(chosen), self._pairs, self._options), twin

    def _judge(self, look: Look) -> Verdict:
        """The verdict on a look, with the allowance for noise that its neighbours need where they agree on it."""
        verdict = look.verdict()
        if not verdict.is_alarm:
            return verdict
        findings = [self._finding(reference.name) for reference in look.neighbourhood.references]
        usable = [other for other in findings if other.is_usable]
        if not usable:
            return verdict
        noise_m = float(np.median([other.offset_m for other in usable]))
        noise_deg = float(np.median([other.turn_deg for other in usable]))
        return look.verdict(noise_m, noise_deg)

    def _without_suspects(self, look: Look, verdict: Verdict, is_wide: bool) -> tuple[Look, Verdict, str]:
        """Look and verdict without neighbours that look faulty; and the worst of them, if too few others are left."""
        names = [reference.name for reference in look.neighbourhood.references]
        suspects = [name for name in names if self._finding(name).is_alarm]
        if not suspects:
            return look, verdict, ""
        rest = [name for name in names if name not in suspects]
        if not is_wide:
            wider = self._around.near(look.subject.name, 2 * self._options.candidate_count)
            spare = [view.name for view in self._around.views([n for n in wider if n not in names])]
            rest += [n for n in spare if not self._finding(n).is_alarm]
        second, _ = self._look(look.subject.name, rest)
        if second.is_usable:
            return second, self._judge(second), ""
        worse = max(suspects, key=lambda n: self._finding(n).excess)
        if self._finding(worse).excess < look.excess(Freedom.NOTHING):
            return look, verdict, ""
        return second, Verdict.UNVERIFIABLE, worse

    def _swapped_with(self, look: Look) -> str:
        """The reference at whose pose the photograph was taken, if that one's was taken here; empty if none is."""
        for name in self._around.near_pose(look.world_from_camera, 4, look.subject.name):
            apart_m, apart_deg = pose_difference(look.world_from_camera, self._around.pose(name))
            options, sigma = self._options, self._options.significance_sigma
            reach_m = options.swap_reach * max(options.position_tolerance_m, sigma * look.largest_sigma_m)
            reach_deg = options.swap_reach * max(options.rotation_tolerance_deg, sigma * look.sigma_deg)
            if apart_m > reach_m or apart_deg > reach_deg:
                continue
            for partner in self._around.views([name]):
                if self._fits(look.subject, partner) and self._fits(partner, look.subject):
                    return name
        return ""

    def _fits(self, photographed: PosedView, posed: PosedView) -> bool:
        """Whether the one reference's photograph fits the other's pose, by the neighbours of that pose."""
        names = self._around.near(posed.name, self._options.candidate_count)
        others = [view for view in self._around.views(names) if view.name != photographed.name]
        others.sort(key=lambda other: -len(self._pairs.match(photographed, other)))
        moved = replace(photographed, world_from_camera=posed.world_from_camera)
        look = look_at(moved, others[: self._options.neighbour_count], self._pairs, self._options)
        return self._judge(look) is Verdict.CONSISTENT

    def _change(self, look: Look, verdict: Verdict) -> Change | None:
        """What of the image does not show what the neighbours show; None where that cannot be said."""
        subject = look.subject
        if verdict is Verdict.UNVERIFIABLE:
            nearest = self._around.views(self._around.near(subject.name, self._options.neighbour_count))
            look, options = look_at(subject, nearest, self._pairs, self._options), SAME_VIEWPOINT
        else:
            options = ChangeOptions()
        change = changed_region(look, options)
        if change is None or not change.is_alarm:
            return change
        # Points of neighbours whose poses are wrong lie where nothing is.
        honest = [r for r in look.neighbourhood.references if not self._finding(r.name).is_alarm]
        if len(honest) == len(look.neighbourhood.references):
            return change
        return changed_region(look_at(subject, honest, self._pairs, self._options), options)
