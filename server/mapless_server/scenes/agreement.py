"""Whether a scene contradicts itself, from the errors of its pairs of references (`method.agreement`)."""

from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mapless_server.method.agreement import MAX_ERROR_PX
from mapless_server.store.pairs import Pair

MIN_GROUP, MIN_BETWEEN, MAX_BETWEEN_SHARE = 3, 6, 0.25
"""References of a group that agree with one another; pairs between two groups; how many of these may agree."""


@dataclass(frozen=True)
class Agreement:
    """How a scene's references agree with their poses.

    Attributes:
        pair_count: number of pairs of references that show the same, so that they can be compared with their poses.
        agreeing_count: how many of these agree with them.
        median_error_px: median error of these pairs, pixels of an image whose longer side is 1024; 0 without pairs.
        mostly_disagrees: whether fewer than half of the pairs agree, also without any one of the references: one alone
            may have a wrong pose, or show what looks like something else.
        group_sizes: sizes of two groups of references, where pairs within each agree and pairs between them do not;
            empty without such groups.
        explanation: the likely mistake, as `method.readings` names it; empty if there is none, or it is not known yet.
    """

    pair_count: int = 0
    agreeing_count: int = 0
    median_error_px: float = 0.0
    mostly_disagrees: bool = False
    group_sizes: tuple[int, ...] = ()
    explanation: str = ""

    @property
    def contradicts_itself(self) -> bool:
        """Whether most pairs disagree, or two groups of references do not agree with each other."""
        return bool(self.group_sizes) or self.mostly_disagrees

    @property
    def contradiction(self) -> str:
        """One sentence that says it, with the numbers and the likely mistake; empty if there is no contradiction."""
        if not self.contradicts_itself:
            return ""
        text = (
            f"the scene contradicts itself: of {self.pair_count} pairs of references that show the same, "
            f"{self.agreeing_count} agree with their poses"
        )
        if self.group_sizes:
            sizes = " and ".join(map(str, self.group_sizes))
            text += f"; groups of {sizes} references agree within, but not with each other, as two worlds would"
        else:
            text += f" (median error {self.median_error_px:.0f} px of an image of 1024, at most {MAX_ERROR_PX:g})"
        return f"{text}; likely: {self.explanation}" if self.explanation else text


def agreement_of(errors_px: Mapping[Pair, float]) -> Agreement:
    """The agreement of a scene's references from the errors of pairs, by their keys."""
    if not errors_px:
        return Agreement()
    agreeing = [pair for pair, error_px in errors_px.items() if error_px <= MAX_ERROR_PX]
    median_px = float(np.median(list(errors_px.values())))
    return Agreement(len(errors_px), len(agreeing), median_px, _mostly_disagree(errors_px), _two_worlds(errors_px))


def _mostly_disagree(errors_px: Mapping[Pair, float]) -> bool:
    """Whether fewer than half of the pairs agree, also of those without any one reference."""
    votes: Counter[str] = Counter()
    for pair, error_px in errors_px.items():
        for key in pair:
            votes[key] += 1 if error_px <= MAX_ERROR_PX else -1
    total = sum(votes.values()) // 2
    return total < 0 and all(total - vote < 0 for vote in votes.values())


def _two_worlds(errors_px: Mapping[Pair, float]) -> tuple[int, ...]:
    """Sizes of the two largest groups that agree within but not with each other; empty if there are none."""
    links: dict[str, dict[str, int]] = {}
    for (first, second), error_px in errors_px.items():
        vote = 1 if error_px <= MAX_ERROR_PX else -1
        links.setdefault(first, {})[second] = vote
        links.setdefault(second, {})[first] = vote
    group = _grouped(links)
    sizes: dict[int, int] = {}
    for of_key in group.values():
        sizes[of_key] = sizes.get(of_key, 0) + 1
    largest = sorted((it for it in sizes if sizes[it] >= MIN_GROUP), key=lambda it: (-sizes[it], it))[:2]
    if len(largest) < 2:
        return ()
    between = [
        vote
        for key, others in links.items()
        for other, vote in others.items()
        if (group[key], group[other]) == (largest[0], largest[1])
    ]
    if len(between) < MIN_BETWEEN or between.count(1) > MAX_BETWEEN_SHARE * len(between):
        return ()
    return sizes[largest[0]], sizes[largest[1]]


def _grouped(links: Mapping[str, Mapping[str, int]]) -> dict[str, int]:
    """Groups of references: each is in the group with which most of its pairs agree, by so many votes more than not."""
    group: dict[str, int] = {}
    order = _along_agreeing(links)
    for _ in range(3):
        before = dict(group)
        for number, key in enumerate(order):
            votes: dict[int, int] = {}
            for other, vote in links[key].items():
                if other in group and other != key:
                    votes[group[other]] = votes.get(group[other], 0) + vote
            best = max(votes, key=lambda it: (votes[it], -it), default=-1)
            if best >= 0 and votes[best] > 0:
                group[key] = best
            elif key not in group:
                group[key] = len(order) + number
        if group == before:
            break
    return group


def _along_agreeing(links: Mapping[str, Mapping[str, int]]) -> list[str]:
    """All references, along pairs that agree as far as these lead, from the one with the most of them on."""
    begin = max(links, key=lambda key: (sum(links[key].values()), key))
    waiting, order, seen = deque([begin]), [begin], {begin}
    left = iter(sorted(links))
    while len(order) < len(links):
        if waiting:
            key = waiting.popleft()
            found = [other for other in sorted(links[key]) if links[key][other] > 0 and other not in seen]
        else:
            found = [next(key for key in left if key not in seen)]
        seen.update(found)
        order += found
        waiting += found
    return order
