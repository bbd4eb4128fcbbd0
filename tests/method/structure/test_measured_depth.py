"""Measured depth at keypoints: planted planes and steps, seen by the same camera, a smaller one and another one."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from mapless import DepthImage, DepthNoise, Fisheye, RadialTangential
from mapless.geometry import Camera, RigidTransform, rotation_from_vector
from mapless_server.method.features.views import DepthSource, Features, KeypointDepths, View, undistort_pixels
from mapless_server.method.structure.measured_depth import MeasuredDepth

CAMERA = Camera(640, 480, 520.0, 520.0, 322.0, 238.0)
NOISE = DepthNoise(0.001, 0.0, 0.002, 0.01)
NORMAL, DISTANCE_M = np.array([0.35, -0.2, 1.0]), 2.0
"""A slanted plane, normal . x = distance."""


def view_of(camera: Camera = CAMERA, count: int = 500) -> View:
    random = np.random.default_rng(0)
    pixels = random.uniform([20, 20], [camera.width_px - 21, camera.height_px - 21], (count, 2)).astype(np.float32)
    features = Features(pixels, np.zeros((count, 128), np.uint8), np.ones(count, np.float32))
    return View(camera.pinhole(), features)


def plane_depth(rays: np.ndarray) -> np.ndarray:
    return np.asarray(DISTANCE_M / (rays @ NORMAL))


def plane_map(camera: Camera, camera_from_depth: RigidTransform | None = None) -> np.ndarray:
    """The plane, fixed in the photograph's camera, as a depth camera sees it."""
    pixels = np.stack(np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px)), axis=-1)
    ideal = undistort_pixels(pixels.reshape(-1, 2).astype(np.float64), camera)
    rays = camera.rays(ideal).reshape(*pixels.shape[:2], 3)
    pose = camera_from_depth or RigidTransform.identity()
    depth = (DISTANCE_M - pose.translation @ NORMAL) / (rays @ (pose.rotation.T @ NORMAL))
    return np.asarray(depth, np.float32)


def error_of(found: KeypointDepths, view: View) -> np.ndarray:
    return np.asarray(found.depth / plane_depth(view.camera.rays(view.features.pixels())) - 1)


@pytest.mark.parametrize("size", [(640, 480), (192, 144), (1280, 960)])
def test_a_plane_has_its_depth_whatever_the_size_of_the_map(size: tuple[int, int]) -> None:
    depth_camera, view = CAMERA.resized(*size), view_of()
    found = MeasuredDepth(depth_camera, plane_map(depth_camera), NOISE).at_keypoints(view)
    assert np.isfinite(found.depth).all()
    np.testing.assert_allclose(error_of(found, view), 0, atol=1e-5)
    noise = (0.001 + 0.002 * found.depth**2) / found.depth
    np.testing.assert_allclose(found.relative_sigma, np.hypot(noise, 0.01), rtol=1e-5)
    assert (found.common_sigma, found.source) == (0.01, DepthSource.MEASURED)


@pytest.mark.parametrize("far_rows", [200, 280])
def test_the_unit_is_judged_by_the_whole_image(far_rows: int) -> None:
    """Most keypoints are on what is near: their own median would say otherwise where most of the image is far."""
    depth = np.full((480, 640), 300.0, np.float32)
    depth[far_rows:] = 2.0
    view = view_of()
    pixels = view.features.keypoints.copy()
    pixels[:, 1] = 300 + 0.35 * pixels[:, 1]
    measured = MeasuredDepth.of(DepthImage.of_metres(depth), depth, CAMERA)
    found = measured.at_keypoints(replace(view, features=replace(view.features, keypoints=pixels)))
    assert np.nanmedian(found.depth) == pytest.approx(2.0)
    assert found.is_plausible is (far_rows < 240)


def test_another_camera_beside_sees_the_plane_too() -> None:
    pose = RigidTransform(rotation_from_vector([0.01, -0.02, 0.015]), np.array([-0.0225, -0.005, 0.01]))
    depth_camera = Camera(640, 480, 585.0, 585.0, 320.0, 240.0)
    view = view_of()
    found = MeasuredDepth(depth_camera, plane_map(depth_camera, pose), NOISE, pose).at_keypoints(view)
    error = error_of(found, view)
    assert np.isfinite(error).mean() > 0.75, "the narrower camera sees 80 % of the photograph"
    assert np.nanquantile(np.abs(error), 0.95) < 0.002
    mistaken = MeasuredDepth(depth_camera, plane_map(depth_camera, pose), NOISE).at_keypoints(view)
    assert np.nanmedian(np.abs(error_of(mistaken, view))) > 0.003, "taken for the photograph's own camera it is off"


@pytest.mark.parametrize("lens", [RadialTangential(-0.1, 0.05, 0.001, 0.001, 0.0), Fisheye(0.05, -0.02, 0.01, 0.0)])
def test_a_large_map_of_a_lens_is_as_exact_as_a_small_one(lens: Fisheye | RadialTangential) -> None:
    """A lens is undistorted on a lattice, which is each pixel of a small map."""
    pose, view = RigidTransform(np.eye(3), np.array([0.05, 0.0, 0.0])), view_of()
    for size in ((640, 480), (1024, 768)):
        depth_camera = replace(Camera(640, 480, 480.0, 480.0, 320.0, 240.0).resized(*size), distortion=lens)
        measured = MeasuredDepth(depth_camera, plane_map(depth_camera, pose), NOISE, pose)
        error = error_of(measured.at_keypoints(view), view)
        assert np.isfinite(error).mean() > 0.8
        assert np.nanquantile(np.abs(error), 0.95) < 0.0025
        assert measured.in_photograph(CAMERA) is measured.in_photograph(CAMERA), "computed once"


@pytest.mark.parametrize("size", [(64, 48), (40, 30)])
def test_a_map_is_reduced_to_the_photographs_pixels(size: tuple[int, int]) -> None:
    pose, small = RigidTransform(np.eye(3), np.array([0.05, 0.0, 0.0])), CAMERA.resized(*size)
    depth_camera = replace(CAMERA, distortion=Fisheye(0.05, -0.02, 0.01, 0.0))
    measured = MeasuredDepth(depth_camera, plane_map(depth_camera, pose), NOISE, pose)
    assert np.isfinite(measured.seen_by(small).depth).mean() > 0.7
    columns, rows = np.meshgrid(np.arange(4, size[0] - 4), np.arange(4, size[1] - 4))
    pixels = np.stack([columns, rows], -1).reshape(-1, 2).astype(np.float64)
    error = measured.at_pixels(small, pixels) / plane_depth(small.rays(pixels)) - 1
    assert np.nanmedian(np.abs(error)) < 0.01


def test_the_nearer_of_two_surfaces_hides_the_other() -> None:
    pose = RigidTransform(np.eye(3), np.array([0.2, 0.0, 0.0]))
    depth = np.full((480, 640), 4.0, np.float32)
    depth[:, 200:400] = 1.0
    found = MeasuredDepth(CAMERA, depth, NOISE, pose).seen_by(CAMERA).depth
    columns = np.flatnonzero(np.abs(found[240] - 1.0) < 0.01)
    assert columns.min() == pytest.approx(200 + 104, abs=1)
    assert columns.max() == pytest.approx(399 + 104, abs=1)


@pytest.mark.parametrize("lens", [None, Fisheye(0.02, -0.01, 0.0, 0.0)])
def test_depths_of_another_camera_are_moved_as_point_by_point(lens: Fisheye | None) -> None:
    """In single precision a place may be rounded to the pixel beside, and so hide, or be hidden."""
    pose = RigidTransform(rotation_from_vector([0.02, -0.03, 0.1]), np.array([0.05, -0.02, 0.01]))
    random = np.random.default_rng(3)
    depth = random.uniform(1.0, 3.0, (120, 160)).astype(np.float32)
    depth[random.uniform(size=depth.shape) < 0.2] = np.nan
    measured = MeasuredDepth(Camera(160, 120, 140.0, 150.0, 80.0, 60.0, lens), depth, NOISE, pose)
    target = CAMERA.resized(160, 120)
    expected = np.full((120, 160), np.inf)
    for x in pose.apply(measured.points()):
        column, row = np.rint(target.project(x)).astype(int)
        if 0 <= column < 160 and 0 <= row < 120:
            expected[row, column] = min(expected[row, column], x[2])
    hit = np.isfinite(expected)
    found = measured.seen_by(target).depth
    assert (np.abs(found[hit] / expected[hit] - 1) < 1e-5).mean() > 0.998


def test_there_is_no_depth_at_an_edge() -> None:
    depth = np.full((480, 640), 2.0, np.float32)
    depth[:, 320:] = 3.0
    view = view_of()
    found = MeasuredDepth(CAMERA, depth, NOISE).at_keypoints(view)
    beside = np.abs(view.features.keypoints[:, 0] - 319.5)
    assert np.isnan(found.depth[beside < 1]).all()
    assert np.isfinite(found.depth[beside > 4]).all()
    assert set(np.round(found.depth[np.isfinite(found.depth)], 4)) == {2.0, 3.0}


def test_holes_of_the_sensor_have_no_depth() -> None:
    depth = plane_map(CAMERA)
    depth[100:200, 100:200] = np.nan
    view = view_of()
    found, pixels = MeasuredDepth(CAMERA, depth, NOISE).at_keypoints(view), view.features.keypoints
    inside = ((pixels > 100) & (pixels < 199)).all(axis=1)
    assert np.isnan(found.depth[inside]).all()
    outside = ((pixels < 98) | (pixels > 201)).any(axis=1)
    np.testing.assert_allclose(error_of(found, view)[outside], 0, atol=1e-5)


def test_a_lens_bends_the_map_as_the_photograph() -> None:
    lens = Camera(640, 480, 400.0, 400.0, 322.0, 238.0, Fisheye(0.05, -0.01, 0.0, 0.0))
    view = view_of(lens, 300)
    error = error_of(MeasuredDepth(lens, plane_map(lens), NOISE).at_keypoints(view), view)
    assert np.isfinite(error).mean() > 0.9
    assert np.nanmax(np.abs(error)) < 1e-3


def test_only_the_surroundings_of_keypoints_are_computed() -> None:
    depth, view = np.full((1920, 2000), 2.0, np.float32), view_of(CAMERA.resized(2000, 1920), 500)
    tracemalloc.start()
    MeasuredDepth(CAMERA.resized(2000, 1920), depth, NOISE).at_keypoints(view)
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak_bytes < depth.nbytes / 4
