"""Pictures for networks: planted blobs are where the picture's camera projects them, for any lens, shape and size."""

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("torch", reason="the networks' extra is not installed")
pytest.importorskip("PIL", reason="the networks' extra is not installed")

from PIL import Image
from support.images import textured

from mapless.geometry import Array, Camera
from mapless.lenses import Fisheye, RadialTangential
from mapless_server.method.coarse.grids import (
    PIXEL_LIMIT,
    Grid,
    common_grid,
    fitted_grid,
    lay_out,
    natural_grid,
)
from mapless_server.method.features.views import undistort_pixels

OFFICIAL_PIXEL_LIMIT = 255_000
"""Number of pixels of the official loader's grids; 574x434 for 4:3."""
BARREL = RadialTangential(-0.25, 0.07, 0.001, -0.0015, -0.005)
CAMERAS = {
    "pinhole": Camera(960, 720, 816.0, 820.0, 470.5, 365.5),
    "smaller than the grid": Camera(320, 240, 260.0, 261.0, 160.5, 118.5),
    "barrel": Camera(960, 720, 816.0, 820.0, 470.5, 365.5, BARREL),
    "pincushion": Camera(960, 720, 816.0, 820.0, 470.5, 365.5, RadialTangential(0.2, 0.05)),
    "fisheye": Camera(512, 512, 190.0, 191.0, 254.5, 256.5, Fisheye(0.003, 0.0007, -0.002, 0.0002)),
    "fisheye beyond a half-space": Camera(640, 480, 150.0, 150.0, 319.5, 239.5, Fisheye(0.03, -0.015, 0.004, -0.001)),
    "portrait with a lens": Camera(720, 960, 816.0, 820.0, 365.5, 470.5, BARREL),
    "panorama": Camera(1242, 375, 721.0, 721.0, 609.5, 172.5),
    "folding in the corners": Camera(640, 480, 500.0, 500.0, 319.5, 239.5, RadialTangential(-0.3)),
}


def camera_of(width_px: int, height_px: int) -> Camera:
    return Camera(width_px, height_px, 0.8 * width_px, 0.8 * width_px, width_px / 2 - 0.5, height_px / 2 - 0.5)


def photograph_of(camera: Camera, rays: Array, sigma_px: float) -> NDArray[np.uint8]:
    """A grey photograph with a bright blob where the camera sees each ray."""
    columns, rows = np.arange(camera.width_px), np.arange(camera.height_px)[:, None]
    image = np.full((camera.height_px, camera.width_px), 60.0)
    for x, y in camera.project(rays):
        image += (
            150 * np.exp(-((columns - x) ** 2) / (2 * sigma_px**2)) * np.exp(-((rows - y) ** 2) / (2 * sigma_px**2))
        )
    return np.repeat(np.rint(image)[..., None], 3, axis=2).astype(np.uint8)


def centroid_near(picture: NDArray[np.float32], pixel: Array, radius: int = 7) -> Array:
    """Centre of brightness (2,) around a pixel of a picture (3, H, W)."""
    x, y = np.rint(pixel).astype(int)
    window = picture[0, y - radius : y + radius + 1, x - radius : x + radius + 1].astype(float)
    weight = np.clip(window - 60 / 255 - 0.02, 0, None)
    rows, columns = np.indices(window.shape) - radius
    return np.array([x + (weight * columns).sum() / weight.sum(), y + (weight * rows).sum() / weight.sum()])


def test_sizes_are_those_of_the_official_loader() -> None:
    sizes = {(4, 3): (574, 434), (3, 4): (434, 574), (16, 9): (672, 378), (1, 1): (504, 504), (752, 480): (630, 392)}
    for aspect, size in sizes.items():
        grid = fitted_grid(*aspect, OFFICIAL_PIXEL_LIMIT)
        assert (grid.width_px, grid.height_px) == size
    assert natural_grid(camera_of(640, 480), PIXEL_LIMIT) == Grid(37, 28)


@pytest.mark.parametrize("limit", [PIXEL_LIMIT, OFFICIAL_PIXEL_LIMIT])
def test_a_usual_photograph_fills_its_grid(limit: int) -> None:
    """From 1:2 to 2:1 the nearest grid is within the stretch that is allowed, so that nothing need be filled."""
    for aspect in np.geomspace(0.5, 2.0, 101):
        layout = lay_out(
            camera_of(1000, round(1000 / aspect)),
            grid := natural_grid(camera_of(1000, round(1000 / aspect)), limit),
            limit,
        )
        assert layout.shown is None
        assert layout.box == (0, 0, grid.width_px, grid.height_px)
        assert grid.width_px * grid.height_px <= limit


def test_the_common_grid_is_that_of_most_references() -> None:
    landscape, portrait, square = camera_of(640, 480), camera_of(480, 640), camera_of(500, 500)
    assert common_grid([square, portrait, landscape, portrait], PIXEL_LIMIT) == natural_grid(portrait, PIXEL_LIMIT)
    assert common_grid([square, landscape, portrait], PIXEL_LIMIT) == natural_grid(square, PIXEL_LIMIT)
    assert common_grid([square, landscape, portrait, portrait, landscape], PIXEL_LIMIT) == natural_grid(
        landscape, PIXEL_LIMIT
    )


def test_undistorted_pictures_equal_the_official_loaders() -> None:
    photograph = textured(752, 480, seed=3)
    layout = lay_out(camera_of(752, 480), Grid(45, 28), PIXEL_LIMIT)
    official = np.asarray(Image.fromarray(photograph).resize((630, 392), Image.Resampling.LANCZOS), np.float32) / 255
    picture = layout.picture(photograph)
    assert picture.dtype == np.float32
    np.testing.assert_array_equal(picture, official.transpose(2, 0, 1))


def test_large_photographs_nearly_equal_the_official_loaders() -> None:
    photograph = textured(2800, 2100, seed=5)
    layout = lay_out(camera_of(2800, 2100), Grid(37, 28), PIXEL_LIMIT)
    official = np.asarray(Image.fromarray(photograph).resize((518, 392), Image.Resampling.LANCZOS), float)
    difference = 255 * layout.picture(photograph).transpose(1, 2, 0) - official
    assert np.abs(difference).max() < 5
    assert np.sqrt((difference**2).mean()) < 0.7


@pytest.mark.parametrize("grid", [Grid(37, 28), Grid(28, 37), Grid(46, 22)], ids=str)
@pytest.mark.parametrize("name", CAMERAS)
def test_planted_blobs_are_where_the_camera_projects_them(name: str, grid: Grid) -> None:
    camera = CAMERAS[name]
    layout = lay_out(camera, grid, PIXEL_LIMIT)
    left, top, width, height = layout.box
    across, down = (np.linspace(start + 16, start + side - 17, 4) for start, side in ((left, width), (top, height)))
    rays = layout.camera.rays(np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2))
    pixels = camera.project(rays)
    sigma_px = max(1.5, 1.8 * layout.ideal.width_px / width)
    room = np.minimum(pixels, np.array([camera.width_px, camera.height_px]) - 1 - pixels).min(axis=1)
    unique = np.abs(undistort_pixels(pixels, camera) - camera.pinhole().project(rays)).max(axis=1) < 1e-3
    rays = rays[(room > 3 * sigma_px) & unique]
    assert len(rays) >= 12
    picture = layout.picture(photograph_of(camera, rays, sigma_px))
    assert picture.shape == (3, grid.height_px, grid.width_px)
    expected = layout.camera.project(rays)
    found = np.array([centroid_near(picture, pixel) for pixel in expected])
    assert np.abs(found - expected).max() < 0.25  # a lens makes blobs lopsided
    assert np.abs((found - expected).mean(axis=0)).max() < 0.01


FOLDING_EVERYWHERE = Camera(640, 480, 400.0, 400.0, 319.5, 239.5, RadialTangential(-0.45))


@pytest.mark.parametrize("camera", [*CAMERAS.values(), FOLDING_EVERYWHERE], ids=[*CAMERAS, "folding at every edge"])
def test_shown_is_the_mask_of_the_photographs_pixels(camera: Camera) -> None:
    """Each shown pixel's ray comes back through the lens, and everything else has one colour."""
    layout = lay_out(camera, natural_grid(camera, PIXEL_LIMIT), PIXEL_LIMIT)
    shown = np.ones((layout.grid.height_px, layout.grid.width_px), bool) if layout.shown is None else layout.shown
    rows, columns = np.nonzero(shown)
    some = slice(None, None, 97)
    ideal = camera.pinhole().project(layout.camera.rays(np.stack([columns, rows], axis=-1)[some]))
    pixels = camera.project(layout.camera.rays(np.stack([columns, rows], axis=-1)[some]))
    assert (pixels >= -0.51).all()
    assert (pixels <= np.array([camera.width_px, camera.height_px]) - 0.49).all()
    returned = undistort_pixels(pixels, camera)
    known = np.isfinite(returned).all(axis=1)  # right at a fold the iteration does not converge
    assert known.mean() > 0.95
    np.testing.assert_allclose(returned[known], ideal[known], atol=5.0)
    photograph = textured(camera.width_px, camera.height_px)
    filling = layout.picture(photograph)[:, ~shown]
    assert (filling == filling[:, :1]).all()


def test_photographs_of_extreme_shapes_have_a_picture() -> None:
    for width, height in ((16384, 32), (32, 4096)):
        camera = camera_of(width, height)
        layout = lay_out(camera, natural_grid(camera, PIXEL_LIMIT), PIXEL_LIMIT)
        picture = layout.picture(np.full((height, width, 3), 200, np.uint8))
        np.testing.assert_allclose(picture, 200 / 255, atol=1e-6)
        assert layout.shown is not None
        assert 0 < layout.shown.mean() < 0.02


def test_a_lens_without_a_visible_field_has_an_empty_picture() -> None:
    """A cut-out from the rim of a fisheye's photograph, with the intrinsics of the whole."""
    camera = Camera(200, 200, 190.0, 190.0, -400.0, 100.0, Fisheye(0.003, 0.0007, -0.002, 0.0002))
    layout = lay_out(camera, natural_grid(camera, PIXEL_LIMIT), PIXEL_LIMIT)
    assert layout.shown is not None
    assert not layout.shown.any()
    assert np.ptp(layout.picture(textured(200, 200))) == 0


def test_intrinsics_have_half_a_pixel_at_the_first_centre() -> None:
    layout = lay_out(camera_of(640, 480), Grid(37, 28), PIXEL_LIMIT)
    np.testing.assert_allclose(layout.intrinsics[:2, 2], [518 / 2, 392 / 2])
    np.testing.assert_allclose(layout.intrinsics[[0, 1], [0, 1]], [0.8 * 518, 0.8 * 640 * 392 / 480])


def test_a_photograph_of_another_size_is_refused() -> None:
    with pytest.raises(ValueError, match="does not belong"):
        lay_out(camera_of(640, 480), Grid(37, 28), PIXEL_LIMIT).picture(textured(480, 640))
