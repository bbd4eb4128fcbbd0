"""Geometry by its algebra, and against OpenCV and SciPy where they know the same formula."""

import math
from functools import reduce

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support.compare import assert_jacobian, assert_pose_close
from support.scenes import CAMERA, random_for

from mapless.geometry import (
    Array,
    Camera,
    Quaternion,
    RigidTransform,
    Similarity,
    cross_matrix,
    nearest_rotation,
    normalize,
    normalize_jacobian,
    resized_pixel,
    rotation_angle_deg,
    rotation_from_vector,
)
from mapless.lenses import Distortion, Fisheye, RadialTangential

coordinate = st.floats(-100.0, 100.0)
point = st.tuples(coordinate, coordinate, coordinate).map(np.array)
vector = st.tuples(*[st.floats(-3.0, 3.0)] * 3).map(np.array)
rigid = st.builds(lambda w, t: RigidTransform(rotation_from_vector(w), t), vector, point)
similarity = st.builds(lambda s, w, t: Similarity(s, rotation_from_vector(w), t), st.floats(0.01, 100.0), vector, point)

LENS = RadialTangential(-0.28, 0.09, 0.001, -0.0015, -0.01)
FISHEYE = Fisheye(0.05, -0.02, 0.004, -0.001)


# Rotations


@given(vector)
def test_rotation_from_vector_is_rodrigues(w: Array) -> None:
    np.testing.assert_allclose(rotation_from_vector(w), Rotation.from_rotvec(w).as_matrix(), atol=1e-12)


@pytest.mark.parametrize("length", [0.0, 1e-12, 0.99e-8, 1.01e-8, 1e-5])
def test_rotation_from_vector_has_no_step_near_zero(length: float) -> None:
    w = length * np.array([0.6, 0.0, -0.8])
    np.testing.assert_allclose(rotation_from_vector(w), np.eye(3) + cross_matrix(w), atol=length**2 + 1e-16)


@pytest.mark.parametrize("degrees", [0.0, 1e-9, 1e-6, 1e-3, 45.0, 90.0, 179.0, 179.999, 179.999999, 180.0])
@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.36, -0.48, 0.8)])
def test_rotation_angle_at_both_ends(axis: tuple[float, float, float], degrees: float) -> None:
    rotation = rotation_from_vector(np.radians(degrees) * np.array(axis))
    assert rotation_angle_deg(rotation) == pytest.approx(degrees, rel=1e-6, abs=1e-13)


# Quaternions


@given(vector, st.floats(-9e-4, 9e-4))
def test_quaternions_of_both_signs_and_rounded_are_the_rotation(w: Array, excess: float) -> None:
    rotation = rotation_from_vector(w)
    q = Quaternion.from_matrix(rotation)
    assert q.w >= 0
    assert math.hypot(q.x, q.y, q.z, q.w) == pytest.approx(1)
    np.testing.assert_allclose(q.matrix(), rotation, atol=1e-12)
    np.testing.assert_array_equal(Quaternion(-q.x, -q.y, -q.z, -q.w).matrix(), q.matrix())
    for factor in (1 + excess, -1 - excess):
        found = Quaternion(factor * q.x, factor * q.y, factor * q.z, factor * q.w).normalized()
        np.testing.assert_allclose(found.matrix(), rotation, atol=1e-12)
        assert math.hypot(found.x, found.y, found.z, found.w) == pytest.approx(1, abs=1e-12)
        assert found.w >= 0
        assert found.normalized() == found


@pytest.mark.parametrize("axis", np.eye(3).tolist())
def test_half_turns_have_no_real_part(axis: list[float]) -> None:
    q = Quaternion.from_matrix(2 * np.outer(axis, axis) - np.eye(3))
    assert q.w == pytest.approx(0)
    assert np.abs([q.x, q.y, q.z]) == pytest.approx(axis)


@pytest.mark.parametrize(
    "parts", [(0, 0, 0, 0), (0, 0, 0, 1.01), (0.5, 0.5, 0.5, 0.6), (math.nan, 0, 0, 1), (0, math.inf, 0, 0)]
)
def test_refuses_what_is_no_unit_quaternion(parts: tuple[float, float, float, float]) -> None:
    with pytest.raises(ValueError, match="norm"):
        Quaternion(*parts).matrix()


# Rigid motions and similarities


@pytest.mark.parametrize(
    "matrix",
    [np.diag([1.0, 1.0, -1.0]), 1.1 * np.eye(3), np.zeros((3, 3)), np.full((3, 3), np.nan), np.eye(2)],
    ids=["reflection", "scaled", "zero", "nan", "shape"],
)
def test_refuses_what_is_no_rotation(matrix: Array) -> None:
    with pytest.raises(ValueError, match="rotation"):
        nearest_rotation(matrix)


def test_nearest_rotation_repairs_rounding() -> None:
    exact = rotation_from_vector([0.3, -0.2, 0.9])
    repaired = nearest_rotation(np.round(exact, 4))
    np.testing.assert_allclose(repaired @ repaired.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(repaired, exact, atol=1e-4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m[:2], "4x4 or 3x4"),
        (lambda m: m + np.diag([0, 0, 0, 1.0]), "last row"),
        (lambda m: np.full((4, 4), np.nan), "not finite"),
        (lambda m: np.where((np.arange(4)[:, None] == 1) & (np.arange(4) == 3), np.inf, m), "not finite"),
    ],
    ids=["shape", "last row", "nan", "infinite"],
)
def test_refuses_what_is_no_rigid_matrix(change: object, message: str) -> None:
    assert callable(change)
    with pytest.raises(ValueError, match=message):
        RigidTransform.from_matrix(change(np.eye(4)))
    with pytest.raises(ValueError, match="column by column"):
        RigidTransform.from_matrix(RigidTransform(np.eye(3), np.ones(3)).matrix().T)


@given(rigid, rigid, rigid, point)
def test_rigid_motions_act_as_their_matrices(a: RigidTransform, b: RigidTransform, c: RigidTransform, x: Array) -> None:
    for matrix in (a.matrix(), a.matrix()[:3]):
        assert_pose_close(RigidTransform.from_matrix(matrix), a, metres=0, degrees=1e-10)
    np.testing.assert_allclose(a.quaternion().matrix(), a.rotation, atol=1e-12)
    for there_and_back in (a.compose(a.inverse()), a.inverse().compose(a)):
        assert_pose_close(there_and_back, RigidTransform.identity(), metres=1e-11, degrees=1e-11)
    expected = reduce(np.matmul, [t.matrix() for t in (a, b, c)])
    np.testing.assert_allclose(a.compose(b).compose(c).matrix(), expected, atol=1e-10)
    np.testing.assert_allclose(a.compose(b.compose(c)).matrix(), expected, atol=1e-10)
    np.testing.assert_allclose(a.compose(b).apply(x), a.apply(b.apply(x)), atol=1e-10)
    np.testing.assert_allclose(a.apply(x), (a.matrix() @ [*x, 1.0])[:3], atol=1e-10)
    np.testing.assert_array_equal(a.apply(np.zeros(3)), a.translation)
    np.testing.assert_allclose(a.shifted(b.translation).apply(x), a.apply(x) + b.translation, atol=1e-10)


@given(similarity, rigid, point)
def test_a_similarity_moves_points_and_cameras_alike(
    target_from_source: Similarity, source_from_camera: RigidTransform, x: Array
) -> None:
    expected = target_from_source.scale * target_from_source.rotation @ x + target_from_source.translation
    np.testing.assert_allclose(target_from_source.apply(x), expected, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(target_from_source.inverse().apply(target_from_source.apply(x)), x, atol=1e-8)
    seen = target_from_source.transform_pose(source_from_camera).apply(target_from_source.scale * x)
    moved = target_from_source.apply(source_from_camera.apply(x))
    np.testing.assert_allclose(seen, moved, rtol=1e-9, atol=1e-7)


@pytest.mark.parametrize("shape", [(), (1,), (0,), (2, 5)])
def test_points_come_in_any_batch(shape: tuple[int, ...]) -> None:
    random = random_for("batch", shape)
    transform = RigidTransform(rotation_from_vector(random.normal(size=3)), random.normal(size=3))
    x = random.normal(size=(*shape, 3))
    for moved in (transform.apply(x), Similarity(2.0, transform.rotation, transform.translation).apply(x)):
        assert moved.shape == x.shape
    assert CAMERA.project(x).shape == (*shape, 2)
    assert CAMERA.rays(CAMERA.project(x)).shape == x.shape
    assert normalize_jacobian(x).shape == (*shape, 2, 3)


# Projection


@given(st.floats(-200.0, 1200.0), st.floats(-200.0, 1000.0), st.floats(0.01, 1000.0))
def test_projection_inverts_rays(x: float, y: float, depth: float) -> None:
    np.testing.assert_allclose(CAMERA.project(depth * CAMERA.rays([x, y])), [x, y], atol=1e-9)


@pytest.mark.parametrize("depth", [0.0, -1.0, np.nan])
@pytest.mark.parametrize("distortion", [None, LENS, FISHEYE])
def test_what_is_not_in_front_projects_to_nan(distortion: Distortion | None, depth: float) -> None:
    camera = Camera(640, 480, 500.0, 500.0, 320.0, 240.0, distortion)
    assert np.isnan(camera.project([0.1, 0.2, depth])).all()
    assert np.isnan(normalize_jacobian([0.1, 0.2, depth])[:, 2]).all()


@given(st.tuples(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0), st.floats(0.2, 10.0)).map(np.array))
def test_normalize_jacobian(x: Array) -> None:
    assert_jacobian(normalize_jacobian(x), normalize, x, step=1e-6 * x[2], tolerance=1e-6)


def test_distortion_is_opencvs() -> None:
    x_in_camera = random_for("distortion").uniform([-1.0, -0.8, 1.0], [1.0, 0.8, 3.0], (200, 3))
    camera = Camera(640, 480, 500.0, 505.0, 321.0, 238.0)
    k, still = camera.matrix(), np.zeros(3)

    coefficients = np.array([LENS.k1, LENS.k2, LENS.p1, LENS.p2, LENS.k3])
    expected, _ = cv2.projectPoints(x_in_camera, still, still, k, coefficients)
    lens = Camera(640, 480, 500.0, 505.0, 321.0, 238.0, LENS)
    np.testing.assert_allclose(lens.project(x_in_camera), expected[:, 0], atol=1e-9)

    coefficients = np.array([FISHEYE.k1, FISHEYE.k2, FISHEYE.k3, FISHEYE.k4])
    expected, _ = cv2.fisheye.projectPoints(x_in_camera[:, None], still, still, k, coefficients)
    fisheye = Camera(640, 480, 500.0, 505.0, 321.0, 238.0, FISHEYE)
    np.testing.assert_allclose(fisheye.project(x_in_camera), expected[:, 0], atol=1e-9)


# Size


@given(st.integers(1, 2000), st.integers(1, 2000), point.filter(lambda x: not 0 < abs(x[2]) < 1e-6))
def test_a_resized_camera_sees_the_resized_pixel(width: int, height: int, x: Array) -> None:
    resized = CAMERA.resized(width, height)
    u, v = CAMERA.project(x)
    expected = [resized_pixel(u, width / CAMERA.width_px), resized_pixel(v, height / CAMERA.height_px)]
    np.testing.assert_allclose(resized.project(x), expected, rtol=1e-9, atol=1e-9)
    assert (resized.width_px, resized.height_px) == (width, height)


@settings(max_examples=20, deadline=None)
@given(st.floats(80.0, 120.0), st.floats(60.0, 90.0), st.sampled_from([(150, 120), (100, 75), (67, 50)]))
def test_a_blob_goes_where_the_rule_says(x: float, y: float, size: tuple[int, int]) -> None:
    columns, rows = np.meshgrid(np.arange(200), np.arange(150))
    blob = np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * 6.0**2))
    small = cv2.resize(blob, size, interpolation=cv2.INTER_AREA)
    columns, rows = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    centroid = np.array([(columns * small).sum(), (rows * small).sum()]) / small.sum()
    expected = [resized_pixel(x, size[0] / 200), resized_pixel(y, size[1] / 150)]
    np.testing.assert_allclose(centroid, expected, atol=0.02)
