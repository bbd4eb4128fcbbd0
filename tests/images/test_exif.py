"""EXIF: focal lengths, zoom, crops, resized and cut files, the way up, the place, and values that are none."""

import io
import math
import struct
from typing import Any

import numpy as np
import pytest
from PIL import ExifTags, Image, ImageOps
from PIL.TiffImagePlugin import IFDRational
from support.images import encode, textured, with_exif_orientation

from mapless_server.images.exif import NO_EXIF, ExifFocal, GpsPosition, Upright, focal_of, read_exif, upright_of

DIAGONAL_MM = math.hypot(36, 24)
WHOLE = 28 / DIAGONAL_MM * 500
"""The focal length of 28 mm for a frame with a diagonal of 500 pixels: 400x300."""


def found(size: tuple[int, int], maker: str = "", **tags: Any) -> ExifFocal | None:
    exif = Image.Exif()
    if maker:
        exif[ExifTags.Base.Make] = maker
    about = exif.get_ifd(ExifTags.IFD.Exif)
    for name, value in tags.items():
        about[ExifTags.Base[name]] = value
    out = io.BytesIO()
    Image.new("RGB", size).save(out, "JPEG", exif=exif)
    return focal_of(read_exif(out.getvalue()), *size)


def px(size: tuple[int, int], maker: str = "", **tags: Any) -> float:
    focal = found(size, maker, FocalLengthIn35mmFilm=28, **tags)
    assert focal is not None
    return focal.focal_px


@pytest.mark.parametrize(
    ("zoom", "factor"),
    [(1.5, 1.5), (2.0, 2.0), (1.0, 1.0), (0.0, 1.0), (IFDRational(0, 0), 1.0), (0.5, 1.0), (1e4, 1.0)],
)
def test_digital_zoom_lengthens_the_focal_length(zoom: Any, factor: float) -> None:
    assert px((400, 300), DigitalZoomRatio=zoom) == pytest.approx(factor * WHOLE)


def test_the_zoom_of_makers_who_include_it_counts_once() -> None:
    assert px((400, 300), "Apple", DigitalZoomRatio=2.0) == pytest.approx(WHOLE)


@pytest.mark.parametrize("size", [(400, 225), (225, 400), (300, 300), (400, 200)])
def test_a_crop_in_the_camera_keeps_the_frames_focal_length(size: tuple[int, int]) -> None:
    focal = found(size, FocalLengthIn35mmFilm=28)
    assert focal is not None
    assert focal.focal_px == pytest.approx(WHOLE)
    own_px = 28 / DIAGONAL_MM * math.hypot(*size)
    assert focal.sigma_px > abs(focal.focal_px - own_px)  # a maker may mean the part


@pytest.mark.parametrize("size", [(400, 300), (300, 400), (4000, 3000), (360, 240)])
def test_whole_frames_of_any_size_have_their_own_diagonal(size: tuple[int, int]) -> None:
    focal = found(size, FocalLengthIn35mmFilm=28, ExifImageWidth=4032, ExifImageHeight=2688 if size[0] == 360 else 3024)
    assert focal is not None
    assert focal.focal_px == pytest.approx(28 / DIAGONAL_MM * math.hypot(*size))
    assert focal.sigma_px == pytest.approx(0.03 * focal.focal_px)


def test_a_file_that_a_program_has_cut_is_refused() -> None:
    with pytest.raises(ValueError, match=r"300x300 pixels, by its EXIF the photograph had 4032x3024: it was cut"):
        found((300, 300), FocalLengthIn35mmFilm=28, ExifImageWidth=4032, ExifImageHeight=3024)


@pytest.mark.parametrize("film", [0, 1, 65535])
def test_a_focal_length_that_is_none_is_not_used(film: int) -> None:
    assert found((400, 300), FocalLengthIn35mmFilm=film) is None
    assert found((400, 300)) is None


def of(gps: dict[str, Any], **tags: Any) -> bytes:
    exif = Image.Exif()
    for name, value in tags.items():
        exif[ExifTags.Base[name]] = value
    about = exif.get_ifd(ExifTags.IFD.GPSInfo)
    for name, value in gps.items():
        about[ExifTags.GPS[name]] = value
    out = io.BytesIO()
    Image.new("RGB", (40, 30)).save(out, "JPEG", exif=exif)
    return out.getvalue()


def test_south_west_below_the_sea_is_negative() -> None:
    gps: dict[str, Any] = {"GPSLatitude": (33.0, 30.0, 36.0), "GPSLatitudeRef": "S", "GPSLongitude": (70.0, 0.0, 0.0)}
    gps |= {"GPSLongitudeRef": "W", "GPSAltitude": 12.5, "GPSAltitudeRef": b"\x01", "GPSHPositioningError": 4.5}
    found = read_exif(of(gps)).position
    assert found == GpsPosition(-(33 + 30 / 60 + 36 / 3600), -70.0, -12.5, 4.5)


@pytest.mark.parametrize("latitude", [(0.0, 0.0, 0.0), (91.0, 0.0, 0.0), (IFDRational(0, 0), 0.0, 0.0), (1.0, 2.0)])
def test_an_impossible_position_is_none(latitude: Any) -> None:
    gps = {"GPSLatitude": latitude, "GPSLatitudeRef": "N", "GPSLongitude": (0.0, 0.0, 0.0), "GPSLongitudeRef": "E"}
    assert read_exif(of(gps)).position is None


@pytest.mark.parametrize(("written", "read"), [(1, 1), (6, 6), (8, 8), (0, 1), (9, 1)])
def test_orientations_other_than_eight_are_upright(written: int, read: int) -> None:
    assert read_exif(of({}, Orientation=written)).orientation == read


def test_texts_have_no_control_characters() -> None:
    assert read_exif(of({}, Make="Acme\x1b[2J  ", Model="One\0")).make == "Acme[2J"


@pytest.mark.parametrize("data", [b"", b"\xff\xd8\xff", b"GIF89a", of({}, Make="A" * 500)[:80]])
def test_files_without_exif_say_nothing(data: bytes) -> None:
    assert read_exif(data) == NO_EXIF


@pytest.mark.parametrize("orientation", range(1, 9))
def test_upright_is_what_viewers_show(orientation: int) -> None:
    data = with_exif_orientation(encode(".jpg", textured(40, 30)), orientation)
    found = upright_of(data)
    with Image.open(io.BytesIO(data)) as opened:
        stored, shown = np.asarray(opened), np.asarray(ImageOps.exif_transpose(opened))
    unmirrored = stored[:, ::-1] if found.is_mirrored else stored
    np.testing.assert_array_equal(np.rot90(unmirrored, -round(found.clockwise_deg / 90)), shown)


@pytest.mark.parametrize("options", [{}, {"progressive": True}, {"comment": b"c" * 60_000}, {"restart_marker_rows": 1}])
def test_pillow_is_not_asked_where_a_jpeg_has_no_segment_for_exif(
    options: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    exif, plain, turned = Image.Exif(), io.BytesIO(), io.BytesIO()
    exif[ExifTags.Base.Orientation] = 6
    picture = Image.fromarray(textured(40, 30))
    picture.save(plain, "JPEG", **options)
    picture.save(turned, "JPEG", exif=exif, **options)
    assert upright_of(turned.getvalue()) == Upright(clockwise_deg=90.0)
    monkeypatch.setattr(Image, "open", None)
    assert (upright_of(plain.getvalue()), read_exif(plain.getvalue())) == (Upright(), NO_EXIF)


@pytest.mark.parametrize(("count", "is_read"), [(998, True), (1000, False)])
def test_exif_after_a_thousand_segments_is_not_read(count: int, is_read: bool) -> None:
    exif = Image.Exif()
    exif[ExifTags.Base.Make] = "Planted"
    out = io.BytesIO()
    Image.new("RGB", (40, 30)).save(out, "JPEG", exif=exif)
    start, rest = out.getvalue()[:2], out.getvalue()[2:]
    assert (read_exif(start + b"\xff\xe2\x00\x02" * count + rest).make == "Planted") == is_read


@pytest.mark.parametrize("ending", [".png", ".webp"])
def test_all_formats_say_which_way_is_up(ending: str) -> None:
    exif, out = Image.Exif(), io.BytesIO()
    exif[ExifTags.Base.Orientation] = 8
    Image.new("RGB", (40, 30)).save(out, ending[1:], exif=exif)
    assert upright_of(out.getvalue()) == Upright(clockwise_deg=270.0)
    assert upright_of(encode(ending, textured(40, 30))) == Upright()


@pytest.mark.parametrize("pointer", [ExifTags.Base.ExifOffset, ExifTags.Base.GPSInfo])
def test_a_pointer_beyond_all_files_is_as_no_exif(pointer: int) -> None:
    """As LONG8, which Pillow reads in TIFF of any kind, a pointer may be larger than a position in a file."""
    entry = struct.pack("<HHI", pointer, 16, 1) + struct.pack("<I", 26)
    tiff = b"II*\0" + struct.pack("<IH", 8, 1) + entry + struct.pack("<I", 0) + struct.pack("<Q", 2**63)
    segment = b"Exif\0\0" + tiff
    jpeg = encode(".jpg", textured(40, 30))
    data = jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + jpeg[2:]
    assert read_exif(data) == NO_EXIF


@pytest.mark.parametrize(("note_bytes", "is_read"), [(60_000, True), (70_000, False)])
def test_exif_that_no_jpeg_could_have_is_as_none(note_bytes: int, is_read: bool) -> None:
    exif, out = Image.Exif(), io.BytesIO()
    exif[ExifTags.Base.Make] = "Maker"
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.MakerNote] = bytes(note_bytes)
    Image.new("RGB", (40, 30)).save(out, "WEBP", exif=exif)
    assert (read_exif(out.getvalue()).make == "Maker") == is_read
