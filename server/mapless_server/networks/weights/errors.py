"""Errors of weights; every message is one sentence for the operator."""


class WeightsError(Exception):
    """Base of all errors of weights."""


class UnknownWeights(WeightsError):
    """There are no weights of this name; the message lists the known names."""


class WeightsMissing(WeightsError):
    """Weights are not in the folder; the message names the command that fetches them."""


class CheckpointError(WeightsError):
    """A file of weights cannot be used."""


class FetchError(WeightsError):
    """Weights could not be fetched; the message describes how to add them by hand."""


class LicenceNotAccepted(WeightsError):
    """The terms were not accepted, or there was no terminal to accept them."""


class FolderError(WeightsError):
    """The weights folder cannot be written, or the path of a file is not a file."""
