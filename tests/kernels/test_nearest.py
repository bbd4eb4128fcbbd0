"""Nearest descriptors by compiled code: against all cosines; sizes that do not fit."""

import numpy as np
import pytest
from numpy.typing import NDArray
from support.scenes import random_for

from mapless_server.kernels import nearest
from mapless_server.kernels.nearest import Whole

pytestmark = pytest.mark.skipif(not nearest.is_available(64), reason="not compiled, or no AVX512-VNNI")


def whole(random: np.random.Generator, count: int, length: int, most: int = 127) -> Whole:
    numbers = random.integers(-most, most + 1, (count, length)).astype(np.int8)
    lengths = np.sqrt((numbers.astype(np.float32) ** 2).sum(axis=1))
    return Whole(numbers, (1 / np.maximum(lengths, 1)).astype(np.float32))


def cosines_of(first: Whole, second: Whole) -> NDArray[np.float32]:
    products = first.numbers.astype(np.int32) @ second.numbers.astype(np.int32).T
    return products.astype(np.float32) * second.inverse_lengths * first.inverse_lengths[:, None]


@pytest.mark.parametrize("length", [4, 64, 128])
@pytest.mark.parametrize(("n", "m"), [(2, 2), (7, 33), (8, 16), (9, 15), (40, 257)])
def test_the_two_largest_cosines_are_exact_to_the_bit(n: int, m: int, length: int) -> None:
    random = random_for("nearest", n, m, length)
    first, second = whole(random, n, length), whole(random, m, length)
    found, cosines = nearest.nearest(first, second), cosines_of(first, second)
    assert found.column.tolist() == cosines.argmax(axis=1).tolist()
    of_rows, of_columns = np.sort(cosines, axis=1)[:, -2:], np.sort(cosines, axis=0)[-2:]
    assert np.stack([found.second_best, found.best], axis=1).tobytes() == of_rows.tobytes()
    assert np.stack([found.second_of_column, found.best_of_column]).tobytes() == of_columns.tobytes()


def test_the_first_of_equal_columns_is_the_nearest() -> None:
    random = random_for("equal columns")
    first, second = whole(random, 20, 4, most=1), whole(random, 70, 4, most=1)
    assert nearest.nearest(first, second).column.tolist() == cosines_of(first, second).argmax(axis=1).tolist()


def test_largest_numbers_do_not_saturate() -> None:
    for ours, theirs in (127, 127), (-128, -128), (-128, 127), (127, -128):
        first, second = (
            Whole(np.full((2, 256), it, np.int8), np.full(2, 1 / 2048, np.float32)) for it in (ours, theirs)
        )
        assert nearest.nearest(first, second).best.tolist() == [256 * ours * theirs / 2048**2] * 2


def test_rows_need_not_be_contiguous() -> None:
    random = random_for("every second")
    first, second = whole(random, 40, 64), whole(random, 30, 64)
    some = Whole(first.numbers[::2], first.inverse_lengths[::2])
    copied = Whole(some.numbers.copy(), some.inverse_lengths.copy())
    assert nearest.nearest(some, second).best.tobytes() == nearest.nearest(copied, second).best.tobytes()


def test_sizes_that_do_not_fit_are_errors() -> None:
    random = random_for("sizes")
    first, second = whole(random, 4, 64), whole(random, 5, 128)
    for ours, theirs in (first, second), (first, Whole(first.numbers, second.inverse_lengths)):
        with pytest.raises(ValueError, match="do not fit"):
            nearest.nearest(ours, theirs)
