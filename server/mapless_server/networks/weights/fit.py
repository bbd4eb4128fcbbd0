"""Whether a file holds the tensors of the network that takes it; asked where the network's packages are installed."""

from __future__ import annotations

import importlib
from pathlib import Path

from mapless_server.extras import install_hint

from .catalogue import Weights
from .safetensors_header import Header, check_fit


def compare_names(header: Header, weights: Weights, called: str) -> str | None:
    """Compares names and shapes with those of the class that the catalogue names, which must not be empty.

    Args:
        header: of the file.
        weights: what it should be.
        called: the file's name in messages.

    Returns:
        Why they could not be compared; None if they could.

    Raises:
        CheckpointError: they differ.
    """
    module_name, class_name = weights.network.split(":")
    try:
        import torch

        from ..checkpoint import IMAGE_NORMALIZATION, UNUSED, expected_tensors

        network = getattr(importlib.import_module(module_name), class_name)
    except ImportError as error:
        return install_hint(error)
    with torch.device("meta"):
        expected = expected_tensors(network())
    check_fit(header, expected, IMAGE_NORMALIZATION.keys(), UNUSED, f"{called} does not fit {class_name}")
    return None


def try_loading(weights: Weights, file: Path) -> str | None:
    """Loads features or matching as the server does, which also finds numbers that are not finite.

    Returns:
        Why it could not be tried; None if it went well.

    Raises:
        CheckpointError: the file does not fit.
    """
    try:
        if weights.purpose == "features":
            from mapless_server.networks.local_features import LOADERS

            LOADERS[weights.name](file)
        elif weights.purpose == "matching":
            from mapless_server.networks.lightglue import load_lightglue

            load_lightglue(weights.name.removesuffix("-lightglue"), file)
        else:
            return f"no network takes {weights.name}"
    except ImportError as error:
        return install_hint(error)
    return None
