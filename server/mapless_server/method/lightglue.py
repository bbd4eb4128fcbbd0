"""LightGlue (Lindenberger et al. 2023): a network that matches the keypoints of two photographs by looking at all.

All layers run, nothing stops early and no keypoint is pruned on the way, so that the pairs of a query can go through
together: references with fewer keypoints are padded, and masks keep the padding out of every sum. A pair's matches
then do not depend on the others', and the device is asked for results once.

The layers are kornia's, and the checkpoint is the authors'.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
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
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import log_softmax, logsigmoid, scaled_dot_product_attention

from mapless.geometry import Camera
from mapless_server.networks.checkpoint import load_strictly

from .correspond import Matches
from .views import Features, PosedView, View

NOTHING: Matches = np.empty((0, 2), np.int32)


@dataclass(frozen=True)
class LightGlueOptions:
    """Options of matching by LightGlue.

    Attributes:
        min_score: a match's least probability; the authors'.
        max_keypoints: of each photograph the first so many are matched, and extractors put the strongest first. The
            time is quadratic in it.
        pairs_at_once: pairs that go through the network together; a query's K on a GPU. A CPU gains nothing from it.
        half: compute in float16, as the authors do on a GPU.
    """

    min_score: float = 0.1
    max_keypoints: int = 2048
    pairs_at_once: int = 32
    half: bool = False

    def __post_init__(self) -> None:
        if not (0 <= self.min_score < 1 and self.max_keypoints >= 1 and self.pairs_at_once >= 1):
            raise ValueError(f"senseless options: {self}")


CPU_OPTIONS = LightGlueOptions(max_keypoints=1024, pairs_at_once=1)
CUDA_OPTIONS = LightGlueOptions(half=True)


class LightGlue(nn.Module):
    """The network, its parameters under the names of the authors' checkpoint; `token_confidence` only for its sake.

    Args:
        input_dim: of descriptors: 128 for ALIKED, 256 for SuperPoint.
        layers: the authors' 9.
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
            mask: (K, M) which of them there are; at least one each.

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
        head = self.log_assignment[-1]
        assert isinstance(head, MatchAssignment)
        return _mutual_best(_log_probabilities(head, query, reference, mask))


def _attend_within(block: SelfBlock, x: Tensor, rotation: Tensor, key_mask: Tensor | None) -> Tensor:
    """SelfBlock of kornia with a mask of keys instead of pairs, (B, N, C) to (B, N, C)."""
    qkv = block.Wqkv(x).unflatten(-1, (block.num_heads, -1, 3)).transpose(1, 2)
    q, k, v = qkv.unbind(-1)
    q, k = apply_cached_rotary_emb(rotation, q), apply_cached_rotary_emb(rotation, k)
    context = scaled_dot_product_attention(q.to(v.dtype), k.to(v.dtype), v, attn_mask=key_mask)
    message = block.out_proj(context.transpose(1, 2).flatten(start_dim=-2))
    updated: Tensor = x + block.ffn(torch.cat([x, message.to(x.dtype)], -1))
    return updated


def _attend_across(block: CrossBlock, x0: Tensor, x1: Tensor, key_mask: Tensor) -> tuple[Tensor, Tensor]:
    """CrossBlock of kornia, the second photograph's keys masked; never holds a matrix of all similarities."""

    def heads(x: Tensor) -> Tensor:
        split: Tensor = x.unflatten(-1, (block.heads, -1))
        return split.transpose(1, 2)

    qk0, qk1, v0, v1 = (heads(x) for x in (block.to_qk(x0), block.to_qk(x1), block.to_v(x0), block.to_v(x1)))
    m0 = scaled_dot_product_attention(qk0, qk1, v1, attn_mask=key_mask)
    m1 = scaled_dot_product_attention(qk1, qk0, v0)
    m0, m1 = (block.to_out(m.transpose(1, 2).flatten(start_dim=-2)) for m in (m0, m1))
    return (
        x0 + block.ffn(torch.cat([x0, m0.to(x0.dtype)], -1)),
        x1 + block.ffn(torch.cat([x1, m1.to(x1.dtype)], -1)),
    )


def _log_probabilities(head: MatchAssignment, x0: Tensor, x1: Tensor, mask: Tensor) -> Tensor:
    """(K, N, M): both softmaxes of the similarity and both keypoints' matchabilities, added as logarithms.

    -inf for padding.
    """
    y0, y1 = (head.final_proj(x) / x.shape[-1] ** 0.25 for x in (x0, x1))
    similarity = (y0 @ y1.transpose(1, 2)).float()
    certainty = logsigmoid(head.matchability(x0).float()) + logsigmoid(head.matchability(x1).float()).transpose(1, 2)
    # A padded keypoint's own column is all -inf after the first softmax, whatever the second makes of it.
    over_second = log_softmax(similarity.masked_fill(~mask[:, None], -torch.inf), 2)
    probabilities: Tensor = over_second + log_softmax(similarity, 1) + certainty
    return probabilities


def _mutual_best(log_probabilities: Tensor) -> tuple[Tensor, Tensor]:
    """Of (K, N, M), each row's best column (K, N), and its probability, or 0 if the row is not that column's best."""
    best, column = log_probabilities.max(2)
    row_of_column = log_probabilities.argmax(1)
    rows = torch.arange(column.shape[1], device=column.device)
    mutual = row_of_column.gather(1, column) == rows
    return column, torch.where(mutual, best.exp(), 0.0)


class LightGlueMatching:
    """Matches a query with its references by LightGlue, see correspond.QueryMatching.

    Args:
        network: with its weights.
        device: "cpu" or a CUDA device.
        options: None takes those for the device.
    """

    def __init__(self, network: LightGlue, device: str = "cpu", options: LightGlueOptions | None = None) -> None:
        self._device = torch.device(device)
        self.options = options or (CUDA_OPTIONS if self._device.type == "cuda" else CPU_OPTIONS)
        self._network = network.to(self._device).eval()

    def match(self, query: View, references: Sequence[PosedView], check: Callable[[], None]) -> Sequence[Matches]:
        """See correspond.QueryMatching.match. Calls `check` before each batch."""
        matches = [NOTHING] * len(references)
        filled = [i for i, r in enumerate(references) if len(r.view.features)] if len(query.features) else []
        for start in range(0, len(filled), self.options.pairs_at_once):
            check()
            batch = filled[start : start + self.options.pairs_at_once]
            for i, found in zip(batch, self._halving(query, [references[i].view for i in batch]), strict=True):
                matches[i] = found
        return matches

    def _halving(self, query: View, references: Sequence[View]) -> list[Matches]:
        """Matches; where the device's memory does not hold them all, half and half, once."""
        try:
            return self._match(query, references)
        except torch.OutOfMemoryError:
            if len(references) < 2:
                raise
        torch.cuda.empty_cache()
        middle = len(references) // 2
        return self._match(query, references[:middle]) + self._match(query, references[middle:])

    @torch.inference_mode()
    def _match(self, query: View, references: Sequence[View]) -> list[Matches]:
        limit, device = self.options.max_keypoints, self._device
        padded = Padded.of(references, limit)
        arrays = (*Padded.of([query], limit).arrays[:2], *padded.arrays)
        tensors = [torch.from_numpy(array).to(device, non_blocking=True) for array in arrays]
        with torch.autocast(device.type, torch.float16, enabled=self.options.half):
            index, score = self._network(*tensors)
        # One transfer for both: indices are whole numbers below 2^24.
        column, probability = torch.stack([index.float(), score.float()]).cpu().numpy()
        matches = []
        for columns, probabilities in zip(column, probability, strict=True):
            row = np.flatnonzero(probabilities > self.options.min_score)
            matches.append(np.stack([row, columns[row]], axis=1).astype(np.int32))
        return matches


@dataclass(frozen=True, eq=False)
class Padded:
    """Views side by side, as many rows each as the one with most keypoints; zeros after a view's own.

    Attributes:
        positions: (K, M, 2) float32, see `normalized_positions`.
        descriptors: (K, M, D) float32.
        mask: (K, M) which rows are keypoints.
    """

    positions: NDArray[np.float32]
    descriptors: NDArray[np.float32]
    mask: NDArray[np.bool_]

    @property
    def arrays(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
        """In the order that the network takes them."""
        return self.positions, self.descriptors, self.mask

    @classmethod
    def of(cls, views: Sequence[View], max_keypoints: int) -> Padded:
        """Of views with the same kind of descriptor, the first `max_keypoints` keypoints each."""
        counts = [min(len(v.features), max_keypoints) for v in views]
        shape = (len(views), max(counts))
        positions = np.zeros((*shape, 2), np.float32)
        descriptors = np.zeros((*shape, views[0].features.descriptors.shape[1]), np.float32)
        for i, (view, count) in enumerate(zip(views, counts, strict=True)):
            positions[i, :count] = normalized_positions(view.features, view.camera)[:count]
            descriptors[i, :count] = view.features.descriptors[:count]
        return cls(positions, descriptors, np.arange(shape[1]) < np.array(counts)[:, None])


def normalized_positions(features: Features, camera: Camera) -> NDArray[np.float32]:
    """(N, 2): from the middle of the image, in halves of its longer side, as the authors do."""
    size = np.array([camera.width_px, camera.height_px], np.float32)
    return np.asarray((features.keypoints - size / 2) / (size.max() / 2), np.float32)


def load_lightglue(features: str, weights: Path) -> LightGlue:
    """The network that matches an extractor's features, with the authors' weights.

    Args:
        features: "aliked" or "superpoint".
        weights: safetensors file; for ALIKED with the names of the authors' checkpoint, for SuperPoint with those of
            transformers.

    Raises:
        ValueError: there is no LightGlue for these features.
        CheckpointError: the weights do not fit.
    """
    if features == "aliked":
        network = LightGlue(input_dim=128)
        load_strictly(network, weights, optional={})
        return network
    if features == "superpoint":
        from .superpoint_lightglue import load_superpoint_lightglue

        return load_superpoint_lightglue(weights)
    raise ValueError(f"there is no LightGlue for features {features!r}: only for aliked and superpoint")
