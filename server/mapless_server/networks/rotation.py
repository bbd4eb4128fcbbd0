"""The rotation nearest to a matrix, without a decomposition, for which the host would wait for the device."""

from __future__ import annotations

import torch
from torch import Tensor

NEWTON_STEPS = 32
"""From above, each step of Newton's method reduces the distance to the largest root of a quartic by at least a quarter,
and convergence is quadratic at the end; if the root is double, a step halves the distance."""


def nearest_rotation(matrices: Tensor) -> Tensor:
    """The rotations R (..., 3, 3) that maximize trace(R^T M): U diag(1, 1, det(U V^T)) V^T for M = U S V^T.

    By Markley's closed form (1993, "FOAM"), with n = |M|^2, C the cofactors of M and l the greatest root of

        (l^2 - n)^2 - 8 l det M - 4 |C|^2 = 0,      k = (l^2 - n) / 2:

        R = ((k + n) M + l C - M M^T M) / (k l - det M).

    A fixed number of elementwise steps in float64. NaN in gives NaN out, where a library's SVD raises.

    Args:
        matrices: (..., 3, 3). Where the nearest rotation is not unique, the denominator is 0 and the result not finite;
            close to there the result is not accurate.
    """
    m = matrices.double()
    first, second, third = m.unbind(-2)
    cofactors = torch.stack(
        [torch.linalg.cross(second, third), torch.linalg.cross(third, first), torch.linalg.cross(first, second)], dim=-2
    )
    norm = m.square().sum((-2, -1))
    determinant = (first * cofactors[..., 0, :]).sum(-1)
    cofactor_norm = cofactors.square().sum((-2, -1))
    root = torch.sqrt(3 * norm)  # the sum of three singular values is no more than this
    for _ in range(NEWTON_STEPS):
        excess = root.square() - norm
        value = excess.square() - 8 * root * determinant - 4 * cofactor_norm
        root = root - value / (4 * root * excess - 8 * determinant)
    half_excess = (root.square() - norm) / 2
    scale = half_excess * root - determinant
    numerator = (half_excess + norm)[..., None, None] * m + root[..., None, None] * cofactors - m @ m.mT @ m
    return (numerator / scale[..., None, None]).to(matrices.dtype)
