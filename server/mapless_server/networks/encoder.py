"""The image encoders: DINOv2 with registers (Oquab, Darcet et al. 2023), and without.

They encode each view alone. Pi3 and Pi3X have a ViT-L/14 with registers; MapAnything a ViT-g/14 and MegaLoc a ViT-B/14
without.
"""

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from .blocks import BLOCK_EPS, Block, LayerNorm

PATCH_PX = 14
POSITION_SIDE = 37
"""The learned position grid has 37 x 37 cells, for images of 518 x 518."""
REGISTERS = 4
POSITION_OFFSET = 0.1
"""DINOv2 without registers resizes its learned positions by the factor (cells + 0.1) / 37, once a guard against
rounding. Weights were trained with it: on 23 x 23 patches it moves the last samples by a sixth of a cell."""


class PatchEmbedding(nn.Module):
    """A linear map of each 14 x 14 patch."""

    def __init__(self, channels: int, width: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(channels, width, PATCH_PX, PATCH_PX)

    def forward(self, images: Tensor) -> Tensor:
        """Images (V, channels, H, W) to patches (V, P, C), row by row."""
        patches: Tensor = self.proj(images.to(self.proj.weight.dtype))
        return patches.flatten(2).transpose(1, 2)


class PlainEncoder(nn.Module):
    """Normalized images to tokens of all blocks, without registers and without a final normalization."""

    def __init__(self, width: int, heads: int, depth: int, *, gated: bool = False) -> None:
        super().__init__()
        self.cls_token = nn.Parameter(torch.empty(1, 1, width))
        self.pos_embed = nn.Parameter(torch.empty(1, 1 + POSITION_SIDE**2, width))
        self.patch_embed = PatchEmbedding(3, width)
        self.blocks = nn.ModuleList(Block(width, heads, gated=gated) for _ in range(depth))

    def forward(self, images: Tensor) -> Tensor:
        """Images (V, 3, H, W), sides multiples of 14, to tokens (V, 1 + P, C) float32; the class token comes first."""
        grid = (images.shape[2] // PATCH_PX, images.shape[3] // PATCH_PX)
        patches = self.patch_embed(images)
        of_class = self.cls_token.expand(len(images), -1, -1)
        x = torch.cat([of_class, patches.to(of_class.dtype)], dim=1) + self.positions(grid)
        for block in self.blocks:
            x = block(x)
        return x

    def positions(self, grid: tuple[int, int]) -> Tensor:
        """Position embeddings (1, 1 + P, C): of the class token, and of the patches of a grid (rows, columns)."""
        if grid == (POSITION_SIDE, POSITION_SIDE):
            return self.pos_embed
        of_class, of_patches = self.pos_embed.split([1, POSITION_SIDE**2], dim=1)
        learned = of_patches.transpose(1, 2).unflatten(2, (POSITION_SIDE, POSITION_SIDE))
        return torch.cat([of_class, self.resized(learned, grid).flatten(2).transpose(1, 2)], dim=1)

    def resized(self, learned: Tensor, grid: tuple[int, int]) -> Tensor:
        """The learned positions (1, C, 37, 37) for a grid, bicubically without antialiasing, see POSITION_OFFSET."""
        factors = [(cells + POSITION_OFFSET) / POSITION_SIDE for cells in grid]
        return F.interpolate(learned, scale_factor=factors, mode="bicubic", align_corners=False)


class Encoder(PlainEncoder):
    """Normalized images to patch tokens, with registers and a final normalization."""

    def __init__(self, width: int, heads: int, depth: int) -> None:
        super().__init__(width, heads, depth)
        self.register_tokens = nn.Parameter(torch.empty(1, REGISTERS, width))
        self.norm = LayerNorm(width, eps=BLOCK_EPS)

    def forward(self, images: Tensor) -> Tensor:
        """Images (V, 3, H, W), sides multiples of 14, to tokens (V, P, C) float32, P = H/14 * W/14, row by row."""
        grid = (images.shape[2] // PATCH_PX, images.shape[3] // PATCH_PX)
        of_class, of_patches = self.positions(grid).split([1, grid[0] * grid[1]], dim=1)
        views = len(images)
        x = torch.cat(
            [
                (self.cls_token + of_class).expand(views, -1, -1),
                self.register_tokens.expand(views, -1, -1),
                self.patch_embed(images) + of_patches,
            ],
            dim=1,
        )
        for block in self.blocks:
            x = block(x)
        tokens: Tensor = self.norm(x)
        return tokens[:, 1 + REGISTERS :]

    def resized(self, learned: Tensor, grid: tuple[int, int]) -> Tensor:
        """The learned positions for a grid, bicubically with antialiasing, to the size itself rather than a factor."""
        return F.interpolate(learned, grid, mode="bicubic", antialias=True, align_corners=False)
