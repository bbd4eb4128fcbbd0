"""The verdict on a scene's poses by epipolar errors: right, wrong as a whole and why, or single wrong ones."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import bdtrc

from ...significance import MAX_LOG10_CHANCE
from ..agreement import MAX_ERROR_PX
from .depth import median_depth
from .errors import FEW_SHARE, WRONG_SHARE, MatchedPair, Pair, PairError, Views, errors_of, summary
from .explanation import explain
from .repeats import contradicting_groups, same_photographs

RIGHT_BAD_SHARE = 0.025
"""Share of the pairs of right poses that are bad: repeated structure gives consistent wrong matches. Evidence:
suspects."""


@dataclass(frozen=True)
class Verdict:
    """The verdict on all pairs; medians and shares are NaN without pairs.

    Suspects do not fit their neighbours although the scene as a whole does; or they are what the explanation concerns,
    if not all. The explanation is the likely mistake if the scene as a whole is wrong, `explained_px` the median error
    after its correction. The median depth of photographed points is in the unit of the poses; None if unknown, or the
    scene is wrong. `same_pose` are groups of photographs of different things with exactly the same pose; their pairs
    count in nothing else. `same_photograph` are pairs that are one photograph, with poses that differ.
    """

    pairs: tuple[PairError, ...]
    unmatched_count: int
    median_px: float
    bad_share: float
    threshold_px: float
    suspects: tuple[int, ...] = ()
    explanation: str = ""
    explained_px: float = math.nan
    median_depth: float | None = None
    same_pose: tuple[tuple[int, ...], ...] = ()
    same_photograph: tuple[Pair, ...] = ()

    @property
    def is_known(self) -> bool:
        """Whether there were any pairs to judge by."""
        return bool(self.pairs)

    @property
    def is_wrong(self) -> bool:
        """Whether the scene as a whole does not fit: more pairs are bad than single photographs can explain."""
        return self.is_known and self.bad_share > WRONG_SHARE


def judge(
    views: Views, matched: Sequence[MatchedPair], unmatched_count: int = 0, unmatched: Sequence[Pair] = ()
) -> Verdict:
    """Judges the matched pairs; `unmatched_count` pairs, of which some may be named, have too few matches."""
    errors = errors_of(views, matched)
    poses = {i: view.world_from_camera for i, view in views.items()}
    groups = contradicting_groups(poses, errors, unmatched)
    excluded = {i for group in groups for i in group}
    matched = [item for item in matched if not excluded & set(item.pair)]
    errors = [error for error in errors if not excluded & set(error.pair)]
    if not errors:
        return Verdict((), unmatched_count, math.nan, math.nan, MAX_ERROR_PX, same_pose=tuple(groups))
    (median_px, bad_share), twins = summary(errors), tuple(same_photographs(views, matched))
    threshold_px = float(np.median([error.threshold_px for error in errors]))
    verdict = Verdict(tuple(errors), unmatched_count, median_px, bad_share, threshold_px)
    verdict = replace(verdict, same_pose=tuple(groups), same_photograph=twins)
    if not verdict.is_wrong:
        return replace(verdict, median_depth=median_depth(views, matched), suspects=suspects_of(errors))
    found = explain(views, matched)
    if found.text:
        return replace(verdict, explanation=found.text, explained_px=found.error_px, suspects=found.photographs)
    suspects = suspects_of(errors)
    left = [error for error in errors if not set(suspects) & set(error.pair)]
    # Where hardly anything is left that fits, nobody knows which photographs are wrong.
    is_known = len(left) >= FEW_SHARE * len(errors) and summary(left)[1] <= WRONG_SHARE
    return replace(verdict, suspects=suspects if is_known else ())


def suspects_of(errors: Sequence[PairError]) -> tuple[int, ...]:
    """Photographs almost all of whose pairs are bad, the worst first; its pairs then do not count against others.

    They are more than chance makes bad: under the null hypothesis the pose is right, and each of its pairs is bad with
    the chance that the others' pairs show, and `RIGHT_BAD_SHARE` before any is seen.
    """
    left = list(errors)
    suspects: list[int] = []
    photographs = {i for error in errors for i in error.pair}
    while True:
        total = Counter(i for error in left for i in error.pair)
        bad = Counter(i for error in left if error.is_bad for i in error.pair)
        doubtful, all_bad = [], sum(error.is_bad for error in left)
        for i in bad:
            others, their_bad = len(left) - total[i], all_bad - bad[i]
            chance = bdtrc(bad[i] - 1, total[i], (their_bad + 1) / (others + 1 / RIGHT_BAD_SHARE))
            is_chance = chance > 0 and math.log10(len(photographs) * chance) > MAX_LOG10_CHANCE
            if bad[i] >= (1 - WRONG_SHARE) * total[i] and not is_chance:
                doubtful.append(i)
        if not doubtful:
            return tuple(suspects)
        worst = max(doubtful, key=lambda i: (bad[i] / total[i], bad[i], -i))
        suspects.append(worst)
        left = [error for error in left if worst not in error.pair]
