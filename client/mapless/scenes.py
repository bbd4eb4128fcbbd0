"""What is known of a scene as a whole, beside its references."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import datetime
from enum import Enum
from typing import Final, Literal

MIN_FACTOR, MAX_FACTOR = 0.01, 1000.0
"""Of radii: what lies beyond is no calibration, but something else that went wrong."""

MAX_TEXT = 128
"""Characters of each text of a calibration."""

Vector = tuple[float, float, float]


class Unchanged(Enum):
    """The type of `UNCHANGED`."""

    UNCHANGED = "unchanged"


UNCHANGED: Final = Unchanged.UNCHANGED
"""Of a scene's datum, down or calibration when it is updated: leave it as it is. None is another thing: forget it."""

UnchangedType = Literal[Unchanged.UNCHANGED]


@dataclass(frozen=True)
class Calibration:
    """How far off answers in a scene were found to be, on photographs with known poses.

    The radii that an answer claims are multiplied by the factors, so that they hold the truth as often as they say; but
    for answers that something else computed than what was measured.

    Attributes:
        position_factor_68, position_factor_95: of the position's radii at 68 and 95 %, 0.01 to 1000.
        rotation_factor_68, rotation_factor_95: of the angle's.
        query_count: photographs that were measured, at least 1.
        features, backend, variant: what computed their answers, as `Diagnostics` names it ("BEST").
        server_version: of the server that was measured.
        create_time: when the calibration was stored, by the server's clock; None for one that is about to be.
    """

    position_factor_68: float
    position_factor_95: float
    rotation_factor_68: float
    rotation_factor_95: float
    query_count: int
    features: str
    backend: str
    variant: str
    server_version: str
    create_time: datetime | None = None

    def __post_init__(self) -> None:
        for name in ("position_factor_68", "position_factor_95", "rotation_factor_68", "rotation_factor_95"):
            factor = getattr(self, name)
            if not MIN_FACTOR <= factor <= MAX_FACTOR:
                raise ValueError(f"{name} must be {MIN_FACTOR:g} to {MAX_FACTOR:g}, is {factor:g}")
        if self.query_count < 1:
            raise ValueError(f"query_count must be at least 1, is {self.query_count}")
        for name in ("features", "backend", "variant", "server_version"):
            if len(getattr(self, name)) > MAX_TEXT:
                raise ValueError(f"{name} must have at most {MAX_TEXT} characters, has {len(getattr(self, name))}")

    def is_of(self, features: str, backend: str, variant: str, server_version: str) -> bool:
        """Whether it was measured with what computed an answer."""
        measured = (self.features, self.backend, self.variant, self.server_version)
        return measured == (features, backend, variant, server_version)


def unit_vector(x: float, y: float, z: float) -> Vector:
    """The direction of a vector.

    Raises:
        ValueError: it is of no length, or not finite.
    """
    longest = max(abs(x), abs(y), abs(z))
    if not 0 < longest < math.inf or not all(map(math.isfinite, (x, y, z))):
        raise ValueError("must be finite and of some length")
    x, y, z = x / longest, y / longest, z / longest  # squares of what is very small or large would be none
    length = math.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length
