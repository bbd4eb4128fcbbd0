"""Lens models: how real lenses deviate from the ideal pinhole, and the table of the models that mapless has.

A model maps normalized coordinates, x/z and y/z in the camera frame, to those at which the lens shows them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Distortion(ABC):
    """A lens model: a frozen dataclass of its coefficients, all with a default."""

    BEND_STEP: ClassVar[float] = 1e-7
    """Step of the differences in `by_bend`; a model that is linear in its first radial coefficient has 1: no error."""

    @abstractmethod
    def distort(self, ideal: Array) -> Array:
        """Normalized coordinates (..., 2) of an ideal pinhole to those the lens gives."""

    @property
    @abstractmethod
    def cubic(self) -> float:
        """The factor of r^3 in the distance at which the lens shows a ray of slope r; for a pinhole 0.

        As a share of what r is multiplied by, where that is not 1.
        """

    @property
    def k1(self) -> float:
        """The value that checks of intrinsics show as k1: the first radial coefficient if that is its name."""
        return self.cubic

    def bent(self, change: float) -> Distortion:
        """The lens with so much more of `cubic`, by its first radial coefficient alone.

        The lens itself, as here, if the model has no such coefficient: checks of intrinsics then hold it as it is.
        """
        return self

    def by_bend(self, ideal: Array) -> Array:
        """Derivative (..., 2) of `distort` by the change in `bent`; zeros if that changes nothing."""
        return np.asarray((self.bent(self.BEND_STEP).distort(ideal) - self.distort(ideal)) / self.BEND_STEP)

    def by_ideal(self, ideal: Array) -> Array:
        """Derivative (N, 2, 2) of `distort` by its argument (N, 2), by finite differences."""
        step = 1e-6
        ahead = [self.distort(ideal + step * axis) - self.distort(ideal - step * axis) for axis in np.eye(2)]
        return np.asarray(np.stack(ahead, axis=2) / (2 * step))


@dataclass(frozen=True)
class RadialTangential(Distortion):
    """OpenCV's radial-tangential distortion of normalized image coordinates."""

    BEND_STEP: ClassVar[float] = 1.0

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    @property
    def cubic(self) -> float:
        """See `Distortion`."""
        return self.k1

    def bent(self, change: float) -> RadialTangential:
        """See `Distortion`."""
        return replace(self, k1=self.k1 + change)

    def distort(self, ideal: Array) -> Array:
        """Normalized coordinates (..., 2) of an ideal pinhole to those the lens gives."""
        x, y = ideal[..., 0], ideal[..., 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        x_distorted = x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x)
        y_distorted = y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y
        return np.stack([x_distorted, y_distorted], axis=-1)


@dataclass(frozen=True)
class Fisheye(Distortion):
    """OpenCV's fisheye distortion: theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)."""

    BEND_STEP: ClassVar[float] = 1.0

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    @property
    def cubic(self) -> float:
        """See `Distortion`. Without coefficients it shows the ray at theta = arctan r = r - r^3 / 3 + ..."""
        return self.k1 - 1 / 3

    def bent(self, change: float) -> Fisheye:
        """See `Distortion`."""
        return replace(self, k1=self.k1 + change)

    def distort(self, ideal: Array) -> Array:
        """Normalized coordinates (..., 2) of an ideal pinhole to those the lens gives."""
        r = np.linalg.norm(ideal, axis=-1, keepdims=True)
        theta = np.arctan(r)
        t2 = theta * theta
        theta_d = theta * (1 + t2 * (self.k1 + t2 * (self.k2 + t2 * (self.k3 + t2 * self.k4))))
        return ideal * np.where(r > 1e-12, theta_d / np.maximum(r, 1e-12), 1.0)


LENS_MODELS: Mapping[str, type[Any]] = {"radial_tangential": RadialTangential, "fisheye": Fisheye}
"""Lens models by name. The interface (the oneof `distortion` of CameraIntrinsics), the store and cameras.json use these
names, and the names of the coefficients; another model begins here."""

DEFAULT_LENS_MODEL = "radial_tangential"
"""Lens of a cameras.json that names none; the last coefficient, k3, may be left out there, as in OpenCV."""


def lens_model_of(lens: object) -> str:
    """The name of a lens's model; TypeError, naming the field, camera.distortion, if it has none."""
    for name, kind in LENS_MODELS.items():
        if isinstance(lens, kind):
            return name
    raise unknown_lens(lens)


def unknown_lens(lens: object) -> TypeError:
    """The error of a lens whose model has no counterpart where it is needed."""
    kind, known = type(lens).__name__, ", ".join(it.__name__ for it in LENS_MODELS.values())
    return TypeError(f"camera.distortion is a {kind}, which has no counterpart here; lens models: {known}")


def lens_from_coefficients(model: object, coefficients: Sequence[float] | None) -> Distortion | None:
    """The lens of a model's name and its coefficients in their order, as a cameras.json has both.

    None for the coefficients stands for zeros, of which the default model is a pinhole: no lens. ValueError for an
    unknown model, or another number of coefficients than it has.
    """
    if not isinstance(model, str) or model not in LENS_MODELS:
        raise ValueError(f"lens must be one of {', '.join(LENS_MODELS)}, is {model!r}")
    is_default = model == DEFAULT_LENS_MODEL
    names = [it.name for it in fields(LENS_MODELS[model])]
    if coefficients is None:
        coefficients = [0.0] * len(names)
    if not len(names) - is_default <= len(coefficients) <= len(names):
        count = f"{len(names) - 1} or {len(names)}" if is_default else f"{len(names)}"
        expected = f"null or {count} coefficients ({' '.join(names)})"
        raise ValueError(f"dist of a {model} lens must be {expected}, has {len(coefficients)}")
    return LENS_MODELS[model](*coefficients) if any(coefficients) or not is_default else None
