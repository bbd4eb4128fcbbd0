"""What was chosen, by what, from which state of the scene."""

from __future__ import annotations

from dataclasses import dataclass

from .ranking import RankedReference


@dataclass(frozen=True, eq=False)
class Choice:
    """References that were chosen, in order.

    Attributes:
        references: the most similar first, but for those that see the same as one before.
        descriptor: name of what was compared.
        generation: of the scene.
    """

    references: tuple[RankedReference, ...]
    descriptor: str
    generation: int
