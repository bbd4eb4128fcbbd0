"""VLAD: the local features of a photograph as one vector (Jegou et al. 2010; Arandjelovic and Zisserman 2013).

Each feature's descriptor is projected to its 32 principal components and assigned to the nearest of 32 words. A word's
part of the vector is the sum of the directions from it to its descriptors; so the vector has 1024 numbers. Their signed
square roots reduce the weight of repeated structure. The positions of features do not matter, so a camera that is
turned about its axis gives the same vector.

It takes about 1 ms for 2048 features, and nothing is downloaded.

A vocabulary is the distribution of local descriptors, learned once and shipped, or assumed without data. The shipped
ones were learned from rendered photographs (server/research, measured once); what others give is in
docs/decisions/026-retrieval.md.
"""

import hashlib
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from mapless_server.method.features.extractors import FeatureExtractor
from mapless_server.method.features.views import View

from .index import Vector

Floats = NDArray[np.float32]

WORDS = 32
"""Centroids. With 16 the share above falls from 0.95 to 0.92; 64 gain less than 0.01 and take twice the memory."""

REDUCED = 32
"""Components of a descriptor after its projection; with 16 the share falls to 0.93."""

LEARNED = ("sift", "aliked", "xfeat", "edgepoint2-l64")
"""Kinds of features that a vocabulary is shipped for; each has three arrays in the file, see `Vocabulary`."""

FILE = "vocabularies.npz"
SEED = 20260101


@dataclass(frozen=True, eq=False)
class Vocabulary:
    """The distribution of the descriptors of one kind of features.

    Attributes:
        mean: (d,) mean of the descriptors.
        projection: (d, REDUCED), the directions in which they differ most.
        words: (WORDS, REDUCED), centroids of the projected descriptors.
    """

    mean: Floats
    projection: Floats
    words: Floats

    def __post_init__(self) -> None:
        shapes = (self.mean.shape, self.projection.shape, self.words.shape)
        if shapes != (self.mean.shape[:1], (*self.mean.shape[:1], REDUCED), (WORDS, REDUCED)):
            raise ValueError(f"mean, projection and words of shapes {shapes} do not fit")

    def digest(self) -> str:
        """Eight hexadecimal digits of its content."""
        digest = hashlib.sha256()
        for array in (self.mean, self.projection, self.words):
            digest.update(np.ascontiguousarray(array, "<f4").tobytes())
        return digest.hexdigest()[:8]


@lru_cache
def shipped(kind: str) -> Vocabulary | None:
    """Loads the vocabulary of a kind of features; None if there is none."""
    if kind not in LEARNED:
        return None
    with files(__package__).joinpath(FILE).open("rb") as file, np.load(file) as arrays:
        parts = (arrays[f"{kind}_{part}"].astype(np.float32) for part in ("mean", "projection", "words"))
        return Vocabulary(*parts)


@lru_cache
def dataless(dimension: int) -> Vocabulary:
    """Makes a vocabulary for unit descriptors of any kind, assumed to point anywhere, from seeded random numbers."""
    random = np.random.default_rng([SEED, dimension])
    projection = random.standard_normal((dimension, REDUCED)) / np.sqrt(dimension)
    # Centroids of evenly distributed descriptors are close to the mean; their directions distinguish the cells.
    words = random.standard_normal((WORDS, REDUCED))
    words *= 0.5 / np.linalg.norm(words, axis=1, keepdims=True)
    arrays = (np.zeros(dimension), projection, words)
    return Vocabulary(*(array.astype(np.float32) for array in arrays))


def nearest_words(points: NDArray[np.floating], words: NDArray[np.floating]) -> NDArray[np.intp]:
    """Index of the nearest of W words (W, REDUCED) for each of N points (N, REDUCED)."""
    return np.asarray((points @ words.T - 0.5 * (words * words).sum(axis=1)).argmax(axis=1))


RULE = 1
"""Version of the computation; part of the name."""

DIMENSION = WORDS * REDUCED


class VladDescriptor:
    """VLAD of one extractor's features, with the vocabulary of their kind, or with one made without data.

    Without a shipped vocabulary (SuperPoint, whose weights were not available; variants of EdgePoint2 that `auto` does
    not use) three times as many of the first ten references show something else; see the module.

    Attributes:
        name: for example "vlad-1-0123abcd-sift-2048-1024px-0.02": version, vocabulary, extractor.
        dimension, extractor: see `GlobalDescriptor`.
    """

    def __init__(self, extractor: str, vocabulary: Vocabulary | None) -> None:
        """`extractor` is its name; without a vocabulary, one is made for the length of its descriptors."""
        used = "dataless" if vocabulary is None else vocabulary.digest()
        self.name = f"vlad-{RULE}-{used}-{extractor}"
        self.dimension = DIMENSION
        self.extractor: str | None = extractor
        self._vocabulary = vocabulary

    @staticmethod
    def of(extractor: FeatureExtractor) -> "VladDescriptor":
        """Makes the descriptor with the shipped vocabulary of the features, whose kind begins the extractor's name."""
        kind = next((it for it in LEARNED if extractor.name.startswith(f"{it}-")), "")
        return VladDescriptor(extractor.name, shipped(kind))

    def describe(self, view: View) -> Vector:
        """See GlobalDescriptor.describe; ValueError if the features are of another kind than the vocabulary."""
        descriptors = view.features.unit_descriptors()
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
    """Computes the vector (DIMENSION,), unit length, of descriptors (N, d); zeros if each of them is a word."""
    points = (descriptors - vocabulary.mean) @ vocabulary.projection
    nearest = nearest_words(points, vocabulary.words)
    residuals = points - vocabulary.words[nearest]
    residuals /= np.maximum(np.linalg.norm(residuals, axis=1, keepdims=True), 1e-9)
    members = (nearest == np.arange(WORDS)[:, None]).astype(np.float32)
    sums = (members @ residuals).ravel()
    powered = np.sign(sums) * np.sqrt(np.abs(sums))
    return np.asarray(powered / max(float(np.linalg.norm(powered)), 1e-9), np.float32)
