"""Errors of a photograph's intrinsics: their derivatives, the evidence of them, and what they add to a covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.planted import NOISE, stages, true_structure
from support.scenes import SceneOptions, SyntheticScene, make_scene, random_for

from mapless.geometry import Array, Camera, Distortion, Fisheye, RadialTangential
from mapless_server.method.adjust import SHARED_CAMERA, AdjustOptions, adjust_pose, pose_problem, with_intrinsics
from mapless_server.method.features import undistort_pixels
from mapless_server.method.intrinsics import IntrinsicsSigma, corrected, keypoint_motion
from mapless_server.method.results import PoseEstimate

LENSES = {
    "pinhole": None,
    "strong": RadialTangential(-0.28, 0.07, 0.001, -0.002),
    "fisheye": Fisheye(0.03, -0.015, 0.004, -0.001),
    "empty fisheye": Fisheye(),
}
ERRORS = {"focal length": (0.01, 0, 0, 0), "principal point": (0, 8.0, -6.0, 0), "k1": (0, 0, 0, 0.03)}


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_keypoint_motion_equals_differences_of_undistortion(lens: Distortion | None) -> None:
    camera = Camera(640, 480, 450.0, 455.0, 321.0, 238.0, lens)
    pixels = random_for("keypoint motion").uniform([0, 0], [639, 479], (40, 2))

    def ideal(errors: Array) -> Array:
        """In pixels of the given pinhole."""
        other = corrected(camera, errors)
        return camera.pinhole().project(other.rays(undistort_pixels(pixels, other)))

    motion = keypoint_motion(camera.pinhole(), lens, undistort_pixels(pixels, camera))
    for i, step in enumerate((1e-4, 1e-2, 1e-2, 1e-4)):
        axis = step * np.eye(4)[i]
        expected = (ideal(-axis) - ideal(axis)) / (2 * step)
        np.testing.assert_allclose(motion[:, :, i], expected, atol=1e-3)


def misread(scene: SyntheticScene, errors: tuple[float, ...]) -> SyntheticScene:
    """The same photograph, whose intrinsics are given with these errors."""
    query = scene.query
    given = corrected(query.camera, -np.array(errors))
    raw = query.camera.project(query.camera.rays(query.features.keypoints.astype(float)))
    keypoints = undistort_pixels(raw, given).astype(np.float32)
    view = replace(query, camera=given.pinhole(), features=replace(query.features, keypoints=keypoints))
    return replace(scene, query=replace(view, distortion=given.distortion))


def adjusted(scene: SyntheticScene, sigma: IntrinsicsSigma | None = None) -> PoseEstimate:
    structure, matches, estimate = stages(scene, scene.references)
    return adjust_pose(scene.query, scene.references, structure, matches, estimate, AdjustOptions(), intrinsics=sigma)


@pytest.mark.parametrize("parameter", ERRORS)
def test_planted_errors_are_found_within_their_sigma(parameter: str) -> None:
    """Within three of them, and they are significant."""
    errors = np.array(ERRORS[parameter], float)
    evidence = adjusted(misread(make_scene(random_for("planted", parameter)), tuple(errors))).intrinsics
    assert evidence
    wrong = errors != 0
    assert (np.abs(evidence.value - errors)[wrong] < 3 * evidence.sigma[wrong]).all()
    assert (np.abs(evidence.value)[wrong] > 4 * evidence.sigma[wrong]).any()


def test_right_intrinsics_have_no_significant_errors() -> None:
    found = [adjusted(make_scene(random_for("right", i))).intrinsics for i in range(10)]
    normalized = np.array([it.value / it.sigma for it in found if it])
    assert np.abs(normalized).max() < 1.5


def test_a_flat_wall_does_not_determine_the_focal_length() -> None:
    frontal = SceneOptions(box_m=(4.0, 2.4, 0.0), query_offset_m=(0.0, 0.0, 0.0), reference_count=2)
    flat, deep = (adjusted(make_scene(random_for("flat"), it)).intrinsics for it in (frontal, SceneOptions()))
    assert flat
    assert deep
    assert flat.sigma[0] > 10 * deep.sigma[0]
    assert flat.sigma[0] > 0.02


def test_less_certain_intrinsics_make_the_covariance_larger() -> None:
    """Where a flat wall does not determine the focal length, a longer one moves the camera back by its share."""
    scene = make_scene(random_for("wall"), SceneOptions(box_m=(4.0, 2.4, 0.0), query_offset_m=(0.0, 0.0, 0.0)))
    for share in (0.003, 0.006):
        found = adjusted(scene, IntrinsicsSigma(focal_share=share, principal_share=1e-6, k1=1e-6))
        sigma_m = np.sqrt(np.linalg.eigvalsh(found.covariance[:3, :3])[-1])
        assert sigma_m == pytest.approx(share * 4.0, rel=0.35)


def test_a_camera_shared_with_the_references_errs_less() -> None:
    """The same image from references of another camera has the usual errors."""
    scene = make_scene(random_for("shared"))
    other = replace(scene.query.camera, focal_x_px=900.0, focal_y_px=900.0)
    strangers = tuple(replace(it, view=replace(it.view, camera=other)) for it in scene.references)
    assert scene.query.has_camera_of(scene.references[0].view)
    assert not scene.query.has_camera_of(strangers[0].view)
    usual = IntrinsicsSigma().of(scene.query.camera)
    found = adjusted(scene).intrinsics
    assert found
    np.testing.assert_allclose(found.prior_sigma, SHARED_CAMERA * usual)
    stated = adjusted(scene, IntrinsicsSigma()).intrinsics
    assert stated
    np.testing.assert_allclose(stated.prior_sigma, usual)


def test_reduced_equations_equal_those_of_plain_rows() -> None:
    """The last four unknowns of the normal equations, from the rows of the query's observations."""
    scene = make_scene(random_for("reduced"), SceneOptions(point_count=25, reference_count=3))
    structure, matches = true_structure(scene, NOISE)
    problem, state = pose_problem(
        scene.query, scene.references, structure, matches, np.arange(len(matches)), scene.world_from_query,
        AdjustOptions(),
    )  # fmt: skip
    wide, there = with_intrinsics(problem, state, scene.query)
    there = replace(there, intrinsics=np.array([1e-3, 0.5, -0.5, 2e-3]))
    point, view = wide.by_view.point, wide.by_view.view
    residual, by_point, by_pose = wide.by_view.linearized(there)
    cameras, count = 24, len(state.points)
    jacobian = np.zeros((len(point), 2, cameras + 4 + 3 * count))
    for o, (p, v) in enumerate(zip(point, view, strict=True)):
        jacobian[o, :, 6 * v : 6 * v + 6] = by_pose[:, :, o]
        jacobian[o, :, cameras + 4 + 3 * p : cameras + 7 + 3 * p] = by_point[:, :, o]
    jacobian[view == 3, :, cameras : cameras + 4] = wide.keypoint_motion
    weighted = jacobian / (1 + (residual**2).sum(axis=0) / wide.loss_scale_sigma**2)[:, None, None]
    matrix = np.einsum("oka,okb->ab", weighted, jacobian)
    gradient = np.einsum("oka,ko->a", weighted, residual)
    split = cameras + 4
    crossed = matrix[:split, split:] @ np.linalg.inv(matrix[split:, split:])
    reduced, right, _ = wide.by_view.equations(there, wide.loss_scale_sigma).reduced(0.0)
    scale = np.sqrt(np.diag(matrix)[:split])
    expected = matrix[:split, :split] - crossed @ matrix[split:, :split]
    np.testing.assert_allclose(reduced / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-9)
    slopes = gradient[:split] - crossed @ gradient[split:]
    np.testing.assert_allclose(right / scale, slopes / scale, atol=1e-9 * np.abs(gradient[:split] / scale).max())


@pytest.mark.parametrize("wrong", [{"focal_share": 0.0}, {"principal_share": -1.0}, {"k1": float("nan")}, {"k1": 2.0}])
def test_standard_deviations_outside_their_bounds_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        IntrinsicsSigma(**wrong)
