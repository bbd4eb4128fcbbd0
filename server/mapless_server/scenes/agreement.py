"""Whether a scene contradicts itself, from the errors of its pairs of references (`method.pairs.agreement`)."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mapless_server.method.pairs.agreement import MAX_ERROR_PX
from mapless_server.method.pairs.readings.depth import implausible_depth
from mapless_server.method.pairs.readings.sessions import sessions_of
from mapless_server.store.pairs import Pair


@dataclass(frozen=True)
class Agreement:
    """How a scene's references agree with their poses.

    Attributes:
        pair_count: number of pairs of references that show the same, so that they can be compared with their poses.
        agreeing_count: how many of these agree with them.
        median_error_px: median error of these pairs, pixels of an image whose longer side is 1024; 0 without pairs.
        mostly_disagrees: whether fewer than half of the pairs agree, also without any one of the references: one alone
            may have a wrong pose, or show what looks like something else.
        groups: keys of two groups of references, where pairs within each agree and pairs between them do not; empty
            without such groups.
        explanation: the likely mistake, as `pairs.readings` names it; empty if there is none, or it is not known yet.
        median_depth: median depth of what pairs that agree show, in the scene's unit; None if it is not known.
        same_pose: one sentence each about references with exactly one pose that show different things.
        depths: one sentence each about measured depths that do not fit what other references see.
    """

    pair_count: int = 0
    agreeing_count: int = 0
    median_error_px: float = 0.0
    mostly_disagrees: bool = False
    groups: tuple[tuple[str, ...], ...] = ()
    explanation: str = ""
    median_depth: float | None = None
    same_pose: tuple[str, ...] = ()
    depths: tuple[str, ...] = ()

    @property
    def contradicts_itself(self) -> bool:
        """Whether most pairs disagree, or two groups of references do not agree with each other."""
        return bool(self.groups) or self.mostly_disagrees

    @property
    def contradiction(self) -> str:
        """One sentence that says it, with the numbers and the likely mistake; empty if there is no contradiction."""
        if not self.contradicts_itself:
            return ""
        text = (
            f"the scene contradicts itself: of {self.pair_count} pairs of references that show the same, "
            f"{self.agreeing_count} agree with their poses"
        )
        if self.groups:
            sizes = " and ".join(str(len(it)) for it in self.groups)
            text += f"; groups of {sizes} references agree within, but not with each other, as two worlds would"
        else:
            text += f" (median error {self.median_error_px:.0f} px of an image of 1024, at most {MAX_ERROR_PX:g})"
        return f"{text}; likely: {self.explanation}" if self.explanation else text

    def warnings(self, arbitrary_unit: bool) -> list[str]:
        """Sentences about the scene: its contradiction or, without one and unless its unit is arbitrary, its unit.

        Also references with exactly one pose that show different things, and wrong depths where poses are right.
        """
        unit = "" if arbitrary_unit else implausible_depth(self.median_depth)
        depths = () if arbitrary_unit or self.contradicts_itself else self.depths
        return [it for it in (self.contradiction or unit, *self.same_pose, *depths) if it]


def agreement_of(errors_px: Mapping[Pair, float]) -> Agreement:
    """The agreement of a scene's references from the errors of pairs, by their keys."""
    if not errors_px:
        return Agreement()
    agreeing = [pair for pair, error_px in errors_px.items() if error_px <= MAX_ERROR_PX]
    median_px = float(np.median(list(errors_px.values())))
    groups = sessions_of({pair: error_px <= MAX_ERROR_PX for pair, error_px in errors_px.items()}) or ()
    return Agreement(len(errors_px), len(agreeing), median_px, _mostly_disagree(errors_px), groups)


def _mostly_disagree(errors_px: Mapping[Pair, float]) -> bool:
    """Whether fewer than half of the pairs agree, also of those without any one reference."""
    votes: Counter[str] = Counter()
    for pair, error_px in errors_px.items():
        for key in pair:
            votes[key] += 1 if error_px <= MAX_ERROR_PX else -1
    total = sum(votes.values()) // 2
    return total < 0 and all(total - vote < 0 for vote in votes.values())
