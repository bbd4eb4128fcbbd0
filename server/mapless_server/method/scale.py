"""Scale: makes a reconstruction metric with the references' known poses, and so poses the query.

The paper's scale estimation and pose initialization. Stage 1 compares depths triangulated from the known poses with the
predicted ones; if the predicted trajectory, so scaled, is as large as the known one, that is the scale. Otherwise
stage 2 lays the predicted trajectory onto the known one, and the stage whose scale fits its size better wins.

The equations are in `scale_equations`. They look at no value, so that they run on NumPy's arrays and on torch's
tensors; `judge` looks at what came out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from mapless.geometry import RigidTransform, Similarity

from .coarse import Reconstruction
from .correspond import Correspondences
from .rejection import Rejection, RejectionReason
from .scale_equations import Weighed, gather, predict, trajectory_radius, weigh
from .views import PosedView


class ScaleStrategy(str, Enum):
    """Which stages may give the scale."""

    TRIANGULATION = "triangulation"
    TRAJECTORY = "trajectory"
    TWO_STAGE = "two_stage"


class ScaleStage(str, Enum):
    """Which stage gave it."""

    TRIANGULATION = "triangulation"
    TRAJECTORY = "trajectory"


@dataclass(frozen=True)
class ScaleOptions:
    """Options of the scale. Numbers "of the paper" are its own; each of the others says what it adds.

    Attributes:
        strategy: two stages, as in the paper; or one of them alone, to compare.
        min_baseline_m, max_baseline_m: pairs of references that are triangulated (of the paper). Closer ones see no
            depth, farther ones hardly see the same things.
        min_parallax_deg: angle at which the two rays of a triangulated match must meet. The paper bounds the baseline
            alone, but 0.3 m tells nothing about what is 100 m away: one pixel at a focal length of 800 px is 0.07 deg,
            so an angle of 1 deg gives a depth to 7 %, about the gate's 5 %. 0 keeps every match.
        min_ratios: fewest depth ratios, two from a match, for their median to count. The median of 12 matches errs by
            1.25 / sqrt(12) of their spread: 3.6 % for a spread of 10 %, inside the gate. Fewer leave it to stage 2.
        max_matches: most matches that are triangulated, evenly chosen among more: 32 references can have 400 000, but
            the median of 20 000 errs by less than a hundredth of their spread.
        max_deviation: deviation below which the scale of stage 1 is adopted at once (of the paper).
        inlier_distance_m: a camera agrees with a scale of stage 2 when its aligned centre comes this close to the known
            one (of the paper).
        max_pair_cameras: stage 2 tries every pair of so many cameras, evenly chosen among more. All 496 pairs of 32
            stand for the paper's 500 random ones, so that an answer is reproducible.
        min_radius_m: smallest trajectory radius of the references that tells a scale: poses are known to about 1 cm.
        min_radius_per_depth: the same as a share of the scene's depth, which is how predicted poses err. At 0.002 the
            references' images differ by the parallax of 1.6 px at a focal length of 800 px: noise of a keypoint.
    """

    strategy: ScaleStrategy = ScaleStrategy.TWO_STAGE
    min_baseline_m: float = 0.3
    max_baseline_m: float = 10.0
    min_parallax_deg: float = 1.0
    min_ratios: int = 24
    max_matches: int = 20_000
    max_deviation: float = 0.05
    inlier_distance_m: float = 0.10
    max_pair_cameras: int = 32
    min_radius_m: float = 0.01
    min_radius_per_depth: float = 0.002

    def __post_init__(self) -> None:
        if not (
            0 < self.min_baseline_m <= self.max_baseline_m
            and 0 <= self.min_parallax_deg < 90
            and self.min_ratios >= 1
            and self.max_matches >= 1
            and self.max_deviation >= 0
            and self.inlier_distance_m > 0
            and self.max_pair_cameras >= 2
            and self.min_radius_m > 0
            and self.min_radius_per_depth >= 0
        ):
            raise ValueError(f"senseless options: {self}")

    @property
    def by_triangulation(self) -> bool:
        """Whether stage 1 may give the scale."""
        return self.strategy is not ScaleStrategy.TRAJECTORY

    @property
    def by_trajectory(self) -> bool:
        """Whether stage 2 may."""
        return self.strategy is not ScaleStrategy.TRIANGULATION


@dataclass(frozen=True, eq=False)
class MetricScale:
    """A reconstruction made metric.

    Attributes:
        metres_per_unit: S, above 0; metres per unit of the reconstruction.
        stage: which stage gave it.
        deviation: d of this scale, 0 and above.
        anchor: index of the reference whose pose ties the local frame to the world.
        world_from_local: the reconstruction's frame in the world, metres.
        world_from_query: the query camera's initial pose P_q^init, metres.
    """

    metres_per_unit: float
    stage: ScaleStage
    deviation: float
    anchor: int
    world_from_local: Similarity
    world_from_query: RigidTransform


def estimate_scale(
    reconstruction: Reconstruction,
    references: Sequence[PosedView],
    correspondences: Correspondences,
    options: ScaleOptions | None = None,
) -> MetricScale | Rejection:
    """The metric scale of a reconstruction, and with it the query's initial pose.

    Args:
        reconstruction: query and references up to scale, its references in the order of `references`.
        references: with known poses.
        correspondences: matches between references; those with the query are not looked at.
        options: defaults to the paper's.

    Returns:
        The scale, everything in it finite; or a rejection: NO_USABLE_REFERENCES for fewer than two,
        DEGENERATE_REFERENCES for references that stand too close together, SCALE_UNRELIABLE when the reconstruction is
        not finite or the strategy finds no scale.

    Raises:
        ValueError: the reconstruction has another number of references.
    """
    options = options or ScaleOptions()
    predicted = predict(reconstruction, references)
    rejection = check_references(references, options)
    if rejection is not None:
        return rejection
    known = gather(references, correspondences, options)
    with np.errstate(divide="ignore", invalid="ignore"):  # what is not finite is for `judge`
        weighed = weigh(known, predicted, options)
    return judge(weighed, len(references), options)


def check_references(references: Sequence[PosedView], options: ScaleOptions) -> Rejection | None:
    """References at one place have no trajectory radius, and nothing else tells how long a metre is."""
    count = len(references)
    if count < 2:
        message = f"the scale needs two references at different places, got {count}"
        return Rejection(RejectionReason.NO_USABLE_REFERENCES, message)
    radius_m = trajectory_radius(np.stack([reference.world_from_camera.translation for reference in references]))
    if not radius_m >= options.min_radius_m:
        message = f"{count} references within {radius_m:.2g} m of their centroid, {options.min_radius_m:g} m needed"
        return Rejection(RejectionReason.DEGENERATE_REFERENCES, message)
    return None


def judge(weighed: Weighed, reference_count: int, options: ScaleOptions) -> MetricScale | Rejection:
    """The scale; or why what was weighed gives none."""
    broken = not_finite(weighed, reference_count)
    if broken:
        return Rejection(RejectionReason.SCALE_UNRELIABLE, broken)
    if not weighed.radius_per_depth >= options.min_radius_per_depth:
        message = (
            f"{reference_count} references predicted within {weighed.radius_per_depth:.2g} of the scene's depth of "
            f"their centroid, {options.min_radius_per_depth:g} needed"
        )
        return Rejection(RejectionReason.DEGENERATE_REFERENCES, message)
    if np.isfinite(weighed.metres_per_unit):
        rotation, scale = weighed.local_rotation, float(weighed.metres_per_unit)
        return MetricScale(
            scale,
            ScaleStage.TRIANGULATION if weighed.by_triangulation else ScaleStage.TRAJECTORY,
            float(weighed.deviation),
            int(weighed.anchor),
            Similarity(scale, rotation, weighed.local_centre),
            RigidTransform(weighed.query_rotation, weighed.query_centre),
        )
    if not options.by_triangulation:
        message = f"no pair of {reference_count} references has two known and two predicted places"
    else:
        message = (
            f"{weighed.ratio_count:.0f} depths triangulated between {reference_count} references with baselines of "
            f"{options.min_baseline_m:g} to {options.max_baseline_m:g} m, {options.min_ratios} needed"
        )
    return Rejection(RejectionReason.SCALE_UNRELIABLE, message)


def not_finite(weighed: Weighed, reference_count: int) -> str | None:
    """A network that fails numerically answers NaN; nothing of it may come near a pose. None if it did not fail."""
    if weighed.broken_poses:
        return f"{weighed.broken_poses:.0f} of {reference_count + 1} predicted poses are not finite"
    if not weighed.known_depths:
        return f"no depth is known at any keypoint of {reference_count} references"
    return None
