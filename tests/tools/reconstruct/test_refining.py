"""The last adjustment of a reconstruction, on synthetic photographs with a planted lens."""

import threading
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from mapless.geometry import Array
from mapless_tools.reconstruct import mapping
from mapless_tools.reconstruct.refining import refine

TRUE = np.array([900.0, 522.0, 376.0, 0.05, -0.02])
"""Focal length, principal point and two radial coefficients; the centre is (512, 384)."""


@pytest.fixture
def model() -> pycolmap.Reconstruction:
    """Photographs of one camera, with noise of half a pixel, whose principal point is taken to be in the centre."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1,
        num_frames_per_rig=8,
        num_points3D=300,
        camera_model_id=pycolmap.CameraModelId.RADIAL,
        camera_params=TRUE.tolist(),
    )
    made = pycolmap.synthesize_dataset(options)
    pycolmap.synthesize_noise(pycolmap.SyntheticNoiseOptions(point2D_stddev=0.5), made)
    camera = _camera(made)
    camera.model, camera.params = pycolmap.CameraModelId.SIMPLE_RADIAL, [930.0, 512.0, 384.0, 0.0]
    return made


def _camera(model: pycolmap.Reconstruction) -> pycolmap.Camera:
    camera: pycolmap.Camera
    (camera,) = model.cameras.values()
    return camera


def _parameters(model: pycolmap.Reconstruction) -> Array:
    return np.array(_camera(model).params)


def test_planted_focal_length_and_principal_point_are_found(model: pycolmap.Reconstruction) -> None:
    """To a pixel and a half."""
    assert refine(model, [], 1)
    assert np.abs(_parameters(model) - TRUE)[:3].max() < 1.5


def test_wrong_matches_do_not_move_the_lens(model: pycolmap.Reconstruction) -> None:
    """One of twenty observations is 8 px off to one side."""
    for image in model.images.values():
        for point in image.points2D[::20]:
            point.xy = point.xy + np.array([8.0, 0.0])
    assert refine(model, [], 1)
    assert np.abs(_parameters(model) - TRUE)[:3].max() < 2


def test_known_camera_stays_as_it_is(model: pycolmap.Reconstruction) -> None:
    """A calibrated one is not adjusted."""
    before = _parameters(model).copy()
    assert refine(model, [_camera(model).camera_id], 1)
    assert _camera(model).model == pycolmap.CameraModelId.SIMPLE_RADIAL
    assert (_parameters(model) == before).all()


def test_three_photographs_leave_the_lens_plausible(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    """Their noise alone would move the principal point by tens of pixels, and bend the lens."""
    for image_id in model.reg_image_ids()[3:]:
        model.deregister_frame(model.image(image_id).frame_id)
    model.write(str(tmp_path))
    three = pycolmap.Reconstruction(str(tmp_path))
    assert refine(three, [], 1)
    _, x, y, *coefficients = _parameters(three)
    assert np.hypot(x - TRUE[1], y - TRUE[2]) < 20
    assert np.abs(coefficients).max() < 0.3


def test_covariances_are_computed_where_an_interrupt_ends_them(
    model: pycolmap.Reconstruction, monkeypatch: pytest.MonkeyPatch
) -> None:
    threads = []
    monkeypatch.setattr(pycolmap, "estimate_ba_covariance", lambda *_: threads.append(threading.current_thread()))
    assert not refine(model, [], 1)
    assert threading.main_thread() not in threads


def test_known_camera_is_kept_in_a_model_that_is_not_refined(
    model: pycolmap.Reconstruction, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    database, camera = tmp_path / "database.db", _camera(model)
    given = _parameters(model).copy()
    with pycolmap.Database.open(database) as content:
        content.write_camera(camera, use_camera_id=True)

    def mapped(_: Path, folder: Path, *rest: object) -> None:
        camera.params = (given + 1).tolist()  # the global mapper refines all
        (folder / "0").mkdir()
        model.write(str(folder / "0"))

    monkeypatch.setattr(mapping, "map_incrementally", mapped)
    monkeypatch.setattr(mapping, "refine", lambda *_: False)
    mapping.map_photographs(database, tmp_path / "models", 8, [camera.camera_id], 1, lambda *_: None)
    written = pycolmap.Reconstruction(str(tmp_path / "models" / "0"))
    assert _parameters(written) == pytest.approx(given)
