"""The camera of a photograph without intrinsics, on planted scenes."""

import math
from dataclasses import replace

import numpy as np
import pytest
from support.planted import true_correspondences
from support.scenes import CAMERA, SceneOptions, SyntheticScene, make_scene, observe, random_for

from mapless.geometry import Camera
from mapless.lenses import RadialTangential
from mapless_server.method.bundle.estimate import PosedSupport
from mapless_server.method.bundle.intrinsics import read_as
from mapless_server.method.bundle.priors import IntrinsicsSigma
from mapless_server.method.features.views import Photograph, View
from mapless_server.method.judge.answer import Localization
from mapless_server.method.localize import localize
from mapless_server.method.options import ChosenCamera, IntrinsicsSource, LocalizeOptions
from mapless_server.method.pairs.correspond import Matcher
from mapless_server.method.pipeline import Pipeline
from mapless_server.method.rejection import Advice, Rejection, RejectionReason
from mapless_server.method.unknown_camera import UNKNOWN, choose_camera

WIDE = replace(CAMERA, height_px=540, principal_y_px=269.5)
"""Other sides than those of the references."""


def scene_of(camera: Camera, options: SceneOptions | None = None, case: str = "unknown-camera") -> SyntheticScene:
    """A scene whose query, read as a pinhole's, is of a camera of its own."""
    options, random = options or SceneOptions(), random_for(case, camera)
    scene = make_scene(random, options)
    of_camera = replace(options, camera=camera)
    query, points = observe(random, of_camera, scene.x_in_world, scene.descriptors, scene.world_from_query)
    raster = Camera.centred(camera.width_px, camera.height_px, float(camera.width_px))
    return replace(scene, query=replace(query, camera=raster), query_points=points)


def chosen(scene: SyntheticScene, *guesses: ChosenCamera) -> ChosenCamera:
    found = choose_camera(scene.query, scene.references, true_correspondences(scene), guesses)
    assert found is not None
    return found


def guess(focal_px: float, share: float, source: IntrinsicsSource = IntrinsicsSource.EXIF) -> ChosenCamera:
    camera = Camera.centred(WIDE.width_px, WIDE.height_px, focal_px)
    return ChosenCamera(camera, replace(UNKNOWN, focal_share=share), source)


def test_focal_lengths_of_other_cameras_are_found() -> None:
    for focal_px in (420.0, 700.0, 816.0, 1900.0):
        found = chosen(scene_of(replace(WIDE, focal_x_px=focal_px, focal_y_px=focal_px)))
        assert found.source is IntrinsicsSource.ESTIMATED
        assert found.camera.focal_x_px == pytest.approx(focal_px, rel=0.01)


def test_half_of_the_matches_may_be_wrong() -> None:
    scene = scene_of(replace(WIDE, focal_x_px=1200.0, focal_y_px=1200.0), SceneOptions(outlier_share=0.3))
    correspondences = Matcher().correspond(scene.query, scene.references)
    right = [len(it) for it in true_correspondences(scene).query_matches]
    assert sum(right) < 0.55 * sum(map(len, correspondences.query_matches))
    found = choose_camera(scene.query, scene.references, correspondences, ())
    assert found is not None
    assert found.camera.focal_x_px == pytest.approx(1200.0, rel=0.01)


def test_a_guess_is_improved_by_the_matches() -> None:
    scene = scene_of(replace(WIDE, focal_x_px=700.0, focal_y_px=700.0))
    found = chosen(scene, guess(0.98 * 700.0, 0.03))
    assert found.source is IntrinsicsSource.EXIF
    assert found.camera.focal_x_px == pytest.approx(700.0, rel=0.01)


def test_a_guess_that_the_matches_contradict_is_not_taken() -> None:
    scene = scene_of(replace(WIDE, focal_x_px=700.0, focal_y_px=700.0))
    found = chosen(scene, guess(1400.0, 0.03))
    assert found.source is IntrinsicsSource.ESTIMATED
    assert found.camera.focal_x_px == pytest.approx(700.0, rel=0.01)


def test_references_of_the_same_sides_give_their_camera() -> None:
    assert chosen(scene_of(CAMERA)).camera == CAMERA
    for focal_px in (1000.0, 1.03 * CAMERA.focal_x_px):  # far off, and so near that scores do not tell
        other = chosen(scene_of(replace(CAMERA, focal_x_px=focal_px, focal_y_px=focal_px)))
        assert other.source is IntrinsicsSource.ESTIMATED
        assert other.camera.focal_x_px == pytest.approx(focal_px, rel=0.01)


def test_the_lens_is_that_of_the_references_camera() -> None:
    lens = replace(CAMERA, distortion=RadialTangential(-0.28, 0.07))
    scene = scene_of(CAMERA)
    raw = read_as(replace(scene.query, camera=CAMERA), CAMERA)
    bent = replace(raw.features, keypoints=lens.project(CAMERA.rays(raw.features.pixels())).astype(np.float32))
    photograph = Photograph(str, lens, lambda: np.zeros((1, 1, 3), np.uint8))
    references = [replace(it, view=replace(it.view, photograph=photograph)) for it in scene.references]
    query = View(scene.query.camera, bent)
    found = choose_camera(query, references, true_correspondences(scene), ())
    assert found is not None
    assert found.camera == lens


def test_one_reference_leaves_what_is_known() -> None:
    scene, known = scene_of(WIDE), guess(700.0, 0.03)
    correspondences = true_correspondences(scene)
    assert choose_camera(scene.query, scene.references[:1], correspondences, (known,)) is known
    assert choose_camera(scene.query, scene.references[:1], correspondences, ()) is None


def test_a_flat_wall_does_not_tell_the_focal_length() -> None:
    """Frontal, it looks the same through a longer lens from farther: the rejection says so."""
    flat = SceneOptions(box_m=(4.0, 2.4, 0.0), query_offset_m=(0.0, 0.0, 0.3))
    scene = scene_of(replace(WIDE, focal_x_px=700.0, focal_y_px=700.0), flat)
    found = chosen(scene)
    query = read_as(scene.query, found.camera)
    answer = localize(query, scene.references, Pipeline(matcher=Matcher()), LocalizeOptions(intrinsics=found.sigma))
    assert isinstance(answer.outcome, Rejection)
    assert answer.outcome.reason is RejectionReason.GATE
    assert "focal length" in answer.outcome.message
    assert answer.outcome.hint is not None
    assert answer.outcome.hint.advice is Advice.CHECK_CALIBRATION


def test_the_pose_is_that_of_the_planted_camera() -> None:
    scene = scene_of(replace(WIDE, focal_x_px=700.0, focal_y_px=700.0))
    found = chosen(scene)
    query = read_as(scene.query, found.camera)
    answer = localize(query, scene.references, Pipeline(matcher=Matcher()), LocalizeOptions(intrinsics=found.sigma))
    assert isinstance(answer.outcome, Localization)
    assert answer.outcome.covariance is not None
    off_m = math.dist(answer.outcome.world_from_camera.translation, scene.world_from_query.translation)
    assert off_m < 0.1
    assert off_m < 3 * math.sqrt(np.trace(answer.outcome.covariance[:3, :3]))
    usual = localize(
        query, scene.references, Pipeline(matcher=Matcher()), LocalizeOptions(intrinsics=IntrinsicsSigma())
    )
    assert isinstance(usual.outcome, Localization)
    assert usual.outcome.covariance is not None
    assert np.trace(answer.outcome.covariance) > np.trace(usual.outcome.covariance)


def test_an_off_centre_principal_point_is_estimated_with_the_pose() -> None:
    camera = replace(WIDE, focal_x_px=700.0, focal_y_px=700.0, principal_x_px=WIDE.principal_x_px + 14.0)
    scene = scene_of(camera)
    found = chosen(scene)
    query = read_as(scene.query, found.camera)
    answer = localize(query, scene.references, Pipeline(matcher=Matcher()), LocalizeOptions(intrinsics=found.sigma))
    assert isinstance(answer.outcome, Localization)
    assert isinstance(answer.support, PosedSupport)
    assert answer.support.query.camera.principal_x_px == pytest.approx(camera.principal_x_px, abs=3.0)
    assert math.dist(answer.outcome.world_from_camera.translation, scene.world_from_query.translation) < 0.02
