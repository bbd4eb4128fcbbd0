"""Scale: makes a reconstruction metric with the references' known poses, which gives the query's initial pose.

The paper's scale estimation and pose initialization. Stage 1 compares depths triangulated from the known poses with the
predicted depths; if the predicted trajectory, scaled by the result, is as large as the known one, this scale is
adopted. Otherwise stage 2 aligns the predicted trajectory with the known one, and the stage whose scale fits the
trajectory's size better is used. In the paper, S is `metres_per_unit`, S_tri the median of `triangulated_ratios`; known
poses are marked GT, those of the reconstruction local.
"""

import math
from collections.abc import Sequence

import numpy as np

from mapless.geometry import Array, RigidTransform, Similarity

from ..features.tracks import keypoint_offsets
from ..features.views import DepthSource, PosedView, Reconstruction
from ..options import ScaleStrategy
from ..pairs.correspond import Correspondences
from ..pairs.epipolar import MIN_PARALLAX_DEG, triangulate_depths
from ..rejection import Rejection, RejectionReason
from ..structure.model import MetricScale, ScaleStage, Structure
from ..structure.observations import keypoint_depths, keypoint_rays

MIN_BASELINE_M, MAX_BASELINE_M = 0.3, 10.0
"""Baselines of pairs of references to triangulate, as in the paper. Shorter ones do not determine depth, longer ones
share few points."""

MIN_RATIOS = 24
"""Fewest depth ratios, two per match, for stage 1: their median errs by 1.25 / sqrt(12) of the spread of 12 matches."""

MAX_MATCHES = 20_000
"""Largest number of matches to triangulate, evenly thinned: their median errs by a hundredth of their spread."""

MAX_DEVIATION = 0.05
"""Deviation below which the scale of stage 1 is adopted at once, as in the paper."""

INLIER_DISTANCE_M = 0.10
"""Largest distance between the aligned and the known centre of a camera that is an inlier of a scale of stage 2, as in
the paper."""

MIN_RADIUS_M = 0.01
"""Smallest trajectory radius of the references that determines a scale: poses are accurate to about 1 cm."""

MIN_RADIUS_PER_DEPTH = 0.002
"""The same for the predicted trajectory, as a share of the scene's depth: a parallax of 1.6 px at a focal length of
800 px."""

MAX_METRE_SIGMAS = 3.0
"""A stage whose scale differs from 1 by more standard deviations (`Reconstruction.metre_sigma`) is not used if the
other stage's does not."""


def estimate_scale(
    reconstruction: Reconstruction,
    references: Sequence[PosedView],
    correspondences: Correspondences,
    strategy: ScaleStrategy = ScaleStrategy.TWO_STAGE,
) -> MetricScale | Rejection:
    """Estimates the metric scale of a reconstruction, and with it the query's initial pose; by default as the paper.

    The reconstruction's references are in the order of `references`; of the correspondences, those with the query are
    not used. Returns the scale, with finite values only, or a rejection: NO_USABLE_REFERENCES for fewer than two
    references, DEGENERATE_REFERENCES for references too close to one another, SCALE_UNRELIABLE if the reconstruction is
    not finite or the strategy finds no scale. ValueError if it has another number of references.
    """
    depth = keypoint_depths(reconstruction, references)
    rejection = _check_references(references) or _check_finite(reconstruction, depth)
    if rejection:
        return rejection
    count, known = len(references), [it.world_from_camera for it in references]
    local = [it.local_from_camera for it in reconstruction.references]
    centres_world, centres = (np.stack([it.translation for it in poses]) for poses in (known, local))
    rejection = _check_depth(trajectory_radius(centres) / float(np.nanmedian(depth)), count)
    if rejection:
        return rejection
    confidences = [np.nansum(view.confidence, dtype=np.float64) for view in reconstruction.references]
    anchor = int(np.argmax(confidences))  # the first of equals
    rotation = known[anchor].rotation @ local[anchor].rotation.T  # R_align, which needs no scale

    ratios, first, second = np.empty(0), math.nan, math.nan
    if strategy is not ScaleStrategy.TRAJECTORY:
        ratios = triangulated_ratios(references, correspondences, depth)
        first = float(np.median(ratios)) if len(ratios) >= MIN_RATIOS else math.nan
    if strategy is not ScaleStrategy.TRIANGULATION:
        second = trajectory_scale(centres @ rotation.T, centres_world)
    of_first, of_second = (trajectory_deviation(scale, centres, centres_world) for scale in (first, second))
    by_triangulation = _is_first_better(first, second, of_first, of_second, reconstruction.metre_sigma)
    deviation = of_first if by_triangulation else of_second
    scale = first if by_triangulation else second
    if not math.isfinite(scale):
        return _no_scale(count, len(ratios), strategy)
    # x_in_world = t_anc^GT + S R_align (x_in_local - t_anc^local), also of the query: P_q^init.
    shift = known[anchor].translation - scale * (rotation @ local[anchor].translation)
    world_from_local = Similarity(scale, rotation, shift)
    world_from_query = world_from_local.transform_pose(reconstruction.query.local_from_camera)
    stage = ScaleStage.TRIANGULATION if by_triangulation else ScaleStage.TRAJECTORY
    return MetricScale(scale, stage, deviation, anchor, world_from_local, world_from_query)


def _is_first_better(first: float, second: float, of_first: float, of_second: float, metre_sigma: float | None) -> bool:
    """Whether stage 1 gives the scale, from the scales of both stages and their deviations; NaN without a scale."""
    if metre_sigma is not None:
        limit = MAX_METRE_SIGMAS * metre_sigma
        first_agrees, second_agrees = (abs(math.log(scale)) <= limit for scale in (first, second))
        if first_agrees != second_agrees:
            return first_agrees
    # Stage 1 if d_tri is below the bound; otherwise the stage with the smaller d, stage 1 of equals.
    return of_first < MAX_DEVIATION or of_first <= of_second or math.isnan(of_second)


def depth_scale(reference: PosedView, world_from_query: RigidTransform) -> MetricScale | Rejection:
    """The scale of a single reference with depths, which is metric already; NO_USABLE_REFERENCES if none is known."""
    depths, pose = reference.depths, reference.world_from_camera
    if depths is None or not np.isfinite(depths.depth).any():
        message = "a single reference, and no depth is known at its keypoints"
        return Rejection(RejectionReason.NO_USABLE_REFERENCES, message)
    unit = float(np.nanmedian(depths.depth))
    frame = Similarity(unit, pose.rotation, pose.translation)
    is_measured = depths.source is DepthSource.MEASURED
    return MetricScale(unit, ScaleStage.DEPTH, 0.0, 0, frame, world_from_query, depths.common_sigma, is_measured)


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
    strategy: ScaleStrategy = ScaleStrategy.TWO_STAGE,
) -> MetricScale | Rejection:
    """The scale of a reconstruction that was triangulated from the known poses, so that it is metric already.

    The structure has at least one point, and its tracks the references' order; the frame is `unit_frame`.
    Unless depths give points, NO_USABLE_REFERENCES for fewer than two references, DEGENERATE_REFERENCES for references
    too close to one another.
    """
    has_depths = structure.planes is not None
    if not has_depths and (rejection := _check_references(references)):
        return rejection
    poses, tracks = [reference.world_from_camera for reference in references], structure.tracks
    centres, axes = np.stack([it.translation for it in poses]), np.stack([it.rotation[:, 2] for it in poses])
    depth_m = ((structure.x_in_world[tracks.point] - centres[tracks.view]) * axes[tracks.view]).sum(axis=1)
    share = trajectory_radius(centres) / float(np.median(depth_m))
    if not has_depths and (rejection := _check_depth(share, len(references))):
        return rejection
    frame = unit_frame(poses[0], structure.x_in_world)
    stage = ScaleStage.TRAJECTORY if strategy is ScaleStrategy.TRAJECTORY else ScaleStage.TRIANGULATION
    anchor = int(np.bincount(tracks.view).argmax())
    return MetricScale(frame.scale, stage, 0.0, anchor, frame, world_from_query)


def unit_frame(world_from_camera: RigidTransform, x_in_world: Array) -> Similarity:
    """The frame of a camera, scaled so that the median of the points (P, 3) is one unit away: world_from_local."""
    distance_m = float(np.median(np.linalg.norm(x_in_world - world_from_camera.translation, axis=1)))
    return Similarity(distance_m, world_from_camera.rotation, world_from_camera.translation)


def _check_references(references: Sequence[PosedView]) -> Rejection | None:
    """Rejects references at one place: their trajectory radius is 0, so the scale is not determined."""
    count = len(references)
    if count < 2:
        message = f"the scale needs two references at different places, got {count}"
        return Rejection(RejectionReason.NO_USABLE_REFERENCES, message)
    radius_m = trajectory_radius(np.stack([reference.world_from_camera.translation for reference in references]))
    if not radius_m >= MIN_RADIUS_M:
        message = (
            f"{count} references within {radius_m:.2g} of their centroid, in the unit of their poses, "
            f"{MIN_RADIUS_M:g} needed"
        )
        return Rejection(RejectionReason.DEGENERATE_REFERENCES, message)
    return None


def _check_finite(reconstruction: Reconstruction, depth: Array) -> Rejection | None:
    """Rejects a reconstruction with a pose that is not finite, or without any depth (N,) at a reference's keypoint."""
    views = (*reconstruction.references, reconstruction.query)
    broken = sum(not np.isfinite(view.local_from_camera.matrix()).all() for view in views)
    if broken:
        message = f"{broken} of {len(views)} predicted poses are not finite"
        return Rejection(RejectionReason.SCALE_UNRELIABLE, message)
    if np.isnan(depth).all():
        message = f"no depth is known at any keypoint of {len(views) - 1} references"
        return Rejection(RejectionReason.SCALE_UNRELIABLE, message)
    return None


def _check_depth(radius_per_depth: float, count: int) -> Rejection | None:
    """Rejects references that are predicted too close to one another for the depth of what they see."""
    if radius_per_depth >= MIN_RADIUS_PER_DEPTH:
        return None
    message = (
        f"{count} references predicted within {radius_per_depth:.2g} of the scene's depth of their centroid, "
        f"{MIN_RADIUS_PER_DEPTH:g} needed"
    )
    return Rejection(RejectionReason.DEGENERATE_REFERENCES, message)


def _no_scale(count: int, ratio_count: int, strategy: ScaleStrategy) -> Rejection:
    message = (
        f"{ratio_count} depths triangulated between {count} references with baselines of {MIN_BASELINE_M:g} to "
        f"{MAX_BASELINE_M:g} m, {MIN_RATIOS} needed"
    )
    if strategy is ScaleStrategy.TRAJECTORY:
        message = f"no pair of {count} references has two known and two predicted places"
    return Rejection(RejectionReason.SCALE_UNRELIABLE, message)


def triangulated_ratios(references: Sequence[PosedView], correspondences: Correspondences, depth: Array) -> Array:
    """Ratios (R,) Z^GT / Z^local of triangulated to predicted depths (N,), of matches whose baseline is in range.

    A match gives one in either image, so that the order of the references does not matter.
    """
    offsets = keypoint_offsets(references)
    chosen = [np.empty((0, 2), np.intp)]
    for (i, j), matches in correspondences.reference_pairs.items():
        between = references[j].world_from_camera.translation - references[i].world_from_camera.translation
        if MIN_BASELINE_M <= np.linalg.norm(between) <= MAX_BASELINE_M:
            chosen.append(matches + offsets[[i, j]])
    in_range = np.concatenate(chosen)
    in_range = in_range[:: 1 + len(in_range) // MAX_MATCHES]
    centre, ray = keypoint_rays(references)
    depth_m, parallax_deg = triangulate_depths(centre[in_range], ray[in_range])
    # A match behind either camera is wrong. False for NaN.
    usable = (depth_m > 0).all(axis=1) & (parallax_deg >= MIN_PARALLAX_DEG)
    ratios = (depth_m[usable] / depth[in_range[usable]]).ravel()
    return np.asarray(ratios[np.isfinite(ratios)])


def trajectory_radius(centres: Array) -> float:
    """RMS distance of camera centres (K, 3) from their centroid, in their unit: r = sqrt(1/K sum |C_i - mean C|^2)."""
    return float(((centres - centres.mean(0)) ** 2).sum(1).mean() ** 0.5)


def trajectory_deviation(metres_per_unit: float, centres: Array, centres_world: Array) -> float:
    """The paper's d = |S r^local / r^GT - 1| of a scale S, from the predicted and the known centres (K, 3)."""
    return abs(metres_per_unit * trajectory_radius(centres) / trajectory_radius(centres_world) - 1)


def trajectory_scale(aligned: Array, centres_world: Array) -> float:
    """S_traj, metres per unit: the scale with the most inliers, of equals that with the smallest RMS distance.

    Every pair of cameras proposes the ratio of their known to their predicted distance; the paper draws 500 at random.
    The predicted centres in world axes, R_align C^local (K, 3), are scaled by it and shifted so that their centroid is
    that of the known ones (K, 3), metres; cameras near their known centre are inliers. NaN when no pair has a distance
    in both trajectories.
    """
    first, second = np.triu_indices(len(aligned), 1)
    predicted, known = (
        np.linalg.norm(centres[first] - centres[second], axis=1) for centres in (aligned, centres_world)
    )
    # Distances at the level of rounding propose no scale.
    apart = (predicted > 1e-6 * trajectory_radius(aligned)) & (known > 1e-6 * trajectory_radius(centres_world))
    if not apart.any():
        return math.nan
    proposals = known[apart] / predicted[apart]
    moved = proposals[:, None, None] * (aligned - aligned.mean(0))  # (P, K, 3)
    squared = ((moved - (centres_world - centres_world.mean(0))) ** 2).sum(2)  # (P, K) square metres
    inliers = squared <= INLIER_DISTANCE_M**2
    count = inliers.sum(1)
    counted = inliers | (count == 0)[:, None]  # all cameras, where none is an inlier
    mean_squared = (squared * counted).sum(1) / counted.sum(1)
    return float(proposals[np.where(count == count.max(), mean_squared, np.inf).argmin()])
