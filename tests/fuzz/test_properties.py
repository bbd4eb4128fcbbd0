"""Properties of the code that reads untrusted input: images, requests, importers, stored text."""

from __future__ import annotations

import base64
import io
import json
import math
import struct
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console
from support.images import encode, textured

from fuzz.images import chunk
from fuzz.importing import CAMERA, image_of
from fuzz.laws import check_pose, check_received_camera
from mapless import names, wire
from mapless.geometry import Camera, RigidTransform, rotation_from_vector
from mapless.lenses import Distortion, Fisheye, RadialTangential
from mapless.v1 import reference_service_pb2 as reference_pb
from mapless.wire import MAX_SIDE_PX, MIN_SIDE_PX, FieldError
from mapless_server.errors import InvalidArgument
from mapless_server.images import ImageLimits, decode_image, image_size
from mapless_server.images.png_chunks import essential_png
from mapless_server.services.messages.references import Page
from mapless_server.store import codec
from mapless_tools.dataset import Dataset, Refusal, legal_id, printable
from mapless_tools.ingest.formats import read_dataset
from mapless_tools.ingest.formats.writing import LAYOUTS, PosedImage
from mapless_tools.ingest.report import ImportReport, print_report

LIMITS = ImageLimits()
RGB = textured(40, 32)
PNG = encode(".png", RGB)

STORED_FIELDS = ("camera", "world_from_camera", "distortion", "model", "count", "datum", "down_in_world", "calibration")

finite = st.floats(allow_nan=False, allow_infinity=False)
identifiers = st.from_regex(r"[A-Za-z0-9_]([A-Za-z0-9_-]{0,20}[A-Za-z0-9_])?", fullmatch=True).filter(str.isascii)
coefficients = st.floats(-100, 100)


@st.composite
def poses(draw: st.DrawFn, most_m: float = 1e7) -> RigidTransform:
    turn = draw(st.tuples(*[st.floats(-3, 3)] * 3))
    return RigidTransform(rotation_from_vector(turn), np.array(draw(st.tuples(*[st.floats(-most_m, most_m)] * 3))))


@st.composite
def cameras(draw: st.DrawFn) -> Camera:
    """All that geometry.proto allows."""
    width, height = draw(st.tuples(*[st.integers(MIN_SIDE_PX, MAX_SIDE_PX)] * 2))
    focals = draw(st.tuples(*[st.floats(0.01 * max(width, height), 100.0 * max(width, height))] * 2))
    centre = draw(st.floats(-width, 2 * width)), draw(st.floats(-height, 2 * height))
    lens: Distortion | None = draw(
        st.one_of(st.none(), st.builds(RadialTangential, *[coefficients] * 5), st.builds(Fisheye, *[coefficients] * 4))
    )
    return Camera(width, height, focals[0], focals[1], centre[0], centre[1], lens)


@given(st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1))
def test_a_png_has_the_size_of_its_header_or_is_refused_for_it(width: int, height: int) -> None:
    data = PNG[:16] + struct.pack(">II", width, height) + PNG[24:]
    fits = min(width, height) >= 32 and max(width, height) <= 16384 and width * height <= LIMITS.max_pixels
    if fits:
        assert image_size(data, LIMITS) == (width, height)
        return
    with pytest.raises(InvalidArgument, match=f"{width}x{height}") as caught:
        image_size(data, LIMITS)
    assert caught.value.reason == ("IMAGE_TOO_SMALL" if min(width, height) < 32 else "IMAGE_TOO_LARGE")


@given(st.integers(0, 65535), st.integers(0, 65535), st.lists(st.binary(max_size=40), max_size=5))
def test_a_jpeg_has_the_size_of_its_frame_header(width: int, height: int, before: list[bytes]) -> None:
    segments = b"".join(b"\xff\xe1" + struct.pack(">H", len(it) + 2) + it for it in before)
    data = b"\xff\xd8" + segments + b"\xff\xc0" + struct.pack(">HBHH", 17, 8, height, width) + bytes(10)
    limits = ImageLimits(max_pixels=2**40, min_side_px=0, max_side_px=2**20)
    assert image_size(data, limits) == (width, height)


kinds = st.binary(min_size=4, max_size=4).filter(lambda kind: kind not in (b"IHDR", b"PLTE", b"IDAT", b"IEND"))


@settings(max_examples=50)
@given(st.lists(st.tuples(kinds, st.binary(max_size=100), st.booleans()), max_size=8), st.integers(1, 200))
def test_no_extra_chunk_or_cut_of_a_png_changes_a_pixel(further: list[tuple[bytes, bytes, bool]], piece: int) -> None:
    length = int.from_bytes(PNG[33:37], "big")
    body = PNG[41 : 41 + length]
    assert PNG[37:41] == b"IDAT"
    before = b"".join(chunk(kind, content) for kind, content, is_first in further if is_first)
    after = b"".join(chunk(kind, content) for kind, content, is_first in further if not is_first)
    pieces = b"".join(chunk(b"IDAT", body[i : i + piece]) for i in range(0, length, piece))
    data = PNG[:33] + before + pieces + after + chunk(b"IEND", b"")
    np.testing.assert_array_equal(decode_image(data, LIMITS), RGB)
    assert essential_png(essential_png(data)) == essential_png(data)


@given(cameras(), poses())
def test_what_the_interface_allows_is_accepted_and_comes_back(camera: Camera, pose: RigidTransform) -> None:
    check_received_camera(camera)
    check_pose(pose)


@settings(max_examples=25)
@given(
    st.lists(
        st.tuples(identifiers, poses(9e6), st.booleans()), min_size=1, max_size=4, unique_by=lambda it: it[0].lower()
    )
)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_poses_and_names_survive_the_layouts_that_we_write(
    tmp_path_factory: pytest.TempPathFactory, layout: str, planted: list[tuple[str, RigidTransform, bool]]
) -> None:
    folder = tmp_path_factory.mktemp("written")
    lens = RadialTangential(0.1, -0.2, 0.01, 0.02)
    images = []
    for name, pose, is_distorted in planted:
        place = folder / LAYOUTS[layout].images
        place.mkdir(parents=True, exist_ok=True)
        (place / f"{name}.png").write_bytes(image_of(".png", 0))
        camera = Camera(**{**vars(CAMERA), "distortion": lens if is_distorted else None})
        images.append(PosedImage(f"{name}.png", camera, pose))
    for file, text in LAYOUTS[layout].files(images, "a test").items():
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_text(text)
    dataset = read_dataset(folder)
    assert dataset.format == layout
    assert dataset.refused == ()
    found = {frame.image_path.stem: frame for frame in dataset.frames}
    assert set(found) == {name for name, _, _ in planted}
    for image in images:
        frame = found[image.name.removesuffix(".png")]
        assert frame.name == image.name.removesuffix(".png")
        np.testing.assert_allclose(frame.camera.matrix(), image.camera.matrix(), rtol=1e-12)
        assert frame.camera.distortion == image.camera.distortion
        assert np.abs(frame.world_from_camera.rotation - image.world_from_camera.rotation).max() < 1e-12
        away_m = np.abs(frame.world_from_camera.translation - image.world_from_camera.translation).max()
        assert away_m < 1e-7  # of 10,000 km, turned there and back


@given(st.text(st.characters(), max_size=50) | st.text(st.characters(categories=["Cs", "Cc", "Zl", "Lo"]), max_size=50))
def test_the_report_can_be_printed_for_any_frame_file(text: str) -> None:
    assert printable(text).isprintable()
    assert printable(printable(text)) == printable(text)
    assert text.isprintable() is (printable(text) == text)
    buffer = io.BytesIO()
    stream = io.TextIOWrapper(buffer, "utf-8")
    dataset = Dataset("a", (), True, "", refused=(Refusal(text, text),))
    print_report(ImportReport("scene", dataset, ()), Console(file=stream, width=10_000))
    stream.flush()
    printed = buffer.getvalue().decode()
    assert all(line.isprintable() for line in printed.split("\n"))
    json.dumps(vars(dataset.refused[0])).encode()


OTHER_LISTS = (("others", "scenes"), ("acme", "scenes/hall"), ("acme", "scenes/hall audit"), ("acm", "e\nscenes"))


@given(st.lists(identifiers, max_size=12, unique=True).map(sorted), st.integers(1, 5))
def test_pages_have_each_of_a_list_once_and_in_order(ids: list[str], size: int) -> None:
    listed: list[str] = []
    token = ""
    for _ in range(len(ids) + 1):
        page = Page(reference_pb.ListScenesRequest(page_size=size, page_token=token), "acme", "scenes")
        found = [it for it in ids if it > page.after][: page.limit]
        records, token = page.cut(found, str)
        listed += records
        if not token:
            break
        for tenant, collection in OTHER_LISTS:
            with pytest.raises(FieldError, match="page_token"):
                Page(reference_pb.ListScenesRequest(page_token=token), tenant, collection)
    assert listed == ids


@given(st.text(max_size=60) | st.binary(max_size=60).map(lambda data: base64.urlsafe_b64encode(data).decode()))
def test_a_token_that_no_list_gave_is_refused(token: str) -> None:
    if token:
        with pytest.raises(FieldError, match="must be a next_page_token of this list") as caught:
            Page(reference_pb.ListScenesRequest(page_token=token.encode(errors="replace").decode()), "acme", "scenes")
        assert caught.value.field == "page_token"


@given(st.text(max_size=140) | identifiers)
def test_an_id_is_ascii_fit_for_names_and_files_or_refused(text: str) -> None:
    try:
        names.check_id(text)
    except ValueError:
        with pytest.raises(FieldError, match=r"^scene: an id is"):
            wire.checked_id(text, "scene")
        return
    assert text.isascii()
    assert wire.scene_id_from_name(names.scene_name(text), "name") == text
    assert wire.reference_ids_from_name(names.reference_name(text, text), "name") == (text, text)
    assert Path(text).name == text
    assert legal_id(text, ()) == text


@given(st.text(max_size=140))
def test_any_file_name_gives_a_legal_id_that_is_not_taken(text: str) -> None:
    made = legal_id(text, ())
    assert names.check_id(made) == made
    assert legal_id(text, {made}) != made


anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=9),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(STORED_FIELDS), inner, max_size=4),
)


@given(anything.map(lambda it: json.dumps(it).encode()) | st.binary(max_size=99))
def test_bytes_of_another_form_are_damaged_or_read(data: bytes) -> None:
    """Although their checksum is right."""
    sha256 = codec.sha256_for("owner", data)
    for read_stored in (codec.decode_geometry, codec.decode_view, codec.decode_attributes):
        with suppress(codec.Damaged):
            read_stored("owner", data, sha256)


@given(st.tuples(*[finite] * 9), st.tuples(*[finite] * 12), st.integers(0, 10_000), st.integers(1, 255))
def test_stored_geometry_returns_bit_for_bit_or_is_damaged(
    lens: tuple[float, ...], motion: tuple[float, ...], at: int, change: int
) -> None:
    camera = Camera(32, 33, lens[0], lens[1], lens[2], lens[3], RadialTangential(*lens[4:]))
    pose = RigidTransform(np.reshape(motion[:9], (3, 3)), np.array(motion[9:]))
    stored = codec.encode_geometry(camera, pose)
    sha256 = codec.sha256_for("owner", stored)
    again, its_pose, _ = codec.decode_geometry("owner", stored, sha256)
    assert repr(again) == repr(camera)
    assert its_pose.matrix().tobytes() == pose.matrix().tobytes()
    damaged = bytearray(stored)
    damaged[at % len(stored)] ^= change
    for owner, data in (("owner", bytes(damaged)), ("other", stored), ("owner", stored[:-1])):
        with pytest.raises(codec.Damaged):
            codec.decode_geometry(owner, data, sha256)


@given(st.lists(finite, min_size=21, max_size=21), st.integers(0, 20), st.sampled_from([math.nan, math.inf, -math.inf]))
def test_no_number_that_is_none_is_stored(numbers: list[float], at: int, value: float) -> None:
    numbers[at] = value
    camera = Camera(32, 33, numbers[0], numbers[1], numbers[2], numbers[3], RadialTangential(*numbers[4:9]))
    with pytest.raises(ValueError, match="Out of range"):
        codec.encode_geometry(camera, RigidTransform(np.reshape(numbers[9:18], (3, 3)), np.array(numbers[18:])))
