"""Dispersion: change of a pose when one of its references is left out.

The errors of a reference, of its pose, its lens model and its shutter, are shared by all points that it observes. A sum
over residuals treats them as independent, as if a thousand matches were a thousand measurements. The jackknife over
references (Quenouille; Efron and Tibshirani 1993, chapter 11) does not: from the poses q_(i) without reference i,
i = 1 ... K,

    C = (K - 1) / K sum_i (q_(i) - mean) (q_(i) - mean)^T

is the covariance of the pose due to its references, with any correlation within each of them. This holds if leaving out
one of K removes 1 / K of the information. Here it removes more: points come from pairs of photographs, and of the
K (K + 1) / 2 pairs of K references and the query K (K - 1) / 2 remain. The steps are too long by the ratio of the two,
(K + 1) / (K - 1), so C is divided by its square.

Solving K times would cost K times the adjustment, so each q_(i) is one Gauss-Newton step away. Let point p be observed
by the query with weight w, derivatives A by the point and J by the pose, and residual r; and by the references with
information C_p = sum_o w_o A_o^T A_o and gradient h_p = sum_o w_o A_o^T r_o. Eliminating the point gives, with

    W = w - w^2 A T^-1 A^T,    u = w (r - A T^-1 (h_p + w A^T r)),    T = C_p + w A^T A,

the information J^T W J and the gradient J^T u of the pose. Leaving out reference i subtracts its terms from C_p and
h_p, which changes W and u only of the points that it observes; so each (point, reference) pair costs the inverse of one
3 x 3 matrix, and the K steps one product of matrices.

The noise of the photograph's own pixels does not depend on the references. It is independent between matches, so its
part of the pose's covariance is

    Q = s^2 H^-1 (sum J^T W w^-1 W J) H^-1,    H = sum J^T W J,

with s^2 the ratio of the squared residuals to the expected ones: the median of |r|^2 is 2 ln 2 times the variance of a
coordinate, and the point's own fit leaves only the share W / w of the noise in a residual.

Residuals of the references are those with their poses as given: an adjustment that moves the references into agreement
would otherwise hide their errors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array

from ..observations import Linearization

MIN_DETERMINANT = 1e-10
"""Least determinant of a point's information, over the cube of its largest diagonal element: below, the point is not
determined and not used."""

LEAST_EIGENVALUE = 1e-10
"""Least eigenvalue of the pose's information with unit diagonal: below, the pose is not determined."""

LEAST_LEFT = 0.01
"""Least share of the information assumed to remain without a reference."""


@dataclass(frozen=True, eq=False)
class LinearizedObservations:
    """Observations of points, linearized; residuals and derivatives in standard deviations.

    Attributes:
        point: (N,) index of the point, common to query and references.
        by_point: (N, 2, 3) derivative of the residual by the point, per metre.
        residual: (N, 2).
        weight: (N,) of the squared residual.
    """

    point: NDArray[np.intp]
    by_point: Array
    residual: Array
    weight: Array


@dataclass(frozen=True, eq=False)
class JackknifeInput:
    """The observations of one pose, or of several estimated jointly.

    Attributes:
        query: observations by the photographs to pose. A point observed twice counts as two points.
        by_pose: (N, 2, U) derivative of their residuals by the U unknowns.
        references: observations of the same points by the references, with their poses as given.
        reference: (M,) index of the reference, from 0.
        reference_count: K.
        thinning: the query has so many times as many observations. The references' errors are the same in all of them;
            the noise of the photograph's own pixels averages out.
    """

    query: LinearizedObservations
    by_pose: Array
    references: LinearizedObservations
    reference: NDArray[np.intp]
    reference_count: int
    thinning: int = 1


@dataclass(frozen=True, eq=False)
class Dispersion:
    """How poses without one reference differ.

    Attributes:
        information: H, (U, U) of the pose, points eliminated and the references held at their given poses.
        offset: (U,) the Gauss-Newton step from the pose to the optimum with all references.
        motions: (K, U) from that optimum to the one without the i-th reference.
        photograph: Q, (U, U) covariance by the errors of the photograph's own pixels.
    """

    information: Array
    offset: Array
    motions: Array
    photograph: Array

    @property
    def covariance(self) -> Array:
        """C, (U, U), by the jackknife; zero with one reference, which has nothing to differ from."""
        count = len(self.motions)
        centred = self.motions - self.motions.mean(axis=0)
        return np.asarray((count - 1) / count * ((count - 1) / (count + 1)) ** 2 * centred.T @ centred)

    @property
    def inflation(self) -> float:
        """i, by how much errors exceed those of independent matches: i^2 = trace(H C) / U."""
        return float(np.sqrt(np.trace(self.information @ self.covariance) / len(self.information)))


def disperse(jackknife: JackknifeInput) -> Dispersion | None:
    """Leaves out one reference at a time; None if all together do not determine a pose."""
    seen, query = jackknife.references, jackknife.query
    size = 1 + int(max(query.point.max(initial=0), seen.point.max(initial=0)))
    of_seen, gradients = _information(seen), _gradient(seen)
    of_point = np.stack([np.bincount(seen.point, row, size) for row in of_seen]).astype(np.float64)
    gradient_of_point = np.stack([np.bincount(seen.point, row, size) for row in gradients]).astype(np.float64)

    everything = _eliminate(query, of_point[:, query.point], gradient_of_point[:, query.point])
    row, other = _pairs(query.point, seen.point, size)
    point = query.point[row]
    some = LinearizedObservations(point, query.by_point[row], query.residual[row], query.weight[row])
    without = _eliminate(
        some, of_point[:, point] - of_seen[:, other], gradient_of_point[:, point] - gradients[:, other]
    )
    change = np.zeros((jackknife.reference_count, 5, len(query.point)))
    # A reference observes a point once, so the pairs are distinct.
    change[jackknife.reference[other], :, row] = (without - everything[:, row]).T
    found = _steps(query, jackknife.by_pose, everything, change)
    return found and replace(found, photograph=found.photograph / jackknife.thinning)


def _steps(query: LinearizedObservations, by_pose: Array, everything: Array, change: Array) -> Dispersion | None:
    """From each observation's W and u (5, N), and their change (K, 5, N) without each reference."""
    unknowns = by_pose.shape[2]
    x, y = by_pose[:, 0], by_pose[:, 1]
    mixed = x[:, :, None] * y[:, None, :]
    squares = np.concatenate(
        [x[:, :, None] * x[:, None, :], mixed + np.swapaxes(mixed, 1, 2), y[:, :, None] * y[:, None, :]]
    )
    squares = squares.reshape(-1, unknowns**2)
    slopes = np.concatenate([x, y])
    information = (everything[:3].reshape(1, -1) @ squares).reshape(unknowns, unknowns)
    gradient = everything[3:].reshape(1, -1) @ slopes
    if not _is_definite(information):
        return None
    count = len(change)
    informations = information + (change[:, :3].reshape(count, -1) @ squares).reshape(count, unknowns, unknowns)
    gradients = gradient + change[:, 3:].reshape(count, -1) @ slopes
    offset = -np.linalg.solve(information, gradient[0])
    # Without its only reference a point has no information, and the rest may not determine a pose.
    without = -np.linalg.solve(informations + LEAST_LEFT * information, gradients[:, :, None])[..., 0]
    if not (np.isfinite(offset).all() and np.isfinite(without).all()):
        return None
    inverse = np.linalg.inv(information)
    spread = (_pixel_noise(query, everything[:3]).reshape(1, -1) @ squares).reshape(unknowns, unknowns)
    return Dispersion(information, offset, without - offset, inverse @ spread @ inverse)


def _is_definite(information: Array) -> bool:
    """Whether a symmetric matrix is well-conditioned positive definite, independent of its units."""
    unit = np.sqrt(np.diag(information).clip(min=0))
    if not (np.isfinite(information).all() and unit.min() > 0):
        return False
    return bool(np.linalg.eigvalsh(information / np.outer(unit, unit))[0] > LEAST_EIGENVALUE)


def _pixel_noise(query: LinearizedObservations, marginal: Array) -> Array:
    """s^2 W w^-1 W of each observation, its elements xx, xy, yy (3, N), from those of W."""
    xx, xy, yy = marginal
    left = (xx + yy) / (2 * query.weight)
    squared = (query.residual**2).sum(axis=1) / np.maximum(left, LEAST_LEFT)
    size = np.median(squared) / (2 * np.log(2))
    return np.asarray(size / query.weight * np.stack([xx**2 + xy**2, xy * (xx + yy), xy**2 + yy**2]))


def _pairs(query_point: NDArray[np.intp], seen_point: NDArray[np.intp], size: int) -> tuple[NDArray[np.intp], ...]:
    """Rows of the query and rows of the references with the same point."""
    order = np.argsort(seen_point, kind="stable")
    counts = np.bincount(seen_point, minlength=size)
    starts = np.cumsum(counts) - counts
    times = counts[query_point]
    row = np.repeat(np.arange(len(query_point)), times)
    first = np.repeat(starts[query_point] - (np.cumsum(times) - times), times)
    return row, order[first + np.arange(len(row))]


def _eliminate(query: LinearizedObservations, information: Array, gradient: Array) -> Array:
    """W_xx, W_xy, W_yy, u_x, u_y (5, N) of observations whose points have this information (6, N) and gradient (3, N).

    Zero where a point is not determined even with the query's own observation.
    """
    weight = query.weight
    inverse = _inverse(information + _information(query))
    both = gradient + _gradient(query)
    a, b = query.by_point[:, 0].T, query.by_point[:, 1].T
    inverse_a, inverse_b = _times(inverse, a), _times(inverse, b)
    squared = weight**2
    result = np.stack(
        [
            weight - squared * (a * inverse_a).sum(axis=0),
            -squared * (b * inverse_a).sum(axis=0),
            weight - squared * (b * inverse_b).sum(axis=0),
            weight * (query.residual[:, 0] - (inverse_a * both).sum(axis=0)),
            weight * (query.residual[:, 1] - (inverse_b * both).sum(axis=0)),
        ]
    )
    return np.where(np.isfinite(result).all(axis=0), result, 0.0)


def _information(observations: LinearizedObservations) -> Array:
    """W A^T A of each, its elements xx, yy, zz, xy, xz, yz (6, N)."""
    x, y, z = np.moveaxis(observations.by_point, 2, 0)  # (N, 2) each
    pairs = ((x, x), (y, y), (z, z), (x, y), (x, z), (y, z))
    return np.stack([observations.weight * (p[:, 0] * q[:, 0] + p[:, 1] * q[:, 1]) for p, q in pairs])


def _gradient(observations: LinearizedObservations) -> Array:
    """W A^T r of each, (3, N)."""
    x, y = (observations.residual * observations.weight[:, None]).T
    return np.asarray(observations.by_point[:, 0].T * x + observations.by_point[:, 1].T * y)


def _inverse(matrices: Array) -> Array:
    """Of symmetric matrices, elements as in `_information`; NaN where singular. One array an element: it is faster."""
    xx, yy, zz, xy, xz, yz = matrices
    adjugate = np.stack(
        [yy * zz - yz**2, xx * zz - xz**2, xx * yy - xy**2, xz * yz - xy * zz, xy * yz - xz * yy, xy * xz - xx * yz]
    )
    determinant = xx * adjugate[0] + xy * adjugate[3] + xz * adjugate[4]
    solvable = determinant > MIN_DETERMINANT * np.maximum(np.maximum(xx, yy), zz) ** 3
    return np.asarray(adjugate / np.where(solvable, determinant, np.nan))


def _times(matrices: Array, vectors: Array) -> Array:
    """Symmetric matrices (6, N) by vectors (3, N)."""
    xx, yy, zz, xy, xz, yz = matrices
    x, y, z = vectors
    return np.stack([xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z])


def jackknife_input(
    rows: Linearization,
    point: NDArray[np.intp],
    view: NDArray[np.intp],
    max_matches: int,
    motions: Array | None = None,
) -> JackknifeInput:
    """The jackknife input for the pose of the last view.

    Args:
        rows: of all observations.
        point: (O,) of each.
        view: (O,) of each; the references, in order, and last the photograph to pose.
        max_matches: of its observations, evenly thinned.
        motions: (V, 6) left perturbations from the given poses to those at which `rows` is linearized; None if both are
            the same.
    """
    asked = int(view.max())
    is_asked = view == asked
    thinning = -(-int(is_asked.sum()) // max_matches)
    if thinning > 1:
        taken = np.zeros(int(point.max()) + 1, bool)
        taken[point[is_asked][::thinning]] = True
        kept = taken[point]
        rows = Linearization(rows.residual[kept], rows.weight[kept], rows.by_point[kept], rows.by_pose[kept])
        point, view, is_asked = point[kept], view[kept], is_asked[kept]
    residual = rows.residual
    if motions is not None:
        residual = residual - (rows.by_pose * motions[view][:, None, :]).sum(axis=2)

    def some(chosen: NDArray[np.bool_]) -> LinearizedObservations:
        return LinearizedObservations(point[chosen], rows.by_point[chosen], residual[chosen], rows.weight[chosen])

    return JackknifeInput(
        some(is_asked), rows.by_pose[is_asked], some(~is_asked), view[~is_asked], asked, max(thinning, 1)
    )
