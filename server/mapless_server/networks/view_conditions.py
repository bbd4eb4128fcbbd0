"""The conditions of MapAnything: what is known of some views besides images, as features added to patches.

Rays and poses may each be given for any subset of the views. Rays concern one view alone; poses are relative to view 0,
and their translations are divided by a common length, which is given apart, if it is metric.

The encoders compute in float32, also where the transformer does not.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from .blocks import BLOCK_EPS, LayerNorm
from .encoder import PATCH_PX

MIN_LENGTH = 1e-8
"""Lengths and scales are not smaller; also added to logarithms' arguments."""


@dataclass(frozen=True, eq=False)
class RelativePoses:
    """Poses of the views of B scenes with N views each, relative to view 0 of each scene.

    Attributes:
        quaternions: (B, N, 4) x, y, z, w; the identity where unknown.
        translations: (B, N, 3) divided by `scale`; 0 where unknown.
        scale: (B,) mean distance from view 0 of the posed views that are at another place.
    """

    quaternions: Tensor
    translations: Tensor
    scale: Tensor


def pinhole_rays(intrinsics: Tensor, height_px: int, width_px: int) -> Tensor:
    """Unit rays (V, H, W, 3) of pinholes (V, 3, 3) in which (0, 0) is the centre of the top-left pixel; skew is 0."""
    columns = torch.arange(width_px, dtype=intrinsics.dtype, device=intrinsics.device)
    rows = torch.arange(height_px, dtype=intrinsics.dtype, device=intrinsics.device)
    (fx, _, cx), (_, fy, cy), _ = (row.unbind(-1) for row in intrinsics[..., None, None, :, :].unbind(-2))
    x, y = torch.broadcast_tensors((columns - cx) / fx, (rows[:, None] - cy) / fy)
    return F.normalize(torch.stack([x, y, torch.ones_like(x)], dim=-1), dim=-1)


def quaternions_from_rotations(rotations: Tensor) -> Tensor:
    """Quaternions (..., 4), x, y, z, w with w >= 0, of rotations (..., 3, 3).

    Each of 4 q_i^2 follows from the diagonal; the others are divided by the largest, which is at least 1/2.
    """
    m = rotations
    x, y, z = m.diagonal(dim1=-2, dim2=-1).unbind(-1)
    squares = torch.stack([1 + x - y - z, 1 - x + y - z, 1 - x - y + z, 1 + x + y + z], dim=-1)  # 4 q_i^2
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    wx, wy, wz = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    # Row i is 4 q_i q, computed from the entries of the rotation.
    products = torch.stack(
        [
            torch.stack([squares[..., 0], xy, xz, wx], dim=-1),
            torch.stack([xy, squares[..., 1], yz, wy], dim=-1),
            torch.stack([xz, yz, squares[..., 2], wz], dim=-1),
            torch.stack([wx, wy, wz, squares[..., 3]], dim=-1),
        ],
        dim=-2,
    )
    largest = squares.argmax(-1)[..., None, None].expand(*squares.shape[:-1], 1, 4)
    quaternions = F.normalize(products.gather(-2, largest)[..., 0, :], dim=-1)
    return torch.where(quaternions[..., 3:] < 0, -quaternions, quaternions)


def rotations_from_quaternions(quaternions: Tensor) -> Tensor:
    """Rotations (..., 3, 3) of quaternions (..., 4), x, y, z, w, of any length above 0."""
    x, y, z, w = quaternions.unbind(-1)
    s = 2 / quaternions.square().sum(-1)
    rows = [
        [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
        [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)],
        [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def multiply_quaternions(left: Tensor, right: Tensor) -> Tensor:
    """Hamilton product (..., 4), x, y, z, w."""
    a, b = left[..., 3:], right[..., 3:]
    vector = a * right[..., :3] + b * left[..., :3] + torch.linalg.cross(left[..., :3], right[..., :3])
    return torch.cat([vector, a * b - (left[..., :3] * right[..., :3]).sum(-1, keepdim=True)], dim=-1)


def relative_poses(quaternions: Tensor, translations: Tensor, posed: Tensor) -> RelativePoses:
    """Computes poses relative to view 0, which must have a pose.

    Large origins should be subtracted before, in double precision. Views at exactly the place of view 0, itself
    included, do not count for the scale.

    Args:
        quaternions: (B, N, 4) x, y, z, w, world_from_camera; their sign is kept.
        translations: (B, N, 3) camera centres.
        posed: (B, N) bool; the values of other views have no effect.
    """
    first = quaternions[:, :1] * quaternions.new_tensor([-1.0, -1.0, -1.0, 1.0])  # the inverse
    relative = multiply_quaternions(first.expand_as(quaternions), quaternions)
    identity = torch.zeros_like(relative)
    identity[..., 3] = 1
    # The difference first: for view 0 it is exactly 0.
    moved = (translations - translations[:, :1]) @ rotations_from_quaternions(quaternions[:, 0])
    moved = torch.where(posed[..., None], moved, 0.0)
    lengths = moved.norm(dim=-1)
    scale = (lengths.sum(1) / ((lengths > 0).sum(1) + MIN_LENGTH)).clamp_min(MIN_LENGTH)
    return RelativePoses(torch.where(posed[..., None], relative, identity), moved / scale[:, None, None], scale)


class MapEncoder(nn.Module):
    """Computes a vector for each patch from values for each pixel, by convolutions over patches."""

    def __init__(self, channels: int, widths: Sequence[int], width_out: int) -> None:
        super().__init__()
        self.conv_in = nn.Conv2d(channels * PATCH_PX**2, widths[0], 3, padding=1)
        blocks = (ResidualPatches(*pair) for pair in pairwise(widths))
        self.encoder = nn.Sequential(*blocks, nn.Conv2d(widths[-1], width_out, 1))
        self.norm_layer = LayerNorm(width_out, eps=BLOCK_EPS)

    def forward(self, values: Tensor) -> Tensor:
        """Values (V, channels, H, W) to (V, P, C)."""
        patches = self.encoder(self.conv_in(F.pixel_unshuffle(values, PATCH_PX)))
        normalized: Tensor = self.norm_layer(patches.flatten(2).transpose(1, 2))
        return normalized


class ResidualPatches(nn.Module):
    """gelu(conv2(gelu(conv1(x))) + shortcut(x))."""

    def __init__(self, width_in: int, width: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(width_in, width, 3, padding=1)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1)
        self.shortcut = nn.Conv2d(width_in, width, 1)

    def forward(self, x: Tensor) -> Tensor:
        """(V, width_in, h, w) to (V, width, h, w)."""
        return F.gelu(self.conv2(F.gelu(self.conv1(x))) + self.shortcut(x))


class VectorEncoder(nn.Module):
    """Computes a vector for a whole view from a few numbers."""

    def __init__(self, width_in: int, widths: Sequence[int], width_out: int) -> None:
        super().__init__()
        layers = nn.Sequential(nn.Linear(width_in, widths[0]), nn.GELU())
        for narrow, wide in pairwise(widths):  # nested, as the names of the checkpoint are
            layers = nn.Sequential(layers, nn.Linear(narrow, wide), nn.GELU())
        self.encoder = nn.Sequential(layers, nn.Linear(widths[-1], width_out))
        self.norm_layer = LayerNorm(width_out, eps=BLOCK_EPS)

    def forward(self, numbers: Tensor) -> Tensor:
        """(..., width_in) to (..., C)."""
        normalized: Tensor = self.norm_layer(self.encoder(numbers))
        return normalized
