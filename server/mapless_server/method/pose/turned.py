"""Matches whose point is at the depth that was measured with the query: the pose of a reference, turned around.

The points are in the query's frame, and the references, whose poses are known, see them: as one rig that is posed among
the points. The depths share a factor, an unknown of which a prior is known.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform, normalize_jacobian

from ..features.views import KeypointDepths, Matches, PosedView, View
from ..optim.optimize import motion_jacobian
from ..structure.model import PixelPoints
from .generalized import CameraMatches, rig_ransac
from .pnp import PnpOptions, ransac

BEHIND_PX = 1e6
"""Residual of a point behind the camera that should see it."""


@dataclass(frozen=True, eq=False)
class Rows:
    """Residuals of M matches, and their derivatives.

    Attributes:
        residual: (M, 2) pixels.
        by_pose: (M, 2, U) by a left perturbation (v, w) of the query's camera_from_world, and by the logarithm of the
            factor of the query's depths, if any are used.
        by_depth: (M, 2) by the logarithm of the match's own depth.
        in_front: (M,) whether the point is in front of the camera that sees it.
    """

    residual: Array
    by_pose: Array
    by_depth: Array
    in_front: NDArray[np.bool_]

    def information(self, sigma_px: float, depth_sigma: float) -> Array:
        """Inverse covariances (M, 2, 2) of the residuals, in closed form: points beside the camera make them huge."""
        j = depth_sigma * self.by_depth
        share = j[:, :, None] * j[:, None, :] / (sigma_px**2 + np.square(j).sum(axis=1))[:, None, None]
        return np.asarray((np.eye(2) - share) / sigma_px**2)

    def and_last(self, others: "Rows") -> "Rows":
        """Appends rows whose derivatives have the factor, too."""
        by_pose = np.concatenate([np.pad(self.by_pose, ((0, 0), (0, 0), (0, 1))), others.by_pose])
        residual = np.concatenate([self.residual, others.residual])
        by_depth = np.concatenate([self.by_depth, others.by_depth])
        return Rows(residual, by_pose, by_depth, np.concatenate([self.in_front, others.in_front]))


@dataclass(frozen=True, eq=False)
class TurnedMatches:
    """Points at depths of the query, which references see.

    Attributes:
        x_in_query: (T, 3) in the unit of poses.
        pixels: (T, 2) where the reference of each sees it.
        view: (T,) index of that reference.
        references: the references.
        common_sigma: standard deviation of the logarithm of the factor that the depths share, at least that of their
            mean.
        depth_sigma: standard deviation of a depth, as a share.
    """

    x_in_query: Array
    pixels: Array
    view: NDArray[np.intp]
    references: tuple[PosedView, ...]
    common_sigma: float
    depth_sigma: float

    @staticmethod
    def of(
        query: View, depths: KeypointDepths, references: Sequence[PosedView], view: NDArray[np.intp], matches: Matches
    ) -> "TurnedMatches":
        """The points of matches (T, 2) with these references (T,); all of their query's keypoints have a depth."""
        keypoint = matches[:, 0]
        rays = query.camera.rays(query.features.pixels(keypoint))
        pixels, sigma = np.empty((len(matches), 2)), float(np.median(depths.relative_sigma[keypoint]))
        for i, reference in enumerate(references):
            pixels[view == i] = reference.view.features.pixels(matches[view == i, 1])
        return TurnedMatches(
            rays / rays[:, 2:] * depths.depth[keypoint, None].astype(np.float64),
            pixels,
            view,
            tuple(references),
            max(depths.common_sigma, sigma / math.sqrt(len(matches))),
            sigma,
        )

    def __len__(self) -> int:
        return len(self.pixels)

    def __getitem__(self, rows: NDArray[np.bool_]) -> "TurnedMatches":
        return replace(self, x_in_query=self.x_in_query[rows], pixels=self.pixels[rows], view=self.view[rows])

    @cached_property
    def _cameras(self) -> tuple[Array, Array, Array, Array]:
        """Focal lengths and principal point (T, 2), and camera_from_world (T, 3, 3), (T, 3), of each match."""
        cameras, poses = zip(*((it.view.camera, it.world_from_camera.inverse()) for it in self.references), strict=True)
        focal = np.array([(it.focal_x_px, it.focal_y_px) for it in cameras])
        principal = np.array([(it.principal_x_px, it.principal_y_px) for it in cameras])
        rotation, translation = np.array([it.rotation for it in poses]), np.array([it.translation for it in poses])
        return focal[self.view], principal[self.view], rotation[self.view], translation[self.view]

    def in_world(self, world_from_query: RigidTransform, log_factor: float) -> Array:
        """The points (T, 3) in the world."""
        return np.asarray(world_from_query.apply(math.exp(log_factor) * self.x_in_query))

    def linearize(self, world_from_query: RigidTransform, log_factor: float) -> Rows:
        """The residuals in the references."""
        (focal, principal, rotation, translation), x_in_query = self._cameras, math.exp(log_factor) * self.x_in_query
        x = np.einsum("tij,tj->ti", rotation, world_from_query.apply(x_in_query)) + translation
        in_front = x[:, 2] > 1e-6
        x = np.where(in_front[:, None], x, [0.0, 0.0, 1.0])
        residual = np.where(in_front[:, None], x[:, :2] / x[:, 2:] * focal + principal - self.pixels, BEHIND_PX)
        by_point = normalize_jacobian(x) * focal[:, :, None] @ (rotation @ world_from_query.rotation)
        by_depth = np.where(in_front[:, None], np.einsum("tij,tj->ti", by_point, x_in_query), 0.0)
        by_pose = np.concatenate([-by_point @ motion_jacobian(x_in_query), by_depth[:, :, None]], axis=2)
        return Rows(residual, by_pose, by_depth, in_front)

    def carried(self, log_factor: float) -> Array:
        """The points (T, 3) in the world on the rays of the references, each posed alone; NaN where that fails.

        Unlike `in_world` they depend on no pose of the query that several references give together.
        """
        points = np.full((len(self), 3), np.nan)
        for i in np.unique(self.view):
            own, reference = self.view == i, self.references[i]
            x_in_query = math.exp(log_factor) * self.x_in_query[own]
            pose = ransac(PixelPoints(reference.view.camera, x_in_query, self.pixels[own]), None, PnpOptions())
            if pose is None:
                continue
            depth, rays = pose.inverse().apply(x_in_query)[:, 2], reference.view.camera.rays(self.pixels[own])
            x = rays / rays[:, 2:] * np.where(depth > 0, depth, np.nan)[:, None]
            points[own] = reference.world_from_camera.apply(x)
        return points

    def ransac(self, options: PnpOptions) -> RigidTransform | None:
        """The query's pose by RANSAC; None without one."""
        rig = []
        for i in np.unique(self.view):
            own, reference = self.view == i, self.references[i]
            seen = PixelPoints(reference.view.camera, self.x_in_query[own], self.pixels[own])
            rig.append(CameraMatches(seen, reference.world_from_camera))
        if len(rig) > 1:
            query_from_world = rig_ransac(rig, options)
            return query_from_world and query_from_world.inverse()
        query_from_reference = ransac(rig[0].seen, None, options)
        return query_from_reference and rig[0].rig_from_camera.compose(query_from_reference.inverse())
