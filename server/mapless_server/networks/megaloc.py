"""MegaLoc (Berton and Masone 2025): one vector for a whole image; images of one place have similar vectors.

A DINOv2 ViT-B/14 without registers (Oquab et al. 2023), SALAD on top, and a linear layer that mixes the parts. Written
from the papers and a description of the published model; modules are named as the entries of its checkpoint.

SALAD (Izquierdo and Civera 2024) makes one vector of an image's tokens, by optimal transport to learned clusters. The
mass of every patch is one; it goes to clusters, or to a dustbin for what does not identify a place (sky, people). Every
cluster receives mass one, the dustbin the rest. The sum of features in a cluster, weighted by mass, is one part of the
descriptor; the class token's features are another.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from .blocks import BLOCK_EPS, LayerNorm
from .encoder import PlainEncoder
from .network import ImageNetwork, patch_grid

ROUNDS = 3
"""Rounds of the Sinkhorn iteration; the published weights were trained with them, so not to be tuned."""
_DROPOUT = nn.Identity
"""In the place of the dropout of training, which is counted in the names of the published entries."""


class PointLinear(nn.Conv2d):
    """A linear layer for tokens whose weights are stored like those of a 1 x 1 convolution."""

    def __init__(self, width: int, width_out: int) -> None:
        super().__init__(width, width_out, 1)

    def forward(self, tokens: Tensor) -> Tensor:
        """Tokens (..., in) to (..., out)."""
        return F.linear(tokens, self.weight.flatten(1), self.bias)


class Salad(nn.Module):
    """Patch tokens and the class token to one vector of unit length, float32 throughout.

    Args:
        width: channels of a token.
        hidden: channels between the two layers of each of the three perceptrons.
        clusters: number of clusters.
        cluster_width: channels of a cluster's part.
        token_width: channels of the class token's part.
    """

    def __init__(self, width: int, hidden: int, clusters: int, cluster_width: int, token_width: int) -> None:
        super().__init__()
        self.token_features = nn.Sequential(nn.Linear(width, hidden), nn.ReLU(), nn.Linear(hidden, token_width))
        self.cluster_features = _of_patches(width, hidden, cluster_width)
        self.score = _of_patches(width, hidden, clusters)
        self.dust_bin = nn.Parameter(torch.empty(()))
        self.length = token_width + clusters * cluster_width

    def forward(self, patches: Tensor, of_class: Tensor) -> Tensor:
        """Patch tokens (B, P, C) and class tokens (B, C) to (B, length); more patches than clusters."""
        masses = transport(self.score(patches).transpose(1, 2), self.dust_bin)
        sums = self.cluster_features(patches).transpose(1, 2) @ masses.transpose(1, 2)  # (B, cluster_width, clusters)
        parts = F.normalize(self.token_features(of_class), dim=1), F.normalize(sums, dim=1).flatten(1)
        return F.normalize(torch.cat(parts, dim=1), dim=1)


def transport(scores: Tensor, dustbin_score: Tensor) -> Tensor:
    """Masses (B, M, N) from each of N patches to each of M clusters, without those to the dustbin.

    Sinkhorn's iteration in logarithms: clusters and dustbin are scaled to their masses, then patches to theirs. Patches
    come last, so the mass of each is exactly one; the masses of clusters are one only in the limit. Scores (B, M, N)
    are higher for a better fit; that of the dustbin is the same for any patch. ValueError if there are no more patches
    than clusters, so that nothing would be left for the dustbin.
    """
    batch, clusters, patches = scores.shape
    if patches <= clusters:
        raise ValueError(f"{patches} patches are too few for {clusters} clusters: show a larger image")
    scores = torch.cat([scores, dustbin_score.expand(batch, 1, patches)], dim=1)
    log_masses = scores.new_zeros(clusters + 1)
    log_masses[-1] = math.log(patches - clusters)
    of_patches = scores.new_zeros(batch, 1, patches)
    for _ in range(ROUNDS):
        of_clusters = log_masses[:, None] - torch.logsumexp(scores + of_patches, dim=2, keepdim=True)
        of_patches = -torch.logsumexp(scores + of_clusters, dim=1, keepdim=True)
    return torch.exp(scores + of_clusters + of_patches)[:, :-1]


def _of_patches(width: int, hidden: int, width_out: int) -> nn.Sequential:
    return nn.Sequential(PointLinear(width, hidden), _DROPOUT(), nn.ReLU(), PointLinear(hidden, width_out))


REDUCTION_SEED = 2025
"""Seed of the signed sums; another one makes descriptors that cannot be compared."""


@dataclass(frozen=True)
class MegaLocSizes:
    """Sizes of the network; the defaults are those of the published one.

    Attributes:
        width, heads, depth: sizes of the transformer.
        hidden: channels within SALAD's perceptrons.
        clusters, cluster_width, token_width: see Salad.
        length: length of the descriptor.
    """

    width: int = 768
    heads: int = 12
    depth: int = 12
    hidden: int = 512
    clusters: int = 64
    cluster_width: int = 256
    token_width: int = 256
    length: int = 8448


class Backbone(PlainEncoder):
    """Normalized images to tokens: DINOv2 without registers, with its final normalization."""

    def __init__(self, width: int, heads: int, depth: int) -> None:
        super().__init__(width, heads, depth)
        self.norm = LayerNorm(width, eps=BLOCK_EPS)

    def forward(self, images: Tensor) -> Tensor:
        """Images (B, 3, H, W), sides multiples of 14, to tokens (B, 1 + P, C) float32; the class token comes first.

        ValueError if a side is not a multiple of 14.
        """
        patch_grid(images)
        tokens: Tensor = self.norm(super().forward(images))
        return tokens


class Mixing(nn.Module):
    """SALAD, then a linear layer."""

    def __init__(self, sizes: MegaLocSizes) -> None:
        super().__init__()
        self.agg = Salad(sizes.width, sizes.hidden, sizes.clusters, sizes.cluster_width, sizes.token_width)
        self.linear = nn.Linear(self.agg.length, sizes.length)

    def forward(self, tokens: Tensor) -> Tensor:
        """Tokens (B, 1 + P, C), the class token first, to (B, length)."""
        mixed: Tensor = self.linear(self.agg(tokens[:, 1:], tokens[:, 0]))
        return mixed


class MegaLoc(ImageNetwork):
    """Images to descriptors."""

    def __init__(self, sizes: MegaLocSizes | None = None) -> None:
        sizes = sizes or MegaLocSizes()
        super().__init__()
        self.backbone = Backbone(sizes.width, sizes.heads, sizes.depth)
        self.aggregator = Mixing(sizes)

    @property
    def length(self) -> int:
        """Length of the descriptors."""
        return self.aggregator.linear.out_features

    def forward(self, images: Tensor) -> Tensor:
        """Images (B, 3, H, W) in [0, 1], sides multiples of 14, to descriptors (B, length) float32 of unit length.

        ValueError if a side is not a multiple of 14, or there are no more patches than SALAD has clusters.
        """
        tokens = self.backbone(self.normalized(images))
        descriptors: Tensor = F.normalize(self.aggregator(tokens), dim=1)
        return descriptors

    @torch.no_grad()
    def reduce(self, length: int) -> None:
        """Shortens all later descriptors; the similarity of two keeps its expected value.

        Each new number is a sum of `signed_groups` of old ones, divided by the root of their count: a random projection
        with orthonormal rows. It is built into the linear layer, which shrinks as the descriptors do. ValueError if the
        length does not divide the present one.
        """
        if length == self.length:
            return
        if length < 1 or self.length % length:
            raise ValueError(f"descriptors of {self.length} numbers cannot be reduced to {length}, which is no divisor")
        whole = self.aggregator.linear
        order, signs = (part.view(length, -1).to(whole.weight.device) for part in signed_groups(self.length))
        with torch.device("meta"):
            reduced = nn.Linear(whole.in_features, length)
        state = {name: _signed_sums(tensor, order, signs) for name, tensor in whole.state_dict().items()}
        reduced.load_state_dict(state, assign=True)
        self.aggregator.linear = reduced.requires_grad_(whole.weight.requires_grad)


def signed_groups(count: int) -> tuple[Tensor, Tensor]:
    """A random order (count,) int64 of numbers, of which consecutive ones form groups, and a sign (count,) for each.

    It uses the raw stream of a generator, which NumPy keeps stable across versions, unlike its distributions.
    """
    raw = np.random.PCG64(REDUCTION_SEED).random_raw(2 * count)
    order = np.argsort(raw[:count], kind="stable")
    signs = 1.0 - 2.0 * (raw[count:] >> np.uint64(63)).astype(np.float32)
    return torch.from_numpy(order), torch.from_numpy(signs)


def _signed_sums(rows: Tensor, order: Tensor, signs: Tensor) -> Tensor:
    """Sums (D, ...) over groups of G rows (D * G, ...), in this order and with these signs (D, G), over the root of G.

    One summand at a time, in preallocated memory: all of them together are as large as the rest of the network.
    """
    shape = (-1, *[1] * (rows.dim() - 1))
    total = rows.new_zeros(len(order), *rows.shape[1:])
    summand = torch.empty_like(total)
    for places, sign in zip(order.T, signs.T, strict=True):
        torch.index_select(rows, 0, places, out=summand)
        total.addcmul_(summand, sign.reshape(shape))
    return total.div_(order.shape[1] ** 0.5)
