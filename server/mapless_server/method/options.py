"""Options check themselves: a wrong value is named with its field and its bounds."""

from __future__ import annotations

import operator

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
