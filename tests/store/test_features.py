"""Features in 8 bits: what they cost, what they round, and that they are preferred to those in float32."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from support.stores import EXTRACTOR, Place, assert_same_bits, make_features, make_reference, view_of

from mapless.geometry import Camera
from mapless_server.method.features.views import Features, View, rounded_descriptors
from mapless_server.security import SceneKey
from mapless_server.store import Store, codec

OFFICE = SceneKey("office")
CAMERA = Camera.from_fov(640, 480, 70.0)


def histograms(seed: int, count: int, dimension: int = 128) -> NDArray[np.uint8]:
    """Numbers as SIFT's: of about the same length, many of them small."""
    random = np.random.default_rng(seed)
    drawn = random.gamma(0.4, 1.0, (count, dimension))
    whole = np.rint(512 * drawn / np.linalg.norm(drawn, axis=1, keepdims=True))
    return np.asarray(np.minimum(whole, 255), np.uint8)


def small_features(seed: int, count: int, dimension: int, is_histogram: bool = False) -> Features:
    found = make_features(np.random.default_rng(seed), count)
    random = np.random.default_rng(seed)
    directions = rounded_descriptors(random.normal(size=(count, dimension)))
    return replace(found, descriptors=histograms(seed, count, dimension) if is_histogram else directions)


@pytest.mark.parametrize(("dimension", "most"), [(64, 150_000), (128, 280_000)])
def test_2048_keypoints_take_the_bytes_that_are_promised(dimension: int, most: int) -> None:
    features = small_features(1, 2048, dimension)
    assert len(codec.encode_view(View(CAMERA, features))) < most


@pytest.mark.parametrize("is_histogram", [False, True])
@pytest.mark.parametrize(("count", "upright_deg"), [(0, 0.0), (1, 270.0), (500, 0.0)])
def test_small_features_come_back(count: int, upright_deg: float, is_histogram: bool) -> None:
    view = View(CAMERA, small_features(2, count, 64, is_histogram), upright_deg=upright_deg)
    blob = codec.encode_view(view)
    again = codec.decode_view("o", blob, codec.sha256_for("o", blob))
    assert (again.camera, again.upright_deg) == (view.camera, upright_deg)
    assert_same_bits(again.features.descriptors, view.features.descriptors)
    np.testing.assert_allclose(again.features.keypoints, view.features.keypoints, rtol=0, atol=2**-14)
    np.testing.assert_allclose(again.features.sizes_px, view.features.sizes_px, rtol=5e-4)
    again_blob = codec.encode_view(again)
    assert codec.decode_view("o", again_blob, codec.sha256_for("o", again_blob)).camera == view.camera


def test_keypoints_far_outside_the_photograph_come_back() -> None:
    features = replace(small_features(3, 2, 8), keypoints=np.array([[-5000.25, 1e5], [7000.5, 3.0]], np.float32))
    blob = codec.encode_view(View(CAMERA, features))
    again = codec.decode_view("o", blob, codec.sha256_for("o", blob)).features
    np.testing.assert_allclose(again.keypoints, features.keypoints, rtol=0, atol=2**-7)


def test_keypoints_in_columns_are_stored_as_those_in_rows() -> None:
    """An extractor may give either order."""
    rows = small_features(3, 7, 8)
    columns = replace(rows, keypoints=np.asfortranarray(rows.keypoints))
    assert codec.encode_view(View(CAMERA, columns)) == codec.encode_view(View(CAMERA, rows))


def test_a_keypoint_that_is_nowhere_is_refused() -> None:
    features = replace(small_features(3, 2, 8), keypoints=np.array([[np.nan, 1.0], [2.0, 3.0]], np.float32))
    with pytest.raises(ValueError, match="not finite"):
        codec.encode_view(View(CAMERA, features))


def test_bytes_cut_short_are_damaged() -> None:
    blob = codec.encode_view(View(CAMERA, small_features(4, 5, 8)))[:-1]
    with pytest.raises(codec.Damaged):
        codec.decode_view("o", blob, codec.sha256_for("o", blob))


def test_cosines_of_rounded_descriptors_are_close() -> None:
    random = np.random.default_rng(7)
    exact = random.normal(size=(200, 64))
    exact /= np.linalg.norm(exact, axis=1, keepdims=True)
    small = replace(small_features(7, 200, 64), descriptors=rounded_descriptors(exact))
    unit = small.unit_descriptors()
    np.testing.assert_allclose(np.linalg.norm(unit, axis=1), 1, atol=1e-6)
    assert np.abs(unit @ unit.T - exact @ exact.T).max() < 0.01


def test_8_bits_are_read_where_an_older_server_added_float32(store: Store, place: Place) -> None:
    store.create_scene(OFFICE)
    new = make_reference("r")
    small = replace(view_of(new), features=small_features(1, 20, 64))
    (record,) = store.add_references(OFFICE, [replace(new, views={EXTRACTOR: small})])
    blob = codec.encode_view(view_of(new))
    place.execute(
        "INSERT INTO features (reference_key, extractor, data, sha256) VALUES (?, ?, ?, ?)",
        *(record.key, EXTRACTOR, blob, codec.sha256_for(f"{record.key}/{EXTRACTOR}", blob)),
    )
    (found,) = store.load_references(OFFICE, ["r"], EXTRACTOR).references
    assert_same_bits(found.view.features.descriptors, small.features.descriptors)
