"""Local features: extractors turn a photograph into a view, a pinhole camera with keypoints and descriptors.

One file per extractor. Features are stored with the reference under the extractor's name, so anything that changes the
features must change the name. The learned extractors import torch, only when they are made.
"""

from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Camera
from mapless_server.choices import EDGEPOINT2, FEATURES

from ..views import Ignored, View
from .sift import SiftExtractor, SiftOptions

__all__ = [
    "FEATURES",
    "FeatureExtractor",
    "KeepsMemory",
    "Mirrors",
    "SiftExtractor",
    "SiftOptions",
    "make_extractor",
]


class FeatureExtractor(Protocol):
    """Finds local features."""

    @property
    def name(self) -> str:
        """Identifies the extractor and everything that changes its output; the key of stored features."""
        ...

    def extract(self, image: NDArray[np.uint8], camera: Camera, ignored: Ignored | None = None) -> View:
        """The view of a photograph, (H, W, 3) uint8 RGB as stored in the file, possibly without keypoints.

        The camera has the same size; `ignored` are pixels, at any size, near which no feature is found, see `masks`.
        """
        ...


@runtime_checkable
class KeepsMemory(Protocol):
    """Keeps memory for the next photograph."""

    def release_memory(self) -> None:
        """Gives it back; the next photograph gets it again. Thread-safe."""
        ...


@runtime_checkable
class Mirrors(Protocol):
    """Knows the features of a photograph's mirror image from those of the photograph."""

    def mirrored(self, view: View) -> View:
        """The view with the descriptors of the mirror image at the same pixels."""
        ...


def make_extractor(name: str, weights: Path | None = None, device: str = "cpu") -> FeatureExtractor:
    """Makes the extractor of a kind of `FEATURES`, for networks with a file of weights and "cpu" or a CUDA device.

    ValueError for an unknown name, or missing weights; CheckpointError if they do not fit; ImportError if a package
    that the network needs is not installed.
    """
    if name == "sift":
        return SiftExtractor()
    if name not in FEATURES:
        raise ValueError(f"unknown features {name!r}; known: {', '.join(FEATURES)}")
    if weights is None:
        raise ValueError(f"features {name!r} need their network's weights")
    if name in EDGEPOINT2:
        from .edgepoint2 import EdgePoint2Extractor

        return EdgePoint2Extractor(name.removeprefix("edgepoint2-"), weights, device)
    if name == "aliked":
        from .aliked import AlikedExtractor

        return AlikedExtractor(weights, device)
    if name == "xfeat":
        from .xfeat import XfeatExtractor

        return XfeatExtractor(weights, device)
    from .superpoint import SuperPointExtractor

    return SuperPointExtractor(weights, device)
