"""VLAD: the local features of a photograph as one vector (Jegou et al. 2010; Arandjelovic and Zisserman 2013).

Each feature's descriptor is projected to its 32 principal numbers and goes to the nearest of 32 words. A word's part of
the vector is the sum of the directions from it to the descriptors that went to it; so the vector has 1024 numbers. The
square roots of them, signs kept, bring repeated structure down to size. Where in the photograph a feature lies does not
matter, so a camera that is turned about its axis sees the same.

It costs about 1 ms for 2048 features, and nothing is downloaded. Vocabularies are in `vocabulary`.
"""

from __future__ import annotations

import numpy as np

from mapless_server.method.features import FeatureExtractor
from mapless_server.method.views import View

from .descriptor import Vector
from .vocabulary import REDUCED, WORDS, Vocabulary, dataless, nearest_words, shipped

RULE = 1
"""Raised by every change of what is made of features and vocabulary: it is part of the name."""

DIMENSION = WORDS * REDUCED


class VladDescriptor:
    """VLAD of one extractor's features, with the vocabulary of their kind, or with one that needs no data.

    Without a shipped vocabulary (SuperPoint, whose weights were not to be had) three times as many of the first ten
    references see something else; see `vocabulary`.
    """

    def __init__(self, extractor: str, vocabulary: Vocabulary | None) -> None:
        """Of the extractor of that name; without a vocabulary one is made for the length of its descriptors."""
        self._extractor = extractor
        self._vocabulary = vocabulary

    @staticmethod
    def of(extractor: FeatureExtractor) -> VladDescriptor:
        """With the vocabulary that is shipped for the kind of features, which the extractor's name begins with."""
        return VladDescriptor(extractor.name, shipped(extractor.name.split("-")[0]))

    @property
    def name(self) -> str:
        """E.g. "vlad-1-0123abcd-sift-2048-1024px-0.02": rule, vocabulary, extractor."""
        vocabulary = "dataless" if self._vocabulary is None else self._vocabulary.digest()
        return f"vlad-{RULE}-{vocabulary}-{self._extractor}"

    @property
    def dimension(self) -> int:
        """Length of the vectors."""
        return DIMENSION

    @property
    def extractor(self) -> str:
        """Name of the features' extractor."""
        return self._extractor

    def describe(self, view: View) -> Vector:
        """See GlobalDescriptor.describe.

        Raises:
            ValueError: the features are of another kind than the vocabulary.
        """
        descriptors = view.features.descriptors
        if not len(descriptors):
            return np.zeros(DIMENSION, np.float32)
        vocabulary = dataless(descriptors.shape[1]) if self._vocabulary is None else self._vocabulary
        if descriptors.shape[1] != len(vocabulary.mean):
            raise ValueError(
                f"features of {self._extractor} have {descriptors.shape[1]} numbers, the vocabulary's have "
                f"{len(vocabulary.mean)}"
            )
        return vlad(descriptors, vocabulary)


def vlad(descriptors: Vector, vocabulary: Vocabulary) -> Vector:
    """The vector (DIMENSION,), unit length, of descriptors (N, d); zeros if they all are words themselves."""
    points = (descriptors - vocabulary.mean) @ vocabulary.projection
    nearest = nearest_words(points, vocabulary.words)
    residuals = points - vocabulary.words[nearest]
    residuals /= np.maximum(np.linalg.norm(residuals, axis=1, keepdims=True), 1e-9)
    members = (nearest == np.arange(WORDS)[:, None]).astype(np.float32)
    sums = (members @ residuals).ravel()
    powered = np.sign(sums) * np.sqrt(np.abs(sums))
    return np.asarray(powered / max(float(np.linalg.norm(powered)), 1e-9), np.float32)
