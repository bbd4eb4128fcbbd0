"""Functions for NumPy arrays and torch tensors alike.

The equations of scale and structure are written once, for NumPy arrays on the host and torch tensors on a device. Most
of them use operators, methods and indexing, which both libraries have. For the rest, `namespace(array)` is NumPy or
torch, whose functions agree in names and order of arguments, if not in keywords. This module has what does not agree.

Nothing here synchronizes with a device: no value is read, and no shape depends on one.
"""

from typing import Any, TypeAlias

import numpy as np

from mapless import geometry

AnyArray: TypeAlias = Any
"""A NumPy array or a torch tensor; all arguments of a call are of one kind, on one device."""


def namespace(array: AnyArray) -> Any:
    """The module, numpy or torch, whose functions take `array`."""
    if isinstance(array, np.ndarray | np.generic):
        return np
    import torch  # a server without a network runs without it

    return torch


def median(values: AnyArray, where: AnyArray) -> AnyArray:
    """Median of the `values` (N,) selected by the mask `where` (N,); NaN if none is selected."""
    xp = namespace(values)
    if xp is np:
        return np.median(values[where]) if where.any() else np.float64(np.nan)
    # Selecting them would synchronize, since their number is unknown. The final infinity is for the index of none.
    count = where.sum()
    ordered = xp.sort(xp.cat([values.masked_fill(~where, np.inf), values.new_full((1,), np.inf)])).values
    middle = ordered[xp.stack([(count - 1).clip(0) // 2, count // 2])]
    return xp.where(count > 0, middle.mean(), np.nan)


def length(vectors: AnyArray) -> AnyArray:
    """Euclidean length (...) of vectors (..., D)."""
    return (vectors**2).sum(-1) ** 0.5


def columns(values: AnyArray) -> AnyArray:
    """Values (N, ...) with the first axis last, (..., N): many small matrices as few long rows.

    NumPy then computes with long rows, several times as fast as with many small matrices.
    """
    if namespace(values) is np:
        return np.ascontiguousarray(np.moveaxis(values, 0, -1))
    return values.movedim(0, -1).contiguous()


def rows(values: AnyArray) -> AnyArray:
    """Inverse of `columns`."""
    if namespace(values) is np:
        return np.ascontiguousarray(np.moveaxis(values, -1, 0))
    return values.movedim(-1, 0).contiguous()


def take(values: AnyArray, index: AnyArray) -> AnyArray:
    """Columns (..., M) of values (..., N) at indices (M,). Indexing takes five times as long in NumPy."""
    return np.take(values, index, axis=-1) if namespace(values) is np else values[..., index]


def apply_columns(matrices: AnyArray, vectors: AnyArray) -> AnyArray:
    """Multiplies many small matrices in columns (I, J, N) with vectors (J, N): (I, N)."""
    if namespace(matrices) is np:
        return np.einsum("ijn,jn->in", matrices, vectors)
    return (matrices * vectors).sum(1)


SYMMETRIC = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""The elements (6, N) of many symmetric 3x3 matrices, in columns."""


def symmetric_products(first: AnyArray, second: AnyArray) -> AnyArray:
    """Products A^T B of many small matrices (I, 3, N), if symmetric: elements (6, N) in the order of `SYMMETRIC`."""
    across = [(first[:, i, None] * second[:, i + 1 :]).sum(0) for i in range(2)]
    return namespace(first).concatenate([(first * second).sum(0), *across])


def solve_columns(matrices: AnyArray, vectors: AnyArray) -> AnyArray:
    """Solves symmetric 3x3 systems in columns, (6, P) in the order of `SYMMETRIC`: (3, P); NaN where singular."""
    xp = namespace(matrices)
    xx, yy, zz, xy, xz, yz = matrices
    x, y, z = vectors
    ixx, ixy, ixz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    iyy, iyz, izz = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    determinant = xx * ixx + xy * ixy + xz * ixz
    solvable = abs(determinant) > 1e-14 * xp.amax(abs(matrices), 0) ** 3
    solution = xp.stack([ixx * x + ixy * y + ixz * z, ixy * x + iyy * y + iyz * z, ixz * x + iyz * y + izz * z])
    return solution / xp.where(solvable, determinant, np.nan)


def invert_symmetric(matrices: AnyArray) -> AnyArray:
    """Inverses of symmetric matrices (P, 3, 3) by the adjugate; NaN where singular.

    Much faster than a LAPACK call per matrix, and exact enough for steps that are checked afterwards.
    """
    xp = namespace(matrices)

    def moved(rows: int, columns: int) -> AnyArray:
        return xp.roll(matrices, (-rows, -columns), (1, 2))

    adjugate = moved(1, 1) * moved(2, 2) - moved(1, 2) * moved(2, 1)
    determinant = (matrices[:, 0] * adjugate[:, 0]).sum(-1)
    solvable = abs(determinant) > 1e-14 * xp.amax(abs(matrices), (1, 2)) ** 3
    return adjugate / xp.where(solvable, determinant, np.nan)[:, None, None]


def normalize(x_in_camera: AnyArray) -> AnyArray:
    """`mapless.geometry.normalize` for either library."""
    return geometry.normalize(x_in_camera, namespace(x_in_camera))


def normalize_jacobian(x_in_camera: AnyArray) -> AnyArray:
    """`mapless.geometry.normalize_jacobian` for either library."""
    return geometry.normalize_jacobian(x_in_camera, namespace(x_in_camera))
