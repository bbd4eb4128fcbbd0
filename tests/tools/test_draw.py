"""The page of an answer: it needs nothing else, runs nothing, and what it draws lies where it belongs."""

import base64
import json
import re
import socket
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from unittest.mock import create_autospec

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure
from support.html import Page
from support.images import encode, textured, with_exif_orientation
from support.planted_answers import CAMERA, NOW, debug, diagnostics, localized, rejected, truth
from typer.testing import CliRunner, Result

from mapless import Client, MaplessError, NotFound, PermissionDenied
from mapless.answers import Hint, Hypothesis, LocalizationResult, Rejected
from mapless.cli.output import plain
from mapless.diagnostics import Debug
from mapless.geometry import Array
from mapless.results import Reference
from mapless_tools.charts import new_axes
from mapless_tools.cli.app import app
from mapless_tools.draw.answers import read_answers
from mapless_tools.draw.page import answer_page, best_references
from mapless_tools.matches import GOOD, RESIDUAL, WRONG, Shot, axes_on, draw_matches, rendered, side_by_side
from mapless_tools.plan import basis_from_above, down_of, ellipse_in_plane

PHOTO = encode(".jpg", textured(640, 480))


def reference(name: str, image: bytes | None = PHOTO) -> Reference:
    return Reference("hall", name, CAMERA, truth().shifted([0.5, 0, 0]), "", 9, NOW, image)


BOTH = (reference("a"), reference("b"))
AMBIGUOUS = rejected(
    reason="AMBIGUOUS", hypotheses=(Hypothesis(truth(), 30, ("a",)), Hypothesis(truth(), 28, ("b",))), debug=debug()
)


def embedded(html: str) -> list[bytes]:
    return [base64.b64decode(it) for it in re.findall(r"data:image/jpeg;base64,([\w+/=]+)", html)]


def pixels(data: bytes) -> Array:
    found = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    assert found is not None
    return np.asarray(found, float)


class TestPage:
    @pytest.mark.parametrize(
        ("answer", "references"),
        [
            (localized(), BOTH),
            (localized(debug=None, covariance=None, accuracy=None, trust=None, pose_stage="COARSE"), ()),
            (AMBIGUOUS, BOTH),
            (rejected(hint=None, debug=debug(wrong=200), diagnostics=diagnostics(())), ()),
        ],
        ids=["localized", "coarse", "ambiguous", "bare"],
    )
    def test_it_loads_nothing_and_runs_no_scripts(
        self, answer: LocalizationResult | Rejected, references: tuple[Reference, ...]
    ) -> None:
        html = answer_page("photo", answer, PHOTO, CAMERA, references)
        page = Page(html)
        assert not {"script", "iframe", "object", "link", "form", "base"} & set(page.tags)
        for tag, name, value in page.attributes:
            assert not name.startswith("on"), tag
            if name in ("href", "src", "xlink:href"):
                assert value.startswith(("#", "data:image/jpeg;base64,"))
        outside = re.sub(r'data:image/\w+;base64,[\w+/=]+|xmlns(:xlink)?="[^"]*"|url\(#\w+\)', "", html)
        assert not re.search(r"https?:|//[a-z]|url\(|@import", outside)
        assert ("meta", "content", "default-src 'none'; img-src data:; style-src 'unsafe-inline'") in page.attributes

    def test_names_and_messages_are_text_whatever_they_hold(self) -> None:
        hostile = "\"><img src=x onerror=alert(1)><script>alert(2)</script></style>'&amp;$\\frac$"
        uses = diagnostics((hostile, "b"))
        answer = rejected(
            reason=hostile,
            message=hostile,
            hint=Hint(hostile, hostile, hostile, f"scenes/hall/references/{hostile}"),
            diagnostics=replace(uses, backend=hostile, stage_s={hostile: 1.0}, request_id=hostile),
            hypotheses=(Hypothesis(truth(), 3, (hostile,)),),
            debug=debug(),
        )
        page = Page(answer_page(hostile, answer, PHOTO, CAMERA, (replace(BOTH[0], reference_id=hostile), BOTH[1])))
        assert page.tags["script"] == 0
        assert page.tags["img"] == 4
        assert sum("onerror=alert(1)" in words for words in page.words) >= 8

    def test_it_shows_what_the_answer_says_and_its_inputs(self) -> None:
        answer = localized(arbitrary_unit=True, diagnostics=replace(diagnostics(), captured=True))
        words = " ".join(Page(answer_page("hall.jpg", answer, PHOTO, CAMERA, BOTH, [0, 0, -1])).words)
        assert str(answer) in words
        for shown in (
            "hall.jpg: localized",
            "(180)",
            "130 triangulated",
            "50 blue, by measured depth",
            "4.00e-04",
            "id-1",
            "radial_tangential: k1 -0.1",
            "x, units",
        ):
            assert shown in words
        assert str(AMBIGUOUS) in " ".join(Page(answer_page("", AMBIGUOUS, PHOTO, CAMERA)).words)

    def test_a_rejection_shows_what_to_point_the_camera_at(self) -> None:
        html = answer_page("", rejected(), PHOTO, CAMERA, (reference("a", encode(".png", textured(64, 48))), BOTH[1]))
        assert "Point the camera at this: a" in html
        assert pixels(embedded(html)[1]).shape == (48, 64, 3)
        hint = rejected().hint
        assert hint is not None
        other = rejected(hint=replace(hint, advice="CHECK_CALIBRATION"))
        assert "It shares most with the photograph: a" in answer_page("", other, PHOTO, CAMERA, BOTH)
        assert "What helps" not in answer_page("", rejected(hint=None), PHOTO, CAMERA, BOTH)

    def test_the_best_references_come_first_after_the_hints(self) -> None:
        used = diagnostics(("a", "b", "c", "d", "e"))
        assert [it[-1] for it in best_references(localized(diagnostics=used))] == ["a", "b", "c"]
        few = replace(used, references=tuple(replace(it, match_count=0) for it in used.references[:4]))
        assert best_references(localized(diagnostics=few)) == []
        hint = replace(rejected().hint, best_reference="scenes/hall/references/e")  # type: ignore[type-var]
        assert [it[-1] for it in best_references(rejected(diagnostics=used, hint=hint))] == ["e", "a", "b", "c"]

    def test_references_without_matches_are_not_mapped(self) -> None:
        uses = tuple(replace(use, match_count=0, inlier_count=0, similarity=0.0) for use in diagnostics().references)
        bare = rejected(hint=None, diagnostics=replace(diagnostics(), references=uses))
        page = answer_page("", bare, PHOTO, CAMERA, BOTH)
        assert "From above" not in page
        assert "feature matches" not in page
        assert "From above" in answer_page("", rejected(), PHOTO, CAMERA, BOTH)

    @pytest.mark.parametrize("orientation", [1, 6])
    def test_photographs_lie_as_stored_without_metadata(self, orientation: int) -> None:
        turned = with_exif_orientation(PHOTO, orientation)
        (data,) = embedded(answer_page("", localized(debug=None), turned + b"where", CAMERA))
        assert b"Exif" not in data
        assert b"where" not in data
        assert np.abs(pixels(data) - pixels(PHOTO)).mean() < 4

    def test_it_can_be_mailed_however_large_photographs_are(self) -> None:
        large = encode(".jpg", np.random.default_rng(1).integers(0, 256, (1800, 2400, 3)).astype(np.uint8))
        html = answer_page("", localized(), large, CAMERA, [reference(name, large) for name in ("a", "b")])
        assert len(embedded(html)) == 3
        assert len(html) < 5e6

    @pytest.mark.parametrize("image", [b"", b"<svg/>", PHOTO[:40]])
    def test_what_is_no_photograph_is_left_out(self, image: bytes) -> None:
        html = answer_page("", localized(), image, CAMERA)
        assert "cannot be read" in html
        assert "data:image" not in html


def near(picture: Array, colour: str) -> Array:
    """Where a picture (H, W, 3) has a colour: pixels (N, 2), x first."""
    wanted = np.array([*bytes.fromhex(colour[1:])], float)
    return np.argwhere(np.abs(picture - wanted).max(axis=2) < 40)[:, ::-1].astype(float)


class TestMatches:
    def test_residuals_lead_from_observed_to_projected_pixels(self) -> None:
        axes = axes_on(np.zeros((400, 800, 3), np.uint8))
        seen = np.array([[100.0, 100.0], [300.0, 300.0], [600.0, 200.0]])
        projected = seen + [[4.0, 0.0], [4.0, 0.0], [500.0, 0.0]]
        factor = draw_matches(axes, seen, projected, np.array([True, True, False]))
        assert factor == 1
        draw_matches(axes, seen[:1], seen[:1] + [0.5, 0.0], np.array([True]))  # drawn longer
        picture = rendered(axes.figure).astype(float)
        assert picture.shape == (400, 800, 3)
        for x, y in seen[:2]:
            assert np.abs(near(picture, GOOD) - (x, y)).sum(axis=1).min() <= 2
        lines = near(picture, RESIDUAL)
        assert np.abs(lines - (304, 300)).sum(axis=1).min() <= 2
        wrong = near(picture, WRONG)
        assert np.abs(wrong - (600, 200)).sum(axis=1).min() <= 2
        assert not picture[:, round(600 + 0.06 * 800 + 3) :].any()  # its line covers nothing

    def test_lines_join_the_pixels_of_two_photographs(self) -> None:
        left, right = (Shot(np.zeros((h, w, 3), np.uint8), CAMERA.resized(w, h)) for h, w in ((240, 320), (480, 640)))
        start, end = np.array([[100.0, 60.0]]), np.array([[500.0, 400.0]])
        picture = side_by_side(left, right, start, end, np.array([True]), 240).astype(float)
        drawn = near(picture, GOOD)
        for at in ((100, 60), (320 + 12 + 250, 200)):
            assert np.abs(drawn - at).sum(axis=1).min() <= 3
        assert not len(near(picture, WRONG))

    def test_names_are_no_formulas(self) -> None:
        figure = new_axes("a$\\frac$", "", "").figure
        assert isinstance(figure, Figure)
        figure.savefig(Path("/dev/null"), format="svg")


class TestPlan:
    def test_east_is_to_the_right_and_north_is_up(self) -> None:
        np.testing.assert_allclose(basis_from_above([0.0, 0.0, -1.0]), [[1, 0, 0], [0, 1, 0]], atol=1e-12)
        np.testing.assert_allclose(np.cross(*basis_from_above([0.0, 1.0, 0.0])), [0.0, -1.0, 0.0], atol=1e-12)

    def test_gravity_is_the_cameras_y_axis_or_their_planes_normal(self) -> None:
        np.testing.assert_allclose(down_of(None, [truth()]), truth().rotation[:, 1])
        turned = truth().rotation @ np.diag([1.0, -1.0, -1.0])
        poses = [truth(), replace(truth().shifted([1, 0, 0]), rotation=turned), truth().shifted([0, 1, 0])]
        poses += [replace(truth().shifted([3, 1, 0]), rotation=turned)]
        np.testing.assert_allclose(np.abs(down_of(None, poses)), [0, 0, 1], atol=1e-12)

    def test_the_ellipse_holds_95_percent(self) -> None:
        random = np.random.default_rng(2)
        root = random.normal(size=(6, 6))
        covariance = root @ root.T
        basis = basis_from_above([0.3, -0.2, -1.0])
        radii, turn = ellipse_in_plane(basis, covariance)
        errors = random.multivariate_normal(np.zeros(6), covariance, 100_000)[:, :3] @ basis.T
        along = errors @ np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        assert ((along / radii) ** 2).sum(axis=1).__le__(1).mean() == pytest.approx(0.95, abs=0.004)


NO_MATCHES = Debug(
    np.empty((0, 2)), np.empty((0, 3)), np.empty(0, bool), np.empty(0), np.empty(0, np.intp), np.empty((0, 2))
)
HINT = Hint("pnp", "LOOK_AT_REFERENCE", "Point the camera there.", "scenes/hall/references/a")
OUTSIDE = ("/etc/hostname", "../x.jpg", "b/../../x.jpg", "..", "")
UNKNOWN = rejected(hint=None, diagnostics=diagnostics(()), debug=NO_MATCHES)
"""A rejection without references, which needs no server."""


def written(answer: LocalizationResult | Rejected, photo: str = "a.jpg") -> str:
    return json.dumps({"photo": photo, "camera": plain(CAMERA)} | plain(answer))


def rounded(answer: LocalizationResult | Rejected) -> object:
    return json.loads(json.dumps(plain(answer)), parse_float=lambda it: round(float(it), 9))


class TestAnswers:
    @pytest.mark.parametrize(
        "answer", [localized(), localized(debug=None, covariance=None), rejected(), AMBIGUOUS, UNKNOWN]
    )
    def test_an_answer_is_read_as_it_was_written(self, answer: LocalizationResult | Rejected) -> None:
        text = written(answer)
        failed = json.dumps({"photo": "b.jpg", "error": {"code": "INTERNAL"}})
        for content in (text, json.dumps(json.loads(text), indent=2), f"{failed}\n{text}\n"):
            (found,) = read_answers(content, "f")
            assert found.photo == "a.jpg"
            assert rounded(found.answer) == rounded(answer)
            assert str(found.answer) == str(answer)
            assert found.camera == CAMERA

    @pytest.mark.parametrize("answer", [localized(debug=NO_MATCHES), rejected(debug=NO_MATCHES)])
    def test_an_answer_without_matches_is_drawn(self, answer: LocalizationResult | Rejected) -> None:
        (found,) = read_answers(written(answer), "f")
        html = answer_page("", found.answer, PHOTO, CAMERA, BOTH)
        assert "0 matches" in html

    @pytest.mark.parametrize(
        ("content", "message"),
        [
            ("", "f is empty"),
            ("[1]", "f: no answer with its photograph and camera"),
            ("{}", "f: no answer with its photograph and camera"),
            ('{"photo": "a"}\n{', "f, line 2 is not JSON"),
            ('{"photo": "a"}', "f: the answer has no camera and no matches"),
            ('{"photo": "a", "camera": {}}', "f: no answer as"),
            ('{"photo": "a", "camera": 3}', "f: no answer as"),
            (
                written(localized(debug=replace(debug(), error_px=np.zeros(3)))),
                "debug.error_px has the shape (3,), not (200,)",
            ),
            (
                written(localized(debug=replace(debug(), query_px=np.zeros(200)))),
                "query_px has the shape (200,), not (200, 2)",
            ),
            (written(localized(debug=replace(debug(), x_in_world=np.zeros((200, 2))))), "not (200, 3)"),
            (written(localized(debug=replace(NO_MATCHES, query_px=np.zeros((1, 2))))), "not (0, 2)"),
            (
                written(localized(debug=replace(debug(), reference=np.full(200, 2)))),
                "has 2, but the answer has 2 references",
            ),
            (written(localized(debug=replace(debug(), reference=np.full(200, -1)))), "debug.reference has -1"),
            (written(localized(debug=replace(debug(), is_inlier=np.full(200, 0.5)))), "elements of the type bool"),
            (written(localized(covariance=np.eye(3))), "covariance has the shape (3, 3), not (6, 6)"),
            (written(localized(inlier_count="many")), "'many' is not of the type int"),
            (
                written(rejected(hint=replace(HINT, best_reference="../a"))),
                "must be scenes/{scene}/references/{reference}",
            ),
            *((written(localized(), name), "photo must name a file in the folder") for name in OUTSIDE),
        ],
    )
    def test_what_is_no_answer_is_named_with_its_line(self, content: str, message: str) -> None:
        with pytest.raises(ValueError, match=re.escape(message)):
            list(read_answers(content, "f"))

    @pytest.mark.parametrize(
        ("files", "arguments", "message"),
        [
            ({}, ("none.json", "a.jpg"), "No such file"),
            ({"a.json": written(localized())}, ("a.json", "b.jpg"), "the answer is of a.jpg, not of b.jpg"),
            ({"a.json": written(localized())}, ("a.json", "."), "a.jpg, of which an answer is, is not there"),
        ],
    )
    def test_wrong_files_are_one_sentence(
        self, files: dict[str, str], arguments: tuple[str, ...], message: str, tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:  # fmt: skip
        monkeypatch.chdir(tmp_path)
        for name, content in files.items():
            Path(name).write_text(content)
        done = CliRunner().invoke(app, ["draw", *arguments])
        assert done.exit_code in (1, 2)
        assert message in done.stderr
        assert "Traceback" not in done.output


def drawn(tmp_path: Path, answers: str, *flags: str) -> Result:
    """The result of `draw` for the photographs of a folder, which writes to "pages"; no store is there."""
    (tmp_path / "answers.jsonl").write_text(answers)
    for name in ("a.jpg", "a_b.jpg", "a/b.jpg"):
        (tmp_path / "photos" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "photos" / name).write_bytes(PHOTO)
    answers_file, photos, pages = (str(tmp_path / it) for it in ("answers.jsonl", "photos", "pages"))
    store = {"MAPLESS_DATA_DIR": str(tmp_path / "store")}
    return CliRunner().invoke(app, ["draw", answers_file, photos, "--output", pages, *flags], env=store)


class TestPages:
    def test_each_answer_has_a_page_of_its_own(self, tmp_path: Path) -> None:
        names = ("a.jpg", "a/b.jpg", "a_b.jpg", "a.jpg", "a.jpg", "./a.jpg")
        done = drawn(tmp_path, "\n".join(written(UNKNOWN, name) for name in names))
        assert done.exit_code == 0, done.output
        pages = {str(it.relative_to(tmp_path / "pages")) for it in (tmp_path / "pages").rglob("*.html")}
        assert pages == {f"{it}.html" for it in ("a.jpg", "a/b.jpg", "a_b.jpg", "a.jpg-2", "a.jpg-3", "a.jpg-4")}
        assert done.stdout == f"6 pages are in {tmp_path / 'pages'}\n"

    def test_answers_without_references_need_no_server(self, tmp_path: Path) -> None:
        done = drawn(tmp_path, written(UNKNOWN))
        assert (done.exit_code, done.stderr) == (0, "")
        assert done.stdout == f"1 page is in {tmp_path / 'pages'}\n"
        assert not (tmp_path / "store").exists()
        assert "left out" not in (tmp_path / "pages/a.jpg.html").read_text()

    def test_without_a_server_pages_say_what_is_missing(self, tmp_path: Path) -> None:
        with socket.socket() as unused:
            unused.bind(("127.0.0.1", 0))  # and does not listen
            address = f"127.0.0.1:{unused.getsockname()[1]}"
            done = drawn(tmp_path, f"{written(localized())}\n{written(rejected(), 'a_b.jpg')}", "--address", address)
        assert done.exit_code == 0, done.output
        assert done.stderr.count("references are left out, because the server did not give them: UNAVAILABLE") == 1
        for name in ("a.jpg", "a_b.jpg"):
            assert "references are left out, because" in (tmp_path / f"pages/{name}.html").read_text()

    def test_wrong_options_of_the_connection_are_wrong_usage(self, tmp_path: Path) -> None:
        done = drawn(tmp_path, written(localized()), "--address", "127.0.0.1:1", "--ca", str(tmp_path / "none.pem"))
        assert done.exit_code == 2
        assert "none.pem cannot be read" in done.stderr

    @pytest.mark.parametrize(
        ("error", "sentence", "calls"),
        [
            (NotFound("NOT_FOUND", "gone"), "1 of 2 references are left out", 4),
            (PermissionDenied("PERMISSION_DENIED", "no"), "did not give them: PERMISSION_DENIED: no", 2),
        ],
        ids=["deleted", "refused"],
    )
    def test_deleted_references_are_counted_refusals_end_asking(
        self, error: MaplessError, sentence: str, calls: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        client = create_autospec(Client, instance=True)
        client.get_reference.side_effect = [BOTH[0], error] * 2
        client.get_scene.side_effect = NotFound("NOT_FOUND", "gone")
        monkeypatch.setattr("mapless_tools.draw.references.connected", lambda *_: nullcontext(client))
        done = drawn(tmp_path, f"{written(localized())}\n{written(localized(), 'a_b.jpg')}")
        assert done.exit_code == 0, done.output
        assert done.stderr.count(sentence) == 1
        assert client.get_reference.call_count == calls
        for name in ("a.jpg", "a_b.jpg"):
            html = (tmp_path / f"pages/{name}.html").read_text()
            assert sentence in html
            assert ("inliers on points that it shows, 90" in html) == (calls == 4)


def test_the_page_names_the_scene_that_was_found_among_several() -> None:
    """The plan is of its world: a hypothesis in another scene's is listed, and not drawn."""
    about = replace(diagnostics(), searched_scene_count=12)
    page = answer_page("photo", localized(scene="scenes/yard", diagnostics=about), PHOTO, CAMERA)
    assert "yard, found among 12" in page
    places = [Hypothesis(truth(), 30, (), scene=f"scenes/{it}") for it in ("yard", "hall")]
    page = answer_page(
        "photo", rejected(scene="scenes/yard", hypotheses=tuple(places), diagnostics=about), PHOTO, CAMERA
    )
    assert ">yard</td>" in page
    assert ">hall</td>" in page
