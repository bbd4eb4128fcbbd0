"""The networks of local features, each with the weights of a file.

EdgePoint2 is our own; ALIKED and XFeat are kornia's, SuperPoint is that of transformers. All raise CheckpointError
where the weights do not fit, and ImportError where the network's package is not installed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from .checkpoint import load_strictly

if TYPE_CHECKING:  # each package is needed for its own networks only
    from kornia.feature import ALIKED
    from kornia.feature.xfeat import XFeatModel
    from torch import nn
    from transformers import SuperPointConfig, SuperPointForKeypointDetection

    from .edgepoint2 import EdgePoint2

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


def load_edgepoint2(variant: str, weights: Path) -> tuple[EdgePoint2, str]:
    """EdgePoint2 of a variant ("s64", "m64", "l64", "e64") and its weights' identity."""
    from .edgepoint2 import VARIANTS, EdgePoint2

    network = EdgePoint2(VARIANTS[variant])
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
    **{f"edgepoint2-{variant}": partial(load_edgepoint2, variant) for variant in ("s64", "m64", "l64", "e64")},
    "superpoint": load_superpoint,
}
"""By the features' names."""
