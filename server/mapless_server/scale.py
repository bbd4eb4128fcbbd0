"""Scale: makes a reconstruction metric with the references' known poses, and so poses the query.

The paper's scale estimation and pose initialization. Stage 1 compares depths triangulated from the known poses with the
predicted ones; if the predicted trajectory, so scaled, is as large as the known one, that is the scale. Otherwise
stage 2 lays the predicted trajectory onto the known one, and the stage whose scale fits its size better wins.

=====================  ======================================================
in the paper           here
=====================  ======================================================
S                      `metres_per_unit`
C^GT, C^local          `centres_world`, `centres_local`
[R^GT | t^GT]          `world_from_camera`, metric
[R^local | t^local]    `local_from_camera`, up to scale
r; d                   `trajectory_radius`; `_Trajectories.deviation`
S_tri; S_traj          `triangulation_scale`; `trajectory_scale`
R_align; P_q^init      `alignment_rotation`; `align`
=====================  ======================================================
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform, Similarity

from .coarse import ReconstructedView, Reconstruction
from .correspond import Correspondences
from .rejection import Rejection, RejectionReason
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
    predictions = reconstruction.references
    depths = [_depths_at_keypoints(*pair) for pair in zip(predictions, references, strict=True)]
    trajectories = _Trajectories(
        _centres([reference.world_from_camera for reference in references]),
        _centres([prediction.local_from_camera for prediction in predictions]),
    )
    rejection = _check_reconstruction(reconstruction, depths) or _check_references(trajectories, depths, options)
    if rejection is not None:
        return rejection

    anchor = select_anchor(predictions)
    world_from_anchor, local_from_anchor = references[anchor].world_from_camera, predictions[anchor].local_from_camera
    rotation = alignment_rotation(world_from_anchor, local_from_anchor)

    outcomes: list[_Candidate | Rejection] = []
    if options.strategy is not ScaleStrategy.TRAJECTORY:
        outcomes.append(_first_stage(references, depths, correspondences, trajectories, options))
    if options.strategy is not ScaleStrategy.TRIANGULATION and not _settles(outcomes, options):
        outcomes.append(_second_stage(trajectories, rotation, options))
    candidates = [outcome for outcome in outcomes if isinstance(outcome, _Candidate)]
    if not candidates:
        return next(outcome for outcome in outcomes if isinstance(outcome, Rejection))
    best = min(candidates, key=lambda candidate: candidate.deviation)  # of equals the first stage's, as in the paper

    world_from_local = align(best.metres_per_unit, rotation, world_from_anchor, local_from_anchor)
    world_from_query = world_from_local.transform_pose(reconstruction.query.local_from_camera)
    return MetricScale(best.metres_per_unit, best.stage, best.deviation, anchor, world_from_local, world_from_query)


@dataclass(frozen=True, eq=False)
class _Trajectories:
    """Centres of the references, (K, 3): known in metres in the world, predicted in the reconstruction's frame."""

    centres_world: Array
    centres_local: Array

    def deviation(self, metres_per_unit: float) -> float:
        """The paper's d = |S r^local / r^GT - 1| of a scale S."""
        return abs(metres_per_unit * trajectory_radius(self.centres_local) / trajectory_radius(self.centres_world) - 1)


@dataclass(frozen=True)
class _Candidate:
    """What one stage proposes; finite, the scale above 0."""

    metres_per_unit: float
    stage: ScaleStage
    deviation: float


def _depths_at_keypoints(prediction: ReconstructedView, reference: PosedView) -> Array:
    """Predicted depth (N,) at each keypoint of a reference, reconstruction units; NaN where there is none."""
    depth = prediction.depth_at(reference.view.features.keypoints, reference.view.camera)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)


def _centres(poses: Sequence[RigidTransform]) -> Array:
    return np.array([pose.translation for pose in poses]).reshape(-1, 3)


def _check_reconstruction(reconstruction: Reconstruction, depths: Sequence[Array]) -> Rejection | None:
    """A network that fails numerically answers NaN; nothing of it may come near a pose."""
    poses = [view.local_from_camera for view in (reconstruction.query, *reconstruction.references)]
    broken = sum(not (np.isfinite(pose.rotation).all() and np.isfinite(pose.translation).all()) for pose in poses)
    if broken:
        message = f"{broken} of {len(poses)} predicted poses are not finite"
        return Rejection(RejectionReason.SCALE_UNRELIABLE, message)
    if depths and np.isnan(np.concatenate(depths)).all():
        message = f"no depth is known at any keypoint of {len(depths)} references"
        return Rejection(RejectionReason.SCALE_UNRELIABLE, message)
    return None


def _check_references(trajectories: _Trajectories, depths: Sequence[Array], options: ScaleOptions) -> Rejection | None:
    """References at one place have no trajectory radius, and nothing else tells how long a metre is."""
    count = len(depths)
    if count < 2:
        message = f"the scale needs two references at different places, got {count}"
        return Rejection(RejectionReason.NO_USABLE_REFERENCES, message)
    radius_m = trajectory_radius(trajectories.centres_world)
    if not radius_m >= options.min_radius_m:
        message = f"{count} references within {radius_m:.2g} m of their centroid, {options.min_radius_m:g} m needed"
        return Rejection(RejectionReason.DEGENERATE_REFERENCES, message)
    per_depth = trajectory_radius(trajectories.centres_local) / float(np.nanmedian(np.concatenate(depths)))
    if not per_depth >= options.min_radius_per_depth:
        message = (
            f"{count} references predicted within {per_depth:.2g} of the scene's depth of their centroid, "
            f"{options.min_radius_per_depth:g} needed"
        )
        return Rejection(RejectionReason.DEGENERATE_REFERENCES, message)
    return None


def trajectory_radius(centres: Array) -> float:
    """RMS distance of camera centres (K, 3) from their centroid, in their unit: r = sqrt(1/K sum |C_i - mean C|^2)."""
    return float(np.sqrt(((centres - centres.mean(axis=0)) ** 2).sum(axis=1).mean()))


def select_anchor(predictions: Sequence[ReconstructedView]) -> int:
    """Index of the reference with the highest total confidence, the first of equals."""
    return int(np.argmax([np.nansum(prediction.confidence, dtype=np.float64) for prediction in predictions]))


def alignment_rotation(world_from_anchor: RigidTransform, local_from_anchor: RigidTransform) -> Array:
    """Rotation (3, 3) from local to world axes, which needs no scale: R_align = R_anc^GT (R_anc^local)^T."""
    return world_from_anchor.rotation @ local_from_anchor.rotation.T


def _first_stage(
    references: Sequence[PosedView],
    depths: Sequence[Array],
    correspondences: Correspondences,
    trajectories: _Trajectories,
    options: ScaleOptions,
) -> _Candidate | Rejection:
    ratios = _depth_ratios(references, depths, correspondences, options)
    if len(ratios) < options.min_ratios:
        message = (
            f"{len(ratios)} depths triangulated between {len(references)} references with baselines of "
            f"{options.min_baseline_m:g} to {options.max_baseline_m:g} m, {options.min_ratios} needed"
        )
        return Rejection(RejectionReason.SCALE_UNRELIABLE, message)
    scale = triangulation_scale(ratios)
    return _Candidate(scale, ScaleStage.TRIANGULATION, trajectories.deviation(scale))


def _depth_ratios(
    references: Sequence[PosedView], depths: Sequence[Array], correspondences: Correspondences, options: ScaleOptions
) -> Array:
    """Z^GT / Z^local, metres per unit, of every match, in both its images: so the references' order does not matter."""
    matches = _matches_in_range(references, correspondences, options)
    counts = [len(depth) for depth in depths]
    centre = np.repeat(_centres([r.world_from_camera for r in references]), counts, axis=0)[matches]  # (M, 2, 3)
    ray = np.concatenate([_keypoint_rays(reference) for reference in references])[matches]  # (M, 2, 3)
    depth_local = np.concatenate(depths)[matches]  # (M, 2)
    depth_m, parallax_deg = triangulate_depths(centre, ray)
    # A match behind either camera is wrong, whatever the other one says. False for NaN.
    usable = (depth_m > 0).all(axis=1) & (parallax_deg >= options.min_parallax_deg)
    ratios: Array = (depth_m[usable] / depth_local[usable]).ravel()
    return ratios[np.isfinite(ratios)]


def _matches_in_range(
    references: Sequence[PosedView], correspondences: Correspondences, options: ScaleOptions
) -> NDArray[np.intp]:
    """Matches (M, 2) of pairs with a baseline in range; keypoints are counted through all references."""
    offsets = np.cumsum([0] + [len(reference.view.features) for reference in references])
    chosen = [np.empty((0, 2), np.intp)]
    for (i, j), matches in correspondences.reference_pairs.items():
        between = references[j].world_from_camera.translation - references[i].world_from_camera.translation
        if options.min_baseline_m <= np.linalg.norm(between) <= options.max_baseline_m:
            chosen.append(matches + offsets[[i, j]])
    in_range = np.concatenate(chosen)
    return in_range[:: 1 + len(in_range) // options.max_matches]


def _keypoint_rays(reference: PosedView) -> Array:
    """Viewing rays (N, 3) of the keypoints in world axes, of depth 1 in the camera."""
    rays: Array = reference.view.camera.rays(reference.view.features.keypoints)
    return rays @ reference.world_from_camera.rotation.T


def triangulate_depths(centre: Array, ray: Array) -> tuple[Array, Array]:
    """Depths at which the two rays of each match pass nearest to one another.

    They solve z_i r_i - z_j r_j = C_j - C_i in the least squares sense:

        z_i = (C_j - C_i) x r_j . n / |n|^2,   z_j = (C_j - C_i) x r_i . n / |n|^2,   n = r_i x r_j.

    Args:
        centre: (M, 2, 3) camera centres C_i and C_j in the world, metres.
        ray: (M, 2, 3) viewing rays r_i and r_j in world axes, of depth 1 in their camera.

    Returns:
        depth_m: (M, 2) in either camera; negative behind it, NaN for parallel rays.
        parallax_deg: (M,) angle between the rays, 0 to 180.
    """
    baseline = centre[:, 1] - centre[:, 0]
    normal = np.cross(ray[:, 0], ray[:, 1])
    squared = (normal**2).sum(axis=1)
    across = np.cross(baseline[:, None], ray[:, ::-1])  # (M, 2, 3), with the other camera's ray
    depth_m = (across * normal[:, None]).sum(axis=2) / np.where(squared > 0, squared, np.nan)[:, None]
    parallax = np.arctan2(np.sqrt(squared), (ray[:, 0] * ray[:, 1]).sum(axis=1))
    return depth_m, np.degrees(parallax)


def triangulation_scale(ratios: Array) -> float:
    """S_tri, the median of the ratios Z^GT / Z^local (N,), in metres per unit."""
    return float(np.median(ratios))


def _settles(outcomes: Sequence[_Candidate | Rejection], options: ScaleOptions) -> bool:
    """Whether the first stage's scale is adopted without a look at the trajectory: d_tri below the gate."""
    return any(isinstance(outcome, _Candidate) and outcome.deviation < options.max_deviation for outcome in outcomes)


def _second_stage(trajectories: _Trajectories, rotation: Array, options: ScaleOptions) -> _Candidate | Rejection:
    scale = trajectory_scale(trajectories.centres_local @ rotation.T, trajectories.centres_world, options)
    if scale is None:
        message = f"no pair of {len(trajectories.centres_world)} references has two known and two predicted places"
        return Rejection(RejectionReason.SCALE_UNRELIABLE, message)
    return _Candidate(scale, ScaleStage.TRAJECTORY, trajectories.deviation(scale))


def trajectory_scale(aligned: Array, centres_world: Array, options: ScaleOptions) -> float | None:
    """S_traj: the scale with the most inliers, among equals that with the smallest RMS distance.

    Every pair of cameras proposes the ratio of their known to their predicted distance. The proposal scales the whole
    trajectory, which is then moved onto the known one by the offset of their centroids; cameras that come within
    `inlier_distance_m` of their known centre are inliers.

    Args:
        aligned: (K, 3) predicted centres in world axes, R_align C^local.
        centres_world: (K, 3) known centres, metres.
        options: the distance, and how many cameras propose.

    Returns:
        Metres per unit; None when no pair has a distance in both trajectories.
    """
    proposals = _pair_scales(aligned, centres_world, options.max_pair_cameras)
    if not len(proposals):
        return None
    moved = proposals[:, None, None] * (aligned - aligned.mean(axis=0))  # (P, K, 3)
    squared = ((moved - (centres_world - centres_world.mean(axis=0))) ** 2).sum(axis=2)  # (P, K) square metres
    inliers = squared <= options.inlier_distance_m**2
    count = inliers.sum(axis=1)
    judges = inliers | (count == 0)[:, None]  # where no camera agrees, all of them judge
    mean_squared = (squared * judges).sum(axis=1) / judges.sum(axis=1)
    return float(proposals[np.lexsort((mean_squared, -count))[0]])


def _pair_scales(aligned: Array, centres_world: Array, max_cameras: int) -> Array:
    """Known over predicted distance (P,) of the pairs of at most `max_cameras` evenly chosen cameras."""
    count = len(aligned)
    cameras = np.linspace(0, count - 1, min(count, max_cameras)).round().astype(np.intp)
    first, second = cameras[np.stack(np.triu_indices(len(cameras), 1))]
    predicted = np.linalg.norm(aligned[first] - aligned[second], axis=1)
    known = np.linalg.norm(centres_world[first] - centres_world[second], axis=1)
    # A distance of nothing but rounding proposes nothing but rounding.
    apart = (predicted > 1e-6 * trajectory_radius(aligned)) & (known > 1e-6 * trajectory_radius(centres_world))
    scales: Array = known[apart] / predicted[apart]
    return scales


def align(
    metres_per_unit: float, rotation: Array, world_from_anchor: RigidTransform, local_from_anchor: RigidTransform
) -> Similarity:
    """``world_from_local`` by rotation and scale, with the anchor's predicted centre on its known one.

    x_in_world = t_anc^GT + S R_align (x_in_local - t_anc^local). Applied to P_q^local it gives the paper's P_q^init:
    R_q^init = R_align R_q^local,   t_q^init = t_anc^GT + R_align S (t_q^local - t_anc^local).
    """
    offset = metres_per_unit * (rotation @ local_from_anchor.translation)
    return Similarity(metres_per_unit, rotation, world_from_anchor.translation - offset)
