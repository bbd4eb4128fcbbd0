"""One table decides which lens models there are; a place that does not know one fails by the field's name."""

import json
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.lenses import Division, add_planted_lenses
from support.planted_answers import localized
from support.scenes import CAMERA

from mapless import wire
from mapless.cameras import read_cameras
from mapless.geometry import Camera, RigidTransform
from mapless.lenses import LENS_MODELS
from mapless.v1 import geometry_pb2 as pb
from mapless_server.method.features.views import undistort_pixels
from mapless_server.store.codec import decode_geometry, encode_geometry, sha256_for
from mapless_tools.draw.page import answer_page
from mapless_tools.ingest.formats.cameras import read_folder
from mapless_tools.ingest.formats.colmap.cameras import from_camera
from mapless_tools.ingest.formats.writing import PosedImage, cameras_files

UNKNOWN = replace(CAMERA, distortion=Division(-0.25))


def sent(camera: Camera, folder: Path) -> Camera:
    """A camera that a request carries."""
    return wire.camera_from_message(wire.camera_to_message(camera), "intrinsics")


def stored(camera: Camera, folder: Path) -> Camera:
    """A camera in the store."""
    data = encode_geometry(camera, RigidTransform.identity())
    return decode_geometry("it", data, sha256_for("it", data))[0]


def written(camera: Camera, folder: Path) -> Path:
    """A folder that describes a photograph of the camera."""
    (folder / "images").mkdir()
    (folder / "images" / "a.jpg").touch()
    for name, text in cameras_files([PosedImage("a.jpg", camera, RigidTransform.identity())], "").items():
        (folder / name).write_text(text)
    return folder


def exported(camera: Camera, folder: Path) -> Camera:
    """A camera of a folder, imported again."""
    return read_folder(written(camera, folder)).frames[0].camera


def listed(camera: Camera, folder: Path) -> Camera:
    """A camera of a folder, as the client reads it."""
    (found,) = read_cameras(written(camera, folder) / "cameras.json").values()
    return found


def to_colmap(camera: Camera, folder: Path) -> Camera:
    """A camera as COLMAP's, and back."""
    return from_camera(1, camera).camera()


def undistorted(camera: Camera, folder: Path) -> Camera:
    """The camera, if keypoints can be undistorted with it."""
    assert np.isfinite(undistort_pixels(np.full((1, 2), 300.0), camera)).all()
    return camera


def reported(camera: Camera, folder: Path) -> Camera:
    """The camera, if the page of an answer names its lens."""
    page = answer_page("a", localized(debug=None), b"", camera)
    return camera if "lens distortion" in page and "coefficient -0.25" in page else CAMERA


PLACES = [sent, stored, exported, listed, undistorted]
Place = Callable[[Camera, Path], Camera]


@pytest.mark.parametrize("model", LENS_MODELS)
@pytest.mark.parametrize("place", PLACES)
def test_every_place_knows_every_model(place: Place, model: str, tmp_path: Path) -> None:
    count = len(fields(LENS_MODELS[model]))
    camera = replace(CAMERA, distortion=LENS_MODELS[model](*[0.01 * (i + 1) for i in range(count)]))
    assert place(camera, tmp_path) == camera


@pytest.mark.parametrize("model", ["radial_tangential", "fisheye"])
def test_colmap_knows_the_models_that_it_has(model: str, tmp_path: Path) -> None:
    test_every_place_knows_every_model(to_colmap, model, tmp_path)


@pytest.mark.parametrize("place", [*PLACES, to_colmap, reported])
def test_a_lens_that_is_not_in_the_table_is_named(place: Place, tmp_path: Path) -> None:
    with pytest.raises(TypeError, match=r"camera\.distortion is a Division.*RadialTangential, Fisheye"):
        place(UNKNOWN, tmp_path)


@pytest.mark.parametrize("place", [*PLACES, to_colmap, reported])
def test_a_model_in_the_table_works_or_fails_loudly(
    place: Place, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    add_planted_lenses(monkeypatch)
    needs_code = place in (sent, listed, to_colmap)  # a field of the interface, COLMAP's name
    if needs_code:
        with pytest.raises((TypeError, ValueError), match=r"camera\.distortion is a Division"):
            place(UNKNOWN, tmp_path)
    else:
        assert place(UNKNOWN, tmp_path) == UNKNOWN


def test_the_interface_has_the_models_of_the_table() -> None:
    descriptor: Any = pb.CameraIntrinsics.DESCRIPTOR
    oneof = descriptor.oneofs_by_name["distortion"]
    coefficients = {field.name: [it.name for it in field.message_type.fields] for field in oneof.fields}
    assert coefficients == {name: [it.name for it in fields(kind)] for name, kind in LENS_MODELS.items()}


@pytest.mark.parametrize("lens", ["spherical", None, ["fisheye"]])
def test_a_folder_names_an_unknown_lens(lens: object, tmp_path: Path) -> None:
    file = written(CAMERA, tmp_path) / "cameras.json"
    content = json.loads(file.read_text())
    content["frames"][0]["lens"] = lens
    file.write_text(json.dumps(content))
    for read in (read_folder, lambda folder: read_cameras(folder / "cameras.json")):
        with pytest.raises(ValueError, match=r"lens must be one of radial_tangential, fisheye"):
            read(tmp_path)
