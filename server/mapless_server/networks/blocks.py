"""The layers common to all parts of the networks: normalization, attention with rotary positions, transformer blocks.

Precision: the linear layers of this module compute in the type of their own weights (`Linear`), float32 or bfloat16;
normalization, rotations and sums with the output of a LayerScale are float32. So a network whose linear layers are cast
to bfloat16 carries a float32 residual stream through every block that has a LayerScale, and a bfloat16 one through
those that have none, as the official models do under autocast.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F  # noqa: N812  its usual name
from torch import Tensor, nn

BLOCK_EPS = 1e-6
"""Epsilon of the normalizations in front of attention and MLP."""
QK_EPS = 1e-5
"""Epsilon of the normalizations of queries and keys."""


class Linear(nn.Linear):
    """A linear layer that computes in the type of its weights, for input of any type."""

    def forward(self, x: Tensor) -> Tensor:
        """(..., in) to (..., out)."""
        return F.linear(x.to(self.weight.dtype), self.weight, self.bias)


class LayerNorm(nn.LayerNorm):
    """Layer normalization in the type of its weights, float32, for input of any type."""

    def forward(self, x: Tensor) -> Tensor:
        """(..., C) to (..., C)."""
        return F.layer_norm(x.to(self.weight.dtype), self.normalized_shape, self.weight, self.bias, self.eps)


class LayerScale(nn.Module):
    """A factor for each channel (Touvron et al. 2021)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.empty(width))

    def forward(self, x: Tensor) -> Tensor:
        """(..., C) to (..., C)."""
        return x * self.gamma


class Mlp(nn.Module):
    """Two linear layers with an exact GELU between them, where the width is four times as large."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.fc1 = Linear(width, 4 * width)
        self.fc2 = Linear(4 * width, width)

    def forward(self, x: Tensor) -> Tensor:
        """(..., C) to (..., C)."""
        return self.fc2(F.gelu(self.fc1(x)))


class SwiGlu(nn.Module):
    """w3(silu(a) * b), where a and b are the halves of w12(x), 8/3 times as wide (Shazeer 2020; as in DINOv2)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        hidden = -(-(4 * width * 2 // 3) // 8) * 8  # a multiple of 8, not smaller
        self.w12 = Linear(width, 2 * hidden)
        self.w3 = Linear(hidden, width)

    def forward(self, x: Tensor) -> Tensor:
        """(..., C) to (..., C)."""
        gate, value = self.w12(x).chunk(2, dim=-1)
        return self.w3(F.silu(gate) * value)


@dataclass(frozen=True, eq=False)
class Rope:
    """Rotary positions in two dimensions (Su et al. 2021; Heo et al. 2024), the table for T tokens of one view.

    A head's first d/2 channels are rotated by the token's row, the others by its column. Channel j of such a half is
    paired with channel j + d/4, and the pair is rotated by position * 100^(-j / (d/4)).

    Attributes:
        cos, sin: (T, 2, d/4) float32; axis 1 is row and column.
    """

    cos: Tensor
    sin: Tensor

    def rotate(self, x: Tensor) -> Tensor:
        """Rotates (..., V * T, d), the tokens of V views one after the other."""
        pairs = x.unflatten(-2, (-1, len(self.cos))).unflatten(-1, (2, 2, -1))  # (..., V, T, axis, half, d/4)
        a, b = pairs.unbind(-2)
        turned = torch.stack([a * self.cos - b * self.sin, b * self.cos + a * self.sin], dim=-2)
        return turned.flatten(-3).flatten(-3, -2)


def rope_table(positions: Tensor, head_width: int) -> Rope:
    """The table of tokens at integer ``positions`` (T, 2), row and column."""
    count = head_width // 4
    frequency = 100.0 ** (-torch.arange(count, dtype=torch.float64, device=positions.device) / count)
    angle = positions[..., None] * frequency
    return Rope(angle.cos().float(), angle.sin().float())


def flash_attention(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """Flash attention (Dao 2023) of (B, heads, T, d); RuntimeError if the device has no such kernel."""
    return torch.ops.aten._scaled_dot_product_flash_attention(q, k, v)[0]


class Attention(nn.Module):
    """Multi-head self-attention with joint projection; optionally with normalized queries and keys."""

    def __init__(self, width: int, heads: int, normalize_qk: bool) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = Linear(width, 3 * width)
        self.proj = Linear(width, width)
        self.q_norm: nn.Module = LayerNorm(width // heads, eps=QK_EPS) if normalize_qk else nn.Identity()
        self.k_norm: nn.Module = LayerNorm(width // heads, eps=QK_EPS) if normalize_qk else nn.Identity()

    def project(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Computes queries, keys and values (B, heads, T, d) of tokens (B, T, C), queries and keys normalized."""
        q, k, v = self.qkv(x).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4).unbind(0)
        return self.q_norm(q), self.k_norm(k), v

    @staticmethod
    def attend(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
        """Softmax(q k^T / sqrt(d)) v in the type of v, (B, heads, T, d).

        In low precision on CUDA this is the flash kernel or an error: torch would silently take a kernel of a quarter
        of the speed, and disabling the other kernels disables them for all threads of the process.
        """
        q, k = q.to(v.dtype), k.to(v.dtype)
        if v.is_cuda and v.dtype in (torch.bfloat16, torch.float16):
            return flash_attention(q, k, v)
        return F.scaled_dot_product_attention(q, k, v)

    def merge(self, x: Tensor) -> Tensor:
        """Merges all heads' (B, heads, T, d) to the output (B, T, C)."""
        return self.proj(x.transpose(1, 2).flatten(2))

    def forward(self, x: Tensor, rope: Rope | None) -> Tensor:
        """Tokens (B, T, C) to (B, T, C); ``rope``, if any, rotates queries and keys."""
        q, k, v = self.project(x)
        if rope is not None:
            q, k = rope.rotate(q), rope.rotate(k)
        return self.merge(self.attend(q, k, v))


class Block(nn.Module):
    """A transformer block, normalized before attention and before the MLP."""

    def __init__(
        self, width: int, heads: int, *, normalize_qk: bool = False, layer_scale: bool = True, gated: bool = False
    ) -> None:
        """A gated block has a SwiGLU in place of the MLP."""
        super().__init__()
        self.norm1 = LayerNorm(width, eps=BLOCK_EPS)
        self.attn = Attention(width, heads, normalize_qk)
        self.ls1: nn.Module = LayerScale(width) if layer_scale else nn.Identity()
        self.norm2 = LayerNorm(width, eps=BLOCK_EPS)
        self.mlp: nn.Module = SwiGlu(width) if gated else Mlp(width)
        self.ls2: nn.Module = LayerScale(width) if layer_scale else nn.Identity()

    def forward(self, x: Tensor, rope: Rope | None = None) -> Tensor:
        """Tokens (B, T, C) to (B, T, C); tokens of one row of the batch attend to each other."""
        x = x + self.ls1(self.attn(self.norm1(x), rope))
        return x + self.ls2(self.mlp(self.norm2(x)))
