"""Matching by LightGlue, a network that compares all keypoints of both photographs (see `networks.lightglue`)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from mapless.geometry import Camera
from mapless_server.networks.lightglue import LightGlue

from .lightglue_options import CONFIDENCES, CPU_OPTIONS, CUDA_OPTIONS, LightGlueOptions
from .views import Features, Matches, PosedView, View

NOTHING: Matches = np.empty((0, 2), np.int32)


class LightGlueMatching:
    """Matches photographs by LightGlue, see `QueryMatching` and `PairMatching`.

    The device is "cpu" or a CUDA device, by which options are chosen if None are given; the weights' hash is a part of
    the name.
    """

    def __init__(
        self, network: LightGlue, device: str = "cpu", options: LightGlueOptions | None = None, sha256: str = ""
    ) -> None:
        self._device = torch.device(device)
        self.options = options or (CUDA_OPTIONS if self._device.type == "cuda" else CPU_OPTIONS)
        self.name = self.options.label(sha256)
        self._network = network.to(self._device).eval()

    def match(self, query: View, references: Sequence[PosedView], check: Callable[[], None]) -> Sequence[Matches]:
        """See correspond.QueryMatching.match. Calls `check` before each batch."""
        matches = [NOTHING] * len(references)
        filled = [i for i, r in enumerate(references) if len(r.view.features)] if len(query.features) else []
        for start in range(0, len(filled), self.options.pairs_at_once):
            check()
            batch = filled[start : start + self.options.pairs_at_once]
            for i, found in zip(batch, self._match_or_halve(query, [references[i].view for i in batch]), strict=True):
                matches[i] = found
        return matches

    @torch.inference_mode()
    def match_one(self, first: View, second: View, pause: Callable[[], None] = lambda: None) -> Matches:
        """See correspond.PairMatching."""
        if not len(first.features) or not len(second.features):
            return NOTHING
        with torch.autocast(self._device.type, torch.float16, enabled=self.options.half):
            found = self._network.match_one(self._inputs(first), self._inputs(second), *CONFIDENCES, pause)
        index, score = (it.cpu().numpy() for it in found)
        return self._probable(index, score)

    def _inputs(self, view: View) -> tuple[torch.Tensor, torch.Tensor]:
        """Positions (1, N, 2) and descriptors (1, N, D) of the strongest keypoints."""
        padded = Padded.of([view], self.options.max_keypoints)
        positions, descriptors = (
            torch.from_numpy(it).to(self._device) for it in (padded.positions, padded.descriptors)
        )
        return positions, descriptors

    def _match_or_halve(self, query: View, references: Sequence[View]) -> list[Matches]:
        """Matches in one batch, or in two halves if the device runs out of memory."""
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
        if self.options.pairs_at_once == 1:
            return [self.match_one(query, reference) for reference in references]
        limit, device = self.options.max_keypoints, self._device
        ours, theirs = Padded.of([query], limit), Padded.of(references, limit)
        arrays = ours.positions, ours.descriptors, theirs.positions, theirs.descriptors, theirs.mask
        position, descriptor, positions, descriptors, mask = (
            torch.from_numpy(array).to(device, non_blocking=True) for array in arrays
        )
        with torch.autocast(device.type, torch.float16, enabled=self.options.half):
            index, score = self._network(position, descriptor, positions, descriptors, mask)
        # One transfer for both: indices are whole numbers below 2^24.
        column, probability = torch.stack([index.float(), score.float()]).cpu().numpy()
        return [self._probable(*row) for row in zip(column, probability, strict=True)]

    def _probable(self, index: NDArray[np.generic], score: NDArray[np.floating]) -> Matches:
        row = np.flatnonzero(score > self.options.min_score)
        return np.stack([row, index[row]], axis=1).astype(np.int32)


@dataclass(frozen=True, eq=False)
class Padded:
    """A batch of views, padded with zeros to the largest number of keypoints.

    Attributes:
        positions: (K, M, 2) float32, see `normalized_positions`.
        descriptors: (K, M, D) float32.
        mask: (K, M) which rows are keypoints.
    """

    positions: NDArray[np.float32]
    descriptors: NDArray[np.float32]
    mask: NDArray[np.bool_]

    @classmethod
    def of(cls, views: Sequence[View], max_keypoints: int) -> "Padded":
        """Pads views that have the same kind of descriptor; uses the first `max_keypoints` keypoints of each."""
        counts = [min(len(v.features), max_keypoints) for v in views]
        shape = (len(views), max(counts))
        positions = np.zeros((*shape, 2), np.float32)
        descriptors = np.zeros((*shape, views[0].features.descriptors.shape[1]), np.float32)
        for i, (view, count) in enumerate(zip(views, counts, strict=True)):
            positions[i, :count] = normalized_positions(view.features, view.camera)[:count]
            descriptors[i, :count] = view.features.unit_descriptors(slice(count))
        return cls(positions, descriptors, np.arange(shape[1]) < np.array(counts)[:, None])


def normalized_positions(features: Features, camera: Camera) -> NDArray[np.float32]:
    """Positions (N, 2) relative to the image centre, in halves of its longer side, as the authors normalize them."""
    size = np.array([camera.width_px, camera.height_px], np.float32)
    return np.asarray((features.keypoints - size / 2) / (size.max() / 2), np.float32)
