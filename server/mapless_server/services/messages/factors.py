"""What a scene's calibration does to an answer: radii and covariance are multiplied, if they are what was measured."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass, replace

import numpy as np

from mapless.geometry import Array
from mapless.scenes import MAX_FACTOR, MIN_FACTOR, Calibration
from mapless_server.method.uncertainty.accuracy import Accuracy


@dataclass(frozen=True)
class Factors:
    """What the radii of an answer are multiplied by; as they are, by default.

    Attributes:
        position_68, position_95: of the position's radii.
        rotation_68, rotation_95: of the rotation's.
    """

    position_68: float = 1.0
    position_95: float = 1.0
    rotation_68: float = 1.0
    rotation_95: float = 1.0

    def __post_init__(self) -> None:
        if not all(math.isfinite(it) and MIN_FACTOR <= it <= MAX_FACTOR for it in astuple(self)):
            raise ValueError(f"a factor of claimed radii must be {MIN_FACTOR:g} to {MAX_FACTOR:g}: {self}")

    @classmethod
    def of(cls, calibration: Calibration) -> Factors:
        """Those of a scene's calibration."""
        return cls(
            calibration.position_factor_68,
            calibration.position_factor_95,
            calibration.rotation_factor_68,
            calibration.rotation_factor_95,
        )

    @property
    def inverse(self) -> Factors:
        """Those that undo these, as far as they are within the bounds."""
        return Factors(*(min(max(1 / it, MIN_FACTOR), MAX_FACTOR) for it in astuple(self)))


@dataclass(frozen=True)
class Conditions:
    """What computed an answer; factors are true of nothing else.

    Attributes:
        features: name of the local features, with their options: "sift-2048-1024px-0.02".
        backend: of the coarse stage.
        variant: form of the method, as `Diagnostics` names it: "BEST".
        server_version: another one may claim other radii.
    """

    features: str
    backend: str
    variant: str
    server_version: str


@dataclass(frozen=True, eq=False)
class Claimed:
    """What is told of an answer's error.

    Attributes:
        accuracy: radii.
        covariance: (6, 6), order x y z rx ry rz, metres and radians.
        calibrated: whether factors were applied.
    """

    accuracy: Accuracy
    covariance: Array
    calibrated: bool


def claimed(accuracy: Accuracy, covariance: Array, conditions: Conditions, calibration: Calibration | None) -> Claimed:
    """The claim of an answer: calibrated, if the scene's calibration was measured under the same conditions.

    Args:
        accuracy: as the method claims it.
        covariance: (6, 6) likewise.
        conditions: what computed the answer.
        calibration: of the scene; None if it has none.
    """
    if calibration is None or not calibration.is_of(*astuple(conditions)):
        return Claimed(accuracy, covariance, False)
    factors = Factors.of(calibration)
    return Claimed(scaled_accuracy(accuracy, factors), scaled_covariance(covariance, factors), True)


def scaled_accuracy(accuracy: Accuracy, factors: Factors) -> Accuracy:
    """Radii times factors; the one for 95 % is never smaller than the one for 68 %."""
    position_68_m = factors.position_68 * accuracy.position_68_m
    rotation_68_deg = factors.rotation_68 * accuracy.rotation_68_deg
    return replace(
        accuracy,
        position_68_m=position_68_m,
        position_95_m=max(position_68_m, factors.position_95 * accuracy.position_95_m),
        rotation_68_deg=rotation_68_deg,
        rotation_95_deg=max(rotation_68_deg, factors.rotation_95 * accuracy.rotation_95_deg),
    )


def scaled_covariance(covariance: Array, factors: Factors) -> Array:
    """The covariance (6, 6) whose 68 % radii are those of the given one times the factors.

    C -> D C D with D = diag(fp, fp, fp, fr, fr, fr): positions by fp^2, rotations by fr^2, what couples them by fp fr,
    so that it stays positive semi-definite and all correlations stay what they are.
    """
    scale = np.repeat([factors.position_68, factors.rotation_68], 3)
    return np.asarray(scale[:, None] * covariance * scale, float)
