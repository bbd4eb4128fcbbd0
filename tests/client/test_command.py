"""The command `mapless` against a real server."""

import io
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf import json_format
from support.commands import run_client
from support.depths import png
from support.servers import BLACK, CAMERA, PHOTO, RunningServer, pose
from typer.testing import CliRunner

import mapless
from mapless import AlreadyExists, Camera, Client, NewReference, Provenance, wire
from mapless.cli.arguments import make_parser
from mapless.cli.commands import _pose_of
from mapless.cli.output import plain
from mapless_tools.cli.app import app

HEALTHY = dict.fromkeys(("server", "LocalizationService", "ReferenceService"), "SERVING")
CLIENT = Path(mapless.__file__).parents[1]


Run = Callable[..., tuple[int, Any, str]]


@pytest.fixture
def run(server: RunningServer, capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs the command: exit code, output (parsed if it is JSON), and error output."""

    def run(*arguments: object) -> tuple[int, Any, str]:
        code, printed, error = run_client(capsys, "--address", server.address, *arguments)
        with suppress(json.JSONDecodeError):
            return code, json.loads(printed), error
        return code, printed, error

    return run


@pytest.fixture
def camera_json(tmp_path: Path) -> str:
    path = tmp_path / "camera.json"
    path.write_text(json_format.MessageToJson(wire.camera_to_message(CAMERA), preserving_proto_field_name=True))
    return str(path)


def test_from_an_empty_server_to_a_pose(run: Run, tmp_path: Path, camera_json: str) -> None:
    photo = tmp_path / "view-1.png"
    photo.write_bytes(PHOTO)
    pose_json = json_format.MessageToJson(wire.transform_to_message(pose(1.0)))

    assert run("health") == (0, HEALTHY, "")
    assert run("scene", "create", "kitchen")[1]["scene_id"] == "kitchen"
    localize = ("localize", "kitchen", str(photo), "--camera", camera_json)
    code, answer, _ = run(*localize)
    assert (code, answer["reason"]) == (3, "NO_USABLE_REFERENCES")
    code, reference, _ = run("reference", "add", "kitchen", str(photo), "--camera", camera_json, "--pose", pose_json)
    assert (code, reference["reference_id"], reference["camera"]["width_px"]) == (0, "view-1", 96)
    code, answer, _ = run(*localize, "--reference", "view-1", "--near", "1", "2", "-1", "0.5")
    assert code == 0
    assert answer["world_from_camera"]["translation_m"] == {"x": 1.0, "y": 2.0, "z": -1.0}
    assert np.shape(answer["covariance"]) == (6, 6)
    assert [r["reference_id"] for r in run("reference", "list", "kitchen")[1]] == ["view-1"]
    assert run("reference", "delete", "kitchen", "view-1")[0] == 0
    assert run("scene", "get", "kitchen")[1]["reference_count"] == 0
    assert run("scene", "delete", "kitchen")[0] == 0
    assert run("scene", "list")[1] == []


@pytest.mark.parametrize(("answer", "is_deleted"), [("y", True), ("n", False), ("", False)])
def test_a_terminal_is_asked_before_deleting(
    run: Run, client: Client, scene: str, answer: str, is_deleted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Input that is no terminal, as a script's, is not asked; nor is anybody with --yes."""
    typed = io.StringIO(f"{answer}\n" * 2)
    monkeypatch.setattr(typed, "isatty", lambda: True)
    monkeypatch.setattr("sys.stdin", typed)
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    code, _, asked = run("reference", "delete", scene, "r0")
    assert (code, asked) == (int(not is_deleted), f"mapless: delete the reference r0 of {scene}? [y/N] ")
    count = 3 - is_deleted
    code, _, asked = run("scene", "delete", scene)
    assert (code, asked) == (
        int(not is_deleted),
        f"mapless: delete the scene {scene} with its {count} references? [y/N] ",
    )
    assert (scene in {it.scene_id for it in client.list_scenes()}) is not is_deleted
    if not is_deleted:
        assert run("reference", "delete", scene, "r0", "--yes") == (0, "", "")
        assert run("scene", "delete", scene, "--yes") == (0, "", "")
    client.create_scene(scene)  # which the fixture deletes


def test_a_reference_is_shown_and_its_photograph_downloaded(
    run: Run, client: Client, scene: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    client.add_reference(scene, NewReference("view", PHOTO, CAMERA, pose(1.5)))
    code, shown, _ = run("reference", "show", scene, "view")
    assert run("reference", "get", scene, "view") == (0, shown, "")
    assert run("scene", "show", scene) == run("scene", "get", scene)
    assert (code, shown["reference_id"], shown["world_from_camera"]["translation_m"]["x"]) == (0, "view", 1.5)
    assert run("reference", "download", scene, "view") == (0, {"file": "view.png"}, "")
    assert (tmp_path / "view.png").read_bytes() == PHOTO
    code, _, error = run("reference", "download", scene, "view")
    assert (code, error) == (2, "mapless: view.png exists; --force overwrites it\n")
    assert run("reference", "download", scene, "view", "--force")[0] == 0
    assert run("reference", "download", scene, "lost")[0] == 1


def test_contradicting_labels_are_wrong_usage(run: Run, scene: str) -> None:
    for arguments, message in (
        (["create", "new", "--label", "site=a", "--label", "site=b"], "--label site is given as 'a' and as 'b'"),
        (["update", scene, "--label", "site=a", "--forget", "labels"], "labels is given, and to be forgotten"),
        (["create", "new", "--label", "site"], "--label takes NAME=VALUE, such as site=a, not 'site'"),
    ):
        code, _, error = run("scene", *arguments)
        assert code == 2
        assert message in error


def test_lists_are_tables_on_a_terminal(run: Run, client: Client, scene: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    head, *rows = run("reference", "list", scene)[1].splitlines()
    assert head.split() == ["REFERENCE", "SIZE", "X", "Y", "Z", "FEATURES", "CREATED"]
    assert [row.split()[:3] for row in rows] == [[f"r{i}", "96x64", f"{i}.000"] for i in range(3)]
    assert len({len(row) for row in rows}) == 1
    head, *rows = run("scene", "list")[1].splitlines()
    assert [scene, "3", "m"] in [row.split()[:3] for row in rows]
    assert run("reference", "list", scene, "--json")[1][0]["reference_id"] == "r0"


def test_text_and_json_follow_one_rule(
    run: Run, scene: str, camera_json: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every command that prints: JSON in a pipe, text on a terminal, and the reverse by a flag."""
    photo = tmp_path / "view.png"
    photo.write_bytes(PHOTO)
    pose_json = json_format.MessageToJson(wire.transform_to_message(pose(1.0)))
    camera = ("--camera", camera_json)
    commands: list[tuple[object, ...]] = [
        ("health",),
        ("scene", "get", scene),
        ("scene", "list"),
        ("scene", "update", scene, "--down", "0", "0", "-1"),
        ("reference", "show", scene, "r0"),
        ("reference", "list", scene),
        ("reference", "download", scene, "r0", "--force", "--output", tmp_path / "r0.png"),
        ("localize", scene, photo, *camera),
        ("retrieve", scene, photo, *camera),
        ("coverage", scene, *camera, "--pose", pose_json),
        ("doctor",),
    ]
    for is_terminal, flag in ((False, "--text"), (True, "--json")):
        monkeypatch.setattr("sys.stdout.isatty", lambda it=is_terminal: it, raising=False)
        for command in commands:
            assert isinstance(run(*command)[1], str) == is_terminal, command
            assert isinstance(run(*command, flag)[1], str) != is_terminal, command


@pytest.mark.parametrize(
    ("source", "said"), [("GIVEN", "given"), ("UNSPECIFIED", "unknown"), ("7", "unknown")], ids=["given", "old", "new"]
)
def test_only_a_given_pose_is_called_given(source: str, said: str) -> None:
    assert _pose_of(Provenance(source), "m") == said


def test_the_text_of_single_things(run: Run, scene: str) -> None:
    printed = run("scene", "get", scene, "--text")[1].splitlines()
    assert [line.split() for line in printed[:3]] == [["scene", scene], ["references", "3"], ["unit", "m"]]
    printed = run("reference", "show", scene, "r1", "--text")[1].splitlines()
    assert [line.split(maxsplit=1)[1] for line in printed[1:4]] == ["96x64", "80.00 81.00 px", "47.50 31.50 px"]


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [(("scene", "get", "kitchn"), "kitchen"), (("reference", "show", "kitchen", "viev"), "view")],
)
def test_a_wrong_name_gets_a_suggestion(run: Run, client: Client, arguments: tuple[str, ...], meant: str) -> None:
    with suppress(AlreadyExists):
        client.create_scene("kitchen")
        client.add_reference("kitchen", NewReference("view", PHOTO, CAMERA, pose(1.5)))
    code, _, error = run(*arguments)
    assert (code, error.endswith(f"; did you mean {meant!r}?\n")) == (1, True)
    assert "did you mean" not in run("scene", "get", "something-else")[2]


def test_the_shell_completes_commands() -> None:
    meant = {"reference sh": "show", "scene g": "get", "scene de": "delete"}
    script = subprocess.run([sys.executable, "-m", "mapless", "completion", "bash"], capture_output=True, text=True)
    asked = [f'COMP_WORDS=(mapless {it}); COMP_CWORD=2; _shtab_mapless; echo "${{COMPREPLY[@]}}"' for it in meant]
    done = subprocess.run(["bash", "-c", "\n".join([script.stdout, *asked])], capture_output=True, text=True)
    assert (done.stdout.split(), script.stderr + done.stderr) == ([*meant.values()], "")


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (("localise", "s", "a.jpg"), "localize"),
        (("scenes", "list"), "scene"),
        (("scene", "lst"), "list"),
        (("reference", "shwo", "s", "r"), "show"),
        (("scene", "create", "s", "--unit", "meter"), "metre"),
        (("reference", "add", "s", "a.jpg", "--camra", "c.json"), "--camera"),
        (("--adress", "localhost:1", "health"), "--address"),
    ],
)
def test_a_wrong_command_gets_a_suggestion(run: Run, arguments: tuple[str, ...], meant: str) -> None:
    code, _, error = run(*arguments)
    assert code == 2
    assert error.endswith(f"did you mean {meant!r}?\n")


def test_a_pose_may_be_a_matrix(run: Run, scene: str, camera_json: str, tmp_path: Path) -> None:
    photo = tmp_path / "view.png"
    photo.write_bytes(PHOTO)
    matrix = json.dumps(pose(1.25).matrix().tolist())
    (tmp_path / "pose.json").write_text(matrix)
    for reference_id, given in (("inline", matrix), ("file", tmp_path / "pose.json")):
        arguments = ("--camera", camera_json, "--pose", given, "--id", reference_id)
        code, stored, _ = run("reference", "add", scene, photo, *arguments)
        assert (code, stored["world_from_camera"]["translation_m"]["x"]) == (0, 1.25)
    code, _, error = run("reference", "add", scene, photo, "--camera", camera_json, "--pose", "[[1, 0], [0, 1]]")
    assert (code, error) == (
        2,
        "mapless: pose: world_from_camera as a matrix: must be 3 or 4 rows of 4 finite numbers, is [[1, 0], [0, 1]]\n",
    )


def test_more_references_than_are_used_say_how(run: Run, scene: str, camera_json: str, tmp_path: Path) -> None:
    photo = tmp_path / "view.png"
    photo.write_bytes(PHOTO)
    named = [argument for i in range(65) for argument in ("--reference", f"r{i}")]
    code, _, error = run("localize", scene, photo, "--camera", camera_json, *named)
    assert code == 1
    assert "at most 1000 with options.rerank_references (--rerank)" in error


def test_errors_are_one_line_with_an_exit_code(run: Run, tmp_path: Path, camera_json: str) -> None:
    code, _, error_text = run("scene", "get", "absent")
    assert code == 1
    assert error_text.startswith("mapless: NOT_FOUND: ")
    photo = str(tmp_path / "absent.jpg")
    code, _, error_text = run("localize", "s", photo, "--camera", camera_json)
    assert (code, "absent.jpg" in error_text) == (2, True)
    assert error_text == f"mapless: {photo}: No such file or directory\n"
    code, _, error_text = run("localize", "s", photo, "--camera", '{"width": 3}')
    assert (code, "width is no field" in error_text) == (2, True)


def test_a_file_whose_name_is_no_id_needs_one(run: Run, scene: str, tmp_path: Path, camera_json: str) -> None:
    (tmp_path / "my photo.png").write_bytes(PHOTO)
    where = ("--camera", camera_json, "--pose", json.dumps(plain(pose(0.5))))
    code, _, error_text = run("reference", "add", scene, tmp_path / "my photo.png", *where)
    assert (code, "my photo.png: its name gives no id, so give one with --id: " in error_text) == (2, True)
    code, stored, _ = run("reference", "add", scene, tmp_path / "my photo.png", *where, "--id", "mine")
    assert (code, stored["reference_id"]) == (0, "mine")


@pytest.mark.parametrize("option", [("unit", "0.01"), ("sensor", "stereo"), ("camera", "c.json"), ("pose", "p.json")])
def test_options_of_a_depth_need_one(
    run: Run, scene: str, tmp_path: Path, camera_json: str, option: tuple[str, str]
) -> None:
    (tmp_path / "view.png").write_bytes(PHOTO)
    where = ("--camera", camera_json, "--pose", json.dumps(plain(pose(0.5))))
    code, _, error = run("reference", "add", scene, tmp_path / "view.png", *where, f"--depth-{option[0]}", option[1])
    assert (code, f"--depth-{option[0]} " in error, "--depth, too" in error) == (2, True, True)


def test_a_stored_depth_is_shown_without_its_bytes(run: Run, scene: str, tmp_path: Path, camera_json: str) -> None:
    (tmp_path / "view.png").write_bytes(PHOTO)
    (tmp_path / "depth.png").write_bytes(png(np.full((64, 96), 1500, np.uint16)))
    given = ("--camera", camera_json, "--pose", json.dumps(plain(pose(0.5))), "--depth", tmp_path / "depth.png")
    _, stored, _ = run("reference", "add", scene, tmp_path / "view.png", *given, "--depth-sensor", "stereo")
    said = {"data": "png", "size": [96, 64], "unit_m": 0.001, "sensor": "stereo", "confidence": False}
    assert stored["depth"] == stored["depth"] | said
    _, shown, _ = run("reference", "show", scene, "view")
    assert (shown["depth"], shown["image"]) == (stored["depth"], None)
    _, card, _ = run("--text", "reference", "show", scene, "view")
    assert re.search(r"depth +96x64, unit 0.001 m, sensor stereo\n", card)


def test_a_blank_reference_is_warned_of(run: Run, scene: str, tmp_path: Path, camera_json: str) -> None:
    (tmp_path / "blank.png").write_bytes(BLACK)
    where = ("--camera", camera_json, "--pose", json.dumps(plain(pose(0.5))))
    code, stored, warning = run("reference", "add", scene, tmp_path / "blank.png", *where)
    assert (code, stored["feature_count"]) == (0, 0)
    assert warning.startswith(f"mapless: warning: {tmp_path}/blank.png is stored, but has no local features: ")


@pytest.mark.parametrize(
    ("content", "camera", "error_text"),
    [
        (b"", CAMERA, "photo.png: IMAGE_EMPTY: the image is empty\n"),
        (b"hello", CAMERA, "photo.png: IMAGE_UNKNOWN_FORMAT: "),
        (PHOTO, replace(CAMERA, width_px=64, height_px=96), "camera.json: INVALID_ARGUMENT: intrinsics.width_px: "),
    ],
)
def test_an_error_names_the_file(
    run: Run, scene: str, tmp_path: Path, content: bytes, camera: Camera, error_text: str
) -> None:
    (tmp_path / "photo.png").write_bytes(content)
    (tmp_path / "camera.json").write_text(json.dumps(plain(camera)))
    code, _, printed = run("localize", scene, tmp_path / "photo.png", "--camera", tmp_path / "camera.json")
    assert code == 1
    assert printed.startswith(f"mapless: {tmp_path}/{error_text}")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three photographs, of which the second is none, and the cameras of the first and the third."""
    photos = tmp_path / "photos"
    (photos / "images").mkdir(parents=True)
    k = CAMERA.matrix().tolist()
    frames = [{"image": f"images/{i}.png", "width": 96, "height": 64, "K": k, "dist": None} for i in (2, 0)]
    (photos / "cameras.json").write_text(json.dumps({"frames": frames}))
    for i in range(3):
        (photos / "images" / f"{i}.png").write_bytes(PHOTO if i != 1 else b"no photograph")
    return photos


FOUR_NUMBERS = "80,81,47.5,31.5"


def lines_of(printed: str) -> list[Any]:
    return [json.loads(line) for line in printed.splitlines()]


@pytest.mark.parametrize("parallel", ["1", "3"])
def test_a_folder_gives_one_json_line_per_photograph_in_order(
    run: Run, scene: str, folder: Path, parallel: str
) -> None:
    code, printed, report = run("localize", scene, folder, "--parallel", parallel)
    answers = lines_of(printed)
    assert (code, report) == (0, "2 of 2 localized\n")
    assert [answer["photo"] for answer in answers] == ["images/2.png", "images/0.png"]
    assert all("world_from_camera" in answer for answer in answers)


def test_a_call_that_fails_does_not_end_the_others(run: Run, scene: str, folder: Path, tmp_path: Path) -> None:
    """Four numbers take the size of the image from each file; a file that has none fails by its call alone."""
    written = tmp_path / "answers.jsonl"
    camera = json_format.MessageToJson(wire.camera_to_message(CAMERA))
    code, printed, report = run("localize", scene, folder / "images", "--camera", camera, "--output", written)
    assert (code, printed, report) == (
        1,
        "",
        f"2 of 3 localized, 1 failed (1 IMAGE_UNKNOWN_FORMAT)\nanswers are in {written}\n",
    )
    first, second, third = lines_of(written.read_text())
    assert (second["photo"], second["error"]["code"], second["error"]["field"]) == (
        "1.png",
        "INVALID_ARGUMENT",
        "image",
    )
    assert first["inlier_count"] == third["inlier_count"] == 90
    (folder / "images" / "1.png").unlink()
    assert run("localize", scene, folder / "images", "--camera", FOUR_NUMBERS)[0] == 0


def test_a_folder_with_unlocalized_photographs_ends_with_3(run: Run, folder: Path) -> None:
    assert run("scene", "create", "bare")[0] == 0
    code, printed, report = run("localize", "bare", folder)
    assert (code, report) == (3, "0 of 2 localized, 2 not localized (2 NO_USABLE_REFERENCES)\n")
    assert {answer["reason"] for answer in lines_of(printed)} == {"NO_USABLE_REFERENCES"}


def test_a_photograph_beside_a_cameras_json_needs_no_camera(run: Run, scene: str, folder: Path) -> None:
    code, answer, report = run("localize", scene, folder / "images" / "0.png")
    assert (code, answer["inlier_count"], report) == (0, 90, "")
    code, _, error_text = run("localize", scene, folder / "images" / "1.png")
    assert (code, "does not list" in error_text) == (2, True)


def test_a_photograph_without_a_camera_is_sent_without(run: Run, scene: str, folder: Path) -> None:
    (folder / "cameras.json").unlink()
    code, answer, report = run("localize", scene, folder / "images" / "0.png")
    assert (code, answer["inlier_count"], answer["used_intrinsics"], report) == (0, 90, None, "")


class TestOnATerminal:
    @pytest.fixture
    def terminal(self, monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
        """To be called by the test itself: what it prints to is not there before."""

        def begin() -> None:
            for stream in (sys.stdout, sys.stderr):
                monkeypatch.setattr(stream, "isatty", lambda: True, raising=False)

        return begin

    def test_a_photograph_is_a_few_lines(
        self, run: Run, scene: str, folder: Path, terminal: Callable[[], None]
    ) -> None:
        terminal()
        photo = str(folder / "images" / "0.png")
        code, printed, _ = run("localize", scene, photo, "--camera", folder / "cameras.json")
        assert code == 0
        assert printed.startswith("localized")
        assert "position  0.000  2.000  -1.000 m   within" in printed
        assert "90 of 120 matches" in printed
        assert len(printed.splitlines()) <= 6
        assert run("localize", scene, photo, "--camera", FOUR_NUMBERS, "--json")[1]["inlier_count"] == 90

    def test_a_folder_is_a_table_and_a_bar(
        self, run: Run, scene: str, folder: Path, terminal: Callable[[], None]
    ) -> None:
        terminal()
        code, printed, report = run("localize", scene, folder)
        assert code == 0
        assert [line.split()[0] for line in printed.splitlines()] == ["photograph", "images/2.png", "images/0.png"]
        assert "[........................] 0/2" in report
        assert "[############............] 1/2, 0 s to go" in report
        assert "[########################] 2/2" in report
        assert report.endswith("\r\x1b[K2 of 2 localized\n")


def test_answers_with_debug_are_drawn_a_page_each(
    run: Run, scene: str, folder: Path, server: RunningServer, tmp_path: Path
) -> None:
    answers, pages = tmp_path / "answers.jsonl", tmp_path / "pages"
    assert run("localize", scene, folder, "--debug", "--output", answers)[0] == 0
    draw = ["draw", str(answers), str(folder), "--output", str(pages), "--address", server.address]
    done = CliRunner().invoke(app, draw)
    assert (done.exit_code, done.output) == (0, f"2 pages are in {pages}\n")
    assert sorted(page.name for page in (pages / "images").iterdir()) == ["0.png.html", "2.png.html"]
    page = (pages / "images" / "0.png.html").read_text()
    for shown in ("images/0.png: localized", "90 of 120 matches", "<td>r0</td>", "From above"):  # with references
        assert shown in page
    assert "camera" not in run("localize", scene, folder / "images" / "0.png", "--camera", FOUR_NUMBERS)[1]


@pytest.mark.parametrize("flag", [["--draw", "pages"], ["--draw=pages"], ["--draw"]])
def test_who_asks_for_drawings_learns_the_new_command(flag: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        make_parser().parse_args(["localize", "kitchen", "query.jpg", *flag])
    error = capsys.readouterr().err
    assert "--draw is gone: write the answer with --debug --output answer.json" in error
    assert "`mapless-server draw answer.json PHOTO`" in error
    assert len(error.splitlines()) == 1


def test_a_scene_has_its_place_on_the_earth(run: Run) -> None:
    code, made, _ = run("scene", "create", "placed", "--datum", "47.5", "8.25", "-3", "--down", "0", "0", "-2")
    assert (code, made["datum"]["latitude_deg"], made["datum"]["height_m"]) == (0, 47.5, -3.0)
    assert made["down_in_world"] == [0.0, 0.0, -1.0]
    turned = ("--datum", "47.5", "8.25", "0", "--enu-from-world", "0", "0", "-1", "0")
    code, changed, _ = run("scene", "update", "placed", *turned, "--forget", "down_in_world")
    assert (code, changed["datum"]["enu_from_world"]["z"]) == (0, -1.0)
    assert changed["generation"] == made["generation"] + 1
    code, got, _ = run("scene", "get", "placed")
    assert got == changed | {"adopted_reference_count": 0, "retired_reference_count": 0}  # which it alone asks for
    assert run("scene", "update", "placed")[0] == 2
    code, made, _ = run("scene", "create", "without-metres", "--unit", "arbitrary")
    assert (code, made["arbitrary_unit"]) == (0, True)
    assert "unit of length is arbitrary" in run("reference", "list", "without-metres")[2]
    code, changed, _ = run("scene", "update", "without-metres", "--unit", "metre")
    assert (code, changed["arbitrary_unit"], changed["warnings"]) == (0, False, [])
    assert run("scene", "create", "x", "--enu-from-world", "0", "0", "0", "1")[0] == 2


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--parallel", "0"], "--parallel must be at least 1, is 0"),
        (["--rerank"], "--rerank needs --reference"),
        (["--camera", FOUR_NUMBERS], "1.png"),
        (["--camera", "1,2,3"], "1,2,3: a camera must be four numbers"),
        (["--camera", "1,2,3,4,5"], "four numbers"),
        (["--camera", "nan,1,2,3"], "nan,1,2,3"),
        (["--camera", "cameras.json"], "cameras.json"),
        (["--axes", "sideways", "--camera", '{"width_px": 96}'], "camera: height_px"),
        (["--camera", FOUR_NUMBERS, "--count", "0"], "--count: must be at least 1, is 0"),
    ],
)
def test_wrong_arguments_are_reported_before_any_call(
    run: Run, folder: Path, arguments: list[str], expected: str
) -> None:
    code, printed, error_text = run("localize", "s", folder / "images", *arguments)
    assert (code, printed) == (2, "")
    assert expected in error_text
    assert "Traceback" not in error_text


def test_an_interruption_while_the_command_is_loaded_is_quiet(tmp_path: Path) -> None:
    """The module stands in for the client's own, and interrupts while it is being loaded."""
    (tmp_path / "mapless").mkdir()
    (tmp_path / "mapless" / "__init__.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGINT)\n")
    program = (
        "import signal\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # the process that runs the tests may ignore it
        "from mapless_command import main\nmain()"
    )
    paths = os.pathsep.join([str(tmp_path), str(CLIENT)])
    done = subprocess.run(
        [sys.executable, "-c", program],
        env=os.environ | {"PYTHONPATH": paths},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (128 + signal.SIGINT, "", "")


def test_connection_flags_may_stand_before_or_after_the_command() -> None:
    for command in (["health"], ["scene", "list"]):
        for arguments in (
            [*command, "--address", "here"],
            ["--address", "127.0.0.1:1", *command, "--address", "here"],
            ["--address", "here", *command, "--timeout", "20"],
            [command[0], "--address", "here", *command[1:]],
        ):
            assert make_parser().parse_args(arguments).address == "here"
    first = make_parser().parse_args(["--timeout", "3", "--tls", "--client-id", "a", "health", "--client-id", "b"])
    assert (first.timeout, first.tls, first.client_id, first.ca) == (3.0, True, "b", None)
    last = make_parser().parse_args(["localize", "s", "p.jpg", "--ca", "x.crt", "--camera", "c.json"])
    assert (str(last.ca), last.camera, last.timeout, last.tls) == ("x.crt", "c.json", 30.0, False)


def test_the_address_is_that_of_the_environment(
    server: RunningServer, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MAPLESS_ADDRESS", server.address)
    code, printed, _ = run_client(capsys, "health")
    assert (code, json.loads(printed)) == (0, HEALTHY)
