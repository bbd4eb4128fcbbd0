"""Structure: 3D points from tracks over the references, whose poses are known and stay fixed.

The paper's structure-only bundle adjustment: with fixed poses every point is its own problem of three unknowns,

    X_k = argmin sum_i rho(|| pi(P_i, X_k) - u_ki ||^2),     rho(s) = 2 c^2 (sqrt(1 + s / c^2) - 1)   (soft L1),

so all points take Levenberg-Marquardt steps at once, each with its own damping. Residuals are divided by the standard
deviation of their keypoint; the paper's form is the one where that is a pixel for all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, normalize, normalize_jacobian

from .coarse import Reconstruction
from .correspond import Correspondences
from .scale import MetricScale
from .tracks import Tracks, build_tracks
from .views import Features, PosedView


@dataclass(frozen=True)
class StructureOptions:
    """Options of the structure.

    Attributes:
        all_references: merge tracks over all pairs of references (better poses) or, as the paper does, take the first
            reference's pairs alone.
        optimize: move the points. Without, they stay where the reconstruction put them (the paper's ablation).
        model_noise: weigh observations by the expected error of their keypoint; the paper gives all the same weight.
        iterations: Levenberg-Marquardt steps, twice; four converge from a good start.
        loss_scale_sigma: residual, in standard deviations, at which the loss turns from square to linear.
        max_residual_sigma: points with a larger residual in any view are dropped; None keeps all.
        min_parallax_deg: points whose rays meet at less are dropped, because their depth is a guess.
    """

    all_references: bool = True
    optimize: bool = True
    model_noise: bool = True
    iterations: int = 4
    loss_scale_sigma: float = 2.0
    max_residual_sigma: float | None = 4.0
    min_parallax_deg: float = 0.5

    def __post_init__(self) -> None:
        positive = self.iterations > 0 and self.loss_scale_sigma > 0 and (self.max_residual_sigma or 1) > 0
        if not (positive and 0 <= self.min_parallax_deg < 90):
            raise ValueError(f"senseless options: {self}")


PAPER_STRUCTURE = StructureOptions(
    all_references=False,
    model_noise=False,
    iterations=12,
    loss_scale_sigma=1.0,
    max_residual_sigma=None,
    min_parallax_deg=0.0,
)
"""What the paper does."""


@dataclass(frozen=True)
class KeypointNoise:
    """How far keypoints lie from where they should: sigma^2 = level^2 + (slope * size)^2.

    Attributes:
        level_px: what all keypoints share: detection, and what errors of poses and lenses look like in pixels.
        slope: error per diameter of the patch; a blob of 20 px is found to a pixel, one of 3 px to a fifth. Measured on
            photographs with surveyed poses.
    """

    level_px: float
    slope: float

    def sigma_px(self, features: Features) -> Array:
        """Standard deviation (N,) of each coordinate of the keypoints."""
        return np.hypot(self.level_px, self.slope * features.sizes_px.astype(np.float64))


ONE_PIXEL = KeypointNoise(1.0, 0.0)
FIRST_GUESS = KeypointNoise(0.3, 0.06)
MIN_NOISE_LEVEL_PX = 0.15
"""No keypoint is better than this: the residuals of surveyed scenes under good light."""


@dataclass(frozen=True, eq=False)
class Structure:
    """Points and the tracks they come from.

    Attributes:
        x_in_world: (P, 3) metres.
        tracks: of these points over the references, in the order of the points.
        noise: of the keypoints, as estimated from the residuals.
    """

    x_in_world: Array
    tracks: Tracks
    noise: KeypointNoise


@dataclass(frozen=True, eq=False)
class Observations:
    """Where references see points; row o is one observation. Sorted by point.

    Attributes:
        point: (O,) index of the point.
        pixel: (O, 2) observed pixel.
        sigma_px: (O,) standard deviation of its coordinates.
        rotation: (O, 3, 3) camera_from_world of the observing reference.
        translation: (O, 3) of the same, metres.
        focal_px: (O, 2) of its camera.
        principal_px: (O, 2) of its camera.
        starts: (P,) first row of each point.
    """

    point: NDArray[np.intp]
    pixel: Array
    sigma_px: Array
    rotation: Array
    translation: Array
    focal_px: Array
    principal_px: Array
    starts: NDArray[np.intp]

    def residuals(self, x_in_world: Array) -> Array:
        """(O, 2) projection minus observation of points (P, 3), in standard deviations; NaN where not in front."""
        ideal = normalize(self.in_camera(x_in_world))
        return (ideal * self.focal_px + self.principal_px - self.pixel) / self.sigma_px[:, None]

    def jacobians(self, x_in_world: Array) -> Array:
        """(O, 2, 3) derivative of each residual by its own point, per metre."""
        return np.asarray(self.camera_jacobians(self.in_camera(x_in_world)) @ self.rotation)

    def camera_jacobians(self, x_in_camera: Array) -> Array:
        """(O, 2, 3) derivative of each residual by its point in the camera's frame (O, 3), per metre."""
        return normalize_jacobian(x_in_camera) * (self.focal_px / self.sigma_px[:, None])[:, :, None]

    def rays(self) -> tuple[Array, Array]:
        """Camera centres (O, 3) and unit viewing directions (O, 3), world frame."""
        ideal = (self.pixel - self.principal_px) / self.focal_px
        direction = (np.concatenate([ideal, np.ones((len(ideal), 1))], axis=1)[:, None] @ self.rotation)[:, 0]
        centre = -(self.translation[:, None] @ self.rotation)[:, 0]
        return centre, direction / np.linalg.norm(direction, axis=1, keepdims=True)

    def sum_by_point(self, values: Array) -> Array:
        """Sums rows (O, ...) over each point's observations, (P, ...)."""
        return np.add.reduceat(values, self.starts, axis=0) if len(self.starts) else values[:0]

    def max_by_point(self, values: Array) -> Array:
        """Largest of (O,) over each point's observations, (P,); infinite where one is NaN."""
        finite = np.where(np.isnan(values), np.inf, values)
        return np.maximum.reduceat(finite, self.starts) if len(self.starts) else finite[:0]

    def in_camera(self, x_in_world: Array) -> Array:
        """Each observation's point (O, 3) in the frame of its camera, of points (P, 3)."""
        return (self.rotation @ x_in_world[self.point, :, None])[..., 0] + self.translation


def build_structure(
    reconstruction: Reconstruction,
    scale: MetricScale,
    references: Sequence[PosedView],
    correspondences: Correspondences,
    options: StructureOptions,
) -> Structure:
    """Metric points from the references' tracks, started at the reconstruction's depths; possibly none at all.

    Args:
        reconstruction: up to scale; its references in the order of `references`.
        scale: its metric scale.
        references: with known poses.
        correspondences: matches between the references.
        options: `PAPER_STRUCTURE` for the paper's form.

    Returns:
        The structure. Every point is finite, in front of the references that see it.
    """
    anchor = None if options.all_references else 0
    counts = [len(r.view.features) for r in references]
    tracks = build_tracks(correspondences.reference_pairs, counts, anchor)
    noise = FIRST_GUESS if options.model_noise else ONE_PIXEL
    observations = observe(tracks, references, noise)
    points = predicted_points(reconstruction, scale, references, tracks)
    if options.optimize:
        if options.all_references:
            points = better_start(observations, points, triangulate(observations), options.loss_scale_sigma)
        points = adjust_points(observations, points, options.loss_scale_sigma, options.iterations)
        if options.model_noise:
            noise = estimate_noise(observations, points, noise)
            observations = observe(tracks, references, noise)
        if options.max_residual_sigma is not None:
            # A chain of matches that took a wrong turn has good links too.
            explained = np.linalg.norm(observations.residuals(points), axis=1) < options.max_residual_sigma
            tracks, kept = tracks.prune(explained)
            points, observations = points[kept], observe(tracks, references, noise)
        points = adjust_points(observations, points, options.loss_scale_sigma, options.iterations)
    keep = trustworthy(observations, points, options)
    return Structure(points[keep], tracks.select(keep), noise)


def observe(tracks: Tracks, references: Sequence[PosedView], noise: KeypointNoise) -> Observations:
    """The observations of tracks over these references."""
    camera_from_world = [r.world_from_camera.inverse() for r in references]
    rotations = np.stack([c.rotation for c in camera_from_world])
    translations = np.stack([c.translation for c in camera_from_world])
    cameras = [r.view.camera for r in references]
    focals = np.array([(c.focal_x_px, c.focal_y_px) for c in cameras])
    principals = np.array([(c.principal_x_px, c.principal_y_px) for c in cameras])
    offsets = np.cumsum([0] + [len(r.view.features) for r in references])
    keypoints = np.concatenate([r.view.features.keypoints for r in references]).astype(np.float64)
    sigmas = np.concatenate([noise.sigma_px(r.view.features) for r in references])
    rows = offsets[tracks.view] + tracks.keypoint
    return Observations(
        tracks.point,
        keypoints[rows],
        sigmas[rows],
        rotations[tracks.view],
        translations[tracks.view],
        focals[tracks.view],
        principals[tracks.view],
        tracks.starts,
    )


def predicted_points(
    reconstruction: Reconstruction, scale: MetricScale, references: Sequence[PosedView], tracks: Tracks
) -> Array:
    """Back-projects the first keypoint of each track with its predicted depth at metric scale, (P, 3) in the world.

    NaN where the reconstruction knows no depth.
    """
    points = np.full((tracks.point_count, 3), np.nan)
    first_view, first_keypoint = tracks.view[tracks.starts], tracks.keypoint[tracks.starts]
    for index in np.unique(first_view):
        reference, mine = references[index], np.flatnonzero(first_view == index)
        camera = reference.view.camera
        pixels = reference.view.features.keypoints[first_keypoint[mine]]
        depth = reconstruction.references[index].depth_at(pixels, camera)
        x_in_camera = camera.rays(pixels) * (scale.metres_per_unit * depth)[:, None]
        points[mine] = reference.world_from_camera.apply(x_in_camera)
    return points


def triangulate(observations: Observations) -> Array:
    """The points (P, 3) nearest to their viewing rays, in the world frame; NaN where the rays are parallel."""
    centre, direction = observations.rays()
    across = np.eye(3) - direction[:, :, None] * direction[:, None, :]
    offsets = (across @ centre[:, :, None])[..., 0]
    return solve_symmetric(observations.sum_by_point(across), observations.sum_by_point(offsets))


def better_start(observations: Observations, first: Array, second: Array, loss_scale_sigma: float) -> Array:
    """Of two guesses (P, 3) each, point by point the one with the lower cost."""
    cost_first = _cost(observations, observations.residuals(first), loss_scale_sigma)
    cost_second = _cost(observations, observations.residuals(second), loss_scale_sigma)
    second_wins = np.isnan(cost_first) | (cost_second < cost_first)
    return np.where(second_wins[:, None], second, first)


def adjust_points(observations: Observations, x_in_world: Array, loss_scale_sigma: float, iterations: int) -> Array:
    """Minimizes the soft L1 reprojection error over the points alone, all at once.

    Args:
        observations: of all points.
        x_in_world: (P, 3) initial points; rows with NaN stay as they are.
        loss_scale_sigma: residual at which the loss turns from square to linear, standard deviations.
        iterations: number of Levenberg-Marquardt steps.

    Returns:
        (P, 3). No point has a higher cost than it began with.
    """
    points = x_in_world
    damping = np.full(len(points), 1e-3)
    residuals = observations.residuals(points)
    cost = _cost(observations, residuals, loss_scale_sigma)
    for _ in range(iterations):
        jacobians = observations.jacobians(points)
        weight = soft_l1_weight((residuals**2).sum(axis=1), loss_scale_sigma)
        weighted = np.swapaxes(jacobians * weight[:, None, None], 1, 2)
        hessian = observations.sum_by_point(weighted @ jacobians)
        gradient = observations.sum_by_point((weighted @ residuals[:, :, None])[..., 0])
        diagonal = np.einsum("pii->pi", hessian)
        diagonal *= 1 + damping[:, None]
        candidate = points - solve_symmetric(hessian, gradient)
        candidate_residuals = observations.residuals(candidate)
        candidate_cost = _cost(observations, candidate_residuals, loss_scale_sigma)
        better = candidate_cost <= cost  # False for NaN: behind a camera, or a singular system
        points = np.where(better[:, None], candidate, points)
        residuals = np.where(better[observations.point, None], candidate_residuals, residuals)
        cost = np.where(better, candidate_cost, cost)
        damping = np.where(better, damping * 0.1, damping * 10)
    return points


def soft_l1(squared: Array, scale: float) -> Array:
    """rho(s) = 2 c^2 (sqrt(1 + s / c^2) - 1): s for small residuals, 2 c sqrt(s) for large ones."""
    return 2 * scale**2 * (np.sqrt(1 + squared / scale**2) - 1)


def soft_l1_weight(squared: Array, scale: float) -> Array:
    """rho'(s), the weight of a squared residual in iteratively reweighted least squares."""
    return 1 / np.sqrt(1 + squared / scale**2)


def solve_symmetric(matrices: Array, vectors: Array) -> Array:
    """Solves symmetric 3x3 systems (P, 3, 3), (P, 3); NaN where singular."""
    return np.asarray((invert_symmetric(matrices) @ vectors[:, :, None])[..., 0])


def invert_symmetric(matrices: Array) -> Array:
    """Inverses of symmetric matrices (P, 3, 3) by the adjugate; NaN where singular.

    Much faster than a LAPACK call per matrix, and exact enough for steps that are checked afterwards.
    """
    a, b, c = matrices[:, 0], matrices[:, 1], matrices[:, 2]
    adjugate = np.stack([_cross(b, c), _cross(c, a), _cross(a, b)], axis=1)
    determinant = (a * adjugate[:, 0]).sum(axis=1)
    solvable = np.abs(determinant) > 1e-14 * np.abs(matrices).max(axis=(1, 2), initial=0.0) ** 3
    return adjugate / np.where(solvable, determinant, np.nan)[:, None, None]


def estimate_noise(observations: Observations, x_in_world: Array, noise: KeypointNoise) -> KeypointNoise:
    """`noise`, with which the observations were weighted, at the level that their residuals show.

    Looks at points with three or more observations. The median length of a two-dimensional normal residual is
    sqrt(2 ln 2) sigma; a point takes 3 of its 2 n degrees of freedom, so residuals come out too small by
    sqrt(1 - 1.5 / n).
    """
    count = np.bincount(observations.point)[observations.point]
    length_px = np.linalg.norm(observations.residuals(x_in_world), axis=1) * observations.sigma_px
    used = (count >= 3) & np.isfinite(length_px)
    if used.sum() < 30:
        return noise
    observed_px = np.median(length_px[used] / np.sqrt(1 - 1.5 / count[used])) / np.sqrt(2 * np.log(2))
    by_size_squared = np.median(observations.sigma_px[used] ** 2 - noise.level_px**2)
    level_px = np.sqrt(max(observed_px**2 - by_size_squared, MIN_NOISE_LEVEL_PX**2))
    return replace(noise, level_px=float(level_px))


def trustworthy(observations: Observations, x_in_world: Array, options: StructureOptions) -> NDArray[np.bool_]:
    """Which points (P,) are finite, explained by all their observations and seen under enough parallax."""
    residual = np.linalg.norm(observations.residuals(x_in_world), axis=1)
    limit = options.max_residual_sigma
    explained = observations.max_by_point(residual) < (np.inf if limit is None else limit)
    centre, _ = observations.rays()
    direction = x_in_world[observations.point] - centre
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    cosine = (direction * direction[observations.starts][observations.point]).sum(axis=1)
    parallax_deg = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    return np.asarray(explained & (observations.max_by_point(parallax_deg) >= options.min_parallax_deg))


def _cost(observations: Observations, residuals: Array, loss_scale_sigma: float) -> Array:
    return observations.sum_by_point(soft_l1((residuals**2).sum(axis=1), loss_scale_sigma))


def _cross(a: Array, b: Array) -> Array:
    return np.stack(
        [
            a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1],
            a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2],
            a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0],
        ],
        axis=1,
    )
