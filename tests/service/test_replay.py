"""Captured calls can be computed again exactly: answers of a real server, from its store or a backup.

The law: with the same program and settings every replayed answer is the answer, to the last bit; whatever was planted
into the folder or the store is found, and named.
"""

import json
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from support import corner
from support.captures import NOW_S, a_call, filled, opened
from support.commands import run
from support.images import encode, textured
from support.stores import make_reference
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
from mapless_server.services.capture.folder import calls_of
from mapless_server.store import Store
from mapless_server.store.backup import back_up
from mapless_server.store.sqlite import DATABASE_FILE, SqliteDatabase
from mapless_tools.child import child_server
from mapless_tools.replay.recompute import RecordedSource, StoredReferences, followed
from mapless_tools.replay.report import Selection, select

NIGHTLY = pytest.mark.nightly("replay")

ANGLES = range(-24, 25, 8)
QUERIES = [corner.pose(angle, height) for angle, height in ((3.3, -1.5), (-14.0, -1.7), (20.0, -1.55))]
PHOTOS = [corner.photograph(it) for it in QUERIES]
NAMED = ["r3", "r4", "r5", "r6"]
BLANK = encode(".png", np.full((384, 512, 3), 90, np.uint8))
ELSEWHERE = encode(".png", textured(512, 384, seed=9))


CAPTURED = 18 + 4
"""Calls that are captured: of each kind, and every fifth again."""


def known_of(pose: Pose) -> Priors:
    """A true pose, neither exact nor certain."""
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
    part = CapturedPart("image", 1, {}, (rolled, upright))
    source = RecordedSource(cast(Any, None), part, cast(Any, None), cast(Any, None), False, "sift")
    for name, expected in (("edgepoint2", upright), ("aliked", upright), ("sift", rolled)):
        extractor = cast(Any, SimpleNamespace(name=name))
        assert source.choose(key_of("", "s"), cast(Any, None), Wanted(1), StageContext(), extractor) is expected


@pytest.fixture(scope="module")
def captured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with calls of each kind, alone and side by side; their store, a backup, and a replay while served."""
    folder = tmp_path_factory.mktemp("captured")
    flags = {"--capture-dir": str(folder / "calls"), "--workers": "2"}
    with (
        child_server(folder / "data", flags, {"MAPLESS_CAPTURE_HOURS": "1"}) as server,
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
        wait_until(lambda: len(calls_of(folder / "calls")) == CAPTURED)
        while_served = run("replay", folder / "calls", "--data-dir", folder / "data", "--last", "2")
        (folder / "while served").write_text(while_served.output)
    database = SqliteDatabase.open_as_is(folder / "data" / DATABASE_FILE)
    back_up(database, folder / "backup")
    database.close()
    return folder


@NIGHTLY
def test_answers_are_computed_again_while_the_store_is_served(captured: Path) -> None:
    assert (captured / "while served").read_text().endswith("2 identical\n")


@NIGHTLY
def test_every_answer_is_computed_again_to_the_last_bit(captured: Path, tmp_path: Path) -> None:
    """From a backup, elsewhere: retrieved and named references, priors, every rejection, rigs, walks, side by side."""
    shutil.copytree(captured / "calls", tmp_path / "calls")
    shutil.copy(captured / "backup", tmp_path / "backup")
    command = [sys.executable, "-m", "mapless_tools", "replay", "calls", "--backup", "backup", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=170, cwd=tmp_path)
    assert not done.stderr
    report = json.loads(done.stdout)
    assert [call for call in report["calls"] if call["verdict"] != "identical"] == []
    assert len(report["calls"]) == CAPTURED
    outcomes = {call["outcome_now"] for call in report["calls"]}
    assert {"localized", "low_texture", "prior_conflict", "no_usable_references"} <= outcomes
    assert {call["method"] for call in report["calls"]} == {"Localize", "LocalizeRig", "LocalizeSequence"}
    assert report["circumstances"] == report["unreadable"] == []
    assert done.returncode == 0
    assert (tmp_path / "backup").read_bytes() == (captured / "backup").read_bytes()


def only(captured: Path, folder: Path, is_wanted: Callable[[CapturedCall], bool]) -> tuple[Path, CapturedCall]:
    """A copy of the folder with one call in it, which fits, and of the store."""
    shutil.copytree(captured / "calls", folder / "calls")
    shutil.copytree(captured / "data", folder / "data")
    found = None
    for path in calls_of(folder / "calls"):
        call = decode_call(path.read_bytes())
        if found is None and is_wanted(call):
            found = path, call
        else:
            path.unlink()
    assert found is not None
    return found


def is_named(call: CapturedCall) -> bool:
    return [part.choices for part in call.parts] == [()] and len(call.parts[0].references) == len(NAMED)


def replay(folder: Path, *arguments: str) -> tuple[int, dict[str, Any]]:
    """Exit code and report of the command, on the store beside the calls."""
    done = run("replay", folder / "calls", "--data-dir", folder / "data", "--json", *arguments)
    return done.exit_code, json.loads(done.stdout)


@NIGHTLY
def test_an_answer_that_was_another_is_shown(captured: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By fields, distance and outcome, with what is computed by: another version then, another coverage now."""
    path, call = only(captured, tmp_path, is_named)
    then = pb.LocalizeResponse.FromString(call.response)
    then.localization.world_from_camera.translation_m.x += 0.002
    planted = replace(call, response=then.SerializeToString(), circumstances={**call.circumstances, "mapless": "0.0.1"})
    path.write_bytes(encode_call(planted))
    code, report = replay(tmp_path)
    (replayed,) = report["calls"]
    assert (code, replayed["verdict"]) == (1, "changed")
    assert replayed["apart_cm"] == pytest.approx(0.2)
    assert replayed["apart_deg"] < 1e-4
    assert [it["field"] for it in replayed["changes"]] == ["localization.world_from_camera.translation_m.x"]
    text = run("replay", tmp_path / "calls", "--data-dir", tmp_path / "data").output
    assert "mapless: then 0.0.1, now " in text
    assert f"{call.request_id} Localize default/corner: changed, localized" in text
    assert "the poses are 0.2000 cm and 0.0000" in text
    assert text.endswith("1 changed\n")
    monkeypatch.setenv("MAPLESS_COVERAGE", "0.000001")
    code, report = replay(tmp_path)
    assert {"field": "coverage", "then": "0.95", "now": "1e-06"} in report["circumstances"]
    (replayed,) = report["calls"]
    assert (code, replayed["outcome_then"], replayed["outcome_now"]) == (1, "localized", "gate")


def test_references_that_have_changed_since_are_named(tmp_path: Path) -> None:
    """Others of the scene may change; and a scene that was deleted, or is in another store, is named, too."""
    scene_key = key_of("acme", "hall")
    with Store.open(tmp_path) as store:
        store.create_scene(scene_key)
        added = store.add_references(scene_key, [make_reference(f"r{i}") for i in range(4)])
        keys = {it.reference_id: it.key for it in added[:3]}
        parts = CapturedPart("a", 1, {"r0": keys["r0"]}), CapturedPart("b", 1, {it: keys[it] for it in ("r1", "r2")})
        call = replace(a_call(), parts=parts)
        references = StoredReferences(store, uses_depths=False)
        store.delete_reference(scene_key, "r3")
        references.check(call)
        store.delete_reference(scene_key, "r0")
        store.delete_reference(scene_key, "r2")
        store.add_references(scene_key, [make_reference("r0")])
        changed = "references of scene 'hall' have changed since: 'r0' was replaced, 'r2' was deleted"
        with pytest.raises(CaptureError, match=changed):
            references.check(call)
        store.delete_scene(scene_key)
        with pytest.raises(CaptureError, match="scene 'hall' was deleted since, or is in another store"):
            references.check(call)
        references.check(replace(call, parts=()))


@NIGHTLY
def test_features_that_the_store_lacks_are_found_anew(captured: Path, tmp_path: Path) -> None:
    """And kept in memory alone; so are those of another version, which are alike, and then the answer is."""
    only(captured, tmp_path, is_named)
    path = tmp_path / "data" / DATABASE_FILE
    with closing(sqlite3.connect(path)) as connection, connection:
        assert connection.execute("DELETE FROM features").rowcount
    before = path.read_bytes()
    code, report = replay(tmp_path)
    assert (code, report["calls"][0]["verdict"]) == (0, "identical")
    assert path.read_bytes() == before


@NIGHTLY
def test_a_reference_that_is_damaged_since_is_named(captured: Path, tmp_path: Path) -> None:
    _, call = only(captured, tmp_path, lambda it: it.method == "Localize" and bool(it.parts[0].choices))
    reference_id, key = next(iter(call.parts[0].references.items()))
    with closing(sqlite3.connect(tmp_path / "data" / DATABASE_FILE)) as connection, connection:
        assert connection.execute("UPDATE features SET data = x'00' WHERE reference_key = ?", [key]).rowcount
    (damaged,) = replay(tmp_path)[1]["calls"][0]["damaged"]
    assert damaged.startswith(f"reference '{reference_id}' is damaged in the store (features")
    text = run("replay", tmp_path / "calls", "--data-dir", tmp_path / "data").output
    assert f"    left out: {damaged}" in text


@NIGHTLY
def test_a_call_that_cannot_be_computed_is_one_row(captured: Path, tmp_path: Path) -> None:
    """A method of another version, a request that is no message, and a damaged file; a fourth one is as it was."""
    path, call = only(captured, tmp_path, is_named)
    for name, planted in {
        "1-1": replace(call, method="LocalizeTwice", request_id="unknown"),
        "1-2": replace(call, request=b"\xff\xff", request_id="garbage"),
    }.items():
        path.with_name(f"{name}.call").write_bytes(encode_call(planted))
    path.with_name("1-3.call").write_bytes(encode_call(call)[:-1])
    code, report = replay(tmp_path)
    verdicts = {it["request_id"]: (it["verdict"], it["error"]) for it in report["calls"]}
    assert code == 1
    assert verdicts["unknown"] == ("not computed", "error: this program knows no method LocalizeTwice")
    assert verdicts["garbage"][0] == "not computed"
    assert verdicts["garbage"][1].startswith("error: DecodeError: ")
    assert verdicts[call.request_id] == ("identical", "")
    assert report["unreadable"] == ["tenants/default/calls/corner/1-3.call: it is cut or damaged, or no captured call"]


def test_only_what_was_asked_for_is_judged(tmp_path: Path) -> None:
    """Another tenant's unreadable file is not reported; an id that does not exist is."""
    folder = opened(tmp_path)
    for number in range(3):
        folder.add(a_call(number, NOW_S + number))
    folder.close()
    first, second, third = calls_of(tmp_path)
    theirs = tmp_path / "tenants" / "other" / "calls" / "z" / "00000000000001-1.call"
    theirs.parent.mkdir(parents=True)
    theirs.write_bytes(b"junk")

    def selected(**options: Any) -> tuple[list[Path], int]:
        unreadable: list[str] = []
        return select(tmp_path, Selection(**options), unreadable), len(unreadable)

    assert selected() == ([first, second, third], 1)
    assert selected(tenant="acme") == selected(scene_id="hall") == ([first, second, third], 0)
    assert selected(last=2) == ([second, third], 0)
    assert selected(request_ids=frozenset({"id-0", "id-2"})) == ([first, third], 0)
    assert selected(request_ids=frozenset({"id-0", "id-2"}), last=1) == ([third], 0)
    assert selected(tenant="other") == ([], 1)
    with pytest.raises(CaptureError, match="holds no call of id absent; 1 files cannot be read"):
        selected(request_ids=frozenset({"absent", "id-1"}))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--id", "nobody"], "holds no call of id nobody"),
        (["--tenant", "nobody"], "holds no such calls"),
        (["--data-dir", "absent"], "there is no database absent/mapless.sqlite3; name the store that answered"),
        (["--backup", "absent"], "there is no database absent; name the store that answered"),
        (["--backend", "pi4"], "pi4"),
        (["--last", "0"], "--last"),
    ],
)
def test_a_replay_that_is_not_possible_is_refused(tmp_path: Path, arguments: list[str], message: str) -> None:
    filled(tmp_path)
    done = run("replay", tmp_path, *arguments)
    assert done.exit_code == 2
    assert message in " ".join(done.stderr.split())


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
