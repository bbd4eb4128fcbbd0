"""The equations of the scale and of the initial pose.

=====================  ======================================================
in the paper           here
=====================  ======================================================
S                      `metres_per_unit`
[R^GT | t^GT]          `Known.rotation`, `Known.centre`: world_from_camera
[R^local | t^local]    `Predicted.rotation`, `Predicted.centre`: local_from_camera
C^GT, C^local          `Known.centre`, `Predicted.centre`
r; d                   `trajectory_radius`; `trajectory_deviation`
S_tri; S_traj          `triangulation_scale`; `trajectory_scale`
R_align; P_q^init      `alignment_rotation`; `align`
=====================  ======================================================

`gather` collects the known values from the references on the host; `scale_candidates` compares them with the predicted
ones, for NumPy arrays and torch tensors (see `arrays`).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array

from .arrays import AnyArray, length, median, namespace
from .correspond import Correspondences
from .options import ScaleStrategy, check_bounds
from .tracks import keypoint_depths, keypoint_offsets, keypoint_rays
from .views import PosedView, Reconstruction


@dataclass(frozen=True)
class ScaleOptions:
    """Options of the scale; "of the paper" marks the paper's values.

    Attributes:
        strategy: two stages, as in the paper; or one of them alone, for comparison.
        min_baseline_m, max_baseline_m: baselines of pairs of references to triangulate (of the paper). Shorter ones do
            not determine depth, longer ones share few points.
        min_parallax_deg: least angle between the two rays of a triangulated match. The paper bounds the baseline alone,
            but 0.3 m does not determine a depth of 100 m: one pixel at a focal length of 800 px is 0.07 deg, so an
            angle of 1 deg gives a depth to 7 %, about the 5 % of `max_deviation`. 0 keeps every match.
        min_ratios: fewest depth ratios, two per match, for stage 1. The median of 12 matches errs by 1.25 / sqrt(12) of
            their spread: 3.6 % for a spread of 10 %, within `max_deviation`. With fewer, stage 2 gives the scale.
        max_matches: largest number of matches to triangulate, evenly thinned: 32 references can have 400 000, but the
            median of 20 000 errs by less than a hundredth of their spread.
        max_deviation: deviation below which the scale of stage 1 is adopted at once (of the paper).
        inlier_distance_m: largest distance between the aligned and the known centre of a camera that is an inlier of a
            scale of stage 2 (of the paper).
        max_pair_cameras: stage 2 tries every pair of at most this many cameras, evenly thinned. All 496 pairs of 32
            replace the paper's 500 random ones, so that an answer is reproducible.
        min_radius_m: smallest trajectory radius of the references that determines a scale: poses are accurate to about
            1 cm.
        min_radius_per_depth: the same for the predicted trajectory, as a share of the scene's depth. At 0.002 the
            references' images differ by a parallax of 1.6 px at a focal length of 800 px: the noise of a keypoint.
        metre_sigma: relative standard deviation of the reconstruction's unit, if that is approximately the metre: a
            stage whose scale differs from 1 by more than `max_metre_sigmas` of it is not used if the other stage's does
            not. If both differ, both may be used. None if the unit is arbitrary, as in the paper.
        max_metre_sigmas: bound for `metre_sigma`; with 20 %, three are a factor of 1.8.
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
    metre_sigma: float | None = None
    max_metre_sigmas: float = 3.0

    def __post_init__(self) -> None:
        check_bounds(self, "min_baseline_m", above=0, at_most=self.max_baseline_m)
        check_bounds(self, "min_parallax_deg", at_least=0, below=90)
        check_bounds(self, "min_ratios max_matches", at_least=1)
        check_bounds(self, "max_deviation min_radius_per_depth", at_least=0)
        check_bounds(self, "inlier_distance_m min_radius_m", above=0)
        check_bounds(self, "max_pair_cameras", at_least=2)
        check_bounds(self, "max_metre_sigmas", above=0)
        if self.metre_sigma is not None:
            check_bounds(self, "metre_sigma", above=0)

    @property
    def by_triangulation(self) -> bool:
        """Whether stage 1 may give the scale."""
        return self.strategy is not ScaleStrategy.TRAJECTORY

    @property
    def by_trajectory(self) -> bool:
        """Whether stage 2 may give the scale."""
        return self.strategy is not ScaleStrategy.TRIANGULATION


@dataclass(frozen=True, eq=False)
class Known:
    """Known values of K references; keypoint indices are into the concatenated keypoints of all references.

    Attributes:
        rotation: (K, 3, 3) world_from_camera.
        centre: (K, 3) in the world, metres.
        pairs: (P, 2) references whose distance proposes a scale in stage 2.
        matches: (M, 2) keypoints of the triangulated matches.
        depth_m: (M, 2) their depths, above 0.
    """

    rotation: AnyArray
    centre: AnyArray
    pairs: AnyArray
    matches: AnyArray
    depth_m: AnyArray


@dataclass(frozen=True, eq=False)
class Predicted:
    """Values that a reconstruction predicts, float64, in its frame and unit.

    Attributes:
        rotation: (K + 1, 3, 3) local_from_camera of the references, then of the query.
        centre: (K + 1, 3) camera centres of the same.
        depth: (N,) depths at the references' keypoints; NaN where there is none.
        confidence: (K,) total confidence of each reference.
    """

    rotation: AnyArray
    centre: AnyArray
    depth: AnyArray
    confidence: AnyArray


@dataclass(frozen=True, eq=False)
class ScaleCandidates:
    """Result of the two stages, from which `scale.judge` takes the scale; scalar arrays if no shape is given.

    Attributes:
        broken_poses: number of predicted poses that are not finite.
        known_depths: number of keypoints with a depth.
        radius_per_depth: radius of the predicted trajectory over the median depth.
        ratio_count: number of depth ratios.
        metres_per_unit: S; NaN if the strategy finds none.
        by_triangulation: whether the scale is that of stage 1.
        deviation: trajectory deviation d of this scale.
        anchor: index of the reference with the highest total confidence, the first of equals.
        local_rotation, local_centre: (3, 3), (3,) world_from_local without the scale.
        query_rotation, query_centre: (3, 3), (3,) world_from_query, P_q^init.
    """

    broken_poses: AnyArray
    known_depths: AnyArray
    radius_per_depth: AnyArray
    ratio_count: AnyArray
    metres_per_unit: AnyArray
    by_triangulation: AnyArray
    deviation: AnyArray
    anchor: AnyArray
    local_rotation: AnyArray
    local_centre: AnyArray
    query_rotation: AnyArray
    query_centre: AnyArray


def predict(reconstruction: Reconstruction, references: Sequence[PosedView]) -> Predicted:
    """Extracts the values of the reconstruction that the scale uses."""
    poses = [view.local_from_camera for view in (*reconstruction.references, reconstruction.query)]
    return Predicted(
        np.stack([pose.rotation for pose in poses]),
        np.stack([pose.translation for pose in poses]),
        keypoint_depths(reconstruction, references),
        np.array([np.nansum(view.confidence, dtype=np.float64) for view in reconstruction.references]),
    )


def gather(references: Sequence[PosedView], correspondences: Correspondences, options: ScaleOptions) -> Known:
    """Collects the known values of two or more references."""
    poses = [reference.world_from_camera for reference in references]
    if not options.by_triangulation:
        correspondences = Correspondences({}, ())
    matches = _matches_in_range(references, correspondences, options)
    centre, ray = keypoint_rays(references)
    depth_m, parallax_deg = triangulate_depths(centre[matches], ray[matches])
    # A match behind either camera is wrong. False for NaN.
    usable = (depth_m > 0).all(axis=1) & (parallax_deg >= options.min_parallax_deg)
    return Known(
        np.stack([pose.rotation for pose in poses]),
        np.stack([pose.translation for pose in poses]),
        pairs_of(len(references), options.max_pair_cameras),
        matches[usable],
        depth_m[usable],
    )


def _matches_in_range(
    references: Sequence[PosedView], correspondences: Correspondences, options: ScaleOptions
) -> NDArray[np.intp]:
    """Returns the matches (M, 2) of pairs whose baseline is in range."""
    offsets = keypoint_offsets(references)
    chosen = [np.empty((0, 2), np.intp)]
    for (i, j), matches in correspondences.reference_pairs.items():
        between = references[j].world_from_camera.translation - references[i].world_from_camera.translation
        if options.min_baseline_m <= np.linalg.norm(between) <= options.max_baseline_m:
            chosen.append(matches + offsets[[i, j]])
    in_range = np.concatenate(chosen)
    return in_range[:: 1 + len(in_range) // options.max_matches]


def pairs_of(count: int, max_cameras: int) -> NDArray[np.intp]:
    """The pairs (P, 2) of at most `max_cameras` evenly chosen cameras of `count`."""
    cameras = np.linspace(0, count - 1, min(count, max_cameras)).round().astype(np.intp)
    return cameras[np.stack(np.triu_indices(len(cameras), 1), axis=1)]


def scale_candidates(known: Known, predicted: Predicted, options: ScaleOptions) -> ScaleCandidates:
    """Computes the candidates of both stages from known and predicted values."""
    xp, count = namespace(predicted.depth), len(known.centre)
    finite = xp.isfinite(xp.concatenate([predicted.rotation.reshape(count + 1, 9), predicted.centre], 1)).all(1)
    has_depth = ~xp.isnan(predicted.depth)
    centre = predicted.centre[:count]
    radius, radius_m = trajectory_radius(centre), trajectory_radius(known.centre)
    anchor = predicted.confidence.argmax()
    world_from_anchor, local_from_anchor = (
        (_pick(poses.rotation, anchor), _pick(poses.centre, anchor)) for poses in (known, predicted)
    )
    rotation = alignment_rotation(world_from_anchor[0], local_from_anchor[0])

    # Ratios in both images of a match, so that the order of the references does not matter.
    ratios = (known.depth_m / predicted.depth[known.matches]).reshape(-1)
    usable = xp.isfinite(ratios)
    enough = (usable.sum() >= options.min_ratios) & options.by_triangulation
    first = xp.where(enough, triangulation_scale(ratios, usable), np.nan)
    second = trajectory_scale(centre @ rotation.T, known.centre, known.pairs, options.inlier_distance_m)
    if not options.by_trajectory:
        second = second * np.nan
    of_first, of_second = (trajectory_deviation(scale, radius, radius_m) for scale in (first, second))
    # Stage 1 if d_tri is below the bound; otherwise the stage with the smaller d, stage 1 of equals.
    by_triangulation = (of_first < options.max_deviation) | (of_first <= of_second) | xp.isnan(of_second)
    if options.metre_sigma is not None:
        limit = options.max_metre_sigmas * options.metre_sigma
        # Neither for NaN, of a stage without a scale.
        first_agrees, second_agrees = (abs(xp.log(scale)) <= limit for scale in (first, second))
        by_triangulation = (by_triangulation & (first_agrees | ~second_agrees)) | (first_agrees & ~second_agrees)

    scale = xp.where(by_triangulation, first, second)
    world_from_local = align(scale, rotation, world_from_anchor[1], local_from_anchor[1])
    return ScaleCandidates(
        (~finite).sum(),
        has_depth.sum(),
        radius / median(predicted.depth, has_depth),
        usable.sum(),
        scale,
        by_triangulation,
        xp.where(by_triangulation, of_first, of_second),
        anchor,
        rotation,
        world_from_local,
        rotation @ predicted.rotation[count],
        scale * (rotation @ predicted.centre[count]) + world_from_local,
    )


def _pick(rows: AnyArray, index: AnyArray) -> AnyArray:
    """Returns one row; torch would synchronize for an index that is not in a tensor."""
    return rows[index.reshape(1)][0]


def triangulate_depths(centre: Array, ray: Array) -> tuple[Array, Array]:
    """Depths at which the two rays of each match are nearest to one another.

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
    # (b x r) n = r (n x b) for either camera, with the other camera's ray r.
    turned = np.cross(normal, baseline)
    depth_m = np.einsum("mvi,mi->mv", ray[:, ::-1], turned) / np.where(squared > 0, squared, np.nan)[:, None]
    parallax = np.arctan2(np.sqrt(squared), (ray[:, 0] * ray[:, 1]).sum(axis=1))
    return depth_m, np.degrees(parallax)


def trajectory_radius(centres: AnyArray) -> AnyArray:
    """RMS distance of camera centres (K, 3) from their centroid, in their unit: r = sqrt(1/K sum |C_i - mean C|^2)."""
    return ((centres - centres.mean(0)) ** 2).sum(1).mean() ** 0.5


def trajectory_deviation(metres_per_unit: AnyArray, radius: AnyArray, radius_m: AnyArray) -> AnyArray:
    """The paper's d = |S r^local / r^GT - 1| of a scale S, by the predicted and the known radius."""
    return abs(metres_per_unit * radius / radius_m - 1)


def alignment_rotation(world_from_anchor: AnyArray, local_from_anchor: AnyArray) -> AnyArray:
    """Rotation (3, 3) from local to world axes, which needs no scale: R_align = R_anc^GT (R_anc^local)^T."""
    return world_from_anchor @ local_from_anchor.T


def triangulation_scale(ratios: AnyArray, usable: AnyArray) -> AnyArray:
    """S_tri, the median of the usable (N,) ratios Z^GT / Z^local (N,), in metres per unit."""
    return median(ratios, usable)


def trajectory_scale(aligned: AnyArray, centres_world: AnyArray, pairs: AnyArray, inlier_distance_m: float) -> AnyArray:
    """S_traj: the scale with the most inliers, of equals that with the smallest RMS distance.

    Every pair of cameras proposes the ratio of their known to their predicted distance. The predicted trajectory is
    scaled by it and shifted so that its centroid is that of the known one; cameras near their known centre are inliers.

    Args:
        aligned: (K, 3) predicted centres in world axes, R_align C^local.
        centres_world: (K, 3) known centres, metres.
        pairs: (P, 2) pairs of cameras, at least one.
        inlier_distance_m: largest distance of an inlier.

    Returns:
        Metres per unit; NaN when no pair has a distance in both trajectories.
    """
    xp = namespace(aligned)
    predicted, known = (length(centres[pairs[:, 0]] - centres[pairs[:, 1]]) for centres in (aligned, centres_world))
    # Distances at the level of rounding propose no scale.
    apart = (predicted > 1e-6 * trajectory_radius(aligned)) & (known > 1e-6 * trajectory_radius(centres_world))
    proposals = known / xp.where(apart, predicted, np.nan)
    moved = proposals[:, None, None] * (aligned - aligned.mean(0))  # (P, K, 3)
    squared = ((moved - (centres_world - centres_world.mean(0))) ** 2).sum(2)  # (P, K) square metres
    inliers = squared <= inlier_distance_m**2
    count = xp.where(apart, inliers.sum(1), -1)
    counted = inliers | (count == 0)[:, None]  # all cameras, where none is an inlier
    mean_squared = (squared * counted).sum(1) / counted.sum(1)
    return _pick(proposals, xp.where(count == count.max(), mean_squared, np.inf).argmin())


def align(
    metres_per_unit: AnyArray, rotation: AnyArray, anchor_in_world: AnyArray, anchor_in_local: AnyArray
) -> AnyArray:
    """Translation (3,) of ``world_from_local``, which maps the anchor's predicted centre (3,) to its known one (3,).

    x_in_world = t_anc^GT + S R_align (x_in_local - t_anc^local). Applied to P_q^local it gives the paper's P_q^init:
    R_q^init = R_align R_q^local,   t_q^init = t_anc^GT + R_align S (t_q^local - t_anc^local).
    """
    return anchor_in_world - metres_per_unit * (rotation @ anchor_in_local)
