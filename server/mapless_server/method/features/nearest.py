"""Two photographs: nearest neighbours of their descriptors."""

from collections import deque
from collections.abc import Iterator, Sequence
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from .views import Features, Matches

_ROWS_AT_ONCE = 128
_FLOAT_ROWS_AT_ONCE = 256
"""With 2,000 columns a block of 128 rows has 1 MB, as the second-level cache of a core; BLAS is slower with so few."""


class Arithmetic(Enum):
    """How descriptors of int8 are multiplied; all others are multiplied as float32.

    A server chooses once, see `fastest_arithmetic`; without a choice it is `FLOAT32`. Cosines differ by rounding.
    """

    FLOAT32 = "float32"
    INT8 = "int8"
    """As whole numbers by torch, in half to four fifths of the time where the processor has instructions for that."""


def mutual_matches(
    first: Features,
    second: Features,
    ratio: float,
    either: bool = False,
    arithmetic: Arithmetic = Arithmetic.FLOAT32,
) -> Matches:
    """Mutual nearest neighbours that pass the ratio test from first to second or, if `either`, from second to first.

    Descriptors have unit length, so with cosine s the distance is sqrt(2 - 2 s).
    """
    if either:
        return mutual_matches_of_ratios(first, second, (ratio,), arithmetic)[0]
    if len(first) < 2 or len(second) < 2:
        return np.empty((0, 2), np.int32)
    nearest, best, second_best = np.empty(len(first), np.intp), *np.empty((2, len(first)), np.float32)
    best_of_column, begin = np.full(len(second), -np.inf, np.float32), 0
    for cosines in cosine_blocks(first, second, arithmetic):
        part, rows = slice(begin, begin + len(cosines)), np.arange(len(cosines))
        nearest[part] = cosines.argmax(axis=1)
        best[part] = cosines[rows, nearest[part]]
        np.maximum(best_of_column, cosines.max(axis=0), out=best_of_column)
        cosines[rows, nearest[part]] = -1.0
        second_best[part] = cosines.max(axis=1)
        begin = part.stop
    mutual = best >= best_of_column[nearest]
    keep = np.flatnonzero(mutual & (best > -1.0) & (1 - best < ratio**2 * (1 - second_best)))
    return np.stack([keep, nearest[keep]], axis=1).astype(np.int32)


def mutual_matches_of_ratios(
    first: Features, second: Features, ratios: Sequence[float], arithmetic: Arithmetic = Arithmetic.FLOAT32
) -> list[Matches]:
    """For each ratio, the mutual nearest neighbours that pass the test from either side, of one comparison."""
    if len(first) < 2 or len(second) < 2:
        return [np.empty((0, 2), np.int32) for _ in ratios]
    similarity = np.empty((len(first), len(second)), np.float32)
    deque(cosine_blocks(first, second, arithmetic, similarity), 0)
    return _best_of_both(similarity, ratios, either=True)


def cosine_blocks(
    first: Features,
    second: Features,
    arithmetic: Arithmetic = Arithmetic.FLOAT32,
    whole: NDArray[np.float32] | None = None,
) -> Iterator[NDArray[np.float32]]:
    """Yields the matrix of cosines (N, M) in blocks of rows: of `whole` (N, M), or each overwritten by the next.

    A block fits into the processor's cache.
    """
    is_whole = first.descriptors.dtype == second.descriptors.dtype == np.int8
    exact = arithmetic is Arithmetic.INT8 and is_whole
    rows = _ROWS_AT_ONCE if exact else _FLOAT_ROWS_AT_ONCE
    block = np.empty((min(rows, len(first)), len(second)), np.float32)
    starts = range(0, len(first), rows)
    blocks = (whole[i : i + rows] if whole is not None else block[: len(first) - i] for i in starts)
    if not exact:
        ours, theirs = first.unit_descriptors(), second.unit_descriptors().T
        for i, cosines in zip(starts, blocks, strict=True):
            yield np.matmul(ours[i : i + rows], theirs, out=cosines)
        return
    import torch

    a, b = torch.tensor(first.descriptors), torch.tensor(second.descriptors).T
    inverse, other_inverse = (torch.from_numpy(it.inverse_lengths) for it in (first, second))
    products = torch.empty(block.shape, dtype=torch.int32)
    for i, cosines in zip(starts, blocks, strict=True):
        part = products[: len(cosines)]
        torch._int_mm(a[i : i + rows], b, out=part)
        # Converted first: the product of a whole and a floating-point number takes longer.
        torch.from_numpy(cosines).copy_(part).mul_(other_inverse).mul_(inverse[i : i + rows, None])
        yield cosines


def fastest_arithmetic() -> Arithmetic:
    """Products of int8 where torch has fast and exact ones on this processor, else of float32. Imports torch.

    Without AVX-VNNI or AVX512-VNNI the sums saturate, or are computed one by one, in 20 times the time of float32.
    """
    import torch

    capabilities = torch.cpu.get_capabilities()
    is_fast = capabilities.get("avx512_vnni") or capabilities.get("avx_vnni")
    return Arithmetic.INT8 if is_fast and has_exact_products() else Arithmetic.FLOAT32


def has_exact_products() -> bool:
    """Whether sums of torch's products of int8 do not saturate on this processor. Imports torch."""
    import torch

    largest = torch.full((_ROWS_AT_ONCE, 64), 127, dtype=torch.int8)
    return bool((torch._int_mm(largest, largest.T) == 64 * 127**2).all())


def best_of_both(
    similarity: NDArray[np.float32], ratio: float, smallest: float = -1.0, either: bool = False
) -> Matches:
    """Entries of a matrix of cosines (N, M) that are mutual maxima, above `smallest`, and pass the ratio test by row.

    If `either`, it suffices to pass the ratio test by column. Overwrites the matrix.
    """
    return _best_of_both(similarity, (ratio,), smallest, either)[0]


def _best_of_both(
    similarity: NDArray[np.float32], ratios: Sequence[float], smallest: float = -1.0, either: bool = False
) -> list[Matches]:
    if not similarity.size:
        return [np.empty((0, 2), np.int32) for _ in ratios]
    rows = np.arange(len(similarity))
    nearest = similarity.argmax(axis=1)
    best = similarity[rows, nearest]
    # The maximum of its column too: compared by value, because an argmax along columns takes ten times as long.
    mutual = best >= similarity.max(axis=0)[nearest]
    similarity[rows[mutual], nearest[mutual]] = -1.0
    second_best = similarity.max(axis=1)
    if either:
        mutual &= np.bincount(nearest[mutual], minlength=similarity.shape[1])[nearest] == 1  # ties are not matched
        second_best = np.minimum(second_best, similarity.max(axis=0)[nearest])
    mutual &= best > smallest
    kept = [mutual & (1 - best < ratio**2 * (1 - second_best)) for ratio in ratios]
    return [np.stack([rows[keep], nearest[keep]], axis=1).astype(np.int32) for keep in kept]
