"""The conditions of Pi3X, its input besides the images: rays of all views, poses of some.

Poses enter through attention among the posed views, whose queries, keys and values are transformed by the cameras
(PRoPE, Li et al. 2025); rays are added to the patch tokens.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from .blocks import BLOCK_EPS, Attention, LayerNorm, LayerScale, Mlp

MIN_MOTION = 0.02
"""Scenes whose views all lie nearer to the first one than this, in the caller's unit, keep their scale."""


def rays_from_intrinsics(intrinsics: Tensor, height_px: int, width_px: int) -> Tensor:
    """Rays (V, 2, H, W), x and y at depth 1, of the pixels' centres.

    In the intrinsics (V, 3, 3), (0.5, 0.5) is the centre of the top-left pixel; elsewhere in mapless it is (0, 0).
    """
    columns = torch.arange(width_px, device=intrinsics.device) + 0.5
    rows = torch.arange(height_px, device=intrinsics.device) + 0.5
    pixels = torch.stack(
        [*torch.meshgrid(columns, rows, indexing="xy"), torch.ones_like(rows)[:, None].expand(-1, width_px)]
    )
    # 3x3 inverses by cofactors: torch.linalg.inv makes the host wait for the device.
    rays = torch.einsum("vij,jhw->vihw", invert_small(intrinsics), pixels)
    return rays[:, :2] / rays[:, 2:]


def invert_small(matrices: Tensor) -> Tensor:
    """Inverses of matrices (..., 3, 3)."""
    a, b, c = matrices.unbind(-2)
    adjugate = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], dim=-1)
    return adjugate / (a * adjugate[..., 0]).sum(-1)[..., None, None]


def invert_poses(poses: Tensor) -> Tensor:
    """Inverses of rigid motions (..., 4, 4)."""
    rotation, translation = poses[..., :3, :3].mT, poses[..., :3, 3:]
    return torch.cat([torch.cat([rotation, -rotation @ translation], dim=-1), poses[..., 3:, :]], dim=-2)


def normalize_poses(poses: Tensor) -> Tensor:
    """Converts poses (B, N, 4, 4), world_from_camera, to be relative to the first view, at the scale of the training.

    The mean distance of all other views from the first becomes 1, including views whose pose is not used. So the value
    given for an unknown pose matters.
    """
    relative = invert_poses(poses[:, :1]) @ poses
    translation = relative[..., :3, 3]
    if poses.shape[1] > 1:
        distance = translation[:, 1:].norm(dim=-1)
        moves = distance.amax(1) >= MIN_MOTION
        scale = torch.where(moves, distance.mean(1) + 1e-8, 1.0)
        translation = translation / scale[:, None, None]
    normalized = relative.clone()
    normalized[..., :3, 3] = translation
    return normalized


@dataclass(frozen=True, eq=False)
class Prope:
    """Camera-relative positions of M posed views with P patches each.

    A head's first d/2 channels, four by four, are transformed between cameras; the next d/4 are rotated by the patch's
    column and the last d/4 by its row. Queries, keys and values are compared in the frame of the first view; outputs
    are transformed back.

    Attributes:
        camera_from_world, world_from_camera: (B, M, 4, 4) of the views.
        cos, sin: (P, 2, d/8); axis 1 is column and row.
    """

    camera_from_world: Tensor
    world_from_camera: Tensor
    cos: Tensor
    sin: Tensor

    def query(self, x: Tensor) -> Tensor:
        """E^T q of queries (B, heads, M * P, d), rotated."""
        return self._apply(x, self.camera_from_world.mT, self.sin)

    def key(self, x: Tensor) -> Tensor:
        """E^-1 k of keys or values (B, heads, M * P, d), rotated."""
        return self._apply(x, self.world_from_camera, self.sin)

    def output(self, x: Tensor) -> Tensor:
        """E o of outputs (B, heads, M * P, d), rotated back."""
        return self._apply(x, self.camera_from_world, -self.sin)

    def _apply(self, x: Tensor, matrices: Tensor, sin: Tensor) -> Tensor:
        views = matrices.shape[1]
        moved, turned = x.float().unflatten(2, (views, -1)).chunk(2, dim=-1)  # (B, heads, M, P, d/2)
        moved = torch.einsum("bmij,bhmpcj->bhmpci", matrices, moved.unflatten(-1, (-1, 4))).flatten(-2)
        a, b = turned.unflatten(-1, (2, 2, -1)).unbind(-2)
        turned = torch.stack([a * self.cos + b * sin, b * self.cos - a * sin], dim=-2).flatten(-3)
        return torch.cat([moved, turned], dim=-1).flatten(2, 3)


def prope(poses: Tensor, grid: tuple[int, int], head_width: int) -> Prope:
    """Positions of views with poses (B, M, 4, 4), world_from_camera, and a grid (rows, columns) of patches."""
    count = head_width // 8
    frequency = 100.0 ** (-torch.arange(count, dtype=torch.float64, device=poses.device) / count)
    rows = torch.arange(grid[0], device=poses.device)
    columns = torch.arange(grid[1], device=poses.device)
    row_column = torch.cartesian_prod(rows, columns)
    angle = row_column.flip(1)[..., None] * frequency
    return Prope(invert_poses(poses), poses, angle.cos().float(), angle.sin().float())


class PoseInjection(nn.Module):
    """Updates the posed views' patches by one another's cameras; attention and MLP are parallel branches."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norm1 = LayerNorm(width, eps=BLOCK_EPS)
        self.attn = Attention(width, heads, normalize_qk=True)
        self.ls1 = LayerScale(width)
        self.norm2 = LayerNorm(width, eps=BLOCK_EPS)
        self.mlp = Mlp(width)
        self.ls2 = LayerScale(width)

    def forward(self, patches: Tensor, positions: Prope) -> Tensor:
        """Patches (B, M * P, C) of M posed views to (B, M * P, C)."""
        q, k, v = self.attn.project(self.norm1(patches))
        moved_v = positions.key(v).to(v.dtype)
        attended = self.attn.attend(positions.query(q), positions.key(k), moved_v)
        attention = self.attn.merge(positions.output(attended))
        return self.ls1(attention) + self.ls2(self.mlp(self.norm2(patches)))
