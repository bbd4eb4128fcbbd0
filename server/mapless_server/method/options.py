"""What a request chooses of the method, and how options check themselves.

The options of the stages stand with the stages; `pipeline.StageOptions` has them together.
"""

from __future__ import annotations

import operator
from dataclasses import dataclass
from enum import Enum

_HOLDS = {"above": operator.gt, "at_least": operator.ge, "below": operator.lt, "at_most": operator.le}


def check_bounds(options: object, names: str, **bounds: float) -> None:
    """Checks fields of a dataclass; of a tuple, every number. NaN is within no bounds.

    Args:
        options: the dataclass.
        names: of the fields, separated by spaces.
        bounds: any of above, at_least, below and at_most.

    Raises:
        ValueError: a number is outside.
    """
    for name in names.split():
        value = getattr(options, name)
        numbers = value if isinstance(value, tuple) else (value,)
        if not all(_HOLDS[relation](number, bound) for number in numbers for relation, bound in bounds.items()):
            expected = " and ".join(f"{relation.replace('_', ' ')} {bound:g}" for relation, bound in bounds.items())
            raise ValueError(f"{type(options).__name__}.{name} must be {expected}, is {value}")


class Variant(str, Enum):
    """Forms of the method; all but `BEST` are the paper's."""

    COARSE = "coarse"
    """The reconstruction's own pose at metric scale."""
    NO_STRUCTURE = "no_structure"
    """PnP on predicted points."""
    FULL = "full"
    """The paper's method."""
    BEST = "best"
    """Tracks over all references, keypoints weighted by their noise, a final adjustment of everything."""


class ScaleStrategy(str, Enum):
    """Which stages may give the scale."""

    TRIANGULATION = "triangulation"
    TRAJECTORY = "trajectory"
    TWO_STAGE = "two_stage"


@dataclass(frozen=True)
class LocalizeOptions:
    """Choices of a request; the defaults are the best we know.

    Attributes:
        variant: form of the method.
        scale_strategy: how the metric scale is found.
        coverage: share of right answers to accept; more, and more wrong ones are accepted too (see `trust.judge`).
    """

    variant: Variant = Variant.BEST
    scale_strategy: ScaleStrategy = ScaleStrategy.TWO_STAGE
    coverage: float = 0.99

    def __post_init__(self) -> None:
        check_bounds(self, "coverage", above=0, at_most=1)
