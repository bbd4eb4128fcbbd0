"""The paper's global descriptor: MegaLoc on the photograph's pixels, reduced to 1056 numbers.

MegaLoc gives 8448 numbers. As float16 that is 17 KB a reference, 1.7 GB for 100,000 and 17 GB for a million, and exact
search reads all of it for every query. So descriptors are reduced to 1056 by random sums of eight (`MegaLoc.reduce`):
2.1 KB, 0.2 GB, 2.1 GB. A similarity s then has an error around zero with a standard deviation of
(1 - s^2) / sqrt(1056): 0.02 at s = 0.6, 0.003 at 0.95; float16 adds 0.00002. It swaps references that are about equally
good, as thinning by distance does, too. It needs no data, and the network's largest layer shrinks by the same factor of
eight: 0.42 GB of weights instead of 0.91.
"""

import logging
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812  its usual name
from torch import Tensor

from mapless_server.method.features.views import View
from mapless_server.networks.blocks import Attention
from mapless_server.networks.checkpoint import load_strictly
from mapless_server.networks.megaloc import MegaLoc, MegaLocSizes

from .index import Vector

log = logging.getLogger(__name__)

SIDE_PX = 322
"""Photographs are resized to squares of this side: what the network was published and measured with."""

_BAND_ROWS = 64
"""Rows that are converted to floating-point at a time: 3 MB of a photograph that is 4000 px wide."""

_VERSION = 1
"""Version of the computation; part of the name."""
DIMENSION = 1056
"""Length of the vectors, a divisor of 8448, the network's own; the module explains this one."""


class MegaLocDescriptor:
    """A `GlobalDescriptor`; safe to use from several threads. Any photograph has a vector, a blank wall too.

    Attributes:
        name: e.g. "megaloc-1056-322px-d4f9f2bc-1"; the letters are the beginning of the weights' SHA-256.
        dimension: length of the vectors.
        extractor: None, since it uses pixels.
        dtype: type of the transformer's computation.

    Args:
        weights: safetensors file, the names of the authors' checkpoint.
        device: "cpu" or a CUDA device.
        sizes: sizes of the network; None for those of the authors' weights.
        dimension: see `DIMENSION`.
        dtype: None for bfloat16 on a CUDA device with flash attention, else float32. Not part of the name, so that
            servers with and without a GPU can share references: it changes similarities by a thousandth of what they
            differ by among photographs of one scene (random weights).

    Raises:
        CheckpointError: the weights do not fit.
        ValueError: the dimension does not divide the network's own.
    """

    extractor: str | None = None

    def __init__(
        self,
        weights: Path,
        device: str = "cpu",
        sizes: MegaLocSizes | None = None,
        dimension: int = DIMENSION,
        dtype: torch.dtype | None = None,
    ) -> None:
        self._device = torch.device(device)
        self.dtype = dtype or _best_dtype(self._device)
        with torch.device("meta"):
            self._network = MegaLoc(sizes)
        sha256 = load_strictly(self._network, weights, optional={})
        self._network.reduce(dimension)
        self._network.set_compute_type(self.dtype)
        self._network.to(self._device).eval().requires_grad_(False)
        self.dimension = self._network.length
        self.name = f"megaloc-{self.dimension}-{SIDE_PX}px-{sha256[:8]}-{_VERSION}"

    @torch.inference_mode()
    def describe(self, view: View) -> Vector:
        """See GlobalDescriptor.describe.

        ValueError if the view has no photograph; RequestError if the photograph cannot be read.
        """
        vector: Vector = self._network(_picture(view)[None].to(self._device))[0].cpu().numpy()
        return vector


def _picture(view: View) -> Tensor:
    """Resizes the upright photograph to a square (3, SIDE_PX, SIDE_PX), float32 in [0, 1]: bilinear with antialiasing.

    It is resized horizontally first, some rows at a time, then vertically. Both at once give the same bits in three
    times the time, and need a float copy of the whole photograph, four times its size.
    """
    if view.photograph is None:
        raise ValueError("MegaLoc uses pixels, and the view has no photograph")
    upright = np.rot90(view.photograph.read(), -round(view.upright_deg / 90))
    pixels = torch.from_numpy(np.ascontiguousarray(upright)).permute(2, 0, 1)[None]
    bands = [_resized(band.float(), (band.shape[2], SIDE_PX)) for band in pixels.split(_BAND_ROWS, dim=2)]
    return _resized(torch.cat(bands, dim=2), (SIDE_PX, SIDE_PX))[0] / 255


def _resized(images: Tensor, size: tuple[int, int]) -> Tensor:
    return F.interpolate(images, size, mode="bilinear", antialias=True, align_corners=False)


def _best_dtype(device: torch.device) -> torch.dtype:
    if device.type != "cuda":
        return torch.float32
    token = torch.ones(1, 1, 1, 64, device=device, dtype=torch.bfloat16)
    try:
        Attention.attend(token, token, token)
    except RuntimeError as error:
        log.warning("retrieval megaloc: in float32, since there is no flash attention on %s: %s", device, error)
        return torch.float32
    return torch.bfloat16
