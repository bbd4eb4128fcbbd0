"""Descriptors as whole numbers of 8 bits: rows, and the inverse norms that turn products into similarities.

Rows take a quarter of float32's memory, and similarities change by less than 0.002.
"""

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float32]
"""(D,) of unit length, so that a dot product is a similarity, -1 to 1; zeros for a view without features."""

CHUNK_BYTES = 1 << 20
"""Bytes of float32 that are converted at a time, so that they fit a core's cache."""

_LARGEST = 127


def quantized(vectors: NDArray[np.float32]) -> tuple[NDArray[np.int8], NDArray[np.float32]]:
    """Quantizes vectors (N, D), each to a 127th of its largest number: rows (N, D) and inverse norms (N,).

    A vector of zeros has the inverse norm 0.
    """
    largest = np.abs(vectors).max(axis=1, initial=0.0).astype(np.float64)
    is_zero = ~(largest > 0)
    scales = (_LARGEST / np.where(is_zero, 1.0, largest)).astype(np.float32)
    steps = np.rint(vectors * scales[:, None])
    steps[is_zero] = 0.0
    norms = np.linalg.norm(steps, axis=1).astype(np.float64)
    inverse = np.where(is_zero, 0.0, 1 / np.where(is_zero, 1.0, norms))
    return steps.astype(np.int8), inverse.astype(np.float32)


def products(rows: NDArray[np.int8], vector: Vector, chosen: NDArray[np.intp] | None = None) -> NDArray[np.float32]:
    """Products (N,) of a vector (D,) with rows (N, D), or with those of them that are chosen (N,)."""
    found = np.empty(len(rows if chosen is None else chosen), np.float32)
    step = max(1, CHUNK_BYTES // (4 * len(vector)))
    chunk = np.empty((step, len(vector)), np.float32)
    for start in range(0, len(found), step):
        part = chunk[: len(found) - start]
        at = slice(start, start + step)
        part[:] = rows[at] if chosen is None else rows[chosen[at]]
        np.dot(part, vector, out=found[at])
    return found
