"""What can go wrong with weights; every message is one sentence for the operator."""

from __future__ import annotations


class WeightsError(Exception):
    """Base of them all."""


class UnknownWeights(WeightsError):
    """There are no weights of this name; the message lists those there are."""


class WeightsMissing(WeightsError):
    """Weights are not in the folder; the message names the command that brings them."""


class CheckpointError(WeightsError):
    """A file of weights cannot be used."""


class FetchError(WeightsError):
    """Weights could not be fetched; the message has the way to get them by hand."""


class LicenceNotAccepted(WeightsError):
    """The terms were not accepted, or there was no terminal to accept them."""


class FolderError(WeightsError):
    """The weights folder cannot be written, or something else lies where a file should."""
