"""The networks of local features, each with the weights of a file: kornia's ALIKED and XFeat, transformers' SuperPoint.

All raise CheckpointError where the weights do not fit, and ImportError where the network's package is not installed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from .checkpoint import load_strictly

if TYPE_CHECKING:  # each package is needed for its own networks only
    from kornia.feature import ALIKED
    from kornia.feature.xfeat import XFeatModel
    from torch import nn
    from transformers import SuperPointConfig, SuperPointForKeypointDetection

DERIVED = {"dkd.hw_grid": None}
"""Computed by kornia, so not in the file of ALIKED's authors."""


def load_aliked(weights: Path, max_keypoints: int = 2048) -> tuple[ALIKED, str]:
    """ALIKED n16 and its weights' identity. It takes the strongest maxima, at most `max_keypoints`, however weak."""
    from kornia.feature import ALIKED

    # A threshold of 0 lets kornia take the strongest maxima. With one it takes any if none is above it.
    network = ALIKED("aliked-n16", max_num_keypoints=max_keypoints, detection_threshold=0.0)
    return network, load_strictly(network, weights, optional=DERIVED)


def load_xfeat(weights: Path) -> tuple[XFeatModel, str]:
    """XFeat and its weights' identity."""
    from kornia.feature.xfeat import XFeatModel

    network = XFeatModel()
    return network, load_strictly(network, weights, optional={})


def load_superpoint(
    weights: Path, config: SuperPointConfig | None = None
) -> tuple[SuperPointForKeypointDetection, str]:
    """SuperPoint and its weights' identity; without a `config` that of the authors' weights."""
    from transformers import SuperPointConfig, SuperPointForKeypointDetection

    network = SuperPointForKeypointDetection(config or SuperPointConfig())
    return network, load_strictly(network, weights, optional={})


LOADERS: Mapping[str, Callable[[Path], tuple[nn.Module, str]]] = {
    "aliked": load_aliked,
    "xfeat": load_xfeat,
    "superpoint": load_superpoint,
}
"""By the features' names."""
