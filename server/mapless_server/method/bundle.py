"""Bundle adjustment of cameras and points.

    min  sum_obs rho(|r_o|^2 / sigma_o^2) + xi^T C^-1 xi      (Cauchy's loss)

over the poses of all cameras and the points; xi are the motions of the references away from their given poses. The last
camera is the query, whose pose may have priors. Its intrinsics may be unknowns too: four errors with a prior of mean 0
(see `intrinsics`). They move its keypoints, which is linear, so that derivatives by poses and points do not depend on
them. The points are eliminated (Schur complement), which leaves a dense system of 6 unknowns per camera and those 4.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array

from mapless.geometry import Array, RigidTransform

from .observations import Observations, Tracks, summed
from .optimize import apply_columns, cauchy_cost, cauchy_weight, columns, solve_step, symmetric_products, take
from .perturbation import pose_columns, world_jacobian
from .priors.known import NO_PRIORS, Priors
from .results import DepthPlanes, Structure
from .structure import observe
from .views import PosedView


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


@dataclass(frozen=True, eq=False)
class BundleProblem:
    """The cost and its derivatives; see `optimize.Problem`.

    Attributes:
        observations: observations of the points in all views; the views' poses are not used.
        view: (O,) index of the view of each observation.
        given: poses of the references.
        information: C^-1, (6 (V - 1), 6 (V - 1)), of the prior on the references' poses; 0 leaves them free.
        loss_scale_sigma: scale of the Cauchy loss, in standard deviations.
        priors: priors on the query's pose.
        prior_weight: factor on their cost, relative to that of the observations.
        keypoint_motion: (O_q, 2, I) of the query's observations, in their order, by errors of its intrinsics, in
            standard deviations; I = 0 if they are no unknowns.
        intrinsics_information: (I,) inverse variances of the prior on these errors.
        intrinsics_offset: (I,) errors of the intrinsics that are removed already; the prior's mean is minus these.
        planes: planes near which the points lie by stored depths, at the references' given poses: motions of these by
            millimetres do not matter for depths known to centimetres.
        least_curvature: least curvature of the loss along a residual, as a share of its weight. Along a residual
            Cauchy's loss curves less than its weight says, so below 1 steps are longer and fewer (Triggs et al.,
            Bundle adjustment: a modern synthesis, 2000); the minimum is the same.
    """

    observations: Observations
    view: NDArray[np.intp]
    given: Poses
    information: Array
    loss_scale_sigma: float
    priors: Priors = NO_PRIORS
    prior_weight: float = 1.0
    keypoint_motion: Array = field(default_factory=lambda: np.zeros((0, 2, 0)))
    intrinsics_information: Array = field(default_factory=lambda: np.zeros(0))
    intrinsics_offset: Array = field(default_factory=lambda: np.zeros(0))
    planes: DepthPlanes | None = None
    least_curvature: float = 1.0

    @cached_property
    def by_view(self) -> ViewColumns:
        """The observations sorted by view, in columns."""
        view_count = len(self.given.rotation) + 1
        return ViewColumns.of(self.observations, self.view, view_count, self.keypoint_motion, self.planes)

    def replaced(self, **changes: Any) -> BundleProblem:
        """Returns the problem with other priors or `keypoint_motion`; the same observations are not sorted again."""
        other, by_view = replace(self, **changes), self.by_view
        if "keypoint_motion" in changes:
            by_view = replace(by_view, by_intrinsics=_by_intrinsics(other.keypoint_motion))
        vars(other)["by_view"] = by_view
        return other

    @property
    def query_rows(self) -> slice:
        """The rows of the query's pose in the normal equations; those of its intrinsics follow."""
        count = 6 * len(self.given.rotation)
        return slice(count, count + 6)

    def reference_motion(self, bundle: Bundle) -> Array:
        """Motion (V - 1, 6) of each reference from its given pose."""
        return bundle.poses[:-1].motion_from(self.given)

    def cost(self, bundle: Bundle) -> float:
        """Cost of the values; NaN if a point is behind a camera."""
        squared = (self.by_view.linearized(bundle)[0] ** 2).sum(axis=0)
        motion = self.reference_motion(bundle).ravel()
        prior = float(motion @ self.information @ motion)
        if bundle.intrinsics.size:
            prior += float(self.intrinsics_information @ (bundle.intrinsics + self.intrinsics_offset) ** 2)
        if self.priors:
            prior += self.prior_weight * self.priors.cost(bundle.world_from_query)
        if self.by_view.planes is not None:
            prior += self.by_view.planes.cost(bundle.points)
        return cauchy_cost(squared, self.loss_scale_sigma) + prior

    def linearize(self, bundle: Bundle) -> NormalEquations:
        """See `optimize.Problem`."""
        equations = self.by_view.equations(bundle, self.loss_scale_sigma, self.least_curvature)
        query = self.query_rows
        references, intrinsics = slice(query.start), slice(query.stop, None)
        equations.pose_block[references, references] += self.information
        equations.pose_gradient[references] += self.information @ self.reference_motion(bundle).ravel()
        if bundle.intrinsics.size:
            errors = bundle.intrinsics + self.intrinsics_offset
            equations.pose_block[intrinsics, intrinsics] += np.diag(self.intrinsics_information)
            equations.pose_gradient[intrinsics] += self.intrinsics_information * errors
        if self.priors:
            pose = bundle.world_from_query
            gradient, information = self.priors.gradient_and_information(pose)
            to_world = world_jacobian(pose)
            equations.pose_gradient[query] += self.prior_weight * to_world.T @ gradient
            equations.pose_block[query, query] += self.prior_weight * to_world.T @ information @ to_world
        return equations

    def step(self, bundle: Bundle, equations: NormalEquations, damping: float) -> Bundle | None:
        """See `optimize.Problem`."""
        matrix, gradient, points = equations.reduced(damping)
        motion = solve_step(matrix, gradient)
        if motion is None:
            return None
        cameras = self.query_rows.stop
        return bundle.moved(motion[:cameras].reshape(-1, 6), points.steps(motion), motion[cameras:])

    def query_motion_sigma(self, before: Bundle, after: Bundle, equations: NormalEquations) -> float:
        """Length of the query's motion, intrinsics included, in standard deviations by the residuals.

        These are as if points and references were known, so the motion is no longer than this.
        """
        motion = after.poses[-1:].motion_from(before.poses[-1:]).ravel()
        step = np.concatenate([motion, after.intrinsics - before.intrinsics])
        unknowns = slice(self.query_rows.start, None)
        return math.sqrt(step @ equations.pose_block[unknowns, unknowns] @ step)


@dataclass(frozen=True, eq=False)
class ViewColumns:
    """Observations sorted by view, one row for each component; column o is one observation (see `optimize`).

    Attributes:
        point, view: (O,) indices of each observation's point and view.
        parts: range of the columns of each view.
        focal, offset: (2, O) as in `Observations`.
        sums: (P, O): a product with it sums over the observations of each point.
        by_intrinsics: (2, I, O_q) derivative of the last view's residuals by errors of its intrinsics.
        planes: planes of the points, if any have stored depths.
    """

    point: NDArray[np.intp]
    view: NDArray[np.intp]
    parts: tuple[slice, ...]
    focal: Array
    offset: Array
    sums: Any
    by_intrinsics: Array
    planes: DepthPlanes | None = None

    @staticmethod
    def of(
        observations: Observations,
        view: NDArray[np.intp],
        view_count: int,
        keypoint_motion: Array,
        planes: DepthPlanes | None = None,
    ) -> ViewColumns:
        """Makes the columns from rows and the view (O,) of each; `keypoint_motion` and `planes` as in BundleProblem."""
        order = np.argsort(view, kind="stable")
        return ViewColumns._sorted(
            observations.point[order],
            view[order],
            take(observations.focal, order),
            take(observations.offset, order),
            _by_intrinsics(keypoint_motion),
            view_count,
            planes,
        )

    @staticmethod
    def _sorted(
        point: NDArray[np.intp],
        view: NDArray[np.intp],
        focal: Array,
        offset: Array,
        by_intrinsics: Array,
        view_count: int,
        planes: DepthPlanes | None,
    ) -> ViewColumns:
        """Makes the columns from arrays that are sorted by view."""
        parts = itertools.pairwise(np.searchsorted(view, np.arange(view_count + 1)).tolist())
        count = len(point)
        sums = csc_array((np.ones(count), point, np.arange(count + 1)), shape=(int(point.max(initial=-1)) + 1, count))
        slices = tuple(slice(*part) for part in parts)
        return ViewColumns(point, view, slices, focal, offset, sums, by_intrinsics, planes)

    def of_points(self, chosen: NDArray[np.bool_]) -> ViewColumns:
        """Returns the observations of some of the points (P,), with the points numbered anew."""
        kept = np.flatnonzero(chosen[self.point])
        point, view = (np.cumsum(chosen) - 1)[self.point[kept]], self.view[kept]
        by_intrinsics = self.by_intrinsics
        if by_intrinsics.size:
            begin = self.parts[-1].start
            by_intrinsics = take(by_intrinsics, kept[np.searchsorted(kept, begin) :] - begin)
        columns = take(self.focal, kept), take(self.offset, kept), by_intrinsics
        return ViewColumns._sorted(point, view, *columns, len(self.parts), self.planes and self.planes[chosen])

    def linearized(self, bundle: Bundle) -> tuple[Array, Array, Array]:
        """Residuals (2, O), NaN behind the camera, and derivatives by the point (2, 3, O) and the pose (2, 6, O).

        They are kept with the bundle: its cost needs the residuals, and few bundles are not linearized too.
        """
        known: tuple[ViewColumns, tuple[Array, Array, Array]] | None = vars(bundle).get("_linearized")
        if known is None or known[0] is not self:
            vars(bundle)["_linearized"] = known = self, self._linearized(bundle)
        return known[1]

    def _linearized(self, bundle: Bundle) -> tuple[Array, Array, Array]:
        rotation = take(columns(bundle.poses.rotation), self.view)
        x_in_world = take(np.ascontiguousarray(bundle.points.T), self.point)
        x, y, z = apply_columns(rotation, x_in_world) + take(bundle.poses.translation.T, self.view)
        inverse_depth = 1 / np.where(z > 0, z, np.nan)
        ideal, slope = np.stack([x, y]) * inverse_depth, self.focal * inverse_depth
        by_point = slope[:, None] * (rotation[:2] - ideal[:, None] * rotation[2])
        by_pose = pose_columns(ideal, self.focal, inverse_depth)
        residual = ideal * self.focal + self.offset
        if bundle.intrinsics.size:
            residual[:, self.parts[-1]] += np.einsum("aio,i->ao", self.by_intrinsics, bundle.intrinsics)
        return residual, by_point, by_pose

    def equations(
        self,
        bundle: Bundle,
        loss_scale_sigma: float,
        least_curvature: float = 1.0,
        linearized: tuple[Array, Array, Array] | None = None,
        weight: Array | None = None,
    ) -> NormalEquations:
        """The normal equations of the observations alone, for a Cauchy loss of this scale.

        `linearized` is the result of the method of that name, if it is known, and `weight` (O,) replaces the loss's.

        With `least_curvature` below 1 derivatives J become (I - (1 - c) r r^T / |r|^2) J and residuals r become r / c,
        which leaves the gradient as it is. For a weight w the loss curves by w (2 w - 1) along r. But c^2 is least at
        w = 1/2 and 1 far away, where the curvature is negative.
        """
        residual, by_point, by_pose = linearized or self.linearized(bundle)
        squared, last, by_intrinsics = (residual**2).sum(axis=0), self.parts[-1], self.by_intrinsics
        weight = cauchy_weight(squared, loss_scale_sigma) if weight is None else weight
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
        if self.planes is not None:
            normal = self.planes.normal.T
            weighted = normal * self.planes.information
            point_block += symmetric_products(weighted[None], normal[None])
            point_gradient += weighted * self.planes.distance(bundle.points)
        pose_block, pose_gradient = _block_diagonal(blocks), np.concatenate(gradients)
        by_camera = weighted_pose, weighted_intrinsics
        return NormalEquations(self, pose_block, pose_gradient, point_block, point_gradient, by_point, *by_camera)


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Normal equations [B E; E^T C] [d_pose; d_point] = -[g; h]: C is block-diagonal, poses include the intrinsics.

    Attributes:
        columns: the observations.
        pose_block: B, (6 V + I, 6 V + I).
        pose_gradient: g, (6 V + I,).
        point_block: C, (6, P) as in `optimize.SYMMETRIC`.
        point_gradient: h, (3, P).
        by_point: A, (2, 3, O), derivatives of the residuals by the points.
        weighted_pose: w J, (2, 6, O), weighted derivatives by the poses. J^T w A is the block of E of an observation.
        weighted_intrinsics: (2, I, O_q), the same by the query's intrinsics.
    """

    columns: ViewColumns
    pose_block: Array
    pose_gradient: Array
    point_block: Array
    point_gradient: Array
    by_point: Array
    weighted_pose: Array
    weighted_intrinsics: Array

    def reduced(self, damping: float) -> tuple[Array, Array, EliminatedPoints]:
        """Eliminates the points: B - E C^-1 E^T (U, U), g - E C^-1 h (U,), U = 6 V + I; `damping` enlarges diagonals.

        With Cholesky's C = L L^T the products are those of F = E L^-T with itself and with L^-1 h.
        """
        damped = self.point_block.copy()
        damped[:3] *= 1 + damping
        factor = _cholesky(damped)
        gradient = np.stack(_forward(factor, self.point_gradient))
        seen = self.columns
        by_point = np.stack(_forward(take(factor, seen.point), np.swapaxes(self.by_point, 0, 1)), axis=1)
        by_observation = np.einsum("kao,kbo->abo", self.weighted_pose, by_point).reshape(18, -1)
        by_view = np.zeros((len(seen.parts), 18, self.point_gradient.shape[1]))
        for cross, part in zip(by_view, seen.parts, strict=True):
            cross[:, seen.point[part]] = by_observation[:, part]  # one observation per point and view
        wide = by_view.reshape(6 * len(by_view), -1)
        if self.weighted_intrinsics.size:
            last = seen.parts[-1]
            of_query = np.einsum("kao,kbo->abo", self.weighted_intrinsics, by_point[:, :, last])
            its_rows = np.zeros((*of_query.shape[:2], self.point_gradient.shape[1]))
            its_rows[:, :, seen.point[last]] = of_query
            wide = np.concatenate([wide, its_rows.reshape(len(of_query), -1)])
        matrix = self.pose_block + damping * np.diag(np.diag(self.pose_block)) - wide @ wide.T
        return matrix, self.pose_gradient - wide @ gradient.ravel(), EliminatedPoints(factor, gradient, wide, by_point)


@dataclass(frozen=True, eq=False)
class EliminatedPoints:
    """What is needed to compute the points once the cameras are known.

    Attributes:
        factor: L (6, P), as in `optimize.SYMMETRIC`.
        gradient: L^-1 h, (3, P).
        cross: E L^-T, (U, 3 P).
        by_point: A L^-T, (2, 3, O), each with the factor of its point.
    """

    factor: Array
    gradient: Array
    cross: Array
    by_point: Array

    def steps(self, motion: Array) -> Array:
        """Steps (P, 3) of the points that follow from a motion (U,) of the cameras."""
        xx, yy, zz, xy, xz, yz = self.factor
        x, y, z = -(self.gradient + (motion @ self.cross).reshape(3, -1))
        z = z / zz
        y = (y - yz * z) / yy
        return np.stack([(x - xy * y - xz * z) / xx, y, z], axis=1)


def _by_intrinsics(keypoint_motion: Array) -> Array:
    """`keypoint_motion` (O, 2, I) of a problem in columns, (2, I, O)."""
    return np.ascontiguousarray(np.moveaxis(keypoint_motion, 0, 2))


def _rotations(vectors: Array) -> Array:
    """Rotations (V, 3, 3) about vectors (V, 3) as `rotation_from_vector` makes each, the same bits."""
    angles = np.sqrt(vectors[:, None] @ vectors[:, :, None]).ravel().tolist()
    small = [angle < 1e-8 for angle in angles]
    first = np.array([1.0 if s else math.sin(a) / a for s, a in zip(small, angles, strict=True)])
    second = np.array([0.5 if s else (1 - math.cos(a)) / a**2 for s, a in zip(small, angles, strict=True)])
    cross = np.zeros((len(vectors), 3, 3))
    cross[:, [2, 0, 1], [1, 2, 0]], cross[:, [1, 2, 0], [2, 0, 1]] = vectors, -vectors
    return np.asarray(np.eye(3) + first[:, None, None] * cross + second[:, None, None] * cross @ cross)


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


def _forward(factor: Array, vectors: Array) -> list[Array]:
    """Solves L y = b for vectors b (3, ..., P); returns the components of y."""
    xx, yy, zz, xy, xz, yz = factor
    x = vectors[0] / xx
    y = (vectors[1] - xy * x) / yy
    return [x, y, (vectors[2] - xz * x - yz * y) / zz]


def bundle_of(
    tracks: Tracks, views: Sequence[PosedView], structure: Structure, chosen: NDArray[np.bool_] | NDArray[np.intp]
) -> tuple[Observations, Bundle, float]:
    """Sets up an adjustment: observations, initial bundle and median depth of the chosen points of a structure, metres.

    The tracks of these points are over the views: the references, then the query.
    """
    observations = observe(tracks, views, structure.noise)
    bundle = Bundle(Poses.of(view.world_from_camera for view in views), structure.x_in_world[chosen])
    return observations, bundle, float(np.median(observations.in_camera(bundle.points)[2]))
