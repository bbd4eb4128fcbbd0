"""Options of a request, how options check themselves, and the context of a computation: cancellation and times.

The options of each stage are in its module; `pipeline.StageOptions` combines them.
"""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import Enum

from mapless.geometry import Camera
from mapless_server.bounds import check_bounds

from .bundle.priors import IntrinsicsSigma
from .bundle.readout import RollingShutter
from .promise import PROMISE, PromiseOptions


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


class IntrinsicsSource(str, Enum):
    """Sources of a photograph's intrinsics, in the order in which they are used."""

    GIVEN = "given"
    SCENE_CAMERA = "scene_camera"
    """References, by the EXIF of both photographs, or by their sides and the matches."""
    EXIF = "exif"
    ESTIMATED = "estimated"


@dataclass(frozen=True)
class ChosenCamera:
    """A camera of a photograph without intrinsics, how far it may be off without the matches, and where it is from.

    As of `LocalizeOptions`, no standard deviations are the usual ones.
    """

    camera: Camera
    sigma: IntrinsicsSigma | None
    source: IntrinsicsSource


@dataclass(frozen=True)
class LocalizeOptions:
    """Options of a request; the defaults are the most accurate ones measured.

    Attributes:
        variant: variant of the method.
        scale_strategy: how the metric scale is estimated.
        coverage: share of right answers to accept, in a difficult place; a larger share accepts more wrong answers too
            (see `judge.judge`). Evidence: coverage.
        intrinsics: standard deviations of the photograph's intrinsics; None for the defaults, which are smaller where
            the references have the same camera.
        shutter: the read-out by a rolling shutter; None for a global one, or if nothing is known of it.
    """

    variant: Variant = Variant.BEST
    scale_strategy: ScaleStrategy = ScaleStrategy.TWO_STAGE
    coverage: float = 0.95
    intrinsics: IntrinsicsSigma | None = None
    shutter: RollingShutter | None = None

    def __post_init__(self) -> None:
        check_bounds(self, "coverage", above=0, at_most=1)


@dataclass(frozen=True)
class DoubtOptions:
    """When an accepted pose is doubtful.

    Attributes:
        trust: a pose with less trust is doubtful. Evidence: low-trust.
        radius_m: a pose whose claimed 68 % radius is larger is doubtful: what a robot needs to pass a door.
        inliers: a pose with fewer inliers is doubtful. Evidence: low-trust.
        promise: when a further attempt at a photograph in doubt is worth its time.
    """

    trust: float = 0.25
    radius_m: float = 0.2
    inliers: int = 100
    promise: PromiseOptions = PROMISE

    def __post_init__(self) -> None:
        check_bounds(self, "trust radius_m inliers", at_least=0)


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
        make_until_s: until when, by `time.monotonic`, what references lack is made.
        lacking: what references were found to lack, see `lacks`.
    """

    check: Check = never_cancelled
    stage_seconds: dict[str, float] = field(default_factory=dict)
    make_until_s: float = math.inf
    lacking: dict[tuple[str, str, str], bool] = field(default_factory=dict)

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

    def lacks(self, kind: str, name: str, reference_key: str, is_made: bool) -> None:
        """Records that a reference lacked something that is made in the background, and whether it was made now."""
        self.lacking[kind, name, reference_key] = is_made or self.lacking.get((kind, name, reference_key), False)

    def makes(self, took_s: float = 0.0) -> bool:
        """Whether there is time left to make what takes so long."""
        return time.monotonic() + took_s <= self.make_until_s
