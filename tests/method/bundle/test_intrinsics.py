"""Errors of a photograph's intrinsics: their derivatives, the evidence of them, and what they add to a covariance."""

import re
from dataclasses import fields, replace

import numpy as np
import pytest
from support.compare import assert_pose_close
from support.lenses import Division, Stereographic, add_planted_lenses
from support.planted import NOISE, stages, true_structure
from support.scenes import SceneOptions, SyntheticScene, make_scene, random_for

from mapless.geometry import Array, Camera
from mapless.lenses import Distortion, Fisheye, RadialTangential
from mapless_server.method.bundle.adjust import adjust_pose
from mapless_server.method.bundle.estimate import PosedSupport, PoseEstimate, PoseStage, Support
from mapless_server.method.bundle.intrinsics import (
    IntrinsicsEvidence,
    corrected,
    keypoint_motion,
    read_as,
)
from mapless_server.method.bundle.pose_problem import AdjustInput, AdjustOptions, pose_problem, with_intrinsics
from mapless_server.method.bundle.priors import IntrinsicsSigma
from mapless_server.method.features.views import View, undistort_pixels
from mapless_server.method.judge import cameras
from mapless_server.method.judge.answer import Answer
from mapless_server.method.judge.cameras import wrong_camera
from mapless_server.method.judge.hints import hinted
from mapless_server.method.judge.intrinsics import intrinsics_checks, is_camera_doubtful, wrong_intrinsics
from mapless_server.method.rejection import Advice, IntrinsicsParameter, Rejection, RejectionReason
from mapless_server.method.structure.model import PointMatches

LENSES = {
    "pinhole": None,
    "strong": RadialTangential(-0.28, 0.07, 0.001, -0.002),
    "fisheye": Fisheye(0.03, -0.015, 0.004, -0.001),
    "empty fisheye": Fisheye(),
    "without k1": Division(-0.2),
    "without a radial coefficient": Stereographic(0.01),
}


@pytest.fixture(autouse=True)
def planted_lenses(monkeypatch: pytest.MonkeyPatch) -> None:
    add_planted_lenses(monkeypatch)


ERRORS = {"focal length": (0.01, 0, 0, 0), "principal point": (0, 16.0, -14.0, 0), "k1": (0, 0, 0, 0.06)}


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


def misread(scene: SyntheticScene, errors: tuple[float, ...], distortion: Distortion | None = None) -> SyntheticScene:
    """The same photograph, by a camera of this lens, whose intrinsics are given with these errors."""
    query = replace(scene.query, camera=replace(scene.query.camera, distortion=distortion))
    given = corrected(query.camera, -np.array(errors))
    raw = query.camera.project(query.camera.rays(query.features.keypoints.astype(float)))
    keypoints = undistort_pixels(raw, given).astype(np.float32)
    view = replace(query, camera=given.pinhole(), features=replace(query.features, keypoints=keypoints))
    return replace(scene, query=replace(view, distortion=given.distortion))


def adjusted(scene: SyntheticScene, sigma: IntrinsicsSigma | None = None) -> PoseEstimate:
    structure, matches, estimate = stages(scene, scene.references)
    return adjust_pose(AdjustInput(scene.query, scene.references, structure, matches, AdjustOptions(), sigma), estimate)


@pytest.mark.parametrize("lens", [None, Division(-0.2)], ids=["pinhole", "without k1"])
@pytest.mark.parametrize("parameter", ERRORS)
def test_planted_errors_are_found_within_their_sigma(parameter: str, lens: Distortion | None) -> None:
    """Within three of them, and they are significant."""
    errors = np.array(ERRORS[parameter], float)
    evidence = adjusted(misread(make_scene(random_for("planted", parameter)), tuple(errors), lens)).intrinsics
    assert evidence
    wrong = errors != 0
    assert (np.abs(evidence.value - errors)[wrong] < 3 * evidence.sigma[wrong]).all()
    assert (np.abs(evidence.value)[wrong] > 4 * evidence.sigma[wrong]).any()


def test_a_lens_without_a_radial_coefficient_is_held() -> None:
    """The other parameters are found as ever; of k1 only the prior is known, and nothing contradicts it."""
    scene = misread(make_scene(random_for("planted", "held")), (0.03, 0, 0, 0), Stereographic())
    evidence = adjusted(scene).intrinsics
    assert evidence
    assert abs(evidence.value[0] - 0.03) < 3 * evidence.sigma[0] < 0.01
    assert (evidence.value[3], evidence.removed[3]) == (0.0, 0.0)
    assert evidence.sigma[3] == pytest.approx(evidence.prior_sigma[3])
    judged = wrong_intrinsics(evidence, "best")
    assert judged
    assert [it.parameter for it in judged.intrinsics_checks if it.conflict] == [FOCAL]


def test_what_the_matches_of_a_reference_share_is_in_the_sigma() -> None:
    """A wrong focal length of two references of five, by which the photograph's is off and more uncertain."""
    scene = make_scene(random_for("shared error"), SceneOptions(reference_count=5))
    wrong = [
        replace(it, view=replace(it.view, camera=corrected(it.view.camera, (error, 0, 0, 0)).pinhole()))
        for it, error in zip(scene.references, (0.02, 0, -0.015, 0, 0), strict=True)
    ]
    right, off = (adjusted(replace(scene, references=tuple(it))).intrinsics for it in (scene.references, wrong))
    assert right
    assert off
    assert off.sigma[0] > 2 * right.sigma[0]
    assert abs(off.value[0]) < 3 * off.sigma[0]


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
    """The errors that photographs of one camera share are in the references' points too."""
    scene = make_scene(random_for("shared"))
    other = replace(scene.query.camera, focal_x_px=900.0, focal_y_px=900.0)
    assert scene.query.has_camera_of(scene.references[0].view)
    assert not replace(scene.query, camera=other).has_camera_of(scene.references[0].view)
    shared, stated = adjusted(scene).intrinsics, adjusted(scene, IntrinsicsSigma()).intrinsics
    assert shared
    assert stated
    np.testing.assert_array_equal(shared.prior_sigma, stated.prior_sigma)
    assert np.trace(shared.pose_covariance) < 0.2 * np.trace(stated.pose_covariance)


@pytest.mark.parametrize(("error", "is_shared"), [(0.0, True), (0.008, False)])
def test_a_photograph_that_errs_otherwise_shares_no_camera(error: float, is_shared: bool) -> None:
    """K is that of the references, but the photograph is of a focal length of its own, too near to be named."""
    scene = make_scene(random_for("other camera"), SceneOptions(point_count=600, noise_px=0.3))
    query = scene.query
    x_in_camera = query.camera.rays(query.features.keypoints.astype(float))
    true = corrected(query.camera, (error, 0, 0, 0)).pinhole()
    keypoints = true.project(x_in_camera).astype(np.float32)
    scene = replace(scene, query=replace(query, features=replace(query.features, keypoints=keypoints)))
    found, stated = adjusted(scene), adjusted(scene, IntrinsicsSigma())
    assert found.intrinsics
    assert wrong_intrinsics(found.intrinsics, "best") is None
    sigma_m, stated_m = (np.sqrt(np.trace(it.covariance[:3, :3])) for it in (found, stated))
    assert (sigma_m < 0.7 * stated_m) == is_shared, (sigma_m, stated_m, found.intrinsics.value, found.intrinsics.sigma)
    off_m = np.linalg.norm(found.world_from_camera.translation - scene.world_from_query.translation)
    assert off_m < 2 * sigma_m


LARGE = {
    "focal length 3 %": (-0.03, 0, 0, 0),
    "focal length 10 %": (0.1, 0, 0, 0),
    "principal point": (0, 60.0, 0, 0),
    "k1": (0, 0, 0, -0.3),
}


@pytest.mark.parametrize("case", LARGE)
def test_a_contradicted_parameter_is_estimated_with_the_pose(case: str) -> None:
    """Every tenth match is wrong. The value is within three of its standard deviations, the others stay as given."""
    errors = np.array(LARGE[case], float)
    scene = make_scene(random_for("large", case), SceneOptions(outlier_share=0.1))
    found = adjusted(misread(scene, tuple(errors)))
    assert found.intrinsics
    assert found.view
    wrong, sigma = errors != 0, found.intrinsics.sigma
    assert (np.abs(found.intrinsics.value - errors) < 3 * sigma)[wrong].all()
    assert (np.abs(found.intrinsics.removed - errors) < 1.5 * found.intrinsics.prior_sigma).all()
    assert_pose_close(found.world_from_camera, scene.world_from_query, metres=0.012, degrees=0.2)
    judged = wrong_intrinsics(found.intrinsics, "best")
    assert judged
    assert [it.conflict for it in judged.intrinsics_checks] == wrong.tolist()


@pytest.mark.parametrize("case", LARGE)
def test_a_wide_prior_leaves_the_intrinsics_to_the_photograph(case: str) -> None:
    """As for a camera of which nobody knows the focal length: the same pose as with the defaults, and no conflict."""
    scene = make_scene(random_for("large", case), SceneOptions(outlier_share=0.1))
    found = adjusted(misread(scene, tuple(LARGE[case])), IntrinsicsSigma(focal_share=0.2, principal_share=0.2, k1=0.6))
    assert found.intrinsics
    assert (found.intrinsics.removed != 0).any()
    assert_pose_close(found.world_from_camera, scene.world_from_query, metres=0.012, degrees=0.2)
    assert wrong_intrinsics(found.intrinsics, "best") is None


def test_a_prior_as_wide_as_that_of_estimates_ends() -> None:
    """A parameter that is off by more than such a prior is estimated once, not again and again."""
    scene = misread(make_scene(random_for("large", "wide"), SceneOptions(outlier_share=0.1)), (-0.26, 0, 0, 0))
    found = adjusted(scene, IntrinsicsSigma(focal_share=0.24))
    assert found.intrinsics
    assert found.intrinsics.removed[0] == pytest.approx(-0.26, abs=0.005)


def test_right_intrinsics_are_never_rejected() -> None:
    for case in range(6):
        few = SceneOptions(point_count=80, noise_px=1.5, outlier_share=0.2)
        scene = make_scene(random_for("never", case), few if case % 2 else SceneOptions(outlier_share=0.2))
        found = adjusted(scene)
        assert found.intrinsics
        assert found.view is None
        assert wrong_intrinsics(found.intrinsics, "best") is None


def test_a_flat_wall_contradicts_no_focal_length() -> None:
    """A nearer camera with a wider lens has the same image."""
    frontal = SceneOptions(box_m=(4.0, 2.4, 0.0), query_offset_m=(0.0, 0.0, 0.0), reference_count=2)
    found = adjusted(misread(make_scene(random_for("wall"), frontal), (0.05, 0, 0, 0)))
    assert found.view is None
    assert found.intrinsics
    assert wrong_intrinsics(found.intrinsics, "best") is None


def evidence_of(lens: Distortion | None, value: tuple[float, ...]) -> IntrinsicsEvidence:
    """Evidence about a photograph that was reduced to half its size."""
    sent = Camera(1280, 960, 1050.0, 1052.0, 641.0, 479.0, lens)
    sigma, covariance = np.array([0.002, 1.0, 1.0, 0.01]), np.zeros((4, 4))
    prior_sigma, motion = IntrinsicsSigma().of(sent.resized(640, 480)), np.zeros((6, 4))
    given, values = sent.resized(640, 480), np.array(value)
    return IntrinsicsEvidence(given, sent, values, sigma, prior_sigma, covariance, motion, values)


@pytest.mark.parametrize(
    ("lens", "value", "message", "advice"),
    [
        (None, (0.03, 0, 0, 0), "focal_x_px is 1050.0, the photograph says 1082.0 +- 2.1", "focal length"),
        (None, (0, 20.0, 0, 0), "principal_x_px is 641.0, the photograph says 681.0 +- 2.0", "principal point"),
        (None, (0, 0, 0, -0.21), "k1 is 0.000, the photograph says -0.210 +- 0.010", "without lens distortion"),
        (Fisheye(), (0, 0, 0, 0.34), "k1 is 0.000, the photograph says 0.340", "fisheye without coefficients"),
        (Fisheye(0.1), (0, 0, 0, 0.2), "k1 is 0.100, the photograph says 0.300", "the order of its coefficients"),
        (None, (0.03, 0, 0, -0.3), "k1 is 0.000, .* +- 0.010; focal_x_px is", "without lens distortion"),
    ],
)
def test_a_rejection_names_the_parameter_and_its_value(
    lens: Distortion | None, value: tuple[float, ...], message: str, advice: str
) -> None:
    rejection = wrong_intrinsics(evidence_of(lens, value), "scenes/hall/references/a")
    assert rejection
    assert rejection.reason is RejectionReason.GATE
    assert re.search(message.replace("+-", r"\+-"), rejection.message), rejection.message
    assert rejection.hint
    assert rejection.hint.advice is Advice.CHECK_CALIBRATION
    assert advice in rejection.hint.message


def test_what_the_prior_allows_is_no_conflict() -> None:
    """One percent of the focal length is significant, but three of both standard deviations together."""
    (focal, *_) = intrinsics_checks(evidence_of(None, (0.0105, 0, 0, 0)))
    assert not focal.conflict
    assert focal.used
    assert focal.estimated == pytest.approx(1050 * np.exp(0.0105))
    wider = replace(evidence_of(None, (0.03, 0, 0, 0)), prior_sigma=np.array([0.02, 2, 2, 0.01]))
    assert wrong_intrinsics(wider, "best") is None
    unsure = replace(evidence_of(None, (0.3, 0, 0, 0)), sigma=np.array([0.05, 1, 1, 0.01]))
    assert wrong_intrinsics(unsure, "best") is None


def test_reduced_equations_equal_those_of_plain_rows() -> None:
    """The last four unknowns of the normal equations, from the rows of the query's observations."""
    scene = make_scene(random_for("reduced"), SceneOptions(point_count=25, reference_count=3))
    structure, matches = true_structure(scene, NOISE)
    given = AdjustInput(scene.query, scene.references, structure, matches, AdjustOptions())
    problem, start = pose_problem(given, np.arange(len(matches)), scene.world_from_query)
    wide, bundle = with_intrinsics(problem, start.bundle, scene.query)
    there = wide.at(replace(bundle, intrinsics=np.array([1e-3, 0.5, -0.5, 2e-3])))
    point, view = wide.by_view.point, wide.by_view.view
    residual, by_point, by_pose = there.residual, there.by_point, there.by_pose
    cameras, count = 24, len(bundle.points)
    jacobian = np.zeros((len(point), 2, cameras + 4 + 3 * count))
    for o, (p, v) in enumerate(zip(point, view, strict=True)):
        jacobian[o, :, 6 * v : 6 * v + 6] = by_pose[:, :, o]
        jacobian[o, :, cameras + 4 + 3 * p : cameras + 7 + 3 * p] = by_point[:, :, o]
    jacobian[view == 3, :, cameras : cameras + 4] = np.moveaxis(wide.by_view.by_intrinsics, 2, 0)
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


FOCAL, X, Y, K1 = IntrinsicsParameter


def rejection_of(
    focal: float = 1.0,
    principal: float = 1.0,
    focal_x: float = 1.0,
    outliers: float = 0.0,
    sigma: float | None = None,
    doubted: float = 3.1,
    is_estimated: bool = False,
    lens: Distortion | None = None,
    given_lens: Distortion | None = None,
    count: int | None = None,
) -> tuple[Rejection | None, Camera]:
    """The judgement of what `support_of` makes, and the true camera."""
    support, true = support_of(
        focal, principal, focal_x, outliers, sigma, doubted, is_estimated, lens, given_lens, count
    )
    return wrong_camera(support, "a"), true


def support_of(
    focal: float = 1.0,
    principal: float = 1.0,
    focal_x: float = 1.0,
    outliers: float = 0.0,
    sigma: float | None = None,
    doubted: float = 3.1,
    is_estimated: bool = False,
    lens: Distortion | None = None,
    given_lens: Distortion | None = None,
    count: int | None = None,
) -> tuple[PosedSupport, Camera]:
    """The support of a photograph with intrinsics wrong by these factors, by `doubted` standard deviations.

    They may be estimated with the pose, and the lens may be another than the given one. It has so many matches.
    """
    scene = make_scene(random_for("wrong camera"))
    random, true = random_for("outliers"), scene.query.camera
    keypoints = scene.query.features.keypoints.copy()
    wrong = random.random(len(keypoints)) < outliers
    keypoints[wrong] = random.uniform((0, 0), (true.width_px, true.height_px), (wrong.sum(), 2))
    given = Camera(
        true.width_px,
        true.height_px,
        focal * focal_x * true.focal_x_px,
        focal * true.focal_y_px,
        principal * true.principal_x_px,
        principal * true.principal_y_px,
    )
    raw = replace(true, distortion=lens).project(true.rays(keypoints.astype(np.float64)))
    keypoints = undistort_pixels(raw, replace(true, distortion=given_lens)).astype(np.float32)
    features = replace(scene.query.features, keypoints=keypoints)
    query = replace(scene.query, camera=given, features=features, distortion=given_lens)
    structure, matches, estimate = stages(replace(scene, query=query), scene.references)
    if is_estimated:
        structure, matches, estimate = stages(scene, scene.references)
        estimate = replace(estimate, view=scene.query)
    stated = IntrinsicsSigma() if sigma is None else IntrinsicsSigma(focal_share=sigma)
    usual = stated.of(given)
    zero = np.zeros(4)
    value = np.array([doubted * np.hypot(usual[0], usual[0]), 0, 0, 0])
    evidence = IntrinsicsEvidence(given, given, value, usual, usual, np.zeros((4, 4)), np.zeros((6, 4)), zero)
    nothing = tuple(np.empty((0, 2), np.int32) for _ in scene.references)
    estimate = replace(estimate, intrinsics=evidence)
    if count is not None:
        rows = np.linspace(0, len(matches) - 1, count).astype(int)
        matches = matches.select(rows)
        estimate = replace(estimate, inliers=estimate.inliers[rows], errors_px=estimate.errors_px[rows])
    support = Support(query, scene.references, structure, matches, np.zeros(3), nothing, stated).posed(estimate)
    return support, true


@pytest.mark.parametrize(
    ("errors", "named"),
    [
        ({"focal": 0.5}, {FOCAL}),
        ({"focal": 2.0}, {FOCAL}),
        ({"focal": 1.5}, {FOCAL}),
        ({"focal": 0.5, "principal": 0.5}, {FOCAL, X, Y}),
        ({"focal": 2.0, "principal": 2.0}, {FOCAL, X, Y}),
        ({"focal_x": 1.25}, {FOCAL}),
    ],
)
def test_a_planted_gross_error_is_named_with_its_value(
    errors: dict[str, float], named: set[IntrinsicsParameter]
) -> None:
    rejection, true = rejection_of(**errors)  # type: ignore[arg-type]  # all are factors
    assert rejection
    assert {it.parameter for it in rejection.intrinsics_checks if it.conflict} == named
    (focal,) = (it for it in rejection.intrinsics_checks if it.parameter is FOCAL)
    assert focal.estimated == pytest.approx(true.focal_x_px, rel=0.1)
    assert f"focal_x_px {focal.estimated:.0f} instead of {focal.given:.0f}" in rejection.message


@pytest.mark.parametrize(
    ("lens", "given_lens", "k1"),
    [
        (RadialTangential(-0.28, 0.07), None, -0.28),
        (None, RadialTangential(-0.28, 0.07), 0.0),
        (RadialTangential(-0.2), RadialTangential(0.1), -0.2),
        (Fisheye(), None, -1 / 3),
        (None, Fisheye(), 1 / 3),
        (None, Division(-0.25), 0.0),
        (Division(-0.28), Division(0.05), -0.28),
        (None, Stereographic(), 0.0),
    ],
    ids=[
        *("forgotten", "undistorted already", "wrong coefficient", "a fisheye's", "no fisheye"),
        *("no lens without k1", "wrong coefficient without k1", "no lens without a radial coefficient"),
    ],
)
def test_another_lens_is_named_with_its_k1(lens: Distortion | None, given_lens: Distortion | None, k1: float) -> None:
    """As a camera without it has it: a ray of slope r is shown at r + k1 r^3, by a fisheye at arctan r."""
    rejection, _ = rejection_of(lens=lens, given_lens=given_lens)
    assert rejection
    (check,) = rejection.intrinsics_checks
    assert (check.parameter, check.conflict) == (K1, True)
    assert check.estimated == pytest.approx(k1, abs=0.06)
    assert check.given == (given_lens.k1 if given_lens else 0.0)
    assert f"k1 {check.estimated:.2f} instead of {check.given:.2f}" in rejection.message
    assert rejection.hint
    assert "lens" in rejection.hint.message


def test_a_wrong_camera_is_found_behind_a_strong_lens() -> None:
    """The photograph is read again with every camera that is tried: K of twice its size moves what the lens bends."""
    lens = RadialTangential(-0.28, 0.07)
    scene = make_scene(random_for("wrong camera"))
    true = replace(scene.query.camera, distortion=lens)
    given = replace(
        true,
        focal_x_px=2 * true.focal_x_px,
        focal_y_px=2 * true.focal_y_px,
        principal_x_px=true.width_px - 1,
        principal_y_px=true.height_px - 1,
    )
    view = replace(scene.query, distortion=lens)
    other = read_as(view, given)
    again = read_as(other, true).features.keypoints
    seen = np.isfinite(other.features.keypoints).all(axis=1)
    assert seen.any()
    np.testing.assert_allclose(again[seen], view.features.keypoints[seen], atol=0.1)


@pytest.mark.parametrize(("is_estimated", "is_named"), [(False, True), (True, False)])
def test_intrinsics_estimated_with_the_pose_are_its_own(is_estimated: bool, is_named: bool) -> None:
    """No other camera is named against intrinsics within what the caller allows."""
    rejection, _ = rejection_of(focal=1.25, sigma=0.08, is_estimated=is_estimated)
    assert (rejection is not None) == is_named


@pytest.mark.parametrize(("count", "is_accused"), [(22, False), (30, False), (300, True)])
def test_few_matches_accuse_no_camera(count: int, is_accused: bool) -> None:
    """Twice the true focal length: the pose of one that fits far more of 22 matches is rejected, its camera not."""
    rejection, _ = rejection_of(focal=2.0, count=count)
    assert rejection
    assert bool(rejection.intrinsics_checks) is is_accused
    assert (rejection.hint is not None) is is_accused
    assert ("focal" in rejection.message) is is_accused


@pytest.mark.parametrize(("count", "focal", "is_named"), [(None, 2.0, True), (30, 2.0, False), (None, 1.0, False)])
def test_a_rejection_without_a_pose_names_its_camera_likewise(count: int | None, focal: float, is_named: bool) -> None:
    support, true = support_of(focal=focal, count=count)
    unposed = Support(**{it.name: getattr(support, it.name) for it in fields(Support)})
    rejection = Rejection(RejectionReason.PNP_FAILED, "planted", tried=len(support.matches))
    shared = tuple(120 for _ in support.references)
    answer = Answer(rejection, reference_match_counts=shared, support=unposed)
    outcome = hinted(answer, support.query, support.references).outcome
    assert isinstance(outcome, Rejection)
    assert outcome.hint is not None
    assert (outcome.hint.advice is Advice.CHECK_CALIBRATION) is is_named
    assert ("Check the photograph's focal length" in outcome.hint.message) is is_named
    if is_named:
        (check,) = outcome.intrinsics_checks
        assert check.estimated == pytest.approx(true.focal_x_px, rel=0.1)
    else:
        assert outcome.intrinsics_checks == ()


def test_a_camera_that_sees_no_keypoint_fits_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """As that of a lens so strong that none of the photograph's pixels is one of its."""

    def blind(view: View, camera: Camera) -> View:
        keypoints = np.full_like(view.features.keypoints, np.nan)
        return replace(view, camera=camera.pinhole(), features=replace(view.features, keypoints=keypoints))

    monkeypatch.setattr(cameras, "read_as", blind)
    assert rejection_of(focal=2.0)[0] is None


def test_a_camera_that_nothing_doubts_is_not_compared() -> None:
    assert [is_camera_doubtful(support_of(focal=2.0, doubted=it)[0]) for it in (2.9, 3.1)] == [False, True]


@pytest.mark.parametrize("outliers", [0.0, 0.5, 0.8])
def test_a_right_camera_is_not_accused_for_outliers(outliers: float) -> None:
    assert rejection_of(outliers=outliers)[0] is None


@pytest.mark.parametrize("focal", [1.1, 1.5])
def test_a_focal_length_that_may_be_so_wrong_is_not_named(focal: float) -> None:
    assert rejection_of(focal=focal, sigma=0.5)[0] is None


@pytest.mark.parametrize(
    ("count", "share", "gain", "is_named"),
    [
        (400, 0.41, 1.05, False),
        (400, 0.43, 1.15, True),
        (400, 0.47, 1.12, False),
        (110, 0.41, 1.15, True),
        (90, 0.41, 1.15, False),
        (90, 0.41, 1.25, True),
    ],
)
def test_another_camera_must_be_clearly_better(count: int, share: float, gain: float, is_named: bool) -> None:
    """1.1 times as good where few of many matches agree with the given camera, else 1.2 times.

    A share of the matches is seen by the given camera, so many times as many by one of half its focal length.
    """
    scene = make_scene(random_for("gain"), SceneOptions(noise_px=0.1))
    structure, matches, _ = stages(scene, scene.references)
    random, camera = random_for("gain", count, share, gain), scene.query.camera
    used = random.permutation(len(matches))[:count]
    matches = PointMatches(matches.point[used], matches.keypoint[used], matches.guided[used], matches.radius_px)
    keypoints, own = scene.query.features.keypoints.copy(), round(share * count)
    other, wrong = np.split(matches.keypoint[own:], [round(gain * own)])
    centre = np.array([camera.principal_x_px, camera.principal_y_px])
    keypoints[other] = centre + (keypoints[other] - centre) / 2
    keypoints[wrong] = random.uniform((0, 0), (camera.width_px, camera.height_px), (len(wrong), 2))
    query = replace(scene.query, features=replace(scene.query.features, keypoints=keypoints))
    inliers = np.arange(count) < own
    usual, zero = IntrinsicsSigma().of(camera), np.zeros(4)
    doubted = IntrinsicsEvidence(camera, camera, 5 * usual, usual, usual, np.zeros((4, 4)), np.zeros((6, 4)), zero)
    estimate = PoseEstimate(scene.world_from_query, PoseStage.REFINED, inliers, zero, np.eye(6), intrinsics=doubted)
    nothing = tuple(np.empty((0, 2), np.int32) for _ in scene.references)
    support = Support(query, scene.references, structure, matches, np.zeros(3), nothing).posed(estimate)
    rejection = wrong_camera(support, "a")
    assert (rejection is not None) == is_named
