"""Whether a further attempt is worth its processor time: what it can be expected to gain, from what is known already.

A photograph of another place matches every reference by chance, whatever features are used; one that matches a single
reference gets no pose by better matches; and an accepted pose that two kinds of features have found is right. So the
expensive attempts are made where something is to be gained: the chance that they help, times the share of photographs
that they help, for each second that they take.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from mapless_server.bounds import check_bounds


@dataclass(frozen=True)
class Worth:
    """Gain and cost of an attempt.

    Attributes:
        cost_s: processor time of a core, seconds, with what follows it; of `rematched`, with the first two references.
        found: share of the photographs without an accepted pose, but with references that agree, that it, or what
            follows it, answers.
        corrected: share of the wrong answers that it, or what follows it, corrects; None if it also makes right answers
            more accurate, so that it is always made where a pose is accepted.
    """

    cost_s: float
    found: float
    corrected: float | None

    def __post_init__(self) -> None:
        check_bounds(self, "cost_s", above=0)
        check_bounds(self, "found" if self.corrected is None else "found corrected", at_least=0, at_most=1)


WORTH: Mapping[str, Worth] = {
    "wide": Worth(0.15, 0.12, None),
    "lines": Worth(0.4, 0.2, 0.0),
    "lines at any roll": Worth(0.4, 0.007, 0.0),
    "wide at any roll": Worth(0.15, 0.03, 0.1),
    "stronger": Worth(3.0, 0.4, 0.3),
    "rematched": Worth(1.0, 0.3, 0.2),
}
"""By the name of the rung; those that are not listed are always worth it. Evidence: rungs-worth, rungs."""


@dataclass(frozen=True)
class PromiseOptions:
    """When an attempt is worth its time.

    Attributes:
        agreement, spread: the chance that a photograph shows what two references show is a logistic function of the
            agreement of its matches with both (see `features.rolls`): a half at the one, rising over the other.
            Evidence: place-agreement.
        wrong_of_low_trust, wrong_otherwise: shares of the accepted poses that are wrong. Evidence: low-trust.
        wrong_if_confirmed: share of these that remains for each further kind of features that finds the same place.
        least_gain_per_s: photographs that a second of processor time must be expected to gain.
    """

    agreement: float = 3.0
    spread: float = 0.25
    wrong_of_low_trust: float = 0.29
    wrong_otherwise: float = 0.01
    wrong_if_confirmed: float = 0.1
    least_gain_per_s: float = 0.02

    def __post_init__(self) -> None:
        check_bounds(self, "agreement least_gain_per_s", at_least=0)
        check_bounds(self, "spread", above=0)
        check_bounds(self, "wrong_of_low_trust wrong_otherwise wrong_if_confirmed", at_least=0, at_most=1)


PROMISE = PromiseOptions()


@dataclass(frozen=True)
class Known:
    """Evidence about a photograph before a further attempt.

    Attributes:
        agreement: the largest that its matches with two references have shown; infinite if it was not computed.
        is_accepted: whether a pose is accepted.
        is_of_low_trust: whether that is of low trust.
        kinds: number of kinds of features that have found a pose at the place that is answered.
    """

    agreement: float = math.inf
    is_accepted: bool = False
    is_of_low_trust: bool = True
    kinds: int = 1

    def chance_of_place(self, options: PromiseOptions = PROMISE) -> float:
        """The chance that the photograph shows what two references show."""
        return (1 + math.tanh((self.agreement - options.agreement) / options.spread / 2)) / 2

    def chance_wrong(self, options: PromiseOptions = PROMISE) -> float:
        """The chance that the accepted pose is wrong."""
        share = options.wrong_of_low_trust if self.is_of_low_trust else options.wrong_otherwise
        return share * options.wrong_if_confirmed ** (self.kinds - 1)

    def gain_per_s(self, worth: Worth, options: PromiseOptions = PROMISE) -> float:
        """Photographs that an attempt is expected to gain for a second of processor time."""
        if not self.is_accepted:
            return self.chance_of_place(options) * worth.found / worth.cost_s
        return math.inf if worth.corrected is None else self.chance_wrong(options) * worth.corrected / worth.cost_s

    def is_worth(self, name: str, options: PromiseOptions = PROMISE) -> bool:
        """Whether to make the attempt of a rung, see `WORTH`."""
        worth = WORTH.get(name)
        return worth is None or self.gain_per_s(worth, options) >= options.least_gain_per_s


UNKNOWN = Known()
"""Nothing is known, so that the photograph may as well show the place."""
