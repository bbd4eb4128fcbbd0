"""The main decoder: blocks that attend within each view and over all views in turn (Wang et al. 2025, pi^3).

The network is equivariant to the order of views.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from .blocks import Block, Rope, rope_table

SPECIALS = 5
"""Learned tokens in front of each view's patches."""

Injection = Callable[[int, Tensor], Tensor]
"""From the index of a block and its output (B, N, T, C) to the input of the next block."""


@dataclass(frozen=True, eq=False)
class TokenLayout:
    """The arrangement of the T = 5 + P tokens of one view, the same for all views of a scene.

    Attributes:
        grid: rows and columns of patches.
        rope: special tokens have position (0, 0), patches (row + 1, column + 1).
    """

    grid: tuple[int, int]
    rope: Rope


def make_layout(grid: tuple[int, int], head_width: int, device: torch.device) -> TokenLayout:
    """The layout of a grid (rows, columns) of patches."""
    rows = torch.arange(1, grid[0] + 1, device=device)
    columns = torch.arange(1, grid[1] + 1, device=device)
    patches = torch.cartesian_prod(rows, columns)
    return TokenLayout(grid, rope_table(torch.cat([patches.new_zeros(SPECIALS, 2), patches]), head_width))


class AlternatingDecoder(nn.ModuleList):
    """An even number of blocks; those with an even index attend within a view, the others over the scene."""

    def __init__(self, width: int, heads: int, depth: int) -> None:
        super().__init__(Block(width, heads, normalize_qk=True) for _ in range(depth))

    def begin(self, tokens: Tensor, rope: Rope) -> Tensor:
        """Block 0: tokens (V, T, C) to (V, T, C). It depends on each view alone, so its result can be cached."""
        return self[0](tokens, rope)

    def forward(self, tokens: Tensor, rope: Rope, inject: Injection | None = None) -> Tensor:
        """Computes the other blocks from tokens (B, N, T, C) of B scenes with N views, after `begin`.

        `rope` has the rotary positions of one view; `inject` changes the output of a block over the whole scene.
        Returns (B, N, T, 2 C): the last block within views, then the last one over the scene.
        """
        scenes, views = tokens.shape[:2]
        x = within = tokens
        for index in range(1, len(self)):
            if index % 2 == 1:
                x = self[index](x.flatten(1, 2), rope).unflatten(1, (views, -1))
                if inject is not None:
                    x = inject(index, x)
            else:
                x = within = self[index](x.flatten(0, 1), rope).unflatten(0, (scenes, views))
        return torch.cat([within, x], dim=-1)
