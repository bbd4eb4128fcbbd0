"""Reported radii of an answer: those of the method, by a scene's calibration where it has one."""

import math
import sys
from dataclasses import asdict, astuple, dataclass, replace

import numpy as np

from mapless.geometry import Array
from mapless.scenes import MAX_FACTOR, MIN_FACTOR, Calibration
from mapless_server.method.bundle.estimate import USUAL_GAP, Accuracy, accuracy_from_covariance, growth
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
    def of(cls, calibration: Calibration, accuracy: Accuracy, gap: float) -> "Factors":
        """Factors of a calibration for an answer with these radii at a gap, see `scenes.calibration.fit`."""
        known, grown = calibration, growth(gap) if calibration.grows_with_gap else 1.0
        position = _factor(grown * known.position_factor_68, known.reference_noise_m, accuracy.position_68_m)
        rotation = _factor(grown * known.rotation_factor_68, known.reference_noise_deg, accuracy.rotation_68_deg)
        return cls(
            position,
            _bounded(position * known.position_factor_95 / known.position_factor_68),
            rotation,
            _bounded(rotation * known.rotation_factor_95 / known.rotation_factor_68),
        )


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


def calibration_of(found: SelfCalibration, conditions: Conditions) -> Calibration:
    """The calibration that a fit to at least one answer gives for answers computed under these conditions."""
    return Calibration(
        found.position_factor,
        _bounded(found.position_tail * found.position_factor),
        found.rotation_factor,
        _bounded(found.rotation_tail * found.rotation_factor),
        found.answer_count,
        **asdict(conditions),
        reference_noise_m=found.reference_noise_m,
        reference_noise_deg=found.reference_noise_deg,
        grows_with_gap=True,
    )


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
    by_references: Array | None = None,
) -> ReportedRadii:
    """Radii by the scene's measured calibration, else by its self-calibration, if made under the same conditions.

    Factors are of errors that surveyed references lead to. Those of adopted references are reported with these, so that
    their part of the covariance is added as it is:

        C' = D (C - R) D + R,    D = diag(fp, fp, fp, fr, fr, fr),

    and the squares of the radii likewise. C contains R, but for rounding, and where a group of photographs determines
    the pose better than the one that R is of: then R counts by the largest share that C contains.

    Args:
        accuracy: radii of the method.
        covariance: (6, 6) of the method.
        conditions: the means that computed the answer.
        kind: kind of the answer, see `store.calibration_kind`; with depths kept with references another one.
        attributes: attributes of the scene.
        gap: gap of the answer, see `method.bundle.estimate.viewpoint_gap`; None if unknown.
        by_references: R (6, 6), the part of the covariance by what adopted references are off in common; None without.
    """
    used, source = attributes.calibration, "MEASURED"
    if used is None or not used.is_of(*astuple(conditions)):
        own = attributes.self_calibration(kind)
        if own is None or not own.answer_count or conditions.variant != _SELF_CALIBRATED:
            return ReportedRadii(accuracy, covariance)
        used, source = calibration_of(own, conditions), "SELF"
    if gap is None and used.grows_with_gap:
        return ReportedRadii(accuracy, covariance)
    if by_references is not None:
        by_references = by_references * _contained_share(by_references, covariance)
        covariance = covariance - by_references
        accuracy = accuracy_from_covariance(covariance)
    factors = Factors.of(used, accuracy, USUAL_GAP if gap is None else gap)
    accuracy, covariance = scaled_accuracy(accuracy, factors), scaled_covariance(covariance, factors)
    if by_references is not None:
        covariance = covariance + by_references
        theirs = astuple(accuracy_from_covariance(by_references))
        accuracy = Accuracy(*map(math.hypot, astuple(accuracy), theirs))
    return ReportedRadii(accuracy, covariance, source, used.query_count)


def _contained_share(part: Array, covariance: Array) -> float:
    """Largest share, at most 1, of a covariance (6, 6) that another one, of full rank, contains."""
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    largest = float(np.linalg.eigvalsh(whiten @ part @ whiten.T)[-1])
    return min(1.0, 1.0 / max(largest, sys.float_info.min))


def _factor(factor: float, noise: float, radius: float) -> float:
    """Ratio by which a radius grows if a factor multiplies it and a constant noise is added."""
    return _bounded(math.hypot(factor, noise / max(radius, sys.float_info.min)))


def _bounded(factor: float) -> float:
    return min(max(factor, MIN_FACTOR), MAX_FACTOR)


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
