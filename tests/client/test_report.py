"""The report of an answer: it needs nothing else, runs nothing, and what it draws lies where it belongs."""

import base64
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.html import Page
from support.images import encode, textured, with_exif_orientation
from support.planted_answers import CAMERA, NOW, debug, diagnostics, localized, rejected, truth

from mapless.answers import Accuracy, Hint, Hypothesis, LocalizationResult, PriorCheck, Rejected
from mapless.geometry import Array
from mapless.report import pictures, report_html, write_report
from mapless.report.plan import _fit, ellipse_in_plane
from mapless.results import Reference

PHOTO = encode(".jpg", textured(640, 480))
ALLOWED = re.findall(
    r"\w+",
    "html head meta title style body header p h1 h2 h3 b span div section figure figcaption svg defs "
    "image use rect path g circle ellipse text table thead tbody tr th td input label footer ",
)


def reference(name: str, image: bytes | None = PHOTO) -> Reference:
    return Reference("hall", name, CAMERA, truth().shifted([0.5, 0, 0]), "", 9, NOW, image)


BOTH = (reference("a"), reference("b"))


@pytest.mark.parametrize(
    "answer",
    [
        localized(),
        localized(debug=None, covariance=None, accuracy=None, trust=None, pose_stage="COARSE"),
        rejected(),
        rejected(reason="AMBIGUOUS", hypotheses=(Hypothesis(truth(), 30, ("a",)), Hypothesis(truth(), 28, ("b",)))),
        rejected(hint=None, debug=debug(wrong=200), diagnostics=diagnostics(())),
        rejected(reason="99"),
    ],
    ids=["localized", "coarse", "rejected", "ambiguous", "bare", "unknown reason"],
)
@pytest.mark.parametrize("references", [(), BOTH], ids=["alone", "with references"])
def test_the_page_has_no_external_resources_and_no_scripts(
    answer: LocalizationResult | Rejected, references: tuple[Reference, ...]
) -> None:
    html = report_html(answer, PHOTO, CAMERA, references)
    page = Page(html)
    assert set(page.tags) <= set(ALLOWED)
    for tag, name, value in page.attributes:
        assert not name.startswith("on"), tag
        if name in ("href", "src", "xlink:href"):
            assert value.startswith(("#", "data:image/jpeg;base64,"))
    outside = re.sub(r"data:image/\w+;base64,[\w+/=]+", "", html)
    assert not re.search(r"https?:|//[a-z]|url\(|@import", outside)
    assert ("meta", "content", "default-src 'none'; img-src data:; style-src 'unsafe-inline'") in page.attributes


HOSTILE = "\"><img src=x onerror=alert(1)><script>alert(2)</script></style>'&amp;"


def test_names_and_messages_are_text_whatever_they_hold() -> None:
    names = (HOSTILE, "b")
    uses = diagnostics(names)
    references = (replace(BOTH[0], reference_id=HOSTILE), BOTH[1])
    hostile = rejected(
        reason=HOSTILE,
        message=HOSTILE,
        hint=Hint(HOSTILE, HOSTILE, HOSTILE, f"scenes/hall/references/{HOSTILE}"),
        diagnostics=replace(uses, backend=HOSTILE, features=HOSTILE, stage_s={HOSTILE: 1.0}, request_id=HOSTILE),
        hypotheses=(Hypothesis(truth(), 3, names),),
        debug=debug(),
    )
    page = Page(report_html(hostile, PHOTO, CAMERA, references, HOSTILE))
    harmless = replace(hostile, diagnostics=replace(uses, stage_s={"pnp": 1.0}))
    assert page.tags == Page(report_html(harmless, PHOTO, CAMERA, references, "a")).tags
    assert page.tags["script"] == page.tags["img"] == 0
    assert sum("onerror=alert(1)" in words for words in page.words) >= 8
    checks = (PriorCheck(HOSTILE, 1.0, 1, True, True),)
    assert Page(report_html(localized(prior_checks=checks, pose_stage=HOSTILE), PHOTO, CAMERA)).tags["script"] == 0


def numbers_of(html: str, kind: str) -> Array:
    """Lines (N, 4) of a layer: where each begins, and how far it goes."""
    (path,) = re.findall(rf'<path class="{kind}" d="([^"]*)"', html)
    found = re.findall(r"M(-?[\d.]+) (-?[\d.]+)l(-?[\d.]+) (-?[\d.]+)", path)
    return np.array(found, float)


def test_residuals_lead_from_observed_to_projected_points() -> None:
    answer = localized()
    assert answer.debug is not None
    html = report_html(answer, PHOTO, CAMERA)
    lines = numbers_of(html, "inlier residual")
    factor = int(re.findall(r"drawn (\d+) times", html)[0]) if "drawn" in html else 1
    good = answer.debug.is_inlier
    np.testing.assert_allclose(lines[:, :2], answer.debug.query_px[good], atol=0.006)
    projected = CAMERA.project(truth().inverse().apply(answer.debug.x_in_world[good]))
    np.testing.assert_allclose(lines[:, :2] + lines[:, 2:] / factor, projected, atol=0.02)
    far = numbers_of(html, "outlier far")
    assert len(far) == (~good).sum()
    assert (np.hypot(far[:, 2], far[:, 3]) <= 0.06 * CAMERA.width_px + 0.02).all()


def test_from_above_east_is_to_the_right_and_north_is_up() -> None:
    cameras = [truth(), truth().shifted([3.0, 1.0, 0.0])]
    plan = _fit(cameras, np.empty((0, 3)), [0.0, 0.0, -1.0])
    here, east, north, up = plan.place(truth().translation + np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]))
    assert east[0] > here[0]
    assert east[1] == pytest.approx(here[1])
    assert north[1] < here[1]
    assert up == pytest.approx(here)
    y_down = _fit(cameras, np.empty((0, 3)), [0.0, 1.0, 0.0])
    np.testing.assert_allclose(np.cross(*y_down.basis), [0.0, -1.0, 0.0], atol=1e-12)


def test_the_ellipse_holds_95_percent() -> None:
    random = np.random.default_rng(2)
    root = random.normal(size=(6, 6))
    covariance = root @ root.T
    basis = _fit([truth()], np.empty((0, 3)), [0.3, -0.2, -1.0]).basis
    radii, turn = ellipse_in_plane(basis, covariance)
    errors = random.multivariate_normal(np.zeros(6), covariance, 100_000)[:, :3] @ basis.T
    along = errors @ np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    assert ((along / radii) ** 2).sum(axis=1).__le__(1).mean() == pytest.approx(0.95, abs=0.004)


def test_a_rejection_has_its_reason_and_hint() -> None:
    text = " ".join(Page(report_html(rejected(), PHOTO, CAMERA, BOTH)).words)
    assert "Not localized" in text
    assert "only 3 matches" in text
    assert "LOW_OVERLAP" in text
    assert "Point the camera there." in text
    assert "drawn" not in text


def test_a_rejection_shows_what_to_point_the_camera_at() -> None:
    other = encode(".png", textured(64, 48))
    early = replace(diagnostics(), stage_s={"correspond": 0.1})
    html = report_html(rejected(diagnostics=early), PHOTO, CAMERA, (reference("a", other), reference("b")))
    assert "Point the camera at this" in html
    assert base64.b64encode(other).decode() in html
    assert "include_debug" not in html
    hint = rejected().hint
    assert hint is not None
    other_advice = rejected(hint=replace(hint, advice="CHECK_CALIBRATION"))
    assert "What it shares most with" in report_html(other_advice, PHOTO, CAMERA, BOTH)
    assert "Point the camera at this" not in report_html(rejected(hint=None), PHOTO, CAMERA, BOTH)
    assert "Point the camera at this" not in report_html(localized(), PHOTO, CAMERA, BOTH)


def test_references_without_matches_are_not_mapped_or_counted() -> None:
    uses = tuple(replace(use, match_count=0, inlier_count=0, similarity=0.0) for use in diagnostics().references)
    page = report_html(rejected(hint=None, diagnostics=replace(diagnostics(), references=uses)), PHOTO, CAMERA, BOTH)
    assert "From above" not in page
    assert "references compared" not in page
    assert "feature matches" not in page
    assert "From above" in report_html(rejected(), PHOTO, CAMERA, BOTH)


def test_matches_that_were_not_asked_for_differ_from_none() -> None:
    assert "they need include_debug" in report_html(localized(debug=None), PHOTO, CAMERA)
    early = replace(diagnostics(), stage_s={"features": 0.1})
    assert "include_debug" not in report_html(rejected(diagnostics=early), PHOTO, CAMERA)


def test_an_uncalibrated_answer_is_marked_in_the_header() -> None:
    assert report_html(localized(), PHOTO, CAMERA).count("(uncalibrated)") == 2
    for source in ((True, "MEASURED", 40), (False, "SELF", 30), (True,)):  # the last of an older server
        calibrated = localized(accuracy=Accuracy(0.02, 0.04, 0.1, 0.2, *source))
        assert "uncalibrated" not in report_html(calibrated, PHOTO, CAMERA)
    assert "by 30 references" in report_html(localized(accuracy=Accuracy(1, 2, 3, 4, False, "SELF", 30)), PHOTO, CAMERA)


def test_an_arbitrary_unit_is_announced() -> None:
    assert "unit of length of this scene is arbitrary" in report_html(localized(arbitrary_unit=True), PHOTO, CAMERA)
    assert "unit of length of this scene is arbitrary" not in report_html(localized(), PHOTO, CAMERA)


def test_capture_is_announced() -> None:
    captured = replace(diagnostics(), captured=True)
    for answer in (localized(diagnostics=captured), rejected(diagnostics=captured)):
        assert "The server keeps this call" in report_html(answer, PHOTO, CAMERA)
    assert "The server keeps this call" not in report_html(localized(), PHOTO, CAMERA)


def embedded(html: str) -> bytes:
    return base64.b64decode(re.findall(r"data:image/\w+;base64,([\w+/=]+)", html)[0])


class TestPictures:
    @pytest.mark.parametrize("orientation", [1, 3, 6, 8])
    def test_no_viewer_turns_them(self, orientation: int) -> None:
        turned = with_exif_orientation(PHOTO, orientation)
        data = embedded(report_html(localized(), turned, CAMERA))
        assert b"Exif" not in data
        np.testing.assert_array_equal(pixels(data), pixels(PHOTO))

    @pytest.mark.parametrize("extension", [".png", ".webp", ".jpg"])
    def test_they_stay_what_they_are(self, extension: str) -> None:
        image = encode(extension, textured(64, 48))
        np.testing.assert_array_equal(pixels(embedded(report_html(localized(), image, CAMERA))), pixels(image))

    def test_what_cameras_add_to_a_webp_is_cut_out(self) -> None:
        simple = encode(".webp", textured(64, 48))
        extended = b"VP8X" + (10).to_bytes(4, "little") + bytes([0x08, 0, 0, 0, 63, 0, 0, 47, 0, 0])
        exif = b"EXIF" + (5).to_bytes(4, "little") + b"where\0"
        body = b"WEBP" + extended + simple[12:] + exif
        data = embedded(report_html(localized(), b"RIFF" + len(body).to_bytes(4, "little") + body, CAMERA))
        assert b"where" not in data
        assert int.from_bytes(data[4:8], "little") == len(data) - 8
        np.testing.assert_array_equal(pixels(data), pixels(simple))

    @pytest.mark.parametrize("extension", [".png", ".webp", ".jpg"])
    def test_what_follows_a_picture_in_its_file_is_cut_off(self, extension: str) -> None:
        image = encode(extension, textured(64, 48))
        further = with_exif_orientation(PHOTO, 6)  # phones append smaller pictures, depth, films
        for trailer in (b"where", b"\xff\xd9where", b"EXIF\5\0\0\0where\0", further, b"PK\3\4"):
            data = embedded(report_html(localized(), image + trailer, CAMERA))
            assert data == embedded(report_html(localized(), image, CAMERA))
            assert b"where" not in data
            np.testing.assert_array_equal(pixels(data), pixels(image))

    @pytest.mark.parametrize(
        "parameters",
        [(cv2.IMWRITE_JPEG_PROGRESSIVE, 1), (cv2.IMWRITE_JPEG_RST_INTERVAL, 2), (cv2.IMWRITE_JPEG_OPTIMIZE, 1)],
        ids=["several scans", "restarts", "tables of its own"],
    )
    def test_a_jpeg_is_followed_to_its_end(self, parameters: tuple[int, int]) -> None:
        image = encode(".jpg", np.random.default_rng(3).integers(0, 256, (48, 64, 3)).astype(np.uint8), *parameters)
        assert embedded(report_html(localized(), image + b"\xff\xd8\xff\xe1where", CAMERA)) == image

    def test_metadata_between_the_scans_of_a_jpeg_are_cut_out(self) -> None:
        image = encode(".jpg", textured(64, 48), cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
        second = image.index(b"\xff\xda", image.index(b"\xff\xda") + 2)
        comment = b"\xff\xfe\0\7where"
        data = embedded(report_html(localized(), image[:second] + comment + image[second:], CAMERA))
        assert b"where" not in data
        np.testing.assert_array_equal(pixels(data), pixels(image))

    def test_a_jpeg_keeps_the_segments_that_decoders_need(self) -> None:
        profile, index, depth = b"ICC_PROFILE\0\1\1profile", b"MPF\0where", b"JFXX\0\x10where"
        segments = b"".join(
            bytes([0xFF, kind]) + (len(body) + 2).to_bytes(2, "big") + body
            for kind, body in ((0xE2, profile), (0xE2, index), (0xE0, depth))
        )
        data = embedded(report_html(localized(), PHOTO[:2] + segments + PHOTO[2:], CAMERA))
        assert b"profile" in data
        assert b"where" not in data

    def test_a_jpeg_without_an_end_is_given_one(self) -> None:
        assert embedded(report_html(localized(), PHOTO[:-2], CAMERA)) == PHOTO

    def test_the_page_can_be_mailed_however_large_they_are(self, tmp_path: Path) -> None:
        noise = np.random.default_rng(1).integers(0, 256, (1800, 2400, 3)).astype(np.uint8)
        large = encode(".jpg", noise)
        assert len(large) > 5e6
        references = [reference(name, large) for name in ("a", "b")]
        file = write_report(localized(), large, CAMERA, tmp_path / "report.html", references=references)
        assert file.stat().st_size < 5e6

    def test_without_pillow_a_large_photo_is_left_out_with_a_note(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(pictures, "_reduced", lambda image: None)
        assert "pillow" in pictures.picture(PHOTO, 1000).note
        assert not pictures.picture(PHOTO, 1000).uri

    @pytest.mark.parametrize(
        "image", [b"", b"<svg/>", PHOTO[:40], b"\x89PNG\r\n\x1a\n\xff\xff", b"RIFF\xff\xff\xff\x7fWEBPVP8 "]
    )
    def test_what_is_no_picture_is_left_out(self, image: bytes) -> None:
        html = report_html(localized(), image, CAMERA)
        assert "is omitted" in html
        assert "data:image" not in html


def pixels(data: bytes) -> Array:
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    found = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    assert found is not None
    return np.asarray(found)
