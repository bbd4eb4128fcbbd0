"""Observations of points by references: residuals and derivatives, by which points are triangulated and adjusted.

Arrays of observations are in columns (see `optimize`), points (P, 3) are not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array
from mapless_server.kernels import adjustment

from ..features.tracks import Tracks
from ..features.views import PosedView, Reconstruction
from ..optim.optimize import (
    apply_columns,
    columns,
    length,
    median_chi_square,
    minimize_each,
    rows,
    soft_l1,
    soft_l1_weight,
    solve_columns,
    symmetric_products,
    take,
)


@dataclass(frozen=True)
class KeypointNoise:
    """Localization noise of keypoints: sigma^2 = level^2 + (slope * size)^2.

    Attributes:
        level_px: noise common to all keypoints: detection, and the effect of pose and lens errors in pixels.
        slope: noise per diameter of the patch, measured on photographs with surveyed poses.
    """

    level_px: float
    slope: float

    def sigma_px(self, sizes_px: Array) -> Array:
        """Standard deviation (N,) of each coordinate of keypoints of these sizes (N,)."""
        return np.asarray((self.level_px**2 + (self.slope * sizes_px) ** 2) ** 0.5)


ONE_PIXEL = KeypointNoise(1.0, 0.0)
"""The same noise for all keypoints, as in the paper."""

FIRST_GUESS = KeypointNoise(0.3, 0.06)
"""Noise before it is estimated from the residuals."""

MIN_NOISE_LEVEL_PX = 0.15
"""Least noise of a keypoint, pixels: that of the residuals in surveyed scenes under good light."""


LEAST_OBSERVATIONS = 30
"""Fewer do not determine the level of the noise."""


@dataclass(frozen=True, eq=False)
class Observations:
    """Observations of points by references; column o is one observation.

    Attributes:
        tracks: assigns the columns to P points.
        pixel: (2, O) observed pixel.
        size_px: (O,) size of the keypoint.
        sigma_px: (O,) standard deviation of its coordinates.
        rotation: (3, 3, O) camera_from_world of the observing reference.
        translation: (3, O) translation of the same pose, metres.
        focal_px: (2, O) focal lengths of its camera.
        principal_px: (2, O) principal point of its camera.
    """

    tracks: Tracks
    pixel: Array
    size_px: Array
    sigma_px: Array
    rotation: Array
    translation: Array
    focal_px: Array
    principal_px: Array

    @cached_property
    def focal(self) -> Array:
        """Focal lengths (2, O), divided by the keypoint's standard deviation."""
        return self.focal_px / self.sigma_px

    @cached_property
    def offset(self) -> Array:
        """Principal point minus observed pixel (2, O), in standard deviations."""
        return (self.principal_px - self.pixel) / self.sigma_px

    def in_camera(self, x_in_world: Array) -> Array:
        """The point (3, O) of each observation in its camera's frame, from points (P, 3)."""
        return apply_columns(self.rotation, take(columns(x_in_world), self.tracks.point)) + self.translation

    def residuals(self, x_in_world: Array) -> Array:
        """Projection minus observation (2, O) of points (P, 3), in standard deviations; NaN behind the camera."""
        x_in_camera = self.in_camera(x_in_world)
        return x_in_camera[:2] * _inverse_depth(x_in_camera) * self.focal + self.offset

    def linearized(self, x_in_world: Array) -> tuple[Array, Array]:
        """Residuals (2, O) at points (P, 3), and the derivative (2, 3, O) of each by its point, per metre."""
        x_in_camera = self.in_camera(x_in_world)
        inverse_depth = _inverse_depth(x_in_camera)
        ideal, slope = x_in_camera[:2] * inverse_depth, self.focal * inverse_depth
        by_point = slope[:, None] * (self.rotation[:2] - ideal[:, None] * self.rotation[2])
        return ideal * self.focal + self.offset, by_point

    def point_covariances(self, x_in_world: Array) -> Array:
        """Covariances (P, 3, 3) of the points, world axes, square metres; NaN where a point is not determined."""
        _, by_point = self.linearized(x_in_world)
        information = self.tracks.sum_columns(symmetric_products(by_point, by_point))
        return rows(solve_columns(information, np.eye(3)[:, :, None]))

    def rays(self) -> tuple[Array, Array]:
        """Camera centres (3, O) and unit viewing directions (3, O), world frame."""
        u, v = -self.offset / self.focal
        x, y, z = self.rotation
        direction = u * x + v * y + z
        centre = -apply_columns(np.swapaxes(self.rotation, 0, 1), self.translation)
        return centre, direction / (direction**2).sum(0) ** 0.5

    def max_by_point(self, values: Array) -> Array:
        """Largest of values (O,) over each point's observations, (P,); infinite if one is NaN."""
        known, starts = np.where(np.isnan(values), np.inf, values), self.tracks.starts
        return np.maximum.reduceat(known, starts) if len(starts) else known

    def prune(self, chosen: NDArray[np.bool_], x_in_world: Array) -> tuple[Observations, Array]:
        """Keeps the chosen observations (O,) and the points (P, 3) that have at least two of them."""
        tracks, kept, points = self.tracks.prune(chosen)
        names = ("pixel", "size_px", "sigma_px", "rotation", "translation", "focal_px", "principal_px")
        return Observations(tracks, *(take(getattr(self, name), kept) for name in names)), x_in_world[points]


def _inverse_depth(x_in_camera: Array) -> Array:
    """Inverse depths (O,) of points (3, O); NaN behind the camera."""
    return np.asarray(1 / np.where(x_in_camera[2] > 0, x_in_camera[2], np.nan))


def keypoint_depths(reconstruction: Reconstruction, references: Sequence[PosedView]) -> Array:
    """Predicted depth (N,) at the references' keypoints, reconstruction units; NaN where unknown."""
    depths = [
        prediction.depth_at(reference.view.features.keypoints, reference.view.camera)
        for prediction, reference in zip(reconstruction.references, references, strict=True)
    ]
    depth = np.concatenate([np.empty(0), *depths])
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)


def keypoint_rays(references: Sequence[PosedView]) -> tuple[Array, Array]:
    """Camera centres (N, 3) and viewing rays (N, 3) of depth 1, world frame, of the references' keypoints."""
    poses = [reference.world_from_camera for reference in references]
    counts = [len(reference.view.features) for reference in references]
    rays = [r.view.camera.rays(r.view.features.keypoints) @ r.world_from_camera.rotation.T for r in references]
    return np.repeat([pose.translation for pose in poses], counts, axis=0), np.concatenate(rays)


def triangulate(observations: Observations) -> Array:
    """The points (P, 3) nearest to their viewing rays, in the world frame; NaN where the rays are parallel.

    They solve sum_i (I - d_i d_i^T) (X - C_i) = 0 for unit directions d_i and centres C_i.
    """
    centre, direction = observations.rays()
    along = symmetric_products(direction[None], direction[None])
    offsets = centre - direction * (direction * centre).sum(0)
    sums = observations.tracks.sum_columns(np.concatenate([1 - along[:3], -along[3:], offsets]))
    return rows(solve_columns(sums[:6], sums[6:]))


def better_start(observations: Observations, first: Array, second: Array, loss_scale_sigma: float) -> Array:
    """Returns, for each point, that of two initial values (P, 3) which has the lower cost."""
    of_first, of_second = (_costs(observations, it, loss_scale_sigma) for it in (first, second))
    second_wins = np.isnan(of_first) | (of_second < of_first)
    return np.where(second_wins[:, None], second, first)


def adjust_points(observations: Observations, x_in_world: Array, loss_scale_sigma: float, iterations: int) -> Array:
    """Minimizes the soft L1 reprojection error over the points (P, 3) alone, all at once, by Levenberg-Marquardt steps.

    Rows with NaN stay as they are, and no point has a higher cost than at the start. The loss turns from square to
    linear at `loss_scale_sigma` standard deviations.
    """
    if adjustment.IS_COMPILED:
        it, start = observations, np.append(observations.tracks.starts, len(observations.tracks.point))
        given = it.rotation, it.translation, it.focal, it.offset, x_in_world
        return adjustment.adjust_each(start, *given, loss_scale_sigma, iterations)

    def cost(points: Array) -> Array:
        return _costs(observations, points.T, loss_scale_sigma)

    def linearize(points: Array) -> tuple[Array, Array]:
        residuals, by_point = observations.linearized(points.T)
        weighted = by_point * soft_l1_weight((residuals**2).sum(0), loss_scale_sigma)
        terms = symmetric_products(weighted, by_point), (weighted * residuals[:, None]).sum(0)
        sums = observations.tracks.sum_columns(np.concatenate(terms))
        return sums[:6], sums[6:]

    return rows(minimize_each(cost, linearize, columns(x_in_world), iterations))


def estimate_noise(observations: Observations, x_in_world: Array, noise: KeypointNoise) -> KeypointNoise:
    """Returns `noise`, which the observations were weighted with, at the level estimated from their residuals.

    Uses points with three or more observations, or those with two, if the others have fewer than 30 observations; fewer
    than 30 of these leave the level as it is. The median length of a two-dimensional normal residual is
    sqrt(2 ln 2) sigma; a point takes 3 of its 2 n degrees of freedom, so residuals are too small by sqrt(1 - 1.5 / n).
    Two observations are both off by half of their distance from the epipolar line, which has one degree of freedom.
    """
    count = observations.tracks.length
    length_px = length(observations.residuals(x_in_world).T) * observations.sigma_px
    is_known = np.isfinite(length_px)
    used, by_count = (count >= 3) & is_known, np.sqrt(2 * np.log(2) * (1 - 1.5 / count))
    if used.sum() < LEAST_OBSERVATIONS:
        used, by_count = (count == 2) & is_known, np.full(len(count), np.sqrt(median_chi_square(1) / 2))
    if used.sum() < LEAST_OBSERVATIONS:
        return noise
    observed_px = np.median(length_px[used] / by_count[used])
    by_size_squared = np.median(observations.sigma_px[used] ** 2 - noise.level_px**2)
    return replace(noise, level_px=float(max(observed_px**2 - by_size_squared, MIN_NOISE_LEVEL_PX**2) ** 0.5))


def _costs(observations: Observations, x_in_world: Array, loss_scale_sigma: float) -> Array:
    """Costs (P,) of points (P, 3)."""
    squared = (observations.residuals(x_in_world) ** 2).sum(0)
    return observations.tracks.sum_columns(soft_l1(squared, loss_scale_sigma))
