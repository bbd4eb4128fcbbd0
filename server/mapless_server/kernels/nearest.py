"""The nearest of many descriptors of int8 by their cosines, from either side, where the processor has AVX512-VNNI.

It takes a third of the time of float32 by BLAS. Sums of products of whole numbers are exact in both, so results are the
same to the last bit. The plain version is in `method.features.matching`, for descriptors of all kinds.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

try:
    from . import _nearest
except ImportError:  # not compiled
    _IS_FAST = False
else:
    _IS_FAST = _nearest.is_fast()


@dataclass(frozen=True, eq=False)
class Nearest:
    """The two largest cosines of each of N descriptors with M others, and of each of these; -2 without another.

    Attributes:
        column: (N,) index of the nearest of the others; the first of equal ones.
        best: (N,) its cosine.
        second_best: (N,) the cosine of the second-nearest.
        best_of_column: (M,) largest cosine of each of the others.
        second_of_column: (M,) second-largest cosine of each of the others.
    """

    column: NDArray[np.int32]
    best: NDArray[np.float32]
    second_best: NDArray[np.float32]
    best_of_column: NDArray[np.float32]
    second_of_column: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Whole:
    """Descriptors of int8.

    Attributes:
        numbers: (N, D) int8.
        inverse_lengths: (N,) float32.
    """

    numbers: NDArray[np.int8]
    inverse_lengths: NDArray[np.float32]


def is_available(length: int) -> bool:
    """Whether `nearest` computes with descriptors of so many numbers here."""
    return _IS_FAST and length % 4 == 0


def nearest(first: Whole, second: Whole) -> Nearest:
    """The nearest of each by (a b inverse_length_b) inverse_length_a, rounded as float32 in this order.

    ValueError if the numbers of rows or their lengths do not fit, or where it is not available.
    """
    if not is_available(first.numbers.shape[1]):
        raise ValueError(f"descriptors of {first.numbers.shape[1]} numbers are not compared by compiled code here")
    rows, columns = len(first.numbers), len(second.numbers)
    best, second_best = np.empty((2, rows), np.float32)
    best_of_column, second_of_column = np.empty((2, columns), np.float32)
    found = Nearest(np.empty(rows, np.int32), best, second_best, best_of_column, second_of_column)
    _nearest.nearest(
        first.numbers.shape[1],
        np.ascontiguousarray(first.numbers),
        np.ascontiguousarray(second.numbers),
        np.ascontiguousarray(first.inverse_lengths),
        np.ascontiguousarray(second.inverse_lengths),
        found.column,
        found.best,
        found.second_best,
        found.best_of_column,
        found.second_of_column,
    )
    return found
