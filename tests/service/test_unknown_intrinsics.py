"""A photograph without intrinsics, through a server: where its camera is from, and how certain."""

import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import pytest
from PIL import ExifTags, Image
from support.corner import CAMERA, make_corner, photograph, pose
from support.images import encode, textured
from support.servers import serving_really

from mapless import (
    Camera,
    Client,
    GroupRejected,
    IntrinsicsUncertainty,
    InvalidArgument,
    LocalizationResult,
    NewReference,
    Rejected,
    RigImage,
    RigLocalization,
    SequenceFrame,
    SequenceLocalization,
)

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


def test_one_reference_needs_a_known_focal_length(client: Client) -> None:
    answer = client.localize(photograph(THERE), scene="corner", references=["r2"])
    assert isinstance(answer, Rejected)
    assert answer.reason == "NO_USABLE_REFERENCES"
    assert "no focal length" in answer.message
    assert answer.hint is not None
    assert answer.hint.advice == "CHECK_CALIBRATION"


def test_an_uncertainty_is_that_of_intrinsics(client: Client) -> None:
    with pytest.raises(InvalidArgument) as raised:
        client.localize(photograph(THERE), scene="corner", intrinsics_uncertainty=IntrinsicsUncertainty(3.0))
    assert raised.value.field == "intrinsics_uncertainty"


WALK = [pose(angle) for angle in (-8.0, -3.0, 2.0, 7.0)]
OTHER = replace(SQUARE, focal_x_px=380.0, focal_y_px=380.0)


def groups_of(cameras: Sequence[Camera | None], images: Sequence[bytes]) -> tuple[list[RigImage], list[SequenceFrame]]:
    """The photographs of the walk as a rig, whose frame is the world's, and as a sequence."""
    rig = [RigImage(image, camera, at) for image, camera, at in zip(images, cameras, WALK, strict=True)]
    frames = [SequenceFrame(image, camera, at) for image, camera, at in zip(images, cameras, WALK, strict=True)]
    return rig, frames


def test_a_sequence_has_one_unknown_camera(client: Client) -> None:
    """A frame that is not localized alone has it, too."""
    images = [photograph(it, SQUARE) for it in WALK]
    images[1] = encode(".png", textured(420, 420, seed=5))
    frames = groups_of([None] * 4, images)[1]
    answer = client.localize_sequence(frames, "corner", timeout_s=120)
    assert isinstance(answer, SequenceLocalization), answer
    used = {(it.source, it.camera, it.focal_sigma_px) for it in (r.used_intrinsics for r in answer.images) if it}
    ((source, camera, sigma_px),) = used
    assert source == "ESTIMATED"
    assert abs(camera.focal_x_px - SQUARE.focal_x_px) < min(3 * sigma_px, 0.02 * SQUARE.focal_x_px)
    off_m = math.dist(answer.world_from_camera[-1].translation, WALK[-1].translation)
    assert off_m < min(0.1, answer.accuracy.position_95_m)


def test_joint_radii_contain_what_the_camera_may_be_off(client: Client) -> None:
    images = [photograph(it, SQUARE) for it in WALK]
    radii_m = list[float]()
    for camera in (SQUARE, None):
        rig, frames = groups_of([camera] * 4, images)
        answers = (
            client.localize_rig(rig, "corner", timeout_s=120),
            client.localize_sequence(frames, "corner", timeout_s=120),
        )
        for answer in answers:
            assert isinstance(answer, RigLocalization | SequenceLocalization), answer
            radii_m.append(answer.accuracy.position_68_m)
    for known_m, found_m in zip(radii_m[:2], radii_m[2:], strict=True):
        assert known_m < found_m < 20 * known_m


def test_images_of_a_rig_share_the_camera_of_equal_exif(client: Client) -> None:
    """Those without EXIF, or of another model, have cameras of their own; that of a given one is as given."""
    wide = replace(CAMERA, focal_x_px=350.0, focal_y_px=350.0)
    images = [photograph(at, it) for at, it in zip(WALK, (wide, wide, OTHER, OTHER), strict=True)]
    images[:2] = [with_exif(it, film_mm(wide), "A") for it in images[:2]]
    answer = client.localize_rig(groups_of([None, None, None, OTHER], images)[0], "corner", timeout_s=120)
    assert isinstance(answer, RigLocalization), answer
    used = [it.used_intrinsics for it in answer.images]
    assert [it and it.source for it in used] == ["EXIF", "EXIF", "ESTIMATED", "GIVEN"]
    focal_px = [it.camera.focal_x_px for it in used if it]
    assert focal_px[0] == focal_px[1] == pytest.approx(wide.focal_x_px, rel=0.02)
    assert focal_px[2] == pytest.approx(OTHER.focal_x_px, rel=0.02)
    assert math.dist(answer.world_from_rig.translation, (0.0, 0.0, 0.0)) < answer.accuracy.position_95_m


def test_photographs_of_a_camera_that_none_determines_are_left_out(client: Client) -> None:
    images = [photograph(WALK[0], SQUARE), *[encode(".png", textured(420, 420, seed=i)) for i in range(3)]]
    rig, frames = groups_of([SQUARE, None, None, None], images)
    answer = client.localize_rig(rig, "corner", timeout_s=120)
    assert isinstance(answer, RigLocalization), answer
    assert [it.used_intrinsics is not None for it in answer.images] == [True, False, False, False]
    assert [it.match_count for it in answer.images[1:]] == [0, 0, 0]
    unknown = client.localize_sequence([replace(it, camera=None) for it in frames[1:]], "corner", timeout_s=120)
    assert isinstance(unknown, GroupRejected)
    assert "focal length" in unknown.message
    assert unknown.hint is not None
    assert unknown.hint.advice == "CHECK_CALIBRATION"


def test_frames_of_one_camera_have_one_size(client: Client) -> None:
    frames = groups_of([None] * 4, [photograph(WALK[0]), *[photograph(it, SQUARE) for it in WALK[1:]]])[1]
    with pytest.raises(InvalidArgument) as raised:
        client.localize_sequence(frames, "corner", timeout_s=120)
    assert raised.value.field == "frames[1].intrinsics"
