"""SALAD (Izquierdo and Civera 2024): one vector from an image's tokens, by optimal transport to learned clusters.

The mass of every patch is one; it goes to clusters, or to a dustbin for what does not identify a place (sky, people).
Every cluster receives mass one, the dustbin the rest. The sum of features in a cluster, weighted by mass, is one part
of the descriptor; the class token's features are another.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F  # noqa: N812  its usual name
from torch import Tensor, nn

ROUNDS = 3
"""Of the Sinkhorn iteration; the published weights were trained with them, so not to be tuned."""
_DROPOUT = nn.Identity
"""In the place of the dropout of training, which is counted in the names of the published entries."""


class PointLinear(nn.Conv2d):
    """A linear layer for tokens whose weights are stored as those of a 1 x 1 convolution."""

    def __init__(self, width: int, width_out: int) -> None:
        super().__init__(width, width_out, 1)

    def forward(self, tokens: Tensor) -> Tensor:
        """(..., in) to (..., out)."""
        return F.linear(tokens, self.weight.flatten(1), self.bias)


class Salad(nn.Module):
    """Patch tokens and the class token to one vector of unit length, float32 throughout.

    Args:
        width: channels of a token.
        hidden: between the two layers of each of the three perceptrons.
        clusters: how many.
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
    come last, so the mass of each is exactly one; the masses of clusters are one only in the limit.

    Args:
        scores: (B, M, N) of cluster and patch, higher for a better fit.
        dustbin_score: (), of the dustbin with any patch.

    Raises:
        ValueError: no more patches than clusters; nothing would be left for the dustbin.
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
