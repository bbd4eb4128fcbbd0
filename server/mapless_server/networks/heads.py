"""The heads, which compute values from the decoded tokens of a view. Their decoders take one view at a time.

`HeadDecoder` prepares tokens for a head; `CameraHead` computes a pose; `LinearHead` (Pi3) and `ConvHead` (Pi3X, as in
MoGe, Wang et al. 2024) values for each pixel; `MetricDecoder` (Pi3X) a vector for the scene. Heads compute in float32,
and their decoders, which have no LayerScale, carry their residual stream in the type of their weights.
"""

from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from .blocks import BLOCK_EPS, Attention, Block, LayerNorm, Linear, Mlp, Rope
from .decoder import SPECIALS
from .encoder import PATCH_PX

NEWTON_STEPS = 32
"""From above, each step of Newton's method reduces the distance to the largest root of a quartic by at least a quarter,
and convergence is quadratic at the end; if the root is double, a step halves the distance."""


def nearest_rotation(matrices: Tensor) -> Tensor:
    """The rotations R (..., 3, 3) that maximize trace(R^T M): U diag(1, 1, det(U V^T)) V^T for M = U S V^T.

    It is computed by Markley's closed form (1993, "FOAM"), with n = |M|^2, C the cofactors of M and l the greatest root
    of

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


class HeadDecoder(nn.Module):
    """Transformer blocks within each view, between two linear layers."""

    def __init__(self, width_in: int, width: int, width_out: int, heads: int, depth: int) -> None:
        super().__init__()
        self.projects = Linear(width_in, width)
        self.blocks = nn.ModuleList(Block(width, heads, layer_scale=False) for _ in range(depth))
        self.linear_out = Linear(width, width_out)

    def forward(self, decoded: Tensor, rope: Rope) -> Tensor:
        """Decoded tokens (V, T, 2 C) to patch tokens (V, P, width_out), float32."""
        x = self.projects(decoded)
        for block in self.blocks:
            x = block(x, rope)
        out: Tensor = self.linear_out(x)
        return out[:, SPECIALS:].to(torch.float32)


class LinearHead(nn.Module):
    """Computes the channels of every pixel of a patch from its token."""

    def __init__(self, width: int, channels: int) -> None:
        super().__init__()
        self.channels = channels
        self.proj = nn.Linear(width, channels * PATCH_PX**2)

    def forward(self, tokens: Tensor, grid: tuple[int, int]) -> Tensor:
        """Patch tokens (V, P, C) of a grid (rows, columns) to (V, H, W, channels)."""
        pixels = self.proj(tokens).unflatten(2, (self.channels, PATCH_PX, PATCH_PX)).unflatten(1, grid)
        # (V, rows, columns, channels, y, x)
        return pixels.permute(0, 1, 4, 2, 5, 3).flatten(3, 4).flatten(1, 2)


class ResidualMlp(nn.Module):
    """x + relu(L3 relu(L2 relu(L1 x)))."""

    def __init__(self, width: int, layer: Callable[[int, int], nn.Module] = nn.Linear) -> None:
        """With a convolution of 1 x 1 as `layer`, the channels are axis 1 of the input; else its last axis."""
        super().__init__()
        self.res_conv1 = layer(width, width)
        self.res_conv2 = layer(width, width)
        self.res_conv3 = layer(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """Returns a tensor of the input's shape."""
        inner = x
        for layer in (self.res_conv1, self.res_conv2, self.res_conv3):
            inner = F.relu(layer(inner))
        return x + inner


class CameraHead(nn.Module):
    """Computes a pose from the mean of a view's patch tokens."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.res_conv = nn.ModuleList(ResidualMlp(width) for _ in range(2))
        self.more_mlps = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())
        self.fc_t = nn.Linear(width, 3)
        self.fc_rot = nn.Linear(width, 9)

    def forward(self, tokens: Tensor) -> Tensor:
        """Patch tokens (V, P, C) to poses (V, 4, 4), local_from_camera, up to the scene's scale.

        Nine numbers fill a matrix row by row, each row is scaled to length 1, and the nearest rotation is taken.
        """
        for block in self.res_conv:
            tokens = block(tokens)
        feature = self.more_mlps(tokens.mean(dim=1))
        rows = F.normalize(self.fc_rot(feature).unflatten(-1, (3, 3)), dim=-1)
        pose = torch.cat([nearest_rotation(rows), self.fc_t(feature)[..., None]], dim=-1)
        last = torch.zeros_like(pose[:, :1])
        last[..., 3] = 1
        return torch.cat([pose, last], dim=1)


class MapUpsampling(nn.Sequential):
    """Doubles the size of a map: transposed convolution, then two residual blocks."""

    def __init__(self, width_in: int, width: int) -> None:
        super().__init__(
            nn.Sequential(nn.ConvTranspose2d(width_in + 2, width, 2, 2), _convolution(width, width)),
            ResidualConvolution(width),
            ResidualConvolution(width),
        )


class ResidualConvolution(nn.Module):
    """x + two normalized convolutions, twice as wide between."""

    def __init__(self, width: int) -> None:
        super().__init__()
        hidden = 2 * width
        self.layers = nn.Sequential(
            nn.GroupNorm(1, width),
            nn.ReLU(),
            _convolution(width, hidden),
            nn.GroupNorm(hidden // 32, hidden),
            nn.ReLU(),
            _convolution(hidden, width),
        )

    def forward(self, x: Tensor) -> Tensor:
        """(V, C, H, W) to (V, C, H, W)."""
        return x + self.layers(x)


class ConvHead(nn.Module):
    """Computes maps from patch tokens by convolutions; one or more outputs with a common trunk."""

    def __init__(self, width: int, stages: Sequence[int], last_width: int, channels: Sequence[int]) -> None:
        super().__init__()
        widths = [width, *stages]
        self.upsample_blocks = nn.ModuleList(MapUpsampling(*pair) for pair in zip(widths, stages, strict=False))
        self.output_block = nn.ModuleList(
            nn.Sequential(_convolution(stages[-1] + 2, last_width), nn.ReLU(), nn.Conv2d(last_width, count, 1))
            for count in channels
        )

    def forward(self, tokens: Tensor, grid: tuple[int, int]) -> Tensor:
        """Patch tokens (V, P, C) of a grid (rows, columns) to (V, H, W, channels of all outputs)."""
        x = tokens.transpose(1, 2).unflatten(2, grid)
        for block in self.upsample_blocks:
            x = block(_with_uv(x, grid))
        size = (grid[0] * PATCH_PX, grid[1] * PATCH_PX)
        x = _with_uv(F.interpolate(x, size, mode="bilinear", align_corners=False), grid)
        return torch.cat([output(x) for output in self.output_block], dim=1).permute(0, 2, 3, 1)


def _convolution(width_in: int, width_out: int) -> nn.Conv2d:
    return nn.Conv2d(width_in, width_out, 3, padding=1, padding_mode="replicate")


def _with_uv(x: Tensor, grid: tuple[int, int]) -> Tensor:
    """A map (V, C, H, W) with two more channels, u along x and v along y; the image's corners have radius 1."""
    height, width = x.shape[2:]
    diagonal = (grid[0] ** 2 + grid[1] ** 2) ** 0.5
    u_end = grid[1] / diagonal * (width - 1) / width
    v_end = grid[0] / diagonal * (height - 1) / height
    u = torch.linspace(-u_end, u_end, width, dtype=x.dtype, device=x.device)
    v = torch.linspace(-v_end, v_end, height, dtype=x.dtype, device=x.device)
    uv = torch.stack(torch.meshgrid(u, v, indexing="xy"))
    return torch.cat([x, uv.expand(len(x), -1, -1, -1)], dim=1)


class CrossAttention(nn.Module):
    """Attention of queries to a context."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.q_proj = Linear(width, width)
        self.k_proj = Linear(width, width)
        self.v_proj = Linear(width, width)
        self.proj = Linear(width, width)

    def forward(self, queries: Tensor, context: Tensor, context_rope: Rope) -> Tensor:
        """(B, Q, C) and (B, M, C) to (B, Q, C). Queries have position (0, 0), whose rotation is the identity."""
        q, k, v = (
            projection(x).unflatten(-1, (self.heads, -1)).transpose(1, 2)
            for projection, x in ((self.q_proj, queries), (self.k_proj, context), (self.v_proj, context))
        )
        x = Attention.attend(q, context_rope.rotate(k), v)
        return self.proj(x.transpose(1, 2).flatten(2))


class MetricBlock(nn.Module):
    """Cross-attention and MLP on the query; the context is not changed."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norm_y = LayerNorm(width, eps=BLOCK_EPS)
        self.norm2 = LayerNorm(width, eps=BLOCK_EPS)
        self.cross_attn = CrossAttention(width, heads)
        self.norm3 = LayerNorm(width, eps=BLOCK_EPS)
        self.mlp = Mlp(width)

    def forward(self, query: Tensor, context: Tensor, context_rope: Rope) -> Tensor:
        """(B, 1, C) and (B, M, C) to (B, 1, C)."""
        query = query + self.cross_attn(self.norm2(query), self.norm_y(context), context_rope)
        return query + self.mlp(self.norm3(query))


class MetricDecoder(nn.Module):
    """One learned query attends to all tokens of the scene."""

    def __init__(self, width_in: int, width: int, heads: int, depth: int) -> None:
        super().__init__()
        self.projects_x = Linear(width_in, width)
        self.projects_y = Linear(width_in, width)
        self.blocks = nn.ModuleList(MetricBlock(width, heads) for _ in range(depth))
        self.linear_out = Linear(width, width)

    def forward(self, query: Tensor, decoded: Tensor, rope: Rope) -> Tensor:
        """The query (1, 1, 2 C) and the decoded tokens (B, N * T, 2 C) to (B, width), float32."""
        x, context = self.projects_x(query.expand(len(decoded), -1, -1)), self.projects_y(decoded)
        for block in self.blocks:
            x = block(x, context, rope)
        out: Tensor = self.linear_out(x)
        return out[:, 0].to(torch.float32)


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
