"""Features: planted blobs are found where they are, through reduction and through a lens."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from support.images import textured
from support.scenes import random_for

from mapless.geometry import Array, Camera
from mapless.lenses import Distortion, Fisheye, RadialTangential
from mapless_server.method.features.extractors import SiftExtractor, SiftOptions, make_extractor
from mapless_server.method.features.views import MAX_INCIDENCE_DEG, Features, reduce_image, undistort_pixels

CAMERA = Camera(400, 300, 350.0, 350.0, 199.5, 149.5)
LENSES = {
    "pinhole": None,
    "barrel": RadialTangential(-0.25, 0.07, 0.001, -0.0015, -0.005),
    "fisheye": Fisheye(0.03, -0.015, 0.004, -0.001),
}


def blobs(random: np.random.Generator, camera: Camera, step_px: int = 40) -> tuple[NDArray[np.uint8], Array]:
    """An image of bright and dark Gaussian blobs, one in each square of a grid, and where their centres are."""
    columns, rows = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    centres = np.stack(
        np.meshgrid(
            np.arange(step_px, camera.width_px - step_px / 2, step_px),
            np.arange(step_px, camera.height_px - step_px / 2, step_px),
        ),
        axis=-1,
    ).reshape(-1, 2)
    centres = centres + random.uniform(-4, 4, centres.shape)
    image = np.full((camera.height_px, camera.width_px), 128.0)
    for (x, y), sigma, sign in zip(
        centres,
        random.uniform(2.5, 5.0, len(centres)) * step_px / 40,
        random.choice([-100, 100], len(centres)),
        strict=True,
    ):
        image += sign * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * sigma**2))
    return np.repeat(np.rint(image)[..., None], 3, axis=2).astype(np.uint8), centres


def misses(keypoints: NDArray[np.floating], centres: Array) -> Array:
    """From each centre that was found to its keypoint, (N, 2).

    SIFT skips an extremum that lies halfway between two samples, so some blobs have no keypoint.
    """
    offsets = keypoints[None].astype(float) - centres[:, None]
    nearest = offsets[np.arange(len(centres)), np.linalg.norm(offsets, axis=2).argmin(axis=1)]
    found = np.linalg.norm(nearest, axis=1) < 2.0
    assert found.mean() > 0.75, f"{found.sum()} of {len(centres)} blobs found"
    return np.asarray(nearest[found])


def assert_is_well_formed(features: Features, dimension: int = 128) -> None:
    assert features.keypoints.dtype == features.sizes_px.dtype == np.float32
    assert features.descriptors.dtype == np.uint8
    assert features.descriptors.shape == (len(features), dimension)
    assert np.isfinite(features.keypoints).all()
    np.testing.assert_allclose(np.linalg.norm(features.unit_descriptors(), axis=1), 1, atol=1e-5)


def test_planted_blobs_are_found_at_their_positions() -> None:
    image, centres = blobs(random_for("blobs"), CAMERA)
    view = SiftExtractor().extract(image, CAMERA)
    missed = misses(view.features.keypoints, centres)
    assert np.linalg.norm(missed, axis=1).max() < 0.1
    assert np.abs(missed.mean(axis=0)).max() < 0.02
    assert view.camera == CAMERA
    assert_is_well_formed(view.features)


@pytest.mark.parametrize("max_side_px", [400, 300, 211, 200])
def test_reduction_keeps_the_rays(max_side_px: int) -> None:
    image, centres = blobs(random_for("reduction"), CAMERA)
    view = SiftExtractor(SiftOptions(max_side_px=max_side_px)).extract(image, CAMERA)
    assert max(view.camera.width_px, view.camera.height_px) == max_side_px
    # Back to the pixels of the photograph through nothing but the two cameras.
    missed = misses(CAMERA.project(view.camera.rays(view.features.keypoints)), centres)
    assert np.linalg.norm(missed, axis=1).max() < 0.15
    assert np.abs(missed.mean(axis=0)).max() < 0.03


def test_small_and_thin_images_are_not_enlarged() -> None:
    small = np.zeros((20, 30), np.uint8)
    same, camera = reduce_image(small, Camera(30, 20, 30.0, 30.0, 14.5, 9.5), 1024)
    assert same is small
    assert camera.width_px == 30
    thin, camera = reduce_image(np.zeros((1, 3000), np.uint8), Camera(3000, 1, 30.0, 30.0, 1499.5, 0.0), 1000)
    assert thin.shape == (camera.height_px, camera.width_px) == (1, 1000)


@pytest.mark.parametrize(
    ("size", "max_side_px", "expected"),
    [
        ((1600, 1067), 1024, (1024, 672)),
        ((640, 480), 1024, (640, 480)),
        ((400, 300), 1024, (384, 288)),
        ((20, 2000), 1024, (32, 1024)),
    ],
)
def test_sides_of_reduced_images_are_multiples(
    size: tuple[int, int], max_side_px: int, expected: tuple[int, int]
) -> None:
    width, height = size
    image, centres = np.zeros((height, width, 3), np.uint8), np.array([[0.0, 0.0], [width - 1.0, height - 1.0]])
    camera = Camera(width, height, 500.0, 500.0, (width - 1) / 2, (height - 1) / 2)
    reduced, reduced_camera = reduce_image(image, camera, max_side_px, multiple_px=32)
    assert (reduced.shape[1], reduced.shape[0]) == (reduced_camera.width_px, reduced_camera.height_px) == expected
    # Outer edges stay outer edges: half a pixel outside of the corner pixels' centres.
    corners = reduced_camera.project(camera.rays(centres + np.array([[-0.5, -0.5], [0.5, 0.5]])))
    np.testing.assert_allclose(corners, [[-0.5, -0.5], [expected[0] - 0.5, expected[1] - 0.5]], atol=1e-9)


@pytest.mark.parametrize("name", LENSES)
def test_undistortion_inverts_projection(name: str) -> None:
    camera = replace(CAMERA, distortion=LENSES[name])
    pixels = np.stack(np.meshgrid(np.linspace(-0.5, 399.5, 21), np.linspace(-0.5, 299.5, 16)), axis=-1).reshape(-1, 2)
    ideal = undistort_pixels(pixels, camera)
    assert np.linalg.norm(camera.project(camera.rays(ideal)) - pixels, axis=1).max() < 0.01
    assert np.linalg.norm(undistort_pixels(camera.project(camera.rays(pixels)), camera) - pixels, axis=1).max() < 0.01


@pytest.mark.parametrize("name", LENSES)
def test_keypoints_are_in_pixels_of_the_pinhole(name: str) -> None:
    camera = replace(CAMERA, distortion=LENSES[name])
    image, centres = blobs(random_for("lens"), camera)
    view = SiftExtractor().extract(image, camera)
    assert view.camera == CAMERA
    assert (
        np.linalg.norm(misses(camera.project(view.camera.rays(view.features.keypoints)), centres), axis=1).max() < 0.1
    )


@pytest.mark.parametrize(
    ("lens", "radius"),
    [
        (RadialTangential(k1=-0.4), 2 / 3 / np.sqrt(3 * 0.4)),  # r (1 - 0.4 r^2) grows up to r = 1 / sqrt(1.2)
        (Fisheye(), np.radians(MAX_INCIDENCE_DEG)),  # theta itself
    ],
    ids=["folded", "sideways"],
)
def test_undistortion_outside_the_lens_domain_is_nan(lens: Distortion, radius: float) -> None:
    camera = Camera(400, 300, 100.0, 100.0, 199.5, 149.5, lens)
    angle = np.linspace(0, 2 * np.pi, 17)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    centre = np.array([199.5, 149.5])
    assert np.isfinite(undistort_pixels(centre + 0.97 * radius * 100 * circle, camera)).all()
    assert np.isnan(undistort_pixels(centre + 1.03 * radius * 100 * circle, camera)).all()

    image, centres = blobs(random_for("outside"), camera)
    features = SiftExtractor().extract(image, camera).features
    assert_is_well_formed(features)
    inside = np.linalg.norm(centres - centre, axis=1) < 0.95 * radius * 100
    assert 0 < inside.sum() < len(centres)
    seen_at = camera.project(camera.rays(features.keypoints))
    assert np.linalg.norm(misses(seen_at, centres[inside]), axis=1).max() < 0.1
    assert np.linalg.norm(seen_at - centre, axis=1).max() < 1.01 * radius * 100


@pytest.mark.parametrize("level", [0, 127, 255])
def test_a_blank_image_has_no_keypoints(level: int) -> None:
    view = SiftExtractor().extract(np.full((300, 400, 3), level, np.uint8), CAMERA)
    assert len(view.features) == 0
    assert_is_well_formed(view.features)


@pytest.mark.parametrize("count", [1, 10, 200])
def test_the_strongest_keypoints_up_to_the_limit_are_kept(count: int) -> None:
    image = textured(400, 300, seed=count)
    everything = SiftExtractor(SiftOptions(max_keypoints=100_000)).extract(image, CAMERA).features
    some = SiftExtractor(SiftOptions(max_keypoints=count)).extract(image, CAMERA).features
    assert len(everything) > 200
    assert len(some) == count
    assert {tuple(k) for k in some.keypoints.tolist()} <= {tuple(k) for k in everything.keypoints.tolist()}
    assert_is_well_formed(some)


def test_colour_channels_are_read_as_rgb() -> None:
    """Grey is 0.3 R + 0.6 G + 0.1 B: what is drawn in red has more contrast than what is drawn in blue."""
    image, _ = blobs(random_for("colour"), CAMERA)
    red, blue = image.copy(), image.copy()
    red[..., 1:], blue[..., :2] = 128, 128
    count = [len(SiftExtractor().extract(i, CAMERA).features) for i in (red, blue)]
    assert count[0] > 1.5 * count[1]


def test_the_name_changes_with_every_option_of_the_features() -> None:
    names = {
        SiftExtractor(options).name
        for options in (
            SiftOptions(),
            SiftOptions(max_keypoints=1000),
            SiftOptions(max_side_px=800),
            SiftOptions(contrast_threshold=0.04),
        )
    }
    assert len(names) == 4
    assert SiftExtractor().name == SiftExtractor(SiftOptions()).name == make_extractor("sift").name


def test_features_of_inconsistent_shapes_are_refused() -> None:
    two, three = np.zeros((2, 2), np.float32), np.zeros((3, 128), np.float32)
    with pytest.raises(ValueError, match="do not fit"):
        Features(two, three, np.zeros(2, np.float32))
    with pytest.raises(ValueError, match="sizes"):
        Features(two, three[:2], np.zeros(3, np.float32))
