"""Captured calls can be computed again exactly: answers of a real server, replayed by another process.

The law: with the same program and settings every replayed answer is the answer, to the last bit; whatever was planted
into the folder is found, and named.
"""

import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from support import corner
from support.images import encode, textured
from support.waiting import wait_until

from mapless import (
    Client,
    GravityPrior,
    LocalizationResult,
    NewReference,
    NotFound,
    PosePrior,
    PositionPrior,
    Priors,
    Rejected,
    RigImage,
    SequenceFrame,
)
from mapless.geometry import RigidTransform as Pose
from mapless.v1 import localization_service_pb2 as pb
from mapless_server.engine.query import CutReason, LadderCut
from mapless_server.method.judge.hypothesis import Attempt
from mapless_server.method.options import StageContext
from mapless_server.scenes import Choice
from mapless_server.scenes import Selection as Wanted
from mapless_server.scheduling import Next, Step
from mapless_server.security import key_of
from mapless_server.services.capture.calls import CapturedCall, CapturedPart, CaptureError, decode_call, encode_call
from mapless_server.services.capture.files import blob_path, calls_of
from mapless_server.settings import load_settings
from mapless_tools.child import child_server
from mapless_tools.replay import report as report_module
from mapless_tools.replay.recompute import RecordedSource, followed, recompute
from mapless_tools.replay.report import Report, Selection, select

pytestmark = pytest.mark.nightly("replay")

ANGLES = range(-24, 25, 8)
QUERIES = [corner.pose(angle, height) for angle, height in ((3.3, -1.5), (-14.0, -1.7), (20.0, -1.55))]
PHOTOS = [corner.photograph(it) for it in QUERIES]
NAMED = ["r3", "r4", "r5", "r6"]
BLANK = encode(".png", np.full((384, 512, 3), 90, np.uint8))
ELSEWHERE = encode(".png", textured(512, 384, seed=9))


CAPTURED = 18 + 4
"""Calls that are captured: of each kind, and every fifth again."""


def known_of(pose: Pose) -> Priors:
    """What is true, and neither exact nor certain."""
    down = pose.rotation.T @ [0.02, 1.0, 0.01]
    return Priors(
        position=PositionPrior(pose.translation + 0.3, radius_m=5.0, covariance_m2=np.eye(3)),
        gravity=GravityPrior(down, sigma_deg=2.0),
    )


def calls(client: Client) -> list[Callable[[], Any]]:
    """One of each kind, which succeed, or are rejected."""
    rig = [RigImage(photo, corner.CAMERA, it) for photo, it in zip(PHOTOS, QUERIES, strict=True)]
    walk = [SequenceFrame(photo, corner.CAMERA, it) for photo, it in zip(PHOTOS, QUERIES, strict=True)]

    def localize(photo: bytes, *arguments: Any, **options: Any) -> Callable[[], Any]:
        return lambda: client.localize(photo, corner.CAMERA, "corner", *arguments, **options)

    return [
        *(localize(photo) for photo in PHOTOS),
        localize(PHOTOS[0], NAMED),
        localize(PHOTOS[0], NAMED, include_debug=True, axes="unity", session_from_camera=corner.pose(1.0)),
        localize(PHOTOS[1], [f"r{i}" for i in range(len(ANGLES))], rerank_references=True, reference_count=4),
        localize(PHOTOS[2], variant="full"),
        localize(PHOTOS[2], variant="coarse"),
        localize(PHOTOS[0], priors=known_of(QUERIES[0])),
        localize(PHOTOS[0], priors=Priors(pose=PosePrior(QUERIES[0], 1e-3 * np.eye(6)))),
        localize(PHOTOS[0], priors=Priors(pose=PosePrior(QUERIES[2], 1e-3 * np.eye(6)))),
        localize(PHOTOS[0], NAMED, priors=Priors(position=PositionPrior(np.array([50.0, 0, 0]), radius_m=1.0))),
        localize(PHOTOS[0], priors=Priors(position=PositionPrior(np.array([50.0, 0, 0]), radius_m=1.0))),
        localize(BLANK),
        localize(ELSEWHERE),
        localize(PHOTOS[0], ["r0"]),
        lambda: client.localize_rig(rig, "corner"),
        lambda: client.localize_sequence(walk, "corner", estimate_session_scale=True),
    ]


def test_each_kind_of_features_gets_its_own_choice() -> None:
    upright, rolled = Choice((), "vlad-1-edgepoint2", 1), Choice((), "vlad-1-sift", 1)
    part = CapturedPart("image", 1, (), (rolled, upright))
    source = RecordedSource(cast(Any, None), part, cast(Any, None), cast(Any, None), False, "sift")
    for name, expected in (("edgepoint2", upright), ("aliked", upright), ("sift", rolled)):
        extractor = cast(Any, SimpleNamespace(name=name))
        assert source.choose(key_of("", "s"), cast(Any, None), Wanted(1), StageContext(), extractor) is expected


@pytest.fixture(scope="module")
def captured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a call of each kind, by itself, and some of them once more, side by side."""
    folder = tmp_path_factory.mktemp("captured")
    flags = {"--capture-dir": str(folder / "calls"), "--workers": "2"}
    environment = {"MAPLESS_CAPTURE_HOURS": "1"}
    with (
        child_server(folder / "data", flags, environment) as server,
        Client(server.address) as client,
        ThreadPoolExecutor(4) as pool,
    ):
        client.create_scene("corner")
        poses = [corner.pose(angle) for angle in ANGLES]
        photos = map(corner.photograph, poses)
        references = [NewReference(f"r{i}", it, corner.CAMERA, poses[i]) for i, it in enumerate(photos)]
        client.add_references("corner", references)
        client.update_scene("corner", down_in_world=(0, 1, 0))
        answers = [call() for call in calls(client)]
        assert sum(isinstance(it, LocalizationResult) for it in answers) == 11
        assert sum(isinstance(it, Rejected) for it in answers) == 5
        list(pool.map(lambda call: call(), calls(client)[::5]))
        with pytest.raises(NotFound):  # of which nothing is kept
            client.localize(PHOTOS[0], corner.CAMERA, "nowhere")
        wait_until(lambda: len(list(calls_of(folder / "calls"))) == CAPTURED)
    return folder / "calls"


def replay(folder: Path, *arguments: str, **environment: str) -> tuple[int, dict[str, Any]]:
    """Exit code and report of the command, which runs on its own, far from the store."""
    command = [sys.executable, "-m", "mapless_tools", "replay", str(folder), "--json", *arguments]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=100, cwd=folder.parent, env={**os.environ, **environment}
    )
    assert not done.stderr
    return done.returncode, json.loads(done.stdout)


def test_every_answer_is_computed_again_to_the_last_bit(captured: Path, tmp_path: Path) -> None:
    """Retrieved and named references, priors, every kind of rejection, rigs, walks, alone and side by side."""
    copy = shutil.copytree(captured, tmp_path / "elsewhere")
    code, report = replay(copy)
    different = [call for call in report["calls"] if call["verdict"] == "changed"]
    assert not different
    assert [call["verdict"] for call in report["calls"]].count("identical") == CAPTURED
    outcomes = {call["outcome_now"] for call in report["calls"]}
    assert {"localized", "low_texture", "prior_conflict", "no_usable_references"} <= outcomes
    assert {call["method"] for call in report["calls"]} == {"Localize", "LocalizeRig", "LocalizeSequence"}
    assert report["circumstances"] == report["unreadable"] == []
    assert code == 0


def only(captured: Path, folder: Path, wanted: Callable[[CapturedCall], bool]) -> tuple[Path, CapturedCall]:
    """A copy of the folder with one call in it, which fits."""
    copy = shutil.copytree(captured, folder)
    found = None
    for path in sorted(calls_of(copy)):
        call = decode_call(path.read_bytes())
        if found is None and wanted(call):
            found = path, call
        else:
            path.unlink()
    assert found is not None
    return found


def is_named(call: CapturedCall) -> bool:
    return [part.choices for part in call.parts] == [()] and len(call.parts[0].references) == len(NAMED)


def test_a_moved_reference_is_detected(captured: Path, tmp_path: Path) -> None:
    path, call = only(captured, tmp_path / "copy", is_named)
    (part,) = call.parts
    first = part.references[0]
    moved = Pose(first.world_from_camera.rotation, first.world_from_camera.translation + [0.002, 0, 0])
    planted = replace(part, references=(replace(first, world_from_camera=moved), *part.references[1:]))
    path.write_bytes(encode_call(replace(call, parts=(planted,))))
    code, report = replay(tmp_path / "copy")
    (replayed,) = report["calls"]
    assert code == 1
    assert replayed["verdict"] == "changed"
    assert 1e-4 < replayed["apart_cm"] < 1
    assert replayed["apart_deg"] < 0.2
    assert any(it["field"].startswith("localization.world_from_camera") for it in replayed["changes"])


def test_what_is_computed_with_is_compared_too(captured: Path, tmp_path: Path) -> None:
    """Another version then, and another coverage now, under which the pose is not trusted."""
    path, call = only(captured, tmp_path / "copy", is_named)
    path.write_bytes(encode_call(replace(call, circumstances={**call.circumstances, "mapless": "0.0.1"})))
    code, report = replay(tmp_path / "copy", MAPLESS_COVERAGE="0.000001")
    changed = {it["field"]: (it["then"], it["now"]) for it in report["circumstances"]}
    assert changed["mapless"][0] == "0.0.1"
    assert changed["coverage"] == ("0.95", "1e-06")
    (replayed,) = report["calls"]
    assert (replayed["outcome_then"], replayed["outcome_now"]) == ("localized", "gate")
    assert code == 1


def test_the_table_shows_what_has_changed(captured: Path, tmp_path: Path) -> None:
    path, call = only(captured, tmp_path / "copy", is_named)
    path.write_bytes(encode_call(replace(call, circumstances={**call.circumstances, "mapless": "0.0.1"})))
    command = [sys.executable, "-m", "mapless_tools", "replay", str(tmp_path / "copy"), "--last", "1"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=True)
    assert "mapless: then 0.0.1, now " in done.stdout
    assert f"{call.request_id} Localize default/corner: identical, localized" in done.stdout
    assert done.stdout.endswith("1 identical\n")


@pytest.mark.parametrize("damage", ["cut", "flipped", "blob"])
def test_damage_is_named_and_not_counted_as_identical(captured: Path, tmp_path: Path, damage: str) -> None:
    path, call = only(captured, tmp_path / "copy", is_named)
    data = bytearray(path.read_bytes())
    if damage == "cut":
        path.write_bytes(data[:-1])
    elif damage == "flipped":
        data[-100] ^= 1
        path.write_bytes(data)
    else:
        view = next(iter(call.parts[0].references[0].views.values()))
        (tmp_path / "copy" / "tenants" / "default" / "blobs" / view).unlink()
    code, report = replay(tmp_path / "copy")
    assert code == 1
    assert "identical" not in {it["verdict"] for it in report["calls"]}
    errors = [*report["unreadable"], *(it["error"] for it in report["calls"])]
    assert len(errors) == 1
    assert "No such file" in errors[0] if damage == "blob" else "cut" in errors[0]


def test_features_of_an_unknown_form_are_extracted_anew(captured: Path, tmp_path: Path) -> None:
    """Of another version, whose features are alike; so the answer is, too."""
    path, call = only(captured, tmp_path / "copy", is_named)
    (part,) = call.parts
    first = part.references[0]
    (extractor,) = first.views
    data = b"of another version"
    name = hashlib.sha256(data).hexdigest()
    blob_path(tmp_path / "copy", call.tenant, name).write_bytes(data)
    planted = replace(part, references=(replace(first, views={extractor: name}), *part.references[1:]))
    path.write_bytes(encode_call(replace(call, parts=(planted,))))
    code, report = replay(tmp_path / "copy")
    (replayed,) = report["calls"]
    assert (code, replayed["verdict"], replayed["found_anew"]) == (0, "identical", 1)


def test_a_call_that_cannot_be_computed_is_one_row(captured: Path, tmp_path: Path) -> None:
    """A method of another version, and a request that is no message; a third one is as it was."""
    path, call = only(captured, tmp_path / "copy", is_named)
    for name, planted in {
        "1-1-1": replace(call, method="LocalizeTwice", request_id="unknown"),
        "1-1-2": replace(call, request=b"\xff\xff", request_id="garbage"),
    }.items():
        path.with_name(f"{name}.call").write_bytes(encode_call(planted))
    code, report = replay(tmp_path / "copy")
    verdicts = {it["request_id"]: (it["verdict"], it["error"]) for it in report["calls"]}
    assert code == 1
    assert verdicts["unknown"] == ("not computed", "error: this program knows no method LocalizeTwice")
    assert verdicts["garbage"][0] == "not computed"
    assert verdicts["garbage"][1].startswith("error: DecodeError: ")
    assert verdicts[call.request_id] == ("identical", "")


def test_only_what_was_asked_for_is_judged(captured: Path, tmp_path: Path) -> None:
    """Another tenant's unreadable file is not reported; an id that does not exist is."""
    _, call = only(captured, tmp_path / "copy", is_named)
    theirs = tmp_path / "copy" / "tenants" / "other" / "calls" / "z" / "00000000000001-1-1.call"
    theirs.parent.mkdir(parents=True)
    theirs.write_bytes(b"junk")

    def report_on(**options: Any) -> Report:
        return report_module.replay(tmp_path / "copy", Selection(**options), load_settings({}).settings)

    for options in ({"tenant": "default"}, {"request_ids": frozenset({call.request_id})}, {"last": 1}):
        report = report_on(**options)
        assert (report.is_identical, len(report.calls), report.unreadable) == (True, 1, ())
    report = report_on()
    assert (report.is_identical, len(report.calls), len(report.unreadable)) == (False, 1, 1)
    with pytest.raises(CaptureError, match="holds no call of id absent; 1 files cannot be read"):
        select(tmp_path / "copy", Selection(frozenset({"absent"})), [])


def test_what_its_server_deletes_meanwhile_is_left_out(
    captured: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The call first, and then its blobs, as a server does."""
    path, _ = only(captured, tmp_path / "copy", is_named)

    def deleted_meanwhile(*arguments: Any) -> Any:
        path.unlink()
        shutil.rmtree(tmp_path / "copy" / "tenants" / "default" / "blobs")
        return recompute(*arguments)

    monkeypatch.setattr(report_module, "recompute", deleted_meanwhile)
    report = report_module.replay(tmp_path / "copy", Selection(), load_settings({}).settings)
    assert (report.calls, report.unreadable, report.is_identical) == ((), (), True)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--id", "nobody"], "holds no call of id nobody"),
        (["--tenant", "nobody"], "holds no such calls"),
        (["--backend", "pi4"], "pi4"),
        (["--last", "0"], "--last"),
    ],
)
def test_a_replay_that_is_not_possible_is_refused(captured: Path, arguments: list[str], message: str) -> None:
    command = [sys.executable, "-m", "mapless_tools", "replay", str(captured), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100)
    assert done.returncode == 2
    assert message in done.stderr
    assert "Traceback" not in done.stderr


THEN = [("as it is", "cheap", "gate"), ("lines", "cheap", "gate"), ("stronger", "strong", "unfinished")]


@pytest.mark.parametrize(
    ("steps", "count", "expected"),
    [
        (["as it is", "stronger"], 0, ("as it is", True)),
        (["wide", "lines", "stronger"], 1, ("lines", True)),
        (["wide", "stronger"], 2, ("stronger", False)),
        (["wide", "lines"], 2, ("wide", True)),
        (["wide", "lines"], 3, ("wide", True)),
    ],
    ids=["first", "second", "without a result", "not among them", "after the last"],
)
def test_attempts_are_those_of_the_captured_answer(steps: list[str], count: int, expected: tuple[str, bool]) -> None:
    """In its order; and one that had no result then has none again, as if there were no time."""
    then = pb.Diagnostics(attempts=[pb.Attempt(rung=r, features=f, outcome=o) for r, f, o in THEN])
    tiers: Any = [SimpleNamespace(features=it) for it in ("cheap", "strong")]
    payloads: Any = [
        SimpleNamespace(rung=it, attempt=Attempt(int(it == "stronger")), attempts=(None,) * count, cuts=())
        for it in steps
    ]
    step, had_result = followed(then, tiers, Next(tuple(Step("", "", "", it) for it in payloads)))
    assert (step.payload.rung, had_result) == expected


@pytest.mark.parametrize(("unmatched", "expected"), [(2, 1), (1, 0), (0, 0)])
def test_references_not_matched_then_are_not_matched_again(unmatched: int, expected: int) -> None:
    """A network had matched some of them when the time was over."""
    then = pb.Diagnostics(
        attempts=[pb.Attempt(rung="rematched", features="strong", outcome="gate")],
        ladder_cuts=[pb.LadderCut(rung="rematched", features="strong", unmatched_reference_count=unmatched)],
    )
    cuts = (), (LadderCut("rematched", "strong", CutReason.NO_TIME, 2),)
    payloads: Any = [SimpleNamespace(rung="rematched", attempt=Attempt(0), attempts=(), cuts=it) for it in cuts]
    steps = tuple(Step("", "", "", it) for it in payloads)
    tiers: Any = [SimpleNamespace(features="strong")]
    assert followed(then, tiers, Next(steps)) == (steps[expected], True)


def test_a_folder_that_is_none_is_refused(tmp_path: Path) -> None:
    for folder, message in ((tmp_path / "absent", "no capture folder"), (tmp_path, "no capture folder")):
        command = [sys.executable, "-m", "mapless_tools", "replay", str(folder)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=100)
        assert (done.returncode, message in done.stderr) == (2, True)
    (tmp_path / "mapless-capture.json").write_text('{"format": 99}')
    done = subprocess.run(
        [sys.executable, "-m", "mapless_tools", "replay", str(tmp_path)], capture_output=True, text=True, timeout=100
    )
    assert (done.returncode, "has format 99" in done.stderr) == (2, True)
