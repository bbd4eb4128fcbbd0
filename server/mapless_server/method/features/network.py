"""Common to the learned extractors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ..options import check_bounds


@dataclass(frozen=True)
class LearnedOptions:
    """Options of a learned extractor.

    Attributes:
        max_keypoints: the strongest are kept; matching is quadratic in it.
        max_side_px: longer images are reduced to it; the size of the networks' training and publication.
        min_score: weaker keypoints are dropped; the extractor's docstring gives the range of its scores.
    """

    max_keypoints: int = 2048
    max_side_px: int = 1024
    min_score: float = 0.01

    def __post_init__(self) -> None:
        check_bounds(self, "max_keypoints", at_least=1)
        check_bounds(self, "max_side_px", at_least=32)
        check_bounds(self, "min_score", at_least=0, below=1)

    def label(self, extractor: str, weights_sha256: str) -> str:
        """The name under which features are stored, e.g. "aliked-n16-2048-1024px-0.01-c2ab3d81"."""
        return f"{extractor}-{self.max_keypoints}-{self.max_side_px}px-{self.min_score:g}-{weights_sha256[:8]}"


def image_tensor(image: NDArray[np.uint8], device: torch.device) -> torch.Tensor:
    """(1, C, H, W) float32 in 0 to 1 of an image (H, W) or (H, W, 3)."""
    pixels = image[..., None] if image.ndim == 2 else image
    # Transferred as bytes, a quarter of the size of floats.
    return torch.from_numpy(np.ascontiguousarray(pixels)).to(device).permute(2, 0, 1)[None].float() / 255


def array_of(tensor: torch.Tensor) -> NDArray[np.float32]:
    """The tensor as float32 on the host."""
    return np.asarray(tensor.float().cpu().numpy(), np.float32)
