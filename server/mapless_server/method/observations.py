"""Observations of points by cameras: residuals, derivatives, triangulation and adjustment of points.

Works on NumPy arrays and on torch tensors (see `arrays`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from .arrays import (
    AnyArray,
    apply_columns,
    columns,
    length,
    median,
    namespace,
    normalize,
    normalize_jacobian,
    rows,
    solve_columns,
    symmetric_products,
    take,
)
from .optimize import minimize_each, soft_l1, soft_l1_weight
from .results import KeypointNoise
from .tracks import Grouping

ONE_PIXEL = KeypointNoise(1.0, 0.0)
FIRST_GUESS = KeypointNoise(0.3, 0.06)
MIN_NOISE_LEVEL_PX = 0.15
"""Least noise of a keypoint: that of the residuals in surveyed scenes under good light."""


@dataclass(frozen=True, eq=False)
class Observations:
    """Observations of points by references; row o is one observation.

    Attributes:
        tracks: assigns the rows to P points.
        pixel: (O, 2) observed pixel.
        size_px: (O,) size of the keypoint.
        sigma_px: (O,) standard deviation of its coordinates.
        rotation: (O, 3, 3) camera_from_world of the observing reference.
        translation: (O, 3) translation of the same pose, metres.
        focal_px: (O, 2) focal lengths of its camera.
        principal_px: (O, 2) principal point of its camera.
    """

    tracks: Grouping
    pixel: AnyArray
    size_px: AnyArray
    sigma_px: AnyArray
    rotation: AnyArray
    translation: AnyArray
    focal_px: AnyArray
    principal_px: AnyArray

    @property
    def point(self) -> AnyArray:
        """Index (O,) of each row's point."""
        return self.tracks.point

    def residuals(self, x_in_world: AnyArray) -> AnyArray:
        """Projection minus observation (O, 2) of points (P, 3), in standard deviations; NaN behind the camera."""
        return rows(self.columns.residuals(self.columns.in_camera(columns(x_in_world))))

    @cached_property
    def columns(self) -> Columns:
        """Returns the observations in columns, which are faster to compute with."""
        return Columns.of(self)

    def linearized(self, x_in_world: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Returns residuals (O, 2) and the derivative (O, 2, 3) of each by its point, per metre."""
        x_in_camera = self.in_camera(x_in_world)
        return self.camera_residuals(x_in_camera), self.camera_jacobians(x_in_camera) @ self.rotation

    def camera_residuals(self, x_in_camera: AnyArray) -> AnyArray:
        """Residuals (O, 2) of points (O, 3) in the camera's frame, in standard deviations."""
        return (normalize(x_in_camera) * self.focal_px + self.principal_px - self.pixel) / self.sigma_px[:, None]

    def camera_jacobians(self, x_in_camera: AnyArray) -> AnyArray:
        """Derivative (O, 2, 3) of each residual by its point (O, 3) in the camera's frame, per metre."""
        return normalize_jacobian(x_in_camera) * (self.focal_px / self.sigma_px[:, None])[:, :, None]

    def rays(self) -> tuple[AnyArray, AnyArray]:
        """Camera centres (O, 3) and unit viewing directions (O, 3), world frame."""
        centre, direction = self.columns.rays()
        return rows(centre), rows(direction)

    def sum_by_point(self, values: AnyArray) -> AnyArray:
        """Sums rows (O, ...) over each point's observations, (P, ...)."""
        return self.tracks.sum_by_point(values)

    def max_by_point(self, values: AnyArray) -> AnyArray:
        """Largest of values (O,) over each point's observations, (P,); infinite if one is NaN."""
        xp = namespace(values)
        return self.tracks.max_by_point(xp.where(xp.isnan(values), np.inf, values))

    def in_camera(self, x_in_world: AnyArray) -> AnyArray:
        """The point (O, 3) of each observation in its camera's frame, from points (P, 3) in the world."""
        # Three times as fast as matmul.
        return np.einsum("oij,oj->oi", self.rotation, x_in_world[self.point]) + self.translation

    def weighted(self, noise: KeypointNoise) -> Observations:
        """Returns the same observations with another noise."""
        return replace(self, sigma_px=noise.sigma_px(self.size_px))

    def prune(self, chosen: AnyArray, x_in_world: AnyArray) -> tuple[Observations, AnyArray]:
        """Keeps the chosen rows (O,) and the points (P, 3) that have at least two of them."""
        tracks, rows, points = self.tracks.prune(chosen)
        columns = ("pixel", "size_px", "sigma_px", "rotation", "translation", "focal_px", "principal_px")
        return Observations(tracks, *(getattr(self, name)[rows] for name in columns)), x_in_world[points]


@dataclass(frozen=True, eq=False)
class Columns:
    """Observations with one row for each component: column o is one observation (see `arrays.columns`).

    Attributes:
        point: (O,) index of each column's point.
        rotation: (3, 3, O) camera_from_world of the observing reference.
        translation: (3, O) translation of the same pose, metres.
        focal: (2, O) focal lengths of its camera, divided by the keypoint's standard deviation.
        offset: (2, O) principal point minus observed pixel, in standard deviations.
    """

    point: AnyArray
    rotation: AnyArray
    translation: AnyArray
    focal: AnyArray
    offset: AnyArray

    @staticmethod
    def of(observations: Observations) -> Columns:
        """Makes the columns from rows."""
        sigma_px = observations.sigma_px[:, None]
        return Columns(
            observations.point,
            columns(observations.rotation),
            columns(observations.translation),
            columns(observations.focal_px / sigma_px),
            columns((observations.principal_px - observations.pixel) / sigma_px),
        )

    def in_camera(self, x_in_world: AnyArray) -> AnyArray:
        """Coordinates (3, O) in the cameras' frames, from points (3, P) in the world."""
        return apply_columns(self.rotation, take(x_in_world, self.point)) + self.translation

    def residuals(self, x_in_camera: AnyArray) -> AnyArray:
        """Residuals (2, O), in standard deviations, of points (3, O) in the camera's frame; NaN behind the camera."""
        return x_in_camera[:2] * _inverse_depth(x_in_camera) * self.focal + self.offset

    def rays(self) -> tuple[AnyArray, AnyArray]:
        """Camera centres (3, O) and unit viewing directions (3, O), world frame."""
        u, v = -self.offset / self.focal
        world_from_camera = namespace(u).swapaxes(self.rotation, 0, 1)
        x, y, z = self.rotation
        direction = u * x + v * y + z
        return -apply_columns(world_from_camera, self.translation), direction / (direction**2).sum(0) ** 0.5

    def linearized(self, x_in_world: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Returns residuals (2, O) at points (3, P), and the derivative (2, 3, O) of each by its point, per metre."""
        x_in_camera = self.in_camera(x_in_world)
        inverse_depth = _inverse_depth(x_in_camera)
        ideal, slope = x_in_camera[:2] * inverse_depth, self.focal * inverse_depth
        by_point = slope[:, None] * (self.rotation[:2] - ideal[:, None] * self.rotation[2])
        return ideal * self.focal + self.offset, by_point


def _inverse_depth(x_in_camera: AnyArray) -> AnyArray:
    """Inverse depths (O,) of points (3, O); NaN behind the camera."""
    return 1 / namespace(x_in_camera).where(x_in_camera[2] > 0, x_in_camera[2], np.nan)


def back_project(centre: AnyArray, ray: AnyArray, depth_m: AnyArray) -> AnyArray:
    """Points (P, 3) at depths (P,) along rays (P, 3) of depth 1 from camera centres (P, 3), all in one frame."""
    return centre + ray * depth_m[:, None]


def triangulate(observations: Observations) -> AnyArray:
    """The points (P, 3) nearest to their viewing rays, in the world frame; NaN where the rays are parallel.

    They solve sum_i (I - d_i d_i^T) (X - C_i) = 0 for unit directions d_i and centres C_i.
    """
    centre, direction = observations.columns.rays()
    along = symmetric_products(direction[None], direction[None])
    across = namespace(along).concatenate([1 - along[:3], -along[3:]])
    offsets = centre - direction * (direction * centre).sum(0)
    sums = observations.tracks.sum_columns(namespace(along).concatenate([across, offsets]))
    return rows(solve_columns(sums[:6], sums[6:]))


def better_start(observations: Observations, first: AnyArray, second: AnyArray, loss_scale_sigma: float) -> AnyArray:
    """Returns, for each point, that of two initial values (P, 3) which has the lower cost."""
    xp = namespace(first)
    cost_first = _cost(observations, observations.residuals(first), loss_scale_sigma)
    cost_second = _cost(observations, observations.residuals(second), loss_scale_sigma)
    second_wins = xp.isnan(cost_first) | (cost_second < cost_first)
    return xp.where(second_wins[:, None], second, first)


def adjust_points(
    observations: Observations, x_in_world: AnyArray, loss_scale_sigma: float, iterations: int
) -> AnyArray:
    """Minimizes the soft L1 reprojection error over the points (P, 3) alone, all at once, by Levenberg-Marquardt steps.

    Rows with NaN stay as they are, and no point has a higher cost than at the start. The loss turns from square to
    linear at `loss_scale_sigma` standard deviations.
    """
    problem = observations.columns

    def cost(points: AnyArray) -> AnyArray:
        squared = (problem.residuals(problem.in_camera(points)) ** 2).sum(0)
        return observations.tracks.sum_columns(soft_l1(squared, loss_scale_sigma))

    def linearize(points: AnyArray) -> tuple[AnyArray, AnyArray]:
        residuals, by_point = problem.linearized(points)
        weighted = by_point * soft_l1_weight((residuals**2).sum(0), loss_scale_sigma)
        terms = symmetric_products(weighted, by_point), (weighted * residuals[:, None]).sum(0)
        sums = observations.tracks.sum_columns(namespace(points).concatenate(terms))
        return sums[:6], sums[6:]

    return rows(minimize_each(cost, linearize, columns(x_in_world), iterations))


def estimate_noise(observations: Observations, x_in_world: AnyArray, noise: KeypointNoise) -> KeypointNoise:
    """Returns `noise`, which the observations were weighted with, at the level estimated from their residuals.

    Uses points with three or more observations; fewer than 30 rows leave the level as it is. The median length of a
    two-dimensional normal residual is sqrt(2 ln 2) sigma; a point takes 3 of its 2 n degrees of freedom, so residuals
    are too small by sqrt(1 - 1.5 / n).
    """
    xp = namespace(x_in_world)
    count = observations.tracks.length
    length_px = length(observations.residuals(x_in_world)) * observations.sigma_px
    used = (count >= 3) & xp.isfinite(length_px)
    observed_px = median(length_px / (1 - 1.5 / count) ** 0.5, used) / np.sqrt(2 * np.log(2))
    by_size_squared = median(observations.sigma_px**2 - noise.level_px**2, used)
    level_px = xp.clip(observed_px**2 - by_size_squared, MIN_NOISE_LEVEL_PX**2, None) ** 0.5
    return replace(noise, level_px=xp.where(used.sum() < 30, noise.level_px, level_px))


def _cost(observations: Observations, residuals: AnyArray, loss_scale_sigma: float) -> AnyArray:
    return observations.sum_by_point(soft_l1((residuals**2).sum(-1), loss_scale_sigma))
