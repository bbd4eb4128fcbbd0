"""Lens models that mapless does not have, as somebody who adds one would write them."""

from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import pytest

from mapless import lenses
from mapless.geometry import Array
from mapless.lenses import Distortion


@dataclass(frozen=True)
class Division(Distortion):
    """Fitzgibbon's division model (2001), r_ideal = r / (1 + coefficient r^2): no k1, and not linear in its own."""

    coefficient: float = 0.0

    def distort(self, ideal: Array) -> Array:
        r2 = (ideal * ideal).sum(axis=-1, keepdims=True)
        return np.asarray(2 * ideal / (1 + np.sqrt(1 - 4 * self.coefficient * r2)))

    @property
    def cubic(self) -> float:
        return self.coefficient

    def bent(self, change: float) -> "Division":
        return replace(self, coefficient=self.coefficient + change)


@dataclass(frozen=True)
class Stereographic(Distortion):
    """A fisheye with 2 tan(theta / 2), and one coefficient that shears: no radial coefficient."""

    shear: float = 0.0

    def distort(self, ideal: Array) -> Array:
        r2 = (ideal * ideal).sum(axis=-1, keepdims=True)
        return np.asarray(2 * ideal / (1 + np.sqrt(1 + r2)) + self.shear * ideal[..., ::-1] * (1.0, 0.0))

    @property
    def cubic(self) -> float:
        return -0.25


def add_planted_lenses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Adds their lines to the table for one test, by names that no lens model of the interface has."""
    for kind in (Division, Stereographic):
        monkeypatch.setitem(cast(dict[str, Any], lenses.LENS_MODELS), f"planted_{kind.__name__.lower()}", kind)
