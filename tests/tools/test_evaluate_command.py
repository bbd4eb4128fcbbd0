"""`mapless-server evaluate` as a user runs it, on a rendered wall."""

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import typer
from support.commands import refusal, run
from support.layouts import write_cambridge, write_cameras, write_seven_scenes, write_twelve_scenes
from support.wall import wall

from bench.__main__ import main as bench
from mapless.geometry import Camera

CAMERA = Camera(480, 360, 420.0, 420.0, 239.5, 179.5)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Nine photographs, 0.35 m apart."""
    return write_cameras(tmp_path_factory.mktemp("wall") / "photographs", wall(CAMERA), CAMERA)


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "mapless_tools", *map(str, arguments)]


def test_leaves_one_out(folder: Path, tmp_path: Path) -> None:
    done = run("evaluate", folder, "--queries", 3, "--json", tmp_path / "figures.json")
    assert done.exit_code == 0, done.output
    assert "3 of 3" in done.stdout
    assert "localizing: 3" in done.stderr
    figures: dict[str, Any] = json.loads((tmp_path / "figures.json").read_text())
    assert (figures["queries"], figures["localized"]) == (3, 3)
    assert figures["median_translation_m"] < 0.02
    assert figures["latency_ms"]["p50"] > 0
    for query in figures["per_query"]:
        assert query["name"] not in query["references"], "no query is its own reference"
        assert len(query["references"]) == 8
        assert 0 < query["claimed_68_m"] < query["claimed_95_m"]
        assert 0 < query["trust"] <= 1
        assert query["processor_ms"] > 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--references", 1), "at least 2"),
        (("--references", 10), "the folder has 9 frames"),
        (("--k", 0), "k, the references of a query"),
        (("--variant", "bset"), "variant must be one of"),
        (("--json", "/nowhere/figures.json"), "cannot be written"),
    ],
)
def test_wrong_arguments_are_one_line(folder: Path, arguments: tuple[object, ...], words: str) -> None:
    assert words in refusal("evaluate", folder, *arguments)


def test_wrong_folders_are_one_line(folder: Path, tmp_path: Path) -> None:
    assert "nowhere" in refusal("evaluate", tmp_path / "nowhere")
    assert "cameras.json" in refusal("evaluate", tmp_path)
    content = json.loads((folder / "cameras.json").read_text())
    (tmp_path / "cameras.json").write_text(json.dumps(content))
    assert "there is no file" in refusal("evaluate", tmp_path)
    shutil.copytree(folder / "images", tmp_path / "images")
    content["frames"][4]["width"] = 640
    (tmp_path / "cameras.json").write_text(json.dumps(content))
    assert "4.png has 480x360 pixels" in refusal("evaluate", tmp_path)
    (tmp_path / "images" / "0.png").write_text("no image")
    assert "0.png: " in refusal("evaluate", tmp_path)


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="finds the server through /proc")
@pytest.mark.nightly
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_it_takes_its_server_along(folder: Path, number: signal.Signals) -> None:
    process = subprocess.Popen(
        command("evaluate", folder), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    assert process.stderr is not None
    try:
        assert any(line.startswith("storing") for line in process.stderr)
        children = children_of(process.pid)
        assert len(children) == 1
        process.send_signal(number)
        assert process.wait(60) != 0
    finally:
        process.kill()
        process.wait()
        process.stderr.close()
    deadline_s = time.monotonic() + 10
    while time.monotonic() < deadline_s and any(os.path.exists(f"/proc/{child}") for child in children):
        time.sleep(0.05)
    assert not any(os.path.exists(f"/proc/{child}") for child in children)


def children_of(process_id: int) -> list[int]:
    tasks = Path(f"/proc/{process_id}/task").iterdir()
    return [int(child) for task in tasks for child in (task / "children").read_text().split()]


def test_bench_without_scenes_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(typer.Exit) as ended:
        bench(tmp_path)
    assert ended.value.exit_code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "holds none of the scenes" in line


KINECT = Camera(640, 480, 525.0, 525.0, 320.0, 240.0)
"""The intrinsics that the reader of 7-Scenes assumes, since the layout has none."""
CENTRED = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)


@pytest.fixture(scope="module")
def chess(tmp_path_factory: pytest.TempPathFactory) -> Path:
    shots = wall(KINECT)
    return write_seven_scenes(tmp_path_factory.mktemp("7scenes") / "chess", shots[::2], shots[1::2])


@pytest.fixture(autouse=True)
def _same_code(monkeypatch: pytest.MonkeyPatch) -> None:
    """Code that is edited while its tests run would be measured anew."""
    monkeypatch.setattr("mapless_tools.evaluate.suite.commit_of", lambda _: "abc1234")


@pytest.mark.nightly
def test_a_failed_scene_stops_no_other_and_is_measured_later(chess: Path, tmp_path: Path) -> None:
    """A photograph is torn behind its header, so that only the server finds out."""
    output = tmp_path / "out"
    for name in ("chess", "fire"):
        shutil.copytree(chess, tmp_path / "data" / name)
    torn = tmp_path / "data" / "fire" / "seq-01" / "frame-000002.color.png"
    whole = torn.read_bytes()
    torn.write_bytes(whole[: len(whole) // 2])
    arguments = (tmp_path / "data", "--protocol", "sparse", "--sparse", 3, "--max-queries", 1, "--worst", 1)

    done = run("evaluate", *arguments, "--output", output)
    assert done.exit_code == 1, done.output
    assert "fire is not complete" in done.stdout
    content = json.loads((output / "evaluation.json").read_text())
    assert [failure["scene"] for failure in content["failures"]] == ["fire"]
    assert [(run["scene"], run["localized"]) for run in content["runs"]] == [("chess", 1)]
    (journal,) = (output / "runs").iterdir()
    written_ns = journal.stat().st_mtime_ns

    torn.write_bytes(whole)
    done = run("evaluate", *arguments, "--output", output)
    assert done.exit_code == 0, done.output
    assert "chess, N=3: storing" not in done.stderr
    assert "fire, N=3: storing" in done.stderr
    assert journal.stat().st_mtime_ns == written_ns
    content = json.loads((output / "evaluation.json").read_text())
    assert content["failures"] == []
    assert [run["scene"] for run in content["runs"]] == ["chess", "fire"]
    assert content["runs"][0]["median_translation_cm"] == pytest.approx(content["runs"][1]["median_translation_cm"])
    assert (output / "report.html").read_text().count("data:image/jpeg") == 2


@pytest.mark.nightly
def test_measures_every_layout(chess: Path, tmp_path: Path) -> None:
    folder, output = tmp_path / "data", tmp_path / "out"
    shutil.copytree(chess, folder / "chess")
    shots = wall(CENTRED)
    write_twelve_scenes(folder / "apt1" / "kitchen", CENTRED, shots[:3], shots[3:])
    write_cambridge(folder / "ShopFacade", shots[::2], shots[1::2], [500.0] * len(shots))
    done = run("evaluate", folder, "--sparse", "3", "--max-queries", 2, "--worst", 1, "--output", output)
    assert done.exit_code == 0, done.output
    content = json.loads((output / "evaluation.json").read_text())
    counts = {"apt1/kitchen": 6, "chess": 5, "ShopFacade": 5}
    assert [(it["scene"], it["setting"], it["references"]) for it in content["runs"]] == [
        (scene, *setting) for scene, count in counts.items() for setting in (("dense", count), ("N=3", 3))
    ]
    for figures in content["runs"]:
        assert figures["localized"] == figures["queries"] == 2
        assert figures["median_translation_cm"] < 3, figures["scene"]
    assert {scene["scene"]: scene["ground_truth"] for scene in content["scenes"]} == {
        "apt1/kitchen": "VoxelHashing (original)",
        "chess": "KinectFusion (original)",
        "ShopFacade": "SfM (VisualSFM, original)",
    }
    page = (output / "report.html").read_text()
    assert page.count("data:image/jpeg") == 3 * 2
    assert "chess: 2 of 4 queries, evenly spread" in page
    assert "Cambridge Landmarks. Dense: median error, cm/°" in " ".join(done.stdout.split())


@pytest.mark.nightly
def test_takes_the_references_of_a_pairs_file(chess: Path, tmp_path: Path) -> None:
    pairs = tmp_path / "pairs.txt"
    wanted = ["seq-01/frame-000002.color.png", "seq-01/frame-000000.color.png", "seq-01/frame-000001.color.png"]
    queries = [f"seq-02/frame-{i:06d}.color.png" for i in range(4)]
    pairs.write_text("".join(f"{query} {reference}\n" for query in queries for reference in wanted))
    flags = ("--protocol", "dense", "--pairs", pairs, "--max-queries", 1, "--worst", 0)
    done = run("evaluate", chess, *flags, "--output", tmp_path / "out")
    assert done.exit_code == 0, done.output
    with (tmp_path / "out" / "queries.csv").open(newline="") as stream:
        (query,) = csv.DictReader(stream)
    assert query["references"].split() == [f"seq-01_frame-{i:06d}" for i in (2, 0, 1)]
    assert "chosen by: the pairs of" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--layout", "cambridge"), "has the layout 7scenes"),
        (("--layout", "8scenes"), "layout must be one of"),
        (("--protocol", "thick"), "protocol must be one of dense, sparse"),
        (("--sparse", "5,many"), "whole numbers"),
        (("--sparse", "-5"), "at least 2 references"),
        (("--sparse", "50"), "5 training frames, 50 references are wanted"),
        (("--variants", "best,bset"), "'bset'"),
        (("--max-queries", "-1"), "max-queries must be at least 1"),
        (("--stride", "0"), "stride"),
        (("--worst", "-1"), "worst must be 0 or more"),
        (("--choose", "luck"), "'luck'"),
        (("--pairs", "/nowhere/pairs.txt"), "no file /nowhere/pairs.txt"),
        (("--output", "/proc/nowhere"), "/proc/nowhere cannot be written"),
        (("--references", "10"), "--references: only for a folder with cameras.json"),
    ],
)
def test_wrong_benchmarks_are_one_line(chess: Path, tmp_path: Path, arguments: tuple[str, ...], words: str) -> None:
    defaults = {"--sparse": "3", "--output": str(tmp_path)}
    given = dict(zip(arguments[::2], arguments[1::2], strict=True))
    assert words in refusal("evaluate", chess, *(part for flag in (defaults | given).items() for part in flag))


def test_a_broken_scene_is_refused_before_anything_is_measured(chess: Path, tmp_path: Path) -> None:
    broken = tmp_path / "data" / "fire"
    shutil.copytree(chess, broken)
    shutil.copytree(chess, tmp_path / "data" / "chess")
    arguments = (tmp_path / "data", "--sparse", "3", "--output", tmp_path / "out")
    (broken / "TestSplit.txt").unlink()
    assert "fire has no frame of the test split" in refusal("evaluate", *arguments)
    (broken / "TestSplit.txt").write_text("sequence3\n")
    assert "seq-03" in refusal("evaluate", *arguments)
    (broken / "TestSplit.txt").write_text("sequence2\n")
    (broken / "seq-02" / "frame-000001.color.png").write_bytes(b"")
    assert "fire: 1 of 9 frames cannot be used, the first, seq-02/frame-000001" in refusal("evaluate", *arguments)
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("seq-02/frame-000000.color.png seq-01/frame-000099.color.png\n")
    assert "has no image 'seq-01/frame-000099.color.png'" in refusal(
        "evaluate", chess, *arguments[1:], "--pairs", pairs
    )
    assert not any((tmp_path / "out" / "runs").iterdir())
