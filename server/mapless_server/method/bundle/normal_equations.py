"""Normal equations of a bundle adjustment, from observations sorted by view, and the elimination of the points.

The unknowns are poses of cameras, points, and errors of the query's intrinsics. What is computed stands here, as numpy
does it; where `kernels.adjustment` is compiled, that computes the same in less time.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array

from mapless.geometry import Array, RigidTransform
from mapless_server.kernels import adjustment
from mapless_server.kernels.adjustment import Cross, Seen

from ..features.tracks import summed
from ..optim.optimize import (
    apply_columns,
    cauchy_weight,
    columns,
    cross_matrices,
    pose_columns,
    symmetric_products,
    take,
)
from ..structure.model import DepthPlanes
from ..structure.observations import Observations


@dataclass(frozen=True, eq=False)
class Poses:
    """The poses `camera_from_world` of several cameras: rotation (V, 3, 3), translation (V, 3)."""

    rotation: Array
    translation: Array

    @staticmethod
    def of(world_from_camera: Iterable[RigidTransform]) -> Poses:
        """Makes the poses from `world_from_camera` of each camera."""
        poses = [it.inverse() for it in world_from_camera]
        if not poses:
            return Poses(np.empty((0, 3, 3)), np.empty((0, 3)))
        return Poses(np.stack([it.rotation for it in poses]), np.stack([it.translation for it in poses]))

    def __getitem__(self, chosen: NDArray[np.intp] | slice) -> Poses:
        return Poses(self.rotation[chosen], self.translation[chosen])

    @property
    def centres(self) -> Array:
        """Centres (V, 3) of the cameras in the world."""
        return np.asarray(-np.einsum("vji,vj->vi", self.rotation, self.translation))

    def and_last(self, camera_from_world: RigidTransform) -> Poses:
        """Returns these poses with another one appended."""
        return Poses(
            np.concatenate([self.rotation, camera_from_world.rotation[None]]),
            np.concatenate([self.translation, camera_from_world.translation[None]]),
        )

    def moved(self, motion: Array) -> Poses:
        """Returns the poses after left perturbations (V, 6)."""
        turn = _rotations(motion[:, 3:])
        return Poses(turn @ self.rotation, (turn @ self.translation[:, :, None])[..., 0] + motion[:, :3])

    def motion_from(self, given: Poses) -> Array:
        """Left perturbations (V, 6) that move the poses `given` to these, if they are small."""
        turn = self.rotation @ np.swapaxes(given.rotation, 1, 2)
        shift = self.translation - (turn @ given.translation[:, :, None])[..., 0]
        skew = (turn - np.swapaxes(turn, 1, 2)) / 2
        return np.asarray(np.concatenate([shift, skew[:, [2, 0, 1], [1, 2, 0]]], axis=1))


@dataclass(frozen=True, eq=False)
class Bundle:
    """Values of the unknowns: cameras' poses (the query's last), points (P, 3), errors (I,) of intrinsics."""

    poses: Poses
    points: Array
    intrinsics: Array = field(default_factory=lambda: np.zeros(0))

    def moved(self, motion: Array, steps: Array, intrinsics: Array | None = None) -> Bundle:
        """Values after left perturbations (V, 6) of the poses, and steps (P, 3) of points and (I,) of intrinsics."""
        errors = self.intrinsics if intrinsics is None else self.intrinsics + intrinsics
        return Bundle(self.poses.moved(motion), self.points + steps, errors)

    @property
    def world_from_query(self) -> RigidTransform:
        """The query's pose."""
        return RigidTransform(self.poses.rotation[-1], self.poses.translation[-1]).inverse()


def _rotations(vectors: Array) -> Array:
    """Rotations (V, 3, 3) about vectors (V, 3) as `rotation_from_vector` makes each, the same bits."""
    angles = np.sqrt(vectors[:, None] @ vectors[:, :, None]).ravel().tolist()
    small = [angle < 1e-8 for angle in angles]
    first = np.array([1.0 if s else math.sin(a) / a for s, a in zip(small, angles, strict=True)])
    second = np.array([0.5 if s else (1 - math.cos(a)) / a**2 for s, a in zip(small, angles, strict=True)])
    cross = cross_matrices(vectors)
    return np.asarray(np.eye(3) + first[:, None, None] * cross + second[:, None, None] * cross @ cross)


@dataclass(frozen=True, eq=False)
class ViewColumns:
    """Observations sorted by view, one row for each component; column o is one observation (see `optimize`).

    Attributes:
        point, view: (O,) indices of each observation's point and view.
        view_count: number of views.
        focal, offset: (2, O) as in `Observations`.
        by_intrinsics: (2, I, O_q) derivative of the last view's residuals by errors of its intrinsics, if unknown.
        planes: planes of the points, if any have depths.
    """

    point: NDArray[np.intp]
    view: NDArray[np.intp]
    view_count: int
    focal: Array
    offset: Array
    by_intrinsics: Array = field(default_factory=lambda: np.zeros((2, 0, 0)))
    planes: DepthPlanes | None = None

    @staticmethod
    def of(observations: Observations, view_count: int, planes: DepthPlanes | None = None) -> ViewColumns:
        """Makes the columns from rows; `planes` as in BundleProblem."""
        view = observations.tracks.view
        order = np.argsort(view, kind="stable")
        focal, offset = take(observations.focal, order), take(observations.offset, order)
        return ViewColumns(observations.tracks.point[order], view[order], view_count, focal, offset, planes=planes)

    @cached_property
    def parts(self) -> tuple[slice, ...]:
        """Range of the columns of each view."""
        ends = np.searchsorted(self.view, np.arange(self.view_count + 1)).tolist()
        return tuple(slice(*part) for part in itertools.pairwise(ends))

    def seen(self, points: int) -> Seen:
        """The observations, of so many points."""
        ends = np.array([part.stop for part in self.parts], np.intp)
        return Seen(ends, self.point, self.view, points, self.by_intrinsics.shape[1])

    @cached_property
    def sums(self) -> csc_array:
        """(P, O) sparse: a product with it sums over the observations of each point."""
        count = len(self.point)
        shape = int(self.point.max(initial=-1)) + 1, count
        return csc_array((np.ones(count), self.point, np.arange(count + 1)), shape=shape)

    def of_points(self, chosen: NDArray[np.bool_]) -> ViewColumns:
        """Returns the observations of some of the points (P,), with the points numbered anew."""
        kept = np.flatnonzero(chosen[self.point])
        point, view = (np.cumsum(chosen) - 1)[self.point[kept]], self.view[kept]
        by_intrinsics = self.by_intrinsics
        if by_intrinsics.size:
            begin = self.parts[-1].start
            by_intrinsics = take(by_intrinsics, kept[np.searchsorted(kept, begin) :] - begin)
        columns = take(self.focal, kept), take(self.offset, kept), by_intrinsics
        return ViewColumns(point, view, self.view_count, *columns, self.planes and self.planes[chosen])

    def at(self, bundle: Bundle) -> Linearized:
        """The residuals at the values of a bundle, with their derivatives."""
        if adjustment.IS_COMPILED:
            poses, its = bundle.poses, (bundle.points, self.focal, self.offset)
            found = adjustment.project(self.seen(len(bundle.points)), poses.rotation, poses.translation, *its)
        else:
            found = self._projected(bundle)
        if bundle.intrinsics.size:
            found[0][:, self.parts[-1]] += np.einsum("aio,i->ao", self.by_intrinsics, bundle.intrinsics)
        return Linearized(bundle, *found)

    def _projected(self, bundle: Bundle) -> tuple[Array, Array, Array]:
        rotation = take(columns(bundle.poses.rotation), self.view)
        x_in_world = take(np.ascontiguousarray(bundle.points.T), self.point)
        x, y, z = apply_columns(rotation, x_in_world) + take(bundle.poses.translation.T, self.view)
        inverse_depth = 1 / np.where(z > 0, z, np.nan)
        ideal, slope = np.stack([x, y]) * inverse_depth, self.focal * inverse_depth
        by_point = slope[:, None] * (rotation[:2] - ideal[:, None] * rotation[2])
        by_pose = pose_columns(ideal, self.focal, inverse_depth)
        return ideal * self.focal + self.offset, by_point, by_pose

    def equations(
        self, there: Linearized, loss_scale_sigma: float, least_curvature: float = 1.0, weight: Array | None = None
    ) -> NormalEquations:
        """The normal equations of the observations alone, for a Cauchy loss of this scale or for weights (O,).

        With `least_curvature` below 1 derivatives J become (I - (1 - c) r r^T / |r|^2) J and residuals r become r / c,
        which leaves the gradient as it is. For a weight w the loss curves by w (2 w - 1) along r. But c^2 is least at
        w = 1/2 and 1 far away, where the curvature is negative.
        """
        weight = cauchy_weight((there.residual**2).sum(axis=0), loss_scale_sigma) if weight is None else weight
        if adjustment.IS_COMPILED:
            its = there.residual, there.by_point, there.by_pose, self.by_intrinsics
            found = adjustment.equations(self.seen(len(there.bundle.points)), *its, weight, least_curvature)
        else:
            found = self._equations(there, weight, least_curvature)
        if self.planes is not None:
            _, _, _, point_block, point_gradient = found
            normal = self.planes.normal.T
            weighted = normal * self.planes.information
            point_block += symmetric_products(weighted[None], normal[None])
            point_gradient += weighted * self.planes.distance(there.bundle.points)
        return NormalEquations(self, *found)

    def _equations(
        self, there: Linearized, weight: Array, least_curvature: float
    ) -> tuple[Cross, Array, Array, Array, Array]:
        residual, by_point, by_pose = there.residual, there.by_point, there.by_pose
        squared, last, by_intrinsics = (residual**2).sum(axis=0), self.parts[-1], self.by_intrinsics
        if least_curvature < 1:
            shrink = np.sqrt(1 - 4 * (1 - least_curvature) * weight * (1 - weight))
            along = residual * ((1 - shrink) / np.maximum(squared, 1e-12))
            by_point = by_point - residual[:, None] * (along[:, None] * by_point).sum(axis=0)
            by_pose = by_pose - residual[:, None] * (along[:, None] * by_pose).sum(axis=0)
            if by_intrinsics.size:
                its_part = (along[:, None, last] * by_intrinsics).sum(axis=0)
                by_intrinsics = by_intrinsics - residual[:, None, last] * its_part
            residual = residual / shrink
        weighted_point, weighted_pose = by_point * weight, by_pose * weight
        weighted_intrinsics = by_intrinsics * weight[last] if by_intrinsics.size else by_intrinsics
        blocks, gradients = [], []
        for part in self.parts:
            (x, y), (weighted_x, weighted_y) = by_pose[:, :, part], weighted_pose[:, :, part]
            if part is last and by_intrinsics.size:
                x, y = np.concatenate([by_pose[:, :, part], by_intrinsics], axis=1)
                weighted_x, weighted_y = np.concatenate([weighted_pose[:, :, part], weighted_intrinsics], axis=1)
            blocks.append(weighted_x @ x.T + weighted_y @ y.T)
            gradients.append(weighted_x @ residual[0, part] + weighted_y @ residual[1, part])
        terms = symmetric_products(weighted_point, by_point), (weighted_point * residual[:, None]).sum(axis=0)
        point_block, point_gradient = np.split(summed(self.sums, np.concatenate(terms)), [6])
        its = by_point[:, :, last] if by_intrinsics.size else by_point[:, :, :0]
        return (
            Cross(
                np.einsum("kao,kbo->oba", weighted_pose, by_point),
                np.einsum("kao,kbo->oba", weighted_intrinsics, its),
            ),
            *(_block_diagonal(blocks), np.concatenate(gradients), point_block, point_gradient),
        )


@dataclass(frozen=True, eq=False)
class Linearized:
    """Values of the unknowns, and the residuals of O observations there with their derivatives.

    Attributes:
        bundle: the values.
        residual: (2, O) in standard deviations; NaN behind the camera.
        by_point, by_pose: (2, 3, O) and (2, 6, O), derivatives by the point and by a left perturbation of the pose.
    """

    bundle: Bundle
    residual: Array
    by_point: Array
    by_pose: Array


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Normal equations [B E; E^T C] [d_pose; d_point] = -[g; h]: C is block-diagonal, poses include the intrinsics.

    Attributes:
        columns: the observations.
        cross: E, in rows of the observations.
        pose_block: B, (6 V + I, 6 V + I).
        pose_gradient: g, (6 V + I,).
        point_block: C, (6, P) as in `optimize.SYMMETRIC`.
        point_gradient: h, (3, P).
    """

    columns: ViewColumns
    cross: Cross
    pose_block: Array
    pose_gradient: Array
    point_block: Array
    point_gradient: Array

    def reduced(self, damping: float) -> tuple[Array, Array, EliminatedPoints]:
        """Eliminates the points: B - E C^-1 E^T (U, U), g - E C^-1 h (U,), U = 6 V + I; `damping` enlarges diagonals.

        With Cholesky's C = L L^T the products are those of F = E L^-T with itself and with L^-1 h.
        """
        matrix = self.pose_block + damping * np.diag(np.diag(self.pose_block))
        if adjustment.IS_COMPILED:
            vector, seen = self.pose_gradient.copy(), self.columns.seen(self.point_block.shape[1])
            points = self.point_block, self.point_gradient
            found = adjustment.eliminate(seen, damping, *points, self.cross, matrix, vector)
            return matrix, vector, EliminatedPoints(self.columns, *found)
        damped = self.point_block.copy()
        damped[:3] *= 1 + damping
        factor, seen_points = _cholesky(damped), self.columns.point
        gradient, its_query = np.stack(forward(factor, self.point_gradient)), self.columns.parts[-1]
        by_intrinsics = self.cross.by_intrinsics
        rows = (self.cross.by_pose, seen_points), (by_intrinsics, seen_points[its_query][: len(by_intrinsics)])
        left = (forward(take(factor, point), columns(it)) for it, point in rows)
        cross = Cross(*(np.moveaxis(np.stack(it), -1, 0) for it in left))
        eliminated = EliminatedPoints(self.columns, factor, gradient, cross)
        wide = eliminated.cross
        return matrix - wide @ wide.T, self.pose_gradient - wide @ gradient.ravel(), eliminated


@dataclass(frozen=True, eq=False)
class EliminatedPoints:
    """The data needed to compute the points once the cameras are known.

    Attributes:
        columns: the observations.
        factor: L (6, P), as in `optimize.SYMMETRIC`.
        gradient: L^-1 h, (3, P).
        rows: E L^-T, in rows of the observations.
    """

    columns: ViewColumns
    factor: Array
    gradient: Array
    rows: Cross

    @cached_property
    def cross(self) -> Array:
        """E L^-T, (U, 3 P)."""
        seen, count = self.columns, self.factor.shape[1]
        by_view = np.zeros((len(seen.parts), 6, 3, count))
        by_pose, by_intrinsics = (it.transpose(2, 1, 0) for it in (self.rows.by_pose, self.rows.by_intrinsics))
        for its, part in zip(by_view, seen.parts, strict=True):
            its[:, :, seen.point[part]] = by_pose[:, :, part]  # one observation per point and view
        of_query = np.zeros((*by_intrinsics.shape[:2], count))
        if by_intrinsics.size:
            of_query[:, :, seen.point[seen.parts[-1]]] = by_intrinsics
        return np.concatenate([by_view.reshape(-1, 3 * count), of_query.reshape(-1, 3 * count)])

    def steps(self, motion: Array) -> Array:
        """Steps (P, 3) of the points that follow from a motion (U,) of the cameras."""
        if adjustment.IS_COMPILED:
            seen = self.columns.seen(self.factor.shape[1])
            return adjustment.step(seen, self.factor, self.gradient, self.rows, motion)
        xx, yy, zz, xy, xz, yz = self.factor
        x, y, z = -(self.gradient + (motion @ self.cross).reshape(3, -1))
        z = z / zz
        y = (y - yz * z) / yy
        return np.stack([(x - xy * y - xz * z) / xx, y, z], axis=1)


def _block_diagonal(blocks: Sequence[Array]) -> Array:
    """Makes a block-diagonal matrix; SciPy's function takes six times as long for a dozen small blocks."""
    ends = list(itertools.accumulate(map(len, blocks), initial=0))
    matrix = np.zeros((ends[-1], ends[-1]))
    for block, begin, end in zip(blocks, ends[:-1], ends[1:], strict=True):
        matrix[begin:end, begin:end] = block
    return matrix


def _cholesky(matrices: Array) -> Array:
    """Cholesky factors L (6, P) of positive matrices (6, P), both as in `optimize.SYMMETRIC`; NaN where singular."""
    xx, yy, zz, xy, xz, yz = matrices
    with np.errstate(divide="ignore", invalid="ignore"):
        first = np.sqrt(xx)
        xy, xz = xy / first, xz / first
        second = yy - xy * xy
        yz = (yz - xz * xy) / np.sqrt(second)
        third = zz - xz * xz - yz * yz
    solvable = xx * second * third > 1e-14 * np.maximum(np.maximum(xx, yy), zz) ** 3
    diagonal = np.sqrt(np.where(solvable, np.stack([xx, second, third]), np.nan))
    return np.concatenate([diagonal, [xy, xz, yz]])


def forward(factor: Array, vectors: Array) -> list[Array]:
    """Solves L y = b for vectors b (3, ..., P); returns the components of y."""
    xx, yy, zz, xy, xz, yz = factor
    x = vectors[0] / xx
    y = (vectors[1] - xy * x) / yy
    return [x, y, (vectors[2] - xz * x - yz * y) / zz]
