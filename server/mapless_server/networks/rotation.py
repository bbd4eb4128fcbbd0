"""The rotation nearest to a matrix, without a decomposition that the host would have to wait for."""

from __future__ import annotations

import torch
from torch import Tensor

NEWTON_STEPS = 32
"""From above, Newton's method comes at least a quarter nearer to the largest root of a quartic with each step, and is
quadratic at the end; where that root is double it halves the distance."""


def nearest_rotation(matrices: Tensor) -> Tensor:
    """The rotations R (..., 3, 3) that maximize trace(R^T M): U diag(1, 1, det(U V^T)) V^T for M = U S V^T.

    By Markley's closed form (1993, "FOAM"), with n = |M|^2, C the cofactors of M and l the greatest root of

        (l^2 - n)^2 - 8 l det M - 4 |C|^2 = 0,      k = (l^2 - n) / 2:

        R = ((k + n) M + l C - M M^T M) / (k l - det M).

    A fixed number of elementwise steps in float64. NaN in gives NaN out, where a library's SVD raises.

    Args:
        matrices: (..., 3, 3), any; near those that have no single nearest rotation the result is not accurate, and on
            them (the denominator is 0) it is not finite.
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
