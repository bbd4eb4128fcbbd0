"""Scale: makes a reconstruction metric with the references' known poses, which gives the query's initial pose.

The paper's scale estimation and pose initialization. Stage 1 compares depths triangulated from the known poses with the
predicted depths; if the predicted trajectory, scaled by the result, is as large as the known one, this scale is
adopted. Otherwise stage 2 aligns the predicted trajectory with the known one, and the stage whose scale fits the
trajectory's size better is used.

The equations are in `scale_equations`, for NumPy arrays and torch tensors, and read no value; `judge` evaluates their
result on the host.
"""

from collections.abc import Sequence

import numpy as np

from mapless.geometry import Array, RigidTransform, Similarity

from .correspond import Correspondences
from .rejection import Rejection, RejectionReason
from .results import MetricScale, ScaleStage, Structure
from .scale_equations import ScaleCandidates, ScaleOptions, gather, predict, scale_candidates, trajectory_radius
from .views import PosedView, Reconstruction


def estimate_scale(
    reconstruction: Reconstruction,
    references: Sequence[PosedView],
    correspondences: Correspondences,
    options: ScaleOptions | None = None,
) -> MetricScale | Rejection:
    """Estimates the metric scale of a reconstruction, and with it the query's initial pose; by default as the paper.

    The reconstruction's references are in the order of `references`; of the correspondences, those with the query are
    not used. Returns the scale, with finite values only, or a rejection: NO_USABLE_REFERENCES for fewer than two
    references, DEGENERATE_REFERENCES for references too close to one another, SCALE_UNRELIABLE if the reconstruction is
    not finite or the strategy finds no scale. ValueError if it has another number of references.
    """
    options = options or ScaleOptions()
    predicted = predict(reconstruction, references)
    rejection = check_references(references, options)
    if rejection is not None:
        return rejection
    known = gather(references, correspondences, options)
    with np.errstate(divide="ignore", invalid="ignore"):  # `judge` rejects what is not finite
        candidates = scale_candidates(known, predicted, options)
    return judge(candidates, len(references), options)


def network_scale(reconstruction: Reconstruction, reference: PosedView) -> MetricScale | Rejection:
    """Returns the scale of a reconstruction from a single reference whose unit is approximately the metre.

    It is one metre per unit, with the query's pose that follows; SCALE_UNRELIABLE if the reconstruction is not finite.
    ValueError if the reconstruction's unit is arbitrary, or it has several references.
    """
    (view,) = reconstruction.references
    if reconstruction.metre_sigma is None:
        raise ValueError("the reconstruction's unit is arbitrary")
    local, of_query = view.local_from_camera, reconstruction.query.local_from_camera
    if not np.isfinite(np.stack([local.matrix(), of_query.matrix()])).all():
        return Rejection(RejectionReason.SCALE_UNRELIABLE, "predicted poses are not finite")
    if not (np.isfinite(view.point_map).all(axis=-1) & (view.confidence > 0)).any():
        return Rejection(RejectionReason.SCALE_UNRELIABLE, "no depth of the reference is known")
    world_from_local = reference.world_from_camera.compose(local.inverse())
    return MetricScale(
        1.0,
        ScaleStage.NETWORK,
        0.0,
        0,
        Similarity(1.0, world_from_local.rotation, world_from_local.translation),
        world_from_local.compose(of_query),
        reconstruction.metre_sigma,
    )


def known_scale(
    structure: Structure,
    world_from_query: RigidTransform,
    references: Sequence[PosedView],
    options: ScaleOptions | None = None,
) -> MetricScale | Rejection:
    """The scale of a reconstruction that was triangulated from the known poses, so that it is metric already.

    The structure has at least one point, and its tracks the references' order; any strategy finds this scale, of the
    frame `unit_frame`. The references' places must be within the options' bounds: NO_USABLE_REFERENCES for fewer than
    two, DEGENERATE_REFERENCES for references too close to one another.
    """
    options = options or ScaleOptions()
    rejection = check_references(references, options)
    if rejection is not None:
        return rejection
    centres, axes = (np.stack(it) for it in zip(*(_centre_and_axis(r) for r in references), strict=True))
    tracks, frame = structure.tracks, unit_frame(references[0].world_from_camera, structure.x_in_world)
    depth_m = ((structure.x_in_world[tracks.point] - centres[tracks.view]) * axes[tracks.view]).sum(axis=1)
    candidates = ScaleCandidates(
        broken_poses=0,
        known_depths=len(depth_m),
        radius_per_depth=trajectory_radius(centres) / np.median(depth_m),
        ratio_count=len(depth_m),
        metres_per_unit=frame.scale,
        by_triangulation=options.by_triangulation,
        deviation=0.0,
        anchor=np.bincount(tracks.view).argmax(),
        local_rotation=frame.rotation,
        local_centre=frame.translation,
        query_rotation=world_from_query.rotation,
        query_centre=world_from_query.translation,
    )
    return judge(candidates, len(references), options)


def _centre_and_axis(reference: PosedView) -> tuple[Array, Array]:
    """Camera centre and viewing direction (3,), world."""
    return reference.world_from_camera.translation, reference.world_from_camera.rotation[:, 2]


def unit_frame(world_from_camera: RigidTransform, x_in_world: Array) -> Similarity:
    """The frame of a camera, scaled so that the median of the points (P, 3) is one unit away: world_from_local."""
    distance_m = float(np.median(np.linalg.norm(x_in_world - world_from_camera.translation, axis=1)))
    return Similarity(distance_m, world_from_camera.rotation, world_from_camera.translation)


def check_references(references: Sequence[PosedView], options: ScaleOptions) -> Rejection | None:
    """Rejects references at one place: their trajectory radius is 0, so the scale is not determined."""
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
    """Chooses the scale from the candidates, or rejects the query."""
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
    """Says in one sentence which part of a network's output is not finite; None if all of it is finite."""
    if candidates.broken_poses:
        return f"{candidates.broken_poses:.0f} of {reference_count + 1} predicted poses are not finite"
    if not candidates.known_depths:
        return f"no depth is known at any keypoint of {reference_count} references"
    return None
