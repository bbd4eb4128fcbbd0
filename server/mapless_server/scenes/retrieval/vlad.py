"""VLAD: the local features of a photograph as one vector (Jegou et al. 2010; Arandjelovic and Zisserman 2013).

Each feature's descriptor is projected to its 32 principal components and assigned to the nearest of 32 words. A word's
part of the vector is the sum of the directions from it to its descriptors; so the vector has 1024 numbers. Their signed
square roots reduce the weight of repeated structure. The positions of features do not matter, so a camera that is
turned about its axis gives the same vector.

It takes about 1 ms for 2048 features, and nothing is downloaded. Vocabularies are in `vocabulary`.
"""

from __future__ import annotations

import numpy as np

from mapless_server.method.features import FeatureExtractor
from mapless_server.method.views import View

from .descriptor import Vector
from .vocabulary import LEARNED, REDUCED, WORDS, Vocabulary, dataless, nearest_words, shipped

RULE = 1
"""Version of the computation; part of the name."""

DIMENSION = WORDS * REDUCED


class VladDescriptor:
    """VLAD of one extractor's features, with the vocabulary of their kind, or with one that needs no data.

    Without a shipped vocabulary (SuperPoint, whose weights were not available; variants of EdgePoint2 that `auto` does
    not use) three times as many of the first ten references see something else; see `vocabulary`.

    Attributes:
        name: for example "vlad-1-0123abcd-sift-2048-1024px-0.02": version, vocabulary, extractor.
        dimension, extractor: see `GlobalDescriptor`.
    """

    def __init__(self, extractor: str, vocabulary: Vocabulary | None) -> None:
        """Of the extractor of that name; without a vocabulary one is made for the length of its descriptors."""
        used = "dataless" if vocabulary is None else vocabulary.digest()
        self.name = f"vlad-{RULE}-{used}-{extractor}"
        self.dimension = DIMENSION
        self.extractor: str | None = extractor
        self._vocabulary = vocabulary

    @staticmethod
    def of(extractor: FeatureExtractor) -> VladDescriptor:
        """With the vocabulary that is shipped for the kind of features, which the extractor's name begins with."""
        kind = next((it for it in LEARNED if extractor.name.startswith(f"{it}-")), "")
        return VladDescriptor(extractor.name, shipped(kind))

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
                f"features of {self.extractor} have {descriptors.shape[1]} numbers, the vocabulary's have "
                f"{len(vocabulary.mean)}"
            )
        return vlad(descriptors, vocabulary)


def vlad(descriptors: Vector, vocabulary: Vocabulary) -> Vector:
    """The vector (DIMENSION,), unit length, of descriptors (N, d); zeros if each of them is a word."""
    points = (descriptors - vocabulary.mean) @ vocabulary.projection
    nearest = nearest_words(points, vocabulary.words)
    residuals = points - vocabulary.words[nearest]
    residuals /= np.maximum(np.linalg.norm(residuals, axis=1, keepdims=True), 1e-9)
    members = (nearest == np.arange(WORDS)[:, None]).astype(np.float32)
    sums = (members @ residuals).ravel()
    powered = np.sign(sums) * np.sqrt(np.abs(sums))
    return np.asarray(powered / max(float(np.linalg.norm(powered)), 1e-9), np.float32)
