"""The common parts of the extractors that torch computes: tensors, and maxima of score maps."""

from functools import reduce

import numpy as np
import torch
from numpy.typing import NDArray


def image_tensor(image: NDArray[np.uint8], device: torch.device) -> torch.Tensor:
    """Converts an image (H, W) or (H, W, 3) to a tensor (1, C, H, W), float32 in 0 to 1."""
    pixels = image[..., None] if image.ndim == 2 else image
    # Transferred as bytes, a quarter of the size of floats.
    return torch.from_numpy(np.ascontiguousarray(pixels)).to(device).permute(2, 0, 1)[None].float() / 255


def array_of(tensor: torch.Tensor) -> NDArray[np.float32]:
    """Copies a tensor to the host as float32."""
    return np.asarray(tensor.float().cpu().numpy(), np.float32)


def strict_maxima(scores: torch.Tensor, window_px: int, threshold: float) -> torch.Tensor:
    """Finds pixels (N, 2), x and y, above the threshold and above all others of their window, which lies in the image.

    The scores are a map (H, W); the side of the window is odd.
    """
    margin = window_px // 2
    if min(scores.shape) < window_px:
        return torch.empty((0, 2), dtype=torch.long, device=scores.device)
    # Of shifted copies: a thirtieth of the time of max_pool2d on a CPU.
    beside = _on_both_sides(scores, margin, 1)
    others = _on_both_sides(torch.maximum(beside, scores[:, margin:-margin]), margin, 0)
    others = torch.maximum(others, beside[margin:-margin])
    inner = scores[margin:-margin, margin:-margin]
    return ((inner > others.clamp_(min=threshold)).nonzero() + margin).flip(1)


def among_usable(pixels: torch.Tensor, usable: NDArray[np.bool_]) -> torch.Tensor:
    """Those of whole pixels (N, 2), x and y, that are usable, (H, W)."""
    chosen = torch.from_numpy(usable).to(pixels.device)[pixels[:, 1], pixels[:, 0]]
    return pixels[chosen]


def _on_both_sides(x: torch.Tensor, margin: int, axis: int) -> torch.Tensor:
    """Largest of the `margin` numbers before and the `margin` after each that has so many, along an axis."""
    count = x.shape[axis] - 2 * margin
    runs = reduce(torch.maximum, [x.narrow(axis, i, count + margin + 1) for i in range(margin)])
    return torch.maximum(runs.narrow(axis, 0, count), runs.narrow(axis, margin + 1, count))


def peaks(heights: torch.Tensor, pixels: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Offsets (N, 2) from strict maxima to the peaks of parabolas through their neighbours, at most half a pixel.

    Also the second derivatives (N, 2) of the parabolas, which are negative. The heights are a map (H, W), for example
    of scores or logits; the maxima, x and y, are not at the border.
    """
    x, y = pixels.unbind(1)
    here = heights[y, x]
    left, right, above, below = heights[y, x - 1], heights[y, x + 1], heights[y - 1, x], heights[y + 1, x]
    slopes = torch.stack([right - left, below - above], dim=1) / 2
    curvatures = torch.stack([left + right - 2 * here, above + below - 2 * here], dim=1)
    return -slopes / curvatures, curvatures
