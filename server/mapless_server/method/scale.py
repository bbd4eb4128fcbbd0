"""Scale: makes a reconstruction metric with the references' known poses, and so poses the query.

The paper's scale estimation and pose initialization. Stage 1 compares depths triangulated from the known poses with the
predicted ones; if the predicted trajectory, so scaled, is as large as the known one, that is the scale. Otherwise
stage 2 lays the predicted trajectory onto the known one, and the stage whose scale fits its size better wins.

The equations are in `scale_equations`. They look at no value, so that they run on NumPy's arrays and on torch's
tensors; `judge` looks at what came out.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mapless.geometry import RigidTransform, Similarity

from .correspond import Correspondences
from .reconstruction import Reconstruction
from .rejection import Rejection, RejectionReason
from .results import MetricScale, ScaleStage
from .scale_equations import ScaleCandidates, ScaleOptions, gather, predict, scale_candidates, trajectory_radius
from .views import PosedView


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
        candidates = scale_candidates(known, predicted, options)
    return judge(candidates, len(references), options)


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


def judge(candidates: ScaleCandidates, reference_count: int, options: ScaleOptions) -> MetricScale | Rejection:
    """The scale; or why the candidates give none."""
    broken = not_finite(candidates, reference_count)
    if broken:
        return Rejection(RejectionReason.SCALE_UNRELIABLE, broken)
    if not candidates.radius_per_depth >= options.min_radius_per_depth:
        message = (
            f"{reference_count} references predicted within {candidates.radius_per_depth:.2g} of the scene's depth of "
            f"their centroid, {options.min_radius_per_depth:g} needed"
        )
        return Rejection(RejectionReason.DEGENERATE_REFERENCES, message)
    if np.isfinite(candidates.metres_per_unit):
        rotation, scale = candidates.local_rotation, float(candidates.metres_per_unit)
        return MetricScale(
            scale,
            ScaleStage.TRIANGULATION if candidates.by_triangulation else ScaleStage.TRAJECTORY,
            float(candidates.deviation),
            int(candidates.anchor),
            Similarity(scale, rotation, candidates.local_centre),
            RigidTransform(candidates.query_rotation, candidates.query_centre),
        )
    if not options.by_triangulation:
        message = f"no pair of {reference_count} references has two known and two predicted places"
    else:
        message = (
            f"{candidates.ratio_count:.0f} depths triangulated between {reference_count} references with baselines of "
            f"{options.min_baseline_m:g} to {options.max_baseline_m:g} m, {options.min_ratios} needed"
        )
    return Rejection(RejectionReason.SCALE_UNRELIABLE, message)


def not_finite(candidates: ScaleCandidates, reference_count: int) -> str | None:
    """A network that fails numerically answers NaN; nothing of it may come near a pose. None if it did not fail."""
    if candidates.broken_poses:
        return f"{candidates.broken_poses:.0f} of {reference_count + 1} predicted poses are not finite"
    if not candidates.known_depths:
        return f"no depth is known at any keypoint of {reference_count} references"
    return None
