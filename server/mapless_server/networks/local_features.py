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
    """Loads ALIKED n16, with its weights' SHA-256; it finds the `max_keypoints` strongest maxima, however weak."""
    from kornia.feature import ALIKED

    # A threshold of 0 lets kornia take the strongest maxima. With one it takes any if none is above it.
    network = ALIKED("aliked-n16", max_num_keypoints=max_keypoints, detection_threshold=0.0)
    return network, load_strictly(network, weights, optional=DERIVED)


def load_xfeat(weights: Path) -> tuple[XFeatModel, str]:
    """Loads XFeat, with its weights' SHA-256."""
    from kornia.feature.xfeat import XFeatModel

    network = XFeatModel()
    return network, load_strictly(network, weights, optional={})


def load_edgepoint2(variant: str, weights: Path) -> tuple[EdgePoint2, str]:
    """Loads a variant of EdgePoint2 ("s64", "m64", "l64", "e64"), with its weights' SHA-256."""
    from .edgepoint2 import EdgePoint2
    from .edgepoint2_sizes import VARIANTS

    network = EdgePoint2(VARIANTS[variant])
    return network, load_strictly(network, weights, optional={})


def load_superpoint(
    weights: Path, config: SuperPointConfig | None = None
) -> tuple[SuperPointForKeypointDetection, str]:
    """Loads SuperPoint, with its weights' SHA-256; without a `config`, that of the authors' weights is used."""
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
