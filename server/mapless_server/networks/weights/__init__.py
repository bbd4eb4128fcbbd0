"""Weights of networks: their catalogue and folder, fetching and checking. Imports no torch."""

from .catalogue import (
    CATALOGUE,
    CheckpointError,
    FetchError,
    FolderError,
    UnknownWeights,
    WeightsError,
    WeightsMissing,
    named,
)
from .folder import find_weights
