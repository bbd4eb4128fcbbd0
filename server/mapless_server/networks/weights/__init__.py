"""Weights of networks: their catalogue and folder, fetching and checking. Imports no torch."""

from .catalogue import CATALOGUE, Weights, named
from .errors import CheckpointError, FetchError, FolderError, UnknownWeights, WeightsError, WeightsMissing
from .folder import find_weights

__all__ = [
    "CATALOGUE",
    "CheckpointError",
    "FetchError",
    "FolderError",
    "UnknownWeights",
    "Weights",
    "WeightsError",
    "WeightsMissing",
    "find_weights",
    "named",
]
