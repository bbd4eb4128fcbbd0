"""`mapless-server evaluate` as a user runs it, on a rendered wall."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from support.commands import refusal, run
from support.layouts import write_cameras
from support.wall import wall

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


@pytest.mark.nightly
def test_chosen_references(folder: Path, tmp_path: Path) -> None:
    done = run("evaluate", folder, "--references", 4, "--queries", 3, "--k", 3, "--json", tmp_path / "figures.json")
    assert done.exit_code == 0, done.output
    figures = json.loads((tmp_path / "figures.json").read_text())
    references = {"0", "3", "5", "8"}
    assert figures["references"] == 4
    for query in figures["per_query"]:
        assert query["name"] not in references
        assert len(query["references"]) == 3
        assert set(query["references"]) <= references


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
    (tmp_path / "images").symlink_to(folder / "images")
    content["frames"][4]["width"] = 640
    (tmp_path / "cameras.json").write_text(json.dumps(content))
    assert "4.png has 480x360 pixels" in refusal("evaluate", tmp_path)


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


def test_bench_without_scenes_is_one_line(tmp_path: Path) -> None:
    assert "holds none of the scenes" in refusal("bench", tmp_path)
