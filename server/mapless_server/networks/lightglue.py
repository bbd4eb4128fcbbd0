"""LightGlue (Lindenberger et al. 2023), the network: kornia's layers, the authors' checkpoint.

On a GPU all layers run, without early stopping and without pruning of keypoints, so that several pairs of photographs
can be matched in one batch: those with fewer keypoints are padded, and masks keep the padding out of every sum. A
pair's matches do not depend on the other pairs, and the host waits for the device once.

A CPU does not gain from batches: there pairs are matched one by one, as the authors do, by as many layers and keypoints
as the pair needs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from kornia.feature import LightGlue as KorniaLightGlue
from kornia.feature.lightglue import (
    CrossBlock,
    LearnableFourierPositionalEncoding,
    MatchAssignment,
    SelfBlock,
    TransformerLayer,
    apply_cached_rotary_emb,
)
from torch import Tensor, nn
from torch.nn.functional import log_softmax, logsigmoid, scaled_dot_product_attention

from .checkpoint import load_strictly

if TYPE_CHECKING:  # needed for SuperPoint's only
    from transformers import LightGlueConfig


class LightGlue(nn.Module):
    """The network; its parameters have the names of the authors' checkpoint.

    Args:
        input_dim: length of descriptors: 128 for ALIKED, 256 for SuperPoint.
        layers: number of layers; the authors use 9.
    """

    def __init__(self, input_dim: int, layers: int = 9) -> None:
        super().__init__()
        # flash: otherwise kornia switches flash attention off, for the whole process.
        parts = KorniaLightGlue(None, input_dim=input_dim, n_layers=layers, flash=True)  # type: ignore[arg-type]
        self.input_proj: nn.Module = parts.input_proj
        self.posenc: LearnableFourierPositionalEncoding = parts.posenc
        self.transformers: nn.ModuleList = parts.transformers
        self.log_assignment: nn.ModuleList = parts.log_assignment
        self.token_confidence: nn.ModuleList = parts.token_confidence

    def forward(
        self, position: Tensor, descriptor: Tensor, positions: Tensor, descriptors: Tensor, mask: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Matches one query with K references. Does not wait for the device.

        Args:
            position: (1, N, 2) the query's keypoints, normalized (see `normalized_positions`).
            descriptor: (1, N, D) their descriptors.
            positions: (K, M, 2) the references' keypoints.
            descriptors: (K, M, D) their descriptors.
            mask: (K, M) which rows are keypoints; at least one for each reference.

        Returns:
            index: (K, N) the reference keypoint that each query keypoint and that matches each other best.
            score: (K, N) the match's probability; 0 where the best is not mutual.
        """
        key_mask = mask[:, None, None, :]
        query, reference = self.input_proj(descriptor), self.input_proj(descriptors)
        query_rotation, reference_rotation = self.posenc(position), self.posenc(positions)
        for layer in self.transformers:
            assert isinstance(layer, TransformerLayer)
            # Before the first layer's second half the query is the same in all pairs, and computed once.
            query = _attend_within(layer.self_attn, query, query_rotation, None)
            query = query.expand(len(reference), -1, -1)
            reference = _attend_within(layer.self_attn, reference, reference_rotation, key_mask)
            query, reference = _attend_across(layer.cross_attn, query, reference, key_mask)
        return _mutual_best(_log_probabilities(self._head(-1), query, reference, mask))

    def match_one(
        self,
        first: tuple[Tensor, Tensor],
        second: tuple[Tensor, Tensor],
        depth_confidence: float,
        width_confidence: float,
        pause: Callable[[], None] = lambda: None,
    ) -> tuple[Tensor, Tensor]:
        """Matches two photographs by as many layers and keypoints as they need, as the authors do.

        Args:
            first: (1, N, 2) keypoints, normalized, and (1, N, D) their descriptors; at least one.
            second: (1, M, 2) and (1, M, D), the same of the other photograph.
            depth_confidence: the layers end when this share of the keypoints is certain of its match, or of having
                none; 1 runs all layers.
            width_confidence: a keypoint without a match, with this confidence, is left out of the next layers; 1 leaves
                out none.
            pause: called between layers; may wait.

        Returns:
            index: (N,) as in `forward`, for each keypoint of the first photograph.
            score: (N,) as in `forward`; 0 for keypoints that were left out.
        """
        sides = [_Side.of(self.input_proj(x), self.posenc(position)) for position, x in (first, second)]
        count, last = sum(len(side.index) for side in sides), len(self.transformers) - 1
        for number, layer in enumerate(self.transformers):
            assert isinstance(layer, TransformerLayer)
            within = [_attend_within(layer.self_attn, side.x, side.rotation, None) for side in sides]
            across = _attend_across(layer.cross_attn, within[0], within[1], None)
            sides = [replace(side, x=x) for side, x in zip(sides, across, strict=True)]
            if number == last:
                break
            certain = [self._is_certain(number, side.x) for side in sides]
            uncertain_count = sum(int((~it).sum()) for it in certain)
            if 1 - uncertain_count / count > depth_confidence:
                break
            head = self._head(number)
            sides = [
                side.kept(~sure | (head.matchability(side.x)[0, :, 0].sigmoid() > 1 - width_confidence))
                for side, sure in zip(sides, certain, strict=True)
            ]
            if not all(len(side.index) for side in sides):
                break
            pause()
        index = torch.zeros(first[0].shape[1], dtype=torch.long, device=first[0].device)
        score = torch.zeros(first[0].shape[1], device=first[0].device)
        if all(len(side.index) for side in sides):
            everything = torch.ones(1, len(sides[1].index), dtype=torch.bool, device=index.device)
            found = _log_probabilities(self._head(number), sides[0].x, sides[1].x, everything)
            column, probability = _mutual_best(found)
            index[sides[0].index], score[sides[0].index] = sides[1].index[column[0]], probability[0]
        return index, score

    def _head(self, number: int) -> MatchAssignment:
        head = self.log_assignment[number]
        assert isinstance(head, MatchAssignment)
        return head

    def _is_certain(self, number: int, x: Tensor) -> Tensor:
        """Mask (N,) of the keypoints whose matches no later layer will change, by the authors' threshold."""
        threshold = 0.8 + 0.1 * math.exp(-4 * number / len(self.transformers))
        certain: Tensor = self.token_confidence[number](x, x)[0][0] >= threshold
        return certain


@dataclass(frozen=True, eq=False)
class _Side:
    """One photograph between two layers.

    Attributes:
        x: (1, N, C) states of the remaining keypoints.
        rotation: their encoded positions.
        index: (N,) index of each among all keypoints.
    """

    x: Tensor
    rotation: Tensor
    index: Tensor

    @classmethod
    def of(cls, x: Tensor, rotation: Tensor) -> _Side:
        """Makes the side of a photograph with all its keypoints."""
        return cls(x, rotation, torch.arange(x.shape[1], device=x.device))

    def kept(self, keep: Tensor) -> _Side:
        """Returns the side with only the keypoints of a mask (N,)."""
        return _Side(self.x[:, keep], self.rotation[..., keep, :], self.index[keep])


def _attend_within(block: SelfBlock, x: Tensor, rotation: Tensor, key_mask: Tensor | None) -> Tensor:
    """SelfBlock of kornia with a mask of keys instead of pairs: (B, N, C) to (B, N, C)."""
    # Made contiguous: the layer interleaves them, and attention over strided values holds all its weights in memory.
    q, k, v = block.Wqkv(x).unflatten(-1, (block.num_heads, -1, 3)).permute(4, 0, 2, 1, 3).contiguous().unbind()
    q, k = apply_cached_rotary_emb(rotation, q), apply_cached_rotary_emb(rotation, k)
    context = scaled_dot_product_attention(q.to(v.dtype), k.to(v.dtype), v, attn_mask=key_mask)
    message = block.out_proj(context.transpose(1, 2).flatten(start_dim=-2))
    updated: Tensor = x + block.ffn(torch.cat([x, message.to(x.dtype)], -1))
    return updated


def _attend_across(block: CrossBlock, x0: Tensor, x1: Tensor, key_mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """CrossBlock of kornia with the second photograph's keys masked; never holds a matrix of all similarities."""

    def heads(x: Tensor) -> Tensor:
        split: Tensor = x.unflatten(-1, (block.heads, -1))
        return split.transpose(1, 2)

    qk0, qk1, v0, v1 = (heads(x) for x in (block.to_qk(x0), block.to_qk(x1), block.to_v(x0), block.to_v(x1)))
    m0 = scaled_dot_product_attention(qk0, qk1, v1, attn_mask=key_mask)
    m1 = scaled_dot_product_attention(qk1, qk0, v0)
    m0, m1 = (block.to_out(m.transpose(1, 2).flatten(start_dim=-2)) for m in (m0, m1))
    return (x0 + block.ffn(torch.cat([x0, m0.to(x0.dtype)], -1)), x1 + block.ffn(torch.cat([x1, m1.to(x1.dtype)], -1)))


def _log_probabilities(head: MatchAssignment, x0: Tensor, x1: Tensor, mask: Tensor) -> Tensor:
    """Log-probabilities (K, N, M): both softmaxes of the similarity plus both keypoints' matchabilities.

    Padding has -inf.
    """
    y0, y1 = (head.final_proj(x) / x.shape[-1] ** 0.25 for x in (x0, x1))
    similarity = (y0 @ y1.transpose(1, 2)).float()
    certainty = logsigmoid(head.matchability(x0).float()) + logsigmoid(head.matchability(x1).float()).transpose(1, 2)
    # A padded keypoint's own column is all -inf after the first softmax, whatever the second makes of it.
    over_second = log_softmax(similarity.masked_fill(~mask[:, None], -torch.inf), 2)
    probabilities: Tensor = over_second + log_softmax(similarity, 1) + certainty
    return probabilities


def _mutual_best(log_probabilities: Tensor) -> tuple[Tensor, Tensor]:
    """Each row's best column (K, N) of (K, N, M), and its probability; 0 if the row is not that column's best."""
    best, column = log_probabilities.max(2)
    row_of_column = log_probabilities.argmax(1)
    rows = torch.arange(column.shape[1], device=column.device)
    mutual = row_of_column.gather(1, column) == rows
    return column, torch.where(mutual, best.exp(), 0.0)


def load_lightglue(features: str, weights: Path) -> tuple[LightGlue, str]:
    """Loads the LightGlue for features "aliked" or "superpoint" with the authors' weights.

    Returns it and their SHA-256. The safetensors file has the names of the authors' checkpoint for ALIKED, those of
    transformers for SuperPoint. ValueError if there is no LightGlue for these features; CheckpointError if the weights
    do not fit.
    """
    if features == "aliked":
        network = LightGlue(input_dim=128)
        return network, load_strictly(network, weights, optional={})
    if features == "superpoint":
        return load_superpoint_lightglue(weights)
    raise ValueError(f"there is no LightGlue for features {features!r}: only for aliked and superpoint")


def load_superpoint_lightglue(weights: Path, config: LightGlueConfig | None = None) -> tuple[LightGlue, str]:
    """Loads LightGlue from transformers' file, whose tensors are split differently; returns it and the file's SHA-256.

    The tensors of SuperPoint itself in it are not used; without a configuration, that of the published weights is used.
    CheckpointError if the weights do not fit; ImportError if transformers is not installed.
    """
    from transformers import LightGlueConfig, LightGlueForKeypointMatching

    theirs = LightGlueForKeypointMatching(config or LightGlueConfig())
    sha256 = load_strictly(theirs, weights, optional={})
    ours = LightGlue(theirs.descriptor_dim, theirs.num_layers)
    ours.load_state_dict(_translated(theirs.state_dict(), theirs.num_layers), strict=True)
    return ours, sha256


def _translated(theirs: Mapping[str, Tensor], layers: int) -> dict[str, Tensor]:
    """Renames the tensors of transformers' network to the names of this one."""
    ours = {"posenc.Wr.weight": theirs["positional_encoder.projector.weight"]}
    for i in range(layers):
        layer, to = f"transformer_layers.{i}", f"transformers.{i}"
        for kind in ("weight", "bias"):
            q, k, v = (theirs[f"{layer}.self_attention.{part}_proj.{kind}"] for part in "qkv")
            # kornia's layer interleaves query, key and value of each channel of each head.
            ours[f"{to}.self_attn.Wqkv.{kind}"] = torch.stack([q, k, v], dim=1).flatten(end_dim=1)
            for our_name, their_name in (
                ("self_attn.out_proj", "self_attention.o_proj"),
                # Across photographs queries and keys have one projection, which transformers stores twice.
                ("cross_attn.to_qk", "cross_attention.q_proj"),
                ("cross_attn.to_v", "cross_attention.v_proj"),
                ("cross_attn.to_out", "cross_attention.o_proj"),
                *(
                    (f"{here}_attn.ffn.{index}", f"{here}_mlp.{part}")
                    for here in ("self", "cross")
                    for index, part in ((0, "fc1"), (1, "layer_norm"), (3, "fc2"))
                ),
            ):
                ours[f"{to}.{our_name}.{kind}"] = theirs[f"{layer}.{their_name}.{kind}"]
            head = f"match_assignment_layers.{i}"
            ours[f"log_assignment.{i}.final_proj.{kind}"] = theirs[f"{head}.final_projection.{kind}"]
            ours[f"log_assignment.{i}.matchability.{kind}"] = theirs[f"{head}.matchability.{kind}"]
            if i < layers - 1:
                ours[f"token_confidence.{i}.token.0.{kind}"] = theirs[f"token_confidence.{i}.token.{kind}"]
    return ours
