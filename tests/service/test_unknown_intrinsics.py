"""A photograph without intrinsics, through a server: where its camera is from, and how certain."""

import io
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest
from PIL import ExifTags, Image
from support.corner import CAMERA, make_corner, photograph, pose
from support.images import encode, textured
from support.servers import serving_really

from mapless import Camera, Client, IntrinsicsUncertainty, InvalidArgument, LocalizationResult, NewReference, Rejected

SQUARE = Camera.centred(420, 420, 352.0)
"""Other sides than those of the references."""
THERE = pose(2.0)


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    settings: dict[str, Any] = {"features": "sift", "backend": "geometric", "background_matching": False}
    with serving_really(tmp_path_factory.mktemp("corner"), **settings) as server, Client(server.address) as client:
        make_corner(client, [pose(angle) for angle in (-25, -15, -5, 5, 15, 25)])
        yield client


def localized(client: Client, image: bytes, scene: str = "corner") -> LocalizationResult:
    answer = client.localize(image, scene=scene)
    assert isinstance(answer, LocalizationResult), answer
    off_m = math.dist(answer.world_from_camera.translation, THERE.translation)
    assert answer.accuracy is not None
    assert off_m < min(0.1, answer.accuracy.position_95_m)
    return answer


def with_exif(image: bytes, film_focal_mm: float, model: str = "") -> bytes:
    exif, file = Image.Exif(), io.BytesIO()
    if model:
        exif[ExifTags.Base.Make], exif[ExifTags.Base.Model] = "Maker", model
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = round(film_focal_mm)
    Image.open(io.BytesIO(image)).convert("RGB").save(file, "JPEG", quality=95, exif=exif)
    return file.getvalue()


def film_mm(camera: Camera) -> float:
    return camera.focal_x_px / math.hypot(camera.width_px, camera.height_px) * math.hypot(36, 24)


def test_references_of_the_same_sides_have_the_camera(client: Client) -> None:
    used = localized(client, photograph(THERE)).used_intrinsics
    assert used is not None
    assert (used.source, used.camera) == ("SCENE_CAMERA", CAMERA)
    assert 0 < used.focal_sigma_px < 0.05 * CAMERA.focal_x_px


def test_another_camera_is_estimated(client: Client) -> None:
    answer = localized(client, photograph(THERE, SQUARE))
    used = answer.used_intrinsics
    assert used is not None
    assert used.source == "ESTIMATED"
    assert used.camera.focal_x_px == pytest.approx(SQUARE.focal_x_px, rel=0.02)
    assert abs(used.camera.focal_x_px - SQUARE.focal_x_px) < 4 * used.focal_sigma_px
    assert "estimated" in str(answer)


def test_exif_gives_the_focal_length_unless_it_lies(client: Client) -> None:
    other = replace(CAMERA, focal_x_px=350.0, focal_y_px=350.0)
    for image_mm, source in ((film_mm(other), "EXIF"), (2.5 * film_mm(other), "ESTIMATED")):
        used = localized(client, with_exif(photograph(THERE, other), image_mm)).used_intrinsics
        assert used is not None
        assert used.source == source
        assert used.camera.focal_x_px == pytest.approx(350.0, rel=0.02)


def test_references_with_the_same_exif_have_the_camera(client: Client) -> None:
    """Also of a photograph that was resized; as accurate as if it were given."""
    client.create_scene("exif")
    poses = [pose(angle) for angle in (-25, -15, -5, 5, 15, 25)]
    images = [with_exif(photograph(it), film_mm(CAMERA), "A") for it in poses]
    client.add_references("exif", [NewReference(f"r{i}", image, CAMERA, poses[i]) for i, image in enumerate(images)])
    small = CAMERA.resized(CAMERA.width_px // 2, CAMERA.height_px // 2)
    for model, source in (("A", "SCENE_CAMERA"), ("B", "EXIF")):
        image = with_exif(photograph(THERE, small), film_mm(small), model)
        used = localized(client, image, "exif").used_intrinsics
        assert used is not None
        assert used.source == source
        assert (used.camera == small) == (model == "A")


def test_given_intrinsics_are_named_as_such(client: Client) -> None:
    answer = client.localize(photograph(THERE), CAMERA, "corner")
    assert answer.used_intrinsics is not None
    assert (answer.used_intrinsics.source, answer.used_intrinsics.camera) == ("GIVEN", CAMERA)


def test_other_places_and_small_images_are_rejected(client: Client) -> None:
    for image in (encode(".png", textured(400, 300, seed=5)), encode(".png", textured(32, 32, seed=6))):
        assert isinstance(client.localize(image, scene="corner"), Rejected)


def test_an_uncertainty_is_that_of_intrinsics(client: Client) -> None:
    with pytest.raises(InvalidArgument) as raised:
        client.localize(photograph(THERE), scene="corner", intrinsics_uncertainty=IntrinsicsUncertainty(3.0))
    assert raised.value.field == "intrinsics_uncertainty"
