"""Intrinsics that are grossly wrong: half or double the focal length, those of another image, one focal length."""

from dataclasses import replace

import numpy as np
import pytest
from support.planted import stages
from support.scenes import make_scene, random_for

from mapless.geometry import Camera
from mapless_server.method.intrinsics import IntrinsicsEvidence
from mapless_server.method.options import IntrinsicsSigma
from mapless_server.method.rejection import IntrinsicsParameter, Rejection
from mapless_server.method.results import Support
from mapless_server.method.trust.wrong_camera import WrongCameraOptions, wrong_camera

FOCAL, X, Y, _ = IntrinsicsParameter


def rejection_of(
    focal: float = 1.0, principal: float = 1.0, focal_x: float = 1.0, outliers: float = 0.0, sigma: float | None = None
) -> tuple[Rejection | None, Camera]:
    """Of a photograph with intrinsics that are wrong by these factors; and the true camera."""
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
    query = replace(scene.query, camera=given, features=replace(scene.query.features, keypoints=keypoints))
    structure, matches, estimate = stages(replace(scene, query=query), scene.references)
    support = Support(query, scene.references, structure, matches, estimate, np.zeros(3))
    usual = (IntrinsicsSigma() if sigma is None else IntrinsicsSigma(focal_share=sigma)).of(given)
    zero = np.zeros(4)
    evidence = IntrinsicsEvidence(given, given, zero, usual, usual, np.zeros((4, 4)), np.zeros((6, 4)), zero)
    return wrong_camera(support, evidence, "a", WrongCameraOptions()), true


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
    rejection, true = rejection_of(**errors)
    assert rejection
    assert {it.parameter for it in rejection.intrinsics_checks if it.conflict} == named
    (focal,) = (it for it in rejection.intrinsics_checks if it.parameter is FOCAL)
    assert focal.estimated == pytest.approx(true.focal_x_px, rel=0.1)
    assert f"focal_x_px {focal.estimated:.0f} instead of {focal.given:.0f}" in rejection.message


@pytest.mark.parametrize("outliers", [0.0, 0.5, 0.8])
def test_a_right_camera_is_not_accused_for_outliers(outliers: float) -> None:
    assert rejection_of(outliers=outliers)[0] is None


@pytest.mark.parametrize("focal", [1.1, 1.5])
def test_a_focal_length_that_may_be_so_wrong_is_not_named(focal: float) -> None:
    assert rejection_of(focal=focal, sigma=0.5)[0] is None
