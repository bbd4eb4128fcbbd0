"""The dense prediction head (Ranftl et al. 2021): values for each pixel from tokens of four depths of a transformer.

Written from the formulas. Each of the four maps gets a size of its own, 4, 2, 1 and 1/2 times that of the patches, and
is added from the coarsest to the finest.
"""

from collections.abc import Sequence

import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from .encoder import PATCH_PX


class ResidualUnit(nn.Module):
    """x + conv2(relu(conv1(relu(x))))."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(width, width, 3, padding=1)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """(V, C, h, w) to (V, C, h, w)."""
        inner: Tensor = self.conv2(F.relu(self.conv1(F.relu(x))))
        return x + inner


class Fusion(nn.Module):
    """Adds a finer map to a coarser one, and doubles the size of both."""

    def __init__(self, width: int, is_coarsest: bool) -> None:
        super().__init__()
        if not is_coarsest:
            self.resConfUnit1 = ResidualUnit(width)
        self.resConfUnit2 = ResidualUnit(width)
        self.out_conv = nn.Conv2d(width, width, 1)

    def forward(self, finer: Tensor, coarser: Tensor | None = None) -> Tensor:
        """Maps (V, C, h, w) of one size to (V, C, 2 h, 2 w); the coarsest level has one map."""
        x = finer if coarser is None else coarser + self.resConfUnit1(finer)
        size = (2 * x.shape[2], 2 * x.shape[3])
        out: Tensor = self.out_conv(F.interpolate(self.resConfUnit2(x), size, mode="bilinear", align_corners=True))
        return out


class DenseFeatures(nn.Module):
    """Converts patch tokens of four depths to one map of eight times the patches' size."""

    def __init__(self, width: int, map_widths: Sequence[int], width_out: int) -> None:
        super().__init__()
        a, b, _, d = map_widths
        resizings: Sequence[list[nn.Module]] = (
            [nn.ConvTranspose2d(a, a, 4, 4)],
            [nn.ConvTranspose2d(b, b, 2, 2)],
            [],
            [nn.Conv2d(d, d, 3, stride=2, padding=1)],
        )
        self.input_process = nn.ModuleList(
            nn.Sequential(
                nn.Sequential(nn.Conv2d(width, map_width, 1), *resizing),
                nn.Conv2d(map_width, width_out, 3, padding=1, bias=False),
            )
            for map_width, resizing in zip(map_widths, resizings, strict=True)
        )
        self.scratch = nn.ModuleDict({f"refinenet{i}": Fusion(width_out, is_coarsest=i == 4) for i in (1, 2, 3, 4)})

    def forward(self, tokens: Sequence[Tensor], grid: tuple[int, int]) -> Tensor:
        """Tokens (V, P, C) of four depths, the first depth first, and a grid (rows, columns), to (V, C', 8 h, 8 w)."""
        inputs = (it.transpose(1, 2).unflatten(2, grid) for it in tokens)
        maps = [process(it) for process, it in zip(self.input_process, inputs, strict=True)]
        fusions = self.scratch
        x = fusions["refinenet4"](maps[3])[:, :, : grid[0], : grid[1]]  # half of an odd size was rounded up
        for i in (3, 2, 1):
            x = fusions[f"refinenet{i}"](maps[i - 1], x)
        return x


class DenseRegression(nn.Module):
    """Computes the channels of every pixel from the map of `DenseFeatures`."""

    def __init__(self, width: int, hidden: int, channels: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(width, hidden, 3, padding=1)
        self.conv2 = nn.Sequential(nn.Conv2d(hidden, hidden, 3, padding=1), nn.ReLU(), nn.Conv2d(hidden, channels, 1))

    def forward(self, features: Tensor, grid: tuple[int, int]) -> Tensor:
        """(V, C, 8 h, 8 w) to (V, channels, 14 h, 14 w)."""
        size = (grid[0] * PATCH_PX, grid[1] * PATCH_PX)
        resized = F.interpolate(self.conv1(features), size, mode="bilinear", align_corners=True)
        out: Tensor = self.conv2(resized)
        return out
