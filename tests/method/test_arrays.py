"""Functions of NumPy and torch arrays: both against plain NumPy, and the projection against the client's."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from support.scenes import random_for

from mapless import geometry
from mapless.geometry import Array
from mapless_server.method.arrays import (
    AnyArray,
    apply,
    identity,
    length,
    median,
    multiply,
    namespace,
    normalize,
    normalize_jacobian,
)

pytest.importorskip("torch", reason="the networks' extra is not installed")

import torch

KINDS: dict[str, Callable[[NDArray[np.generic]], AnyArray]] = {"numpy": lambda array: array, "torch": torch.from_numpy}
POINTS = np.concatenate([random_for("points").normal(size=(20, 3)), [[1.0, 2.0, 0.0], [1.0, 2.0, np.nan]]])

every_kind = pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
Kind = Callable[[NDArray[np.generic]], AnyArray]


@every_kind
@pytest.mark.parametrize("size", [0, 1, 2, 7, 8])
def test_masked_median_is_that_of_the_chosen_values(kind: Kind, size: int) -> None:
    random = random_for("median", size)
    for chosen_count in range(size + 1):
        values, where = random.normal(size=size), random.permutation(size) < chosen_count
        expected = np.median(values[where]) if chosen_count else np.nan
        np.testing.assert_array_equal(np.asarray(median(kind(values), kind(where))), expected)


@every_kind
def test_masked_median_ignores_nan_outside_the_mask(kind: Kind) -> None:
    values = np.array([np.nan, 3.0, np.inf, 1.0, -np.inf])
    assert median(kind(values), kind(np.array([False, True, False, True, False]))) == 2


@every_kind
def test_projection_equals_the_clients(kind: Kind) -> None:
    """Also behind the camera, beside it and for NaN."""
    points = kind(POINTS)
    np.testing.assert_array_equal(np.asarray(normalize(points)), geometry.normalize(POINTS))
    expected: Array = geometry.normalize_jacobian(POINTS)
    np.testing.assert_allclose(np.asarray(normalize_jacobian(points)), expected, rtol=1e-15)


@every_kind
def test_products_and_lengths_equal_numpys(kind: Kind) -> None:
    random = random_for("products")
    first, second, vectors = (random.normal(size=shape) for shape in ((5, 2, 3), (5, 3, 4), (5, 3)))
    np.testing.assert_allclose(np.asarray(multiply(kind(first), kind(second))), first @ second, rtol=1e-12)
    np.testing.assert_allclose(np.asarray(apply(kind(first), kind(vectors))), (first @ vectors[..., None])[..., 0])
    np.testing.assert_allclose(np.asarray(length(kind(vectors))), np.linalg.norm(vectors, axis=-1))
    np.testing.assert_array_equal(np.asarray(identity(kind(vectors))), np.eye(3))


@every_kind
def test_the_namespace_follows_the_arrays_type(kind: Kind) -> None:
    array = kind(POINTS)
    assert type(namespace(array).isnan(array)) is type(array)
