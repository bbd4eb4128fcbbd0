"""Attributes of a scene: its position on the Earth, down, unit, calibrations and adoption policy."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mapless.geodesy import Datum
from mapless.geometry import Array
from mapless.scenes import LARGEST_RADIUS_M, LEAST_RADIUS_M, MAX_FACTOR, MIN_FACTOR, AdoptionPolicy, Calibration, Vector

MAX_DOWN_DISAGREEMENT_DEG = 10.0
"""Datums are oriented by compass or by hand, to some degrees; 90 degrees mean a world whose y is up, not z."""


class ContradictingDown(ValueError):
    """A scene's datum and its down_in_world contradict each other."""


class DatumWithoutMetres(ValueError):
    """A scene has a datum, although its unit of length is not the metre."""


class WrongRadius(ValueError):
    """The radius of a scene's adoption policy is none for its unit of length."""


CALIBRATION_MODEL = 5
"""Raised whenever the same references would give another `SelfCalibration`, or answers use it in another way."""


@dataclass(frozen=True)
class SelfCalibration:
    """Radii and trust of a scene's answers, learned from references that are localized against the others.

    Attributes:
        kind: kind of the answers that it holds for, see `calibration_kind`.
        generation: generation of the scene when its references were read.
        answer_count: number of references whose answers were used; 0 if there were too few, then it changes nothing.
        position_factor, rotation_factor: factors of radii at the usual gap (see `viewpoint_gap`), 0.01 to 1000.
        reference_noise_m, reference_noise_deg: errors of the references' own poses, not exceeded in 68 % of cases,
            which every answer contains.
        trust_quantiles: quantiles of the generic trust of right answers, at the levels of `method.judge.judge`; empty
            if unknown.
        lens: sentence about an error of the intrinsics that the references share; empty if they show none.
        position_tail, rotation_tail: factors on the ratio of the radius of 95 % to that of 68 %.
    """

    kind: str
    generation: int
    answer_count: int
    position_factor: float = 1.0
    rotation_factor: float = 1.0
    reference_noise_m: float = 0.0
    reference_noise_deg: float = 0.0
    trust_quantiles: tuple[float, ...] = ()
    lens: str = ""
    position_tail: float = 1.0
    rotation_tail: float = 1.0

    def __post_init__(self) -> None:
        for name in ("position_factor", "rotation_factor", "position_tail", "rotation_tail"):
            factor = getattr(self, name)
            if not MIN_FACTOR <= factor <= MAX_FACTOR:
                raise ValueError(f"{name} must be {MIN_FACTOR:g} to {MAX_FACTOR:g}, is {factor:g}")
        for name in ("reference_noise_m", "reference_noise_deg"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be at least 0, is {getattr(self, name):g}")


def calibration_kind(features: str, backend: str, server_version: str) -> str:
    """Name of what computes answers; a self-calibration holds only for answers of its own kind."""
    return f"{features}/{backend}/{server_version}/{CALIBRATION_MODEL}"


@dataclass(frozen=True)
class SceneAttributes:
    """Attributes of a scene; None where unknown.

    The datum is the position of its world on the Earth; `down_in_world` the unit vector in the direction of gravity,
    None for that of the datum, if there is one. The calibration has measured factors of the radii of answers; the
    self-calibrations, one for each kind of answers, and the contradiction, a sentence if the scene contradicts itself,
    are only filled for answers. The adoption policy says which localized photographs become references; None for none.
    ContradictingDown if datum and down_in_world do not belong to the same world;
    DatumWithoutMetres if there is a datum, but the unit of length is arbitrary instead of the metre; WrongRadius if the
    adoption policy's radius is out of bounds, in metres, or missing in an arbitrary unit. In metres it has a default.
    """

    datum: Datum | None = None
    down_in_world: Vector | None = None
    calibration: Calibration | None = None
    arbitrary_unit: bool = False
    self_calibrations: tuple[SelfCalibration, ...] = ()
    contradiction: str = ""
    adoption: AdoptionPolicy | None = None

    @property
    def world(self) -> tuple[Datum | None, Vector | None, bool]:
        """The attributes that say what a pose in its world means: datum, down and unit."""
        return self.datum, self.down_in_world, self.arbitrary_unit

    @property
    def unit(self) -> str:
        """Its unit of length, in messages for a person."""
        return "units" if self.arbitrary_unit else "m"

    def __post_init__(self) -> None:
        if self.datum is not None and self.arbitrary_unit:
            raise DatumWithoutMetres("needs a scene in metres: the unit of length of this one is arbitrary")
        if self.adoption is not None:
            radius_m = self.adoption.radius_m
            if self.arbitrary_unit and self.adoption.max_radius_m is None:
                raise WrongRadius("is required: the scene's unit is arbitrary, so it has no default")
            if not self.arbitrary_unit and not LEAST_RADIUS_M <= radius_m <= LARGEST_RADIUS_M:
                raise WrongRadius(f"must be {LEAST_RADIUS_M:g} to {LARGEST_RADIUS_M:g} metres, is {radius_m:g}")
            object.__setattr__(self, "adoption", replace(self.adoption, max_radius_m=radius_m))
        if self.datum is None or self.down_in_world is None:
            return
        cosine = float(self.datum.down_in_world() @ self.down_in_world)
        angle_deg = math.degrees(math.acos(min(max(cosine, -1.0), 1.0)))
        if angle_deg > MAX_DOWN_DISAGREEMENT_DEG:
            raise ContradictingDown(
                f"is {angle_deg:.0f} degrees off the datum's down; its enu_from_world must turn the world's axes to "
                "east, north and up"
            )

    def changed(self, changes: Mapping[str, Any]) -> SceneAttributes:
        """The attributes with other values, by name; WrongRadius if the unit changes without the adoption policy."""
        made = replace(self, **changes)
        if self.adoption is not None and "adoption" not in changes and made.unit != self.unit:
            raise WrongRadius(f"is in {self.unit}: give the policy with the unit, its radius in {made.unit}")
        return made

    def self_calibration(self, kind: str) -> SelfCalibration | None:
        """The self-calibration of this kind of answers, if there is one."""
        return next((it for it in self.self_calibrations if it.kind == kind), None)

    def down(self) -> Array | None:
        """Unit vector (3,) in the direction of gravity, world; None if unknown."""
        if self.down_in_world is not None:
            return np.array(self.down_in_world)
        return None if self.datum is None else self.datum.down_in_world()
