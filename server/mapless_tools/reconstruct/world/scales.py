"""The unit of length from several sources: those that agree are combined, those that contradict are named."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

BOUND_SIGMAS = 3.0
"""Two sources contradict each other if they differ by more than so many standard deviations of their difference."""


@dataclass(frozen=True)
class ScaleEstimate:
    """Metres per unit by one source, with the relative standard deviation; `source` is its name in messages."""

    source: str
    metres_per_unit: float
    sigma: float

    def __str__(self) -> str:
        return f"{self.source}: {self.metres_per_unit:.6g} m +- {100 * self.sigma:.2g} %"

    def fits(self, other: "ScaleEstimate") -> bool:
        """Whether the two differ by no more than their standard deviations allow."""
        difference = abs(math.log(self.metres_per_unit / other.metres_per_unit))
        return difference <= BOUND_SIGMAS * math.hypot(self.sigma, other.sigma)


@dataclass(frozen=True)
class AgreedScale:
    """The combined estimate, the sources that it is made of, and those that contradict them."""

    estimate: ScaleEstimate
    used: tuple[ScaleEstimate, ...]
    contradicting: tuple[ScaleEstimate, ...] = ()


def agreed(estimates: Sequence[ScaleEstimate]) -> AgreedScale:
    """Combines at least one estimate: those of the majority that agrees.

    ValueError, with all numbers, if no majority of them agrees.
    """
    groups = [[it for it in estimates if it.fits(centre)] for centre in estimates]
    largest = max(groups, key=len)
    mean = _mean(largest)
    used = tuple(it for it in estimates if it.fits(mean))
    if len(used) * 2 <= len(estimates):
        raise ValueError(
            "what is known of the unit of length contradicts itself: one unit of the reconstruction is, by "
            f"{'; '.join(map(str, estimates))}; leave out what is wrong"
        )
    return AgreedScale(_mean(used), used, tuple(it for it in estimates if it not in used))


def _mean(estimates: Sequence[ScaleEstimate]) -> ScaleEstimate:
    """The mean weighted by inverse variances; its deviation is that of the sources, larger if they scatter more."""
    weights = np.array([it.sigma**-2 for it in estimates])
    logs = np.log([it.metres_per_unit for it in estimates])
    mean = float(weights @ logs / weights.sum())
    scatter = float(weights @ (logs - mean) ** 2) / max(len(estimates) - 1, 1)
    sigma = math.sqrt(max(scatter, 1.0) / float(weights.sum()))
    return ScaleEstimate(", ".join(it.source for it in estimates), math.exp(mean), sigma)
