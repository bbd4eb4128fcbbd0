"""The matcher of each kind of features."""

from pathlib import Path
from typing import TYPE_CHECKING

from ..features.matching import OPTIONS
from .correspond import Matcher

if TYPE_CHECKING:
    from ..features.lightglue import LightGlueMatching


def make_matcher(
    features: str,
    threads: int = 1,
    weights: Path | None = None,
    device: str = "cpu",
) -> Matcher:
    """Makes the matcher for an extractor.

    Args:
        features: one of `OPTIONS`.
        threads: number of threads that a query's pairs are distributed over.
        weights: weights of the features' LightGlue; None takes nearest neighbours alone. On a CUDA device LightGlue
            matches the query; on a CPU, where it is slow, it is the `Matcher.pair_matching`.
        device: "cpu" or a CUDA device, for LightGlue.

    Raises:
        ValueError: unknown name, or features without a LightGlue.
        CheckpointError: the weights do not fit.
        ImportError: a package that LightGlue needs is not installed.
    """
    if features not in OPTIONS:
        raise ValueError(f"unknown features {features!r}; known: {', '.join(OPTIONS)}")
    if weights is None:
        return Matcher(OPTIONS[features], threads)
    light_glue = make_light_glue(features, weights, device)
    if device == "cpu":
        return Matcher(OPTIONS[features], threads, pair_matching=light_glue)
    return Matcher(OPTIONS[features], threads, light_glue)


def make_light_glue(features: str, weights: Path, device: str = "cpu") -> "LightGlueMatching":
    """Makes the LightGlue of an extractor; errors as in `make_matcher`."""
    from mapless_server.networks.lightglue import load_lightglue

    from ..features.lightglue import LightGlueMatching

    network, sha256 = load_lightglue(features, weights)
    return LightGlueMatching(network, device, sha256=sha256)
