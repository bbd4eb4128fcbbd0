"""Least squares: Levenberg-Marquardt, robust losses, and small motions of poses.

`minimize` solves one problem, `minimize_each` many small ones at once. A step solves the linearized problem with its
diagonal enlarged by a relative damping. A step that lowers the cost is accepted and the damping is reduced; any other,
also one that cannot be computed, is repeated with more damping. So the cost never rises, and a start whose cost is NaN
is returned as it is. Each problem solves its own normal equations: dense ones (`damped_step`), or with the points
eliminated (see `bundle`).

Robust losses rho(s) of a squared residual s, with a scale c; both in standard deviations.

    loss       rho(s)                           weight rho'(s)
    Cauchy     c^2 log(1 + s / c^2)             1 / (1 + s / c^2)
    soft L1    2 c^2 (sqrt(1 + s / c^2) - 1)    1 / sqrt(1 + s / c^2)
    switched   s / (1 + s / c^2)                1 / (1 + s / c^2)^2

All are s for small s. For large s, soft L1 grows like the residual, and Cauchy's loss like its logarithm, so that the
influence of outliers vanishes. The switched loss (Geman and McClure's) is that of a switch variable 0 <= t <= 1 for
each residual, min_t t^2 s + (1 - t)^2 c^2 (Suenderhauf and Protzel 2012): an outlier costs c^2, however large it is.
The weights are those of iteratively reweighted least squares: the gradient of a sum of losses is 2 sum rho'(s) J^T r.

An array "in columns" has its long axis last, (..., N) instead of (N, ...): many small matrices as few long rows, with
which NumPy computes several times as fast.

A pose error is given as d = (x, y, z), the shift of the camera's centre c, and r = (rx, ry, rz), a rotation about the
fixed axes of the world (ROS's order):

    c' = c + d,    R_wc' = Exp(r) R_wc.

Solvers perturb camera_from_world = [R | t] from the left instead, with a shift v and a rotation w,

    [R | t]' = Exp(v, w) [R | t],    so that to first order    d = -R_wc v,    r = -R_wc w.

This moves the camera about its own centre, so no lever arm appears. Derivatives: Sola, Deray, Atchuthan 2018, "A micro
Lie theory".
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, RigidTransform, rotation_from_vector
from mapless_server.bounds import check_bounds

LEAST_DAMPING = 1e-9
"""Relative damping that moves no solution, and leaves what observations do not determine with no information."""


@cache
def median_chi_square(degrees_of_freedom: int) -> float:
    """The median of a chi-square variable."""
    from scipy.special import gammaincinv  # here: services import this module, and answer before it is loaded

    return 2 * float(gammaincinv(degrees_of_freedom / 2, 0.5))


def normal_sigma(deviations: Array) -> Array:
    """Standard deviations of normal deviations (N, ...) by their median size; few outliers hardly change them."""
    return np.asarray(np.median(np.abs(deviations), axis=0) / median_chi_square(1) ** 0.5)


def perturbed(target_from_source: RigidTransform, step: Array) -> RigidTransform:
    """The pose after a left perturbation (v, w) (6,): a rotation by w about the target's origin, then a shift by v."""
    rotation = rotation_from_vector(step[3:])
    return RigidTransform(rotation @ target_from_source.rotation, rotation @ target_from_source.translation + step[:3])


def moved(world_from_camera: RigidTransform, error: Array) -> RigidTransform:
    """Returns the pose after an error (6,), order x y z rx ry rz, about fixed world axes."""
    return RigidTransform(
        rotation_from_vector(error[3:]) @ world_from_camera.rotation, world_from_camera.translation + error[:3]
    )


def world_jacobian(world_from_camera: RigidTransform) -> Array:
    """Derivative (6, 6) of the world error (x y z rx ry rz) by a left perturbation (v, w) of camera_from_world."""
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = jacobian[3:, 3:] = -world_from_camera.rotation
    return jacobian


def covariance_in_world(covariance: Array, world_from_camera: RigidTransform) -> Array:
    """Covariance (6, 6) of world_from_camera, order x y z rx ry rz, from that of a left perturbation (v, w)."""
    jacobian = world_jacobian(world_from_camera)
    turned = jacobian @ covariance @ jacobian.T
    return np.asarray((turned + turned.T) / 2)


def world_covariance(information: Array, world_from_camera: RigidTransform) -> Array:
    """The same from the information (6, 6), its inverse; directions without information are left out."""
    covariance = np.asarray(np.linalg.pinv(information, hermitian=True), np.float64)
    return covariance_in_world(covariance, world_from_camera)


def cross_matrices(vectors: Array) -> Array:
    """The matrices (N, 3, 3) of the cross products with vectors (N, 3)."""
    matrices = np.zeros((len(vectors), 3, 3))
    matrices[:, [2, 0, 1], [1, 2, 0]], matrices[:, [1, 2, 0], [2, 0, 1]] = vectors, -vectors
    return matrices


def motion_jacobian(x_in_camera: Array) -> Array:
    """Derivative (..., 3, 6) of Exp(v, w) x by the perturbation at zero: [I | -[x]x]."""
    jacobian = np.zeros((*x_in_camera.shape, 6))
    x, y, z = np.moveaxis(x_in_camera, -1, 0)
    jacobian[..., 0, 0] = jacobian[..., 1, 1] = jacobian[..., 2, 2] = 1
    jacobian[..., 0, 4], jacobian[..., 0, 5] = z, -y
    jacobian[..., 1, 3], jacobian[..., 1, 5] = -z, x
    jacobian[..., 2, 3], jacobian[..., 2, 4] = y, -x
    return jacobian


def pose_columns(ideal: Array, focal: Array, inverse_depth: Array) -> Array:
    """Derivative (2, 6, M) of projections by a left perturbation of camera_from_world, in the unit of focal lengths.

    The points are seen at `ideal` = x / z, y / z (2, M); `focal` is (2, M) or (2, 1), the inverse depths (M,).
    """
    (u, v), (fx, fy) = ideal, focal
    jacobian = np.empty((2, 6, len(u)))
    jacobian[0, 0], jacobian[0, 1], jacobian[0, 3], jacobian[0, 5] = fx * inverse_depth, 0, -fx * u * v, -fx * v
    jacobian[1, 0], jacobian[1, 1], jacobian[1, 4], jacobian[1, 5] = 0, fy * inverse_depth, fy * u * v, fy * u
    jacobian[0, 2], jacobian[0, 4] = -jacobian[0, 0] * u, fx * (1 + u * u)
    jacobian[1, 2], jacobian[1, 3] = -jacobian[1, 1] * v, -fy * (1 + v * v)
    return jacobian


def pose_jacobian(camera: Camera, x_in_camera: Array) -> Array:
    """Derivative (2, 6, M) of the projections of points (M, 3), in pixels; NaN behind the camera."""
    x, y, z = np.where(x_in_camera[:, 2] > 0, x_in_camera.T, np.nan)
    return pose_columns(np.stack([x / z, y / z]), np.array([[camera.focal_x_px], [camera.focal_y_px]]), 1 / z)


def pose_hessian(camera: Camera, world_from_camera: RigidTransform, x_in_world: Array) -> Array:
    """J^T J (6, 6) of the projections in pixels by a left perturbation (v, w) of camera_from_world."""
    x, y = pose_jacobian(camera, world_from_camera.inverse().apply(x_in_world))
    return np.asarray(x @ x.T + y @ y.T)


X = TypeVar("X")
E = TypeVar("E")

LOWERED = 0.1
"""Factor on the damping after an accepted step."""

MAX_DAMPING = 1e6
"""Largest damping; the steps of a larger one are too short to matter."""

LEAST_DIAGONAL = 1e-12
"""Added to the diagonal before it is damped: an unknown that is not determined stays where it is."""


class Problem(Protocol[X, E]):
    """A cost over points of any type X; E is the type of its linearization."""

    def cost(self, x: X) -> float:
        """The cost; NaN where it is not defined, for example behind a camera."""
        ...

    def linearize(self, x: X) -> E:
        """The linearization at a point, which does not depend on the damping."""
        ...

    def step(self, x: X, equations: E, damping: float) -> X | None:
        """The point after a step; None where the step is not determined."""
        ...


@dataclass(frozen=True)
class MinimizeOptions:
    """Options of `minimize`.

    Attributes:
        iterations: largest number of steps that are tried.
        min_decrease: stop after a step that lowers the cost by a smaller share.
        damping: initial value; small, since the Gauss-Newton step is nearly right within an inlier threshold of the
            minimum.
        raised_by: factor on the damping after a rejected step.
    """

    iterations: int
    min_decrease: float
    damping: float = 1e-4
    raised_by: float = 10.0

    def __post_init__(self) -> None:
        check_bounds(self, "iterations", at_least=0)
        check_bounds(self, "min_decrease damping", above=0)
        check_bounds(self, "raised_by", above=1)


def minimize(
    problem: Problem[X, E],
    start: X,
    options: MinimizeOptions,
    is_near: Callable[[X, X, E], bool] = lambda before, after, equations: False,
) -> X:
    """Finds the minimum near a start; returns the last point if the iterations do not suffice.

    `is_near` is whether an accepted step, by the equations at its start, is so short that it may be the last one.
    """
    x, cost, damping = start, problem.cost(start), options.damping
    if math.isnan(cost):
        return start
    equations: E | None = None
    for _ in range(options.iterations):
        if equations is None:
            equations = problem.linearize(x)
        candidate = problem.step(x, equations, damping)
        candidate_cost = math.nan if candidate is None else problem.cost(candidate)
        if candidate is None or not candidate_cost < cost:
            damping *= options.raised_by
            if damping > MAX_DAMPING:
                break
            continue
        converged = cost - candidate_cost < options.min_decrease * cost or is_near(x, candidate, equations)
        x, cost, damping, equations = candidate, candidate_cost, damping * LOWERED, None
        if converged:
            break
    return x


def minimize_each(
    cost: Callable[[Array], Array], linearize: Callable[[Array], tuple[Array, Array]], start: Array, iterations: int
) -> Array:
    """Finds minima of many independent problems of three unknowns, each with its own damping, from points (3, P).

    All problems take the same number of steps. `cost` returns the costs (P,) at points (3, P); `linearize` the hessians
    (6, P), as in `optimize.SYMMETRIC`, and gradients (3, P) of half the cost.
    """
    x, damped, least = start, np.full_like(start[0], 1e-3), cost(start)
    for _ in range(iterations):
        hessian, gradient = linearize(x)
        hessian[:3] *= 1 + damped  # the diagonals
        candidate = x - solve_columns(hessian, gradient)
        candidate_cost = cost(candidate)
        better = candidate_cost <= least  # False for NaN: behind a camera, or a singular system
        x = np.where(better, candidate, x)
        least = np.where(better, candidate_cost, least)
        damped = np.where(better, damped * LOWERED, damped * MinimizeOptions.raised_by)
    return x


def damped_step(hessian: Array, gradient: Array, damping: float) -> Array | None:
    """Step (N,) of dense normal equations (N, N), (N,); None where it is not determined."""
    return solve_step(hessian + damping * np.diag(np.diag(hessian) + LEAST_DIAGONAL), gradient)


def solve_step(matrix: Array, gradient: Array, *, least_norm: bool = False) -> Array | None:
    """Returns -matrix^-1 gradient; None if not finite. With `least_norm`, the shortest solution if singular."""
    try:
        step = -np.linalg.lstsq(matrix, gradient, rcond=None)[0] if least_norm else -np.linalg.solve(matrix, gradient)
    except np.linalg.LinAlgError:
        return None
    return np.asarray(step, np.float64) if np.isfinite(step).all() else None


def cauchy_cost(squared: Array, scale: float) -> float:
    """Sum of rho over squared residuals (N,); NaN if one is NaN."""
    return float(scale**2 * np.log1p(squared / scale**2).sum())


def cauchy_weight(squared: Array, scale: float) -> Array:
    """Weights rho' (N,)."""
    return np.asarray(1 / (1 + squared / scale**2))


def switched_cost(squared: Array, scale: float) -> float:
    """Sum of rho over squared residuals (N,), with a switch for each."""
    return float((squared / (1 + squared / scale**2)).sum())


def switched_weight(squared: Array, scale: float) -> Array:
    """Weights rho' (N,): the squares of the switches."""
    return np.asarray((1 + squared / scale**2) ** -2.0)


def soft_l1(squared: Array, scale: float) -> Array:
    """Losses rho (N,)."""
    return np.asarray(2 * scale**2 * ((1 + squared / scale**2) ** 0.5 - 1))


def soft_l1_weight(squared: Array, scale: float) -> Array:
    """Weights rho' (N,)."""
    return np.asarray(1 / (1 + squared / scale**2) ** 0.5)


def length(vectors: Array) -> Array:
    """Euclidean length (...) of vectors (..., D)."""
    return np.asarray((vectors**2).sum(-1) ** 0.5)


def columns(values: Array) -> Array:
    """Values (N, ...) in columns, (..., N)."""
    return np.ascontiguousarray(np.moveaxis(values, 0, -1))


def rows(values: Array) -> Array:
    """Inverse of `columns`."""
    return np.ascontiguousarray(np.moveaxis(values, -1, 0))


def take(values: Array, index: NDArray[np.intp] | NDArray[np.bool_]) -> Array:
    """Columns (..., M) of values (..., N) at indices (M,) or where a mask (N,) is true, faster than indexing."""
    return np.take(values, np.flatnonzero(index) if index.dtype == bool else index, axis=-1)


def apply_columns(matrices: Array, vectors: Array) -> Array:
    """Multiplies matrices (I, J, N) with one vector (J, N) each: (I, N)."""
    return np.asarray(np.einsum("ijn,jn->in", matrices, vectors))


SYMMETRIC = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""The elements (6, N) of many symmetric 3x3 matrices, in columns."""


def symmetric_products(first: Array, second: Array) -> Array:
    """Products A^T B of matrices (I, 3, N), if symmetric: elements (6, N) in the order of `SYMMETRIC`."""
    across = [(first[:, i, None] * second[:, i + 1 :]).sum(0) for i in range(2)]
    return np.concatenate([(first * second).sum(0), *across])


def solve_columns(matrices: Array, vectors: Array) -> Array:
    """Solves symmetric 3x3 systems, (6, P) in the order of `SYMMETRIC`, of vectors (3, ..., P); NaN where singular.

    By the adjugate: much faster than a LAPACK call per matrix, and exact enough for steps that are checked afterwards.
    """
    xx, yy, zz, xy, xz, yz = matrices
    x, y, z = vectors
    ixx, ixy, ixz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    iyy, iyz, izz = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    determinant = xx * ixx + xy * ixy + xz * ixz
    solvable = abs(determinant) > 1e-14 * abs(matrices).max(axis=0) ** 3
    solution = np.stack([ixx * x + ixy * y + ixz * z, ixy * x + iyy * y + iyz * z, ixz * x + iyz * y + izz * z])
    return np.asarray(solution / np.where(solvable, determinant, np.nan))
