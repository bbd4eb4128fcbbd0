"""Options of a request, how options check themselves, and the context of a computation: cancellation and times.

The options of each stage are in its module; `pipeline.StageOptions` combines them.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from mapless.geometry import Array, Camera

from .optim.bounds import check_bounds


class Variant(str, Enum):
    """Variants of the method; all but `BEST` are the paper's."""

    COARSE = "coarse"
    """The reconstruction's own pose at metric scale."""
    NO_STRUCTURE = "no_structure"
    """PnP on the points that the reconstruction predicts."""
    FULL = "full"
    """The paper's method."""
    BEST = "best"
    """Tracks over all references, keypoints weighted by their noise, a final bundle adjustment."""


class ScaleStrategy(str, Enum):
    """The stages that estimate the scale."""

    TRIANGULATION = "triangulation"
    TRAJECTORY = "trajectory"
    TWO_STAGE = "two_stage"


@dataclass(frozen=True)
class IntrinsicsSigma:
    """Standard deviations of a photograph's intrinsics.

    Attributes:
        focal_share: of both focal lengths together, as a share of them. Lenses change by this much with focus and
            temperature, and calibrations are not more repeatable.
        principal_share: of each coordinate of the principal point, as a share of the image's width.
        k1: of the first radial coefficient.
    """

    focal_share: float = 0.003
    principal_share: float = 0.003
    k1: float = 0.01

    def __post_init__(self) -> None:
        check_bounds(self, "focal_share principal_share k1", above=0, at_most=1)

    def of(self, camera: Camera) -> Array:
        """Standard deviations (4,) of s, of the principal point in pixels of this camera, and of k1."""
        principal_px = self.principal_share * camera.width_px
        return np.array([self.focal_share, principal_px, principal_px, self.k1])


@dataclass(frozen=True)
class LocalizeOptions:
    """Options of a request; the defaults are the most accurate ones measured.

    Attributes:
        variant: variant of the method.
        scale_strategy: how the metric scale is estimated.
        coverage: share of right answers to accept, in a difficult place; a larger share accepts more wrong answers too
            (see `judge.judge`).
        intrinsics: standard deviations of the photograph's intrinsics; None for the defaults, which are smaller where
            the references have the same camera.
    """

    variant: Variant = Variant.BEST
    scale_strategy: ScaleStrategy = ScaleStrategy.TWO_STAGE
    coverage: float = 0.95
    intrinsics: IntrinsicsSigma | None = None

    def __post_init__(self) -> None:
        check_bounds(self, "coverage", above=0, at_most=1)


Check = Callable[[], None]
"""Called between the steps of a computation; raises to cancel it."""


def never_cancelled() -> None:
    """A `Check` that never raises."""


@dataclass(eq=False)
class StageContext:
    """A computation that can be cancelled between its stages, which are timed.

    Attributes:
        check: raises to cancel the computation.
        stage_seconds: time of each stage so far, in order; a stage that runs twice counts twice.
    """

    check: Check = never_cancelled
    stage_seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Calls `check`, then measures the time of a stage, also if the stage raises."""
        self.check()
        start_s = time.perf_counter()
        try:
            yield
        finally:
            self.add(name, time.perf_counter() - start_s)

    def add(self, name: str, seconds: float) -> None:
        """Adds time that was measured elsewhere, such as that of a batch."""
        self.stage_seconds[name] = self.stage_seconds.get(name, 0.0) + seconds
