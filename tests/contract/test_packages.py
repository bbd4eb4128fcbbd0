"""The package as others install it: built, put into empty environments, with each of its extras."""

import json
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from support.programs import Program
from support.users import registry_environment
from support.waiting import LIMIT_S

ROOT = Path(__file__).parents[2]
SOURCES = ("client", "server", "deploy/ray/mapless_ray", "pyproject.toml", "setup.py", "README.md", "LICENSE")
BUILD_LIMIT_S = 170.0
UV = (sys.executable, ROOT / ".ci" / "uv.py")
"""uv, with the package sources of pip."""

pytestmark = [pytest.mark.nightly, pytest.mark.timeout(600)]


def environment() -> dict[str, str]:
    """The variables of this process without this checkout's paths and settings."""
    return {name: it for name, it in registry_environment().items() if not name.startswith(("MAPLESS_", "PYTHON"))}


def run(*command: str | Path, code: int = 0) -> str:
    """A command's output, both streams."""
    done = subprocess.run(
        list(map(str, command)), capture_output=True, text=True, env=environment(), timeout=BUILD_LIMIT_S, cwd="/"
    )
    assert done.returncode == code, f"{done.stdout}\n{done.stderr}"
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of what is built, since building writes beside it."""
    folder = tmp_path_factory.mktemp("source")
    for name in SOURCES:
        copy = folder / name
        copy.parent.mkdir(parents=True, exist_ok=True)
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, copy, ignore=shutil.ignore_patterns("__pycache__", "node_modules"))
        else:
            shutil.copy(ROOT / name, copy)
    return folder


@pytest.fixture(scope="module")
def wheel(source: Path) -> Path:
    """The wheel, built from the sdist."""
    run(sys.executable, "-m", "build", source)
    (found,) = (source / "dist").glob("*.whl")
    return found


@pytest.fixture(scope="module")
def install(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Makes an environment with the wheel and some of its extras; gives the folder of its programs."""

    def install(extras: str) -> Path:
        folder = tmp_path_factory.mktemp("environment")
        run(*UV, "venv", "--clear", "--python", sys.executable, folder)
        python = folder / "bin" / "python"
        run(*UV, "pip", "install", "--python", python, f"mapless{extras} @ {wheel.as_uri()}")
        return folder / "bin"

    return install


def test_the_wheel_holds_exactly_the_files_of_the_packages(source: Path, wheel: Path) -> None:
    packaged = set(zipfile.ZipFile(wheel).namelist())
    tops = {name.partition("/")[0] for name in packaged}
    packages = {"mapless", "mapless_command", "mapless_ray", "mapless_server", "mapless_tools"}
    assert {top for top in tops if not top.endswith(".dist-info")} == packages
    for place in ("client", "server", "deploy/ray"):
        for package in (source / place).glob("mapless*"):
            files = {it.relative_to(source / place).as_posix() for it in package.rglob("*") if it.is_file()}
            assert files <= packaged, package.name


def command(programs: Path, extra: str, wheel: Path) -> str:
    """The command that installs an extra into an environment of uv's, which has no pip."""
    return f"uv pip install --python {programs / 'python'} 'mapless[{extra}] @ {wheel.as_uri()}'"


def test_the_client_alone_needs_neither_server_nor_torch(install: Callable[[str], Path], wheel: Path) -> None:
    programs = install("")
    run(programs / "mapless", "--help")
    installed = json.loads(run(*UV, "pip", "list", "-q", "--format=json", "-p", programs.parent))
    needed = {"googleapis-common-protos", "grpcio", "mapless", "numpy", "protobuf", "typing-extensions"}
    assert {it["name"] for it in installed} == needed
    message = run(programs / "mapless-server", "serve", code=1)
    expected = "the Python package typer is not installed"
    assert message == f"mapless-server: {expected}: {command(programs, 'server', wheel)}\n"


def test_a_server_without_tools_names_their_extra(install: Callable[[str], Path], wheel: Path, tmp_path: Path) -> None:
    programs = install("[server]")
    server = programs / "mapless-server"
    for arguments in (["--help"], ["serve", "--help"], ["store", "--help"], ["token", "--help"], ["weights", "list"]):
        run(server, *arguments)
    message = run(server, "evaluate", "folder", code=2)
    expected = f"evaluate needs the Python package jinja2: {command(programs, 'tools', wheel)}"
    assert message == f"mapless-server: {expected}\n"
    flags = ["--port", "0", "--no-metrics", "--data-dir", str(tmp_path / "data")]
    with (tmp_path / "log").open("w") as log:
        process = subprocess.Popen(
            [server, "serve", *flags], stdout=subprocess.PIPE, stderr=log, text=True, env=environment()
        )
    try:
        address = Program(process, tmp_path).address
        assert json.loads(run(programs / "mapless", "--address", address, "health"))["server"] == "SERVING"
    finally:
        process.kill()
        process.communicate(timeout=LIMIT_S)


def test_tools_run_with_their_extra(install: Callable[[str], Path], wheel: Path, tmp_path: Path) -> None:
    programs = install("[server,tools]")
    server = programs / "mapless-server"
    for name in ("import", "export", "audit", "evaluate", "replay", "demo"):
        run(server, name, "--help")
    assert "is not a folder" in run(server, "import", tmp_path / "absent", "scene", code=2)
    message = run(server, "view", "scene", code=2)
    expected = f"view needs the Python package viser: {command(programs, 'view', wheel)}"
    assert message == f"mapless-server: {expected}\n"
