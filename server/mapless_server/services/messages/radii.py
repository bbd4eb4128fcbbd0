"""Reported radii of an answer: those of the method, by a scene's calibration where it has one."""

import math
import sys
from dataclasses import asdict, astuple, dataclass, replace

import numpy as np

from mapless.geometry import Array
from mapless.scenes import FACTORS, MAX_FACTOR, MIN_FACTOR, Calibration
from mapless_server.method.bundle.estimate import TAIL_95, Accuracy, growth, self_tail
from mapless_server.method.options import Variant
from mapless_server.store import SceneAttributes, SelfCalibration

_SELF_CALIBRATED = Variant.BEST.name
"""The variant by which references are localized against the others."""


@dataclass(frozen=True)
class Factors:
    """Factors of the radii of an answer's position and rotation; 1 leaves them as they are."""

    position_68: float = 1.0
    position_95: float = 1.0
    rotation_68: float = 1.0
    rotation_95: float = 1.0

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if not (math.isfinite(value) and MIN_FACTOR <= value <= MAX_FACTOR):
                raise ValueError(f"{name} must be {MIN_FACTOR:g} to {MAX_FACTOR:g}, is {value:g}")

    @classmethod
    def of(cls, calibration: Calibration) -> "Factors":
        """The factors of a scene's calibration."""
        return cls(*(getattr(calibration, name) for name in FACTORS))

    @classmethod
    def of_references(cls, calibration: SelfCalibration, accuracy: Accuracy, gap: float) -> "Factors":
        """Factors of a self-calibration for an answer with these radii at a gap, see `scenes.calibration.fit`."""
        own, grown = calibration, growth(gap)
        position = _factor(grown * own.position_factor, own.reference_noise_m, accuracy.position_68_m)
        rotation = _factor(grown * own.rotation_factor, own.reference_noise_deg, accuracy.rotation_68_deg)
        tail = self_tail(own.answer_count) / TAIL_95
        return cls(position, max(MIN_FACTOR, position * tail), rotation, max(MIN_FACTOR, rotation * tail))


@dataclass(frozen=True)
class Conditions:
    """The means that computed an answer; factors hold only for answers of the same conditions.

    The name of the features contains their options, "sift-2048-1024px-0.02"; the variant is named as by `Diagnostics`,
    "BEST". Another version of the server may report other radii.
    """

    features: str
    backend: str
    variant: str
    server_version: str


@dataclass(frozen=True, eq=False)
class ReportedRadii:
    """The reported uncertainty of an answer.

    Attributes:
        accuracy: the radii.
        covariance: (6, 6), order x y z rx ry rz, metres and radians.
        calibration: origin of the factors: "GENERIC" (no factors), "SELF" or "MEASURED".
        count: number of references that were localized against the others, or of photographs that were measured.
    """

    accuracy: Accuracy
    covariance: Array
    calibration: str = "GENERIC"
    count: int = 0


def reported_radii(
    accuracy: Accuracy,
    covariance: Array,
    conditions: Conditions,
    kind: str,
    attributes: SceneAttributes,
    gap: float | None,
) -> ReportedRadii:
    """Radii by the scene's measured calibration, else by its self-calibration, if made under the same conditions.

    Args:
        accuracy: radii of the method.
        covariance: (6, 6) of the method.
        conditions: the means that computed the answer.
        kind: kind of the answer, see `store.calibration_kind`; with depths kept with references another one.
        attributes: attributes of the scene.
        gap: gap of the answer, see `method.bundle.estimate.viewpoint_gap`; None if unknown.
    """
    measured = attributes.calibration
    if measured is not None and measured.is_of(*astuple(conditions)):
        factors, calibration, count = Factors.of(measured), "MEASURED", measured.query_count
    else:
        own = attributes.self_calibration(kind)
        if own is None or not own.answer_count or conditions.variant != _SELF_CALIBRATED or gap is None:
            return ReportedRadii(accuracy, covariance)
        factors, calibration, count = Factors.of_references(own, accuracy, gap), "SELF", own.answer_count
    return ReportedRadii(scaled_accuracy(accuracy, factors), scaled_covariance(covariance, factors), calibration, count)


def _factor(factor: float, noise: float, radius: float) -> float:
    """Ratio by which a radius grows if a factor multiplies it and a constant noise is added."""
    return min(max(math.hypot(factor, noise / max(radius, sys.float_info.min)), MIN_FACTOR), MAX_FACTOR)


def scaled_accuracy(accuracy: Accuracy, factors: Factors) -> Accuracy:
    """Multiplies radii by factors; the 95 % radius is never smaller than the 68 % radius."""
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

    C -> D C D with D = diag(fp, fp, fp, fr, fr, fr): positions by fp^2, rotations by fr^2, their covariances by fp fr,
    so that it stays positive semi-definite and all correlations are kept.
    """
    scale = np.repeat([factors.position_68, factors.rotation_68], 3)
    return np.asarray(scale[:, None] * covariance * scale, float)
