"""The rendered room: its truth is exact, its photographs are worth localizing, and a seed gives the same ones."""

import itertools

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, RigidTransform
from mapless_tools.demo import room
from mapless_tools.demo.furniture import ROOM_M
from mapless_tools.demo.raycast import Quad, Surface, cast, shade
from mapless_tools.demo.room import CameraEffects, Photo, Station

SMALL = room.REFERENCE_CAMERA.resized(320, 240)


def small(stations: list[Station]) -> list[Station]:
    return [Station(s.name, s.camera.resized(320, 240), s.world_from_camera) for s in stations]


@pytest.fixture(scope="module")
def photos() -> list[Photo]:
    _, surfaces = room._lit_room(0)
    stations = room.walk(0, 16)[:3] + room.scatter(0, 2)
    return [room.take(surfaces, station) for station in small(stations)]


def world_points(photo: Photo) -> Array:
    """(H, W, 3) where each pixel's centre looks."""
    y, x = np.mgrid[: photo.camera.height_px, : photo.camera.width_px]
    rays = photo.camera.rays(np.stack([x, y], axis=-1))
    return photo.world_from_camera.apply(rays * photo.depth_m[..., None])


def bilinear(image: NDArray[np.floating], pixels: NDArray[np.floating]) -> Array:
    """Values (N,) of an image (H, W) at pixels (N, 2) inside it."""
    x, y = pixels[:, 0], pixels[:, 1]
    left = np.minimum(x.astype(int), image.shape[1] - 2)
    top = np.minimum(y.astype(int), image.shape[0] - 2)
    a, b = x - left, y - top
    upper = image[top, left] * (1 - a) + image[top, left + 1] * a
    lower = image[top + 1, left] * (1 - a) + image[top + 1, left + 1] * a
    return np.asarray(upper * (1 - b) + lower * b, float)


def test_depth_maps_agree(photos: list[Photo]) -> None:
    """A point of one photograph lies on the surface that the next one sees there, unless something hides it."""
    for a, b in itertools.pairwise(photos[:3]):
        x_in_b = b.world_from_camera.inverse().apply(world_points(a).reshape(-1, 3))
        pixels = b.camera.project(x_in_b)
        inside = ((pixels >= 0) & (pixels <= [b.camera.width_px - 1, b.camera.height_px - 1])).all(axis=-1)
        pixels, depth = pixels[inside], x_in_b[inside, 2]
        # On a plane 1 / depth is linear in the pixel, so that interpolating it is exact.
        seen = 1 / bilinear(1 / b.depth_m, pixels)
        visible = depth < seen + 0.02
        assert visible.sum() > 0.3 * a.depth_m.size
        assert np.median(np.abs(depth - seen)[visible]) < 1e-3


def checkerboard(cells: int, cell_px: int) -> NDArray[np.float32]:
    y, x = np.mgrid[: cells * cell_px, : cells * cell_px] // cell_px
    return np.repeat(((x + y) % 2)[..., None], 3, axis=-1).astype(np.float32) * 0.8 + 0.1


def test_a_planted_corner_appears_where_it_projects() -> None:
    """Half a pixel would be seen: the corner of a texture against the projection of the point it lies at."""
    quad = Quad(np.zeros(3), np.array([0.8, 0, 0]), np.array([0, 0, -0.8]), checkerboard(8, 60))
    corners = np.array([[0.1 * i, 0.0, -0.1 * j] for i in range(2, 7) for j in range(2, 7)])
    # Uneven or clipped light moves where a corner seems to be, by up to a quarter of a pixel; not what is tested here.
    even_light = CameraEffects(exposure_stops=0, white_balance=0, vignetting=0, shot_noise=0, read_noise=0)
    for centre in ([0.4, -1.2, -0.4], [1.0, -1.0, -0.1], [-0.2, -1.1, -0.9]):
        pose = room.look_at(centre, [0.4, 0.0, -0.4], roll_deg=11)
        station = Station("x", room.QUERY_CAMERA, pose)
        photo = room.take([Surface.of(quad, quad.texture)], station, effects=even_light)
        expected = photo.camera.project(pose.inverse().apply(corners)).astype(np.float32)
        found = cv2.cornerSubPix(
            cv2.cvtColor(photo.image, cv2.COLOR_RGB2GRAY),
            expected[:, None] + 0.7,
            (7, 7),
            (-1, -1),
            (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-4),
        )[:, 0]
        assert np.abs(found - expected).max() < 0.2
        assert np.abs(np.median(found - expected, axis=0)).max() < 0.05


def test_a_rectangle_through_the_camera_plane_is_clipped() -> None:
    """A floor that passes under the camera fills the picture below the horizon and nothing above it."""
    floor = Quad(np.array([-50.0, 50, 0]), np.array([100.0, 0, 0]), np.array([0, -100.0, 0]), checkerboard(2, 8))
    pose = room.look_at([0, 0, 1.5], [0, 1, 1.5])
    camera = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
    visible = cast([floor], camera, pose)
    assert (visible.index[26:] == 0).all()
    assert (visible.index[:24] == -1).all()
    np.testing.assert_allclose(1 / visible.inverse_depth[47], 1.5 * 60 / (47 - 23.5), rtol=1e-5)
    assert shade([Surface.of(floor, floor.texture)], visible, camera, pose)[47].min() > 0.05


def test_seen_from_behind_there_is_nothing() -> None:
    quad = Quad(np.zeros(3), np.array([1.0, 0, 0]), np.array([0, 0, -1.0]), checkerboard(2, 8))
    np.testing.assert_allclose(quad.normal(), [0, -1, 0])
    for y, seen in ((-2.0, True), (2.0, False)):
        pose = room.look_at([0.5, y, -0.5], [0.5, 0, -0.5])
        assert (cast([quad], SMALL, pose).index >= 0).any() == seen


def test_photographs_are_full_and_rich(photos: list[Photo]) -> None:
    for photo in photos:
        assert photo.image.shape == (240, 320, 3)
        assert photo.depth_m.min() > room.CLEARANCE_M / 2
        assert photo.depth_m.max() < 12
        assert 50 < photo.image.mean() < 190
        assert len(cv2.SIFT.create().detect(photo.image, None)) > 300


def test_a_seed_gives_the_same_photograph(photos: list[Photo]) -> None:
    room._lit_room.cache_clear()
    _, surfaces = room._lit_room(0)
    again = room.take(surfaces, small(room.walk(0, 16))[0])
    np.testing.assert_array_equal(again.image, photos[0].image)
    np.testing.assert_array_equal(again.depth_m, photos[0].depth_m)


def test_exposure_changes_and_noise_are_there() -> None:
    grey = np.full((120, 160, 3), 0.3, np.float32)
    means = [room.expose(np.random.default_rng(k), grey.copy(), CameraEffects()).mean() for k in range(8)]
    assert np.std(means) > 5
    still = room.expose(np.random.default_rng(0), grey.copy(), CameraEffects(vignetting=0))
    assert 0.5 < still[..., 1].std() < 6


def test_cameras_keep_clear_of_furniture_and_walls() -> None:
    stations = room.walk(0, 16) + room.scatter(0, 8)
    boxes = room._lit_room(0)[0].boxes
    for station in stations:
        centre = station.world_from_camera.translation
        assert (centre > 0.3).all()
        assert (centre < ROOM_M - 0.3).all()
        assert not room._blocked(centre, boxes)
    steps = np.diff([s.world_from_camera.translation for s in stations[:16]], axis=0)
    assert 0.3 < np.linalg.norm(steps, axis=-1).mean() < 0.7


def test_look_at_is_a_rotation_with_z_up() -> None:
    pose = room.look_at([1, 2, 1], [3, 2, 1])
    np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose.rotation) == pytest.approx(1)
    above = RigidTransform.inverse(pose).apply([3, 2, 2])
    assert above[1] < 0
