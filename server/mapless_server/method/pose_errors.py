"""Errors of the references' given poses: how large they are, and how alike for neighbours.

A given pose has an error of its own (a marker, a surveyor's reading) and one that it shares with its neighbours and
that drifts with the distance (odometry, the lens model, the scale of a reconstruction). A query's pose is known
relative to the references around it, so what counts are the references' errors relative to the place of the query, x_q.
The drift is modelled as a random walk over space, whose variance grows in proportion to the distance; then errors i and
j have the covariance

    C_ij = a^2 delta_ij + b^2 (|x_i - x_q| + |x_j - x_q| - |x_i - x_j|) / 2 d,

in units of the structure's noise in the image (a shift by depth / focal length, or a rotation by 1 / focal length, for
each pixel), where d is the median distance between two references that observe the points. So references near the query
hold it, far ones hold little, and several far ones that are neighbours no more than one of them.

The sizes a and b are the most probable ones under the observations of the references. At the given poses, with points
and query eliminated from the normal equations of the adjustment, the gradient g of the references' motions has the
covariance S + S C S, where S is the matrix. Where references share little, the prior of a and b decides.

The random walk is the linear variogram of geostatistics (Matheron, Principles of geostatistics, 1963).
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array

from .options import check_bounds

LEAST_EIGENVALUE = 1e-6
"""Directions with a smaller share of the largest eigenvalue are not observed: motions of the references as a whole."""
LEAST_SPACING = 0.05
"""Smallest d, as a share of the depth of the points: references at one place have no distance to measure drift by."""


@dataclass(frozen=True)
class PoseErrorOptions:
    """Options of the errors of given poses, in units of the structure's noise.

    Attributes:
        own: values of a that are tried. The smallest is that of a reconstruction from these very photographs.
        drift: values of b that are tried.
        usual_own, usual_drift: medians of the priors of a and b, log-normal and wide: ten references determine both,
            three do not. Reconstructions are smooth, so without evidence the poses drift.
        prior_log: standard deviation of log a and log b.
        own_inflation, drift_inflation: factors on the a and b that are found from residuals. Keypoints move with the
            viewpoint, by the same for far references, so the drift is larger than residuals say. With 1 the median is
            0.167 instead of 0.150 cm in a kitchen, 0.55 instead of 0.53 on a drive. Where the errors are all the poses'
            own, more of the drift makes the answer worse.
    """

    own: tuple[float, ...] = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6)
    drift: tuple[float, ...] = (0.1, 0.2, 0.4, 1.0, 2.0, 4.0)
    usual_own: float = 0.1
    usual_drift: float = 0.4
    prior_log: float = 1.5
    own_inflation: float = 1.5
    drift_inflation: float = 2.0

    def __post_init__(self) -> None:
        for name in ("own", "drift"):
            if not getattr(self, name) or min(getattr(self, name)) <= 0:
                raise ValueError(f"PoseErrorOptions.{name} must be numbers above 0, is {getattr(self, name)}")
        check_bounds(self, "usual_own usual_drift prior_log own_inflation drift_inflation", above=0)


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """The two parts of the covariance of K references' errors, each (6 K, 6 K), with a = b = 1.

    The errors are left perturbations (v, w) of camera_from_world, metres and radians.
    """

    own: Array
    drift: Array

    def covariance(self, own: float, drift: float) -> Array:
        """The covariance C (6 K, 6 K) for sizes a = `own` and b = `drift`."""
        return own**2 * self.own + drift**2 * self.drift


def pose_errors(
    centres: Array,
    rotations: Array,
    query_centre: Array,
    level_px: float,
    focal_px: float,
    depth_m: float,
    observing: NDArray[np.intp] | None = None,
) -> PoseErrors:
    """Computes the two parts of the covariance of the errors of K references.

    Centres (K, 3) and (3,) of the query are in metres, rotations (K, 3, 3) are camera_from_world. `level_px` is the
    noise of the structure, `depth_m` the median depth of the points. References that are not `observing` points (None
    for all) may be in another part of the scene, and do not count for d.
    """
    unit = level_px / focal_px * np.array([depth_m, 1.0])
    between = np.linalg.norm(centres[:, None] - centres, axis=2)
    to_query = np.linalg.norm(centres - query_centre, axis=1)
    distances = [between[i, j] for i, j in combinations(range(len(centres)) if observing is None else observing, 2)]
    spacing = max(float(np.median(distances)) if distances else 0.0, LEAST_SPACING * depth_m)
    drift = (to_query[:, None] + to_query - between) / (2 * spacing)
    return PoseErrors(_of_motions(np.eye(len(centres)), rotations, unit), _of_motions(drift, rotations, unit))


def _of_motions(covariance: Array, rotations: Array, unit: Array) -> Array:
    """Covariance (6 K, 6 K) of left perturbations, from that (K, K) of shifts and rotations along each world axis."""
    count = len(rotations)
    turned = np.einsum("ij,iab,jcb->iajc", covariance, rotations, rotations)
    result = np.zeros((count, 2, 3, count, 2, 3))
    for kind in range(2):
        result[:, kind, :, :, kind] = unit[kind] ** 2 * turned
    return result.reshape(6 * count, 6 * count)


def most_probable(errors: PoseErrors, matrix: Array, gradient: Array, options: PoseErrorOptions) -> tuple[float, float]:
    """Most probable a and b, from normal equations of 6 K unknowns and, last, the query's, at the given poses."""
    finite = bool(np.isfinite(matrix).all() and np.isfinite(gradient).all())
    if not finite:
        return options.own_inflation * options.usual_own, options.drift_inflation * options.usual_drift
    project, data = _whitened(*_without_query(matrix, gradient, len(errors.own)), np.sqrt(np.diag(errors.own)))
    own, drift = project @ errors.own @ project.T, project @ errors.drift @ project.T
    sizes = np.array([(a, b) for a in options.own for b in options.drift])
    squares = sizes[:, :, None, None] ** 2
    # The last row of a Cholesky factor [L 0; (L^-1 d)^T .] of the matrix bordered by d.
    bordered = np.empty((len(sizes), len(data) + 1, len(data) + 1))
    bordered[:, :-1, :-1] = np.eye(len(data)) + squares[:, 0] * own + squares[:, 1] * drift
    bordered[:, -1, :-1] = bordered[:, :-1, -1] = data
    bordered[:, -1, -1] = 1 + data @ data
    factor = np.linalg.cholesky(bordered)
    error = factor[:, -1, :-1]
    log_determinant = np.log(np.diagonal(factor, axis1=1, axis2=2)[:, :-1]).sum(axis=1)
    usual = np.array([options.usual_own, options.usual_drift])
    unusual = (np.log(sizes / usual) / options.prior_log) ** 2
    best = np.argmax(-0.5 * (error**2).sum(axis=1) - log_determinant - 0.5 * unusual.sum(axis=1))
    return options.own_inflation * float(sizes[best, 0]), options.drift_inflation * float(sizes[best, 1])


def _without_query(matrix: Array, gradient: Array, n: int) -> tuple[Array, Array]:
    """Normal equations (n, n), (n,) of the references, with the query's unknowns eliminated."""
    coupling = matrix[:n, n:]
    solved = np.linalg.lstsq(matrix[n:, n:], np.column_stack([coupling.T, gradient[n:]]), rcond=None)[0]
    return matrix[:n, :n] - coupling @ solved[:, :-1], gradient[:n] - coupling @ solved[:, -1]


def _whitened(matrix: Array, gradient: Array, unit: Array) -> tuple[Array, Array]:
    """Linear observations of the errors e: P (M, 6 K) and d (M,), with d = P e + noise of standard deviation 1."""
    values, vectors = np.linalg.eigh(matrix * unit[:, None] * unit)
    seen = values > LEAST_EIGENVALUE * max(values[-1], 1.0)
    root, vectors = np.sqrt(values[seen]), vectors[:, seen]
    return root[:, None] * vectors.T / unit, vectors.T @ (gradient * unit) / root
