"""Options that check themselves."""

import operator

_HOLDS = {"above": operator.gt, "at_least": operator.ge, "below": operator.lt, "at_most": operator.le}


def check_bounds(options: object, names: str, **bounds: float) -> None:
    """Checks that fields of a dataclass, and every number of a tuple, are within bounds; NaN is out of bounds.

    The names are separated by spaces; bounds are any of above, at_least, below and at_most. ValueError if a number is
    out.
    """
    for name in names.split():
        value = getattr(options, name)
        numbers = value if isinstance(value, tuple) else (value,)
        if not all(_HOLDS[relation](number, bound) for number in numbers for relation, bound in bounds.items()):
            expected = " and ".join(f"{relation.replace('_', ' ')} {bound:g}" for relation, bound in bounds.items())
            raise ValueError(f"{type(options).__name__}.{name} must be {expected}, is {value}")
