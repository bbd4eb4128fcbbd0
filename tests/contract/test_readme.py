"""What the README says is so: its Python runs, its tables are complete, its commands and metrics exist."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer.main
from prometheus_client import generate_latest
from support.images import encode, textured
from support.servers import pose, serving

from mapless import Client, NewReference, RigidTransform
from mapless import errors as client_errors
from mapless.cli.arguments import make_parser
from mapless_server import errors
from mapless_server.method.answer import Variant
from mapless_server.method.rejection import RejectionReason
from mapless_server.observability.metrics import Metrics
from mapless_server.scheduling import Refusal
from mapless_server.settings import Settings
from mapless_tools.cli.app import app

SERVER = Path(errors.__file__).parent
README = (Path(__file__).parents[2] / "README.md").read_text()


def first_cells(heading: str) -> list[str]:
    """The names in the first column of the table with this first heading."""
    (table,) = re.findall(rf"^\| {heading} \|.*\n((?:\|.*\n)+)", README, re.MULTILINE)
    return re.findall(r"^\| `(\w+)`", table, re.MULTILINE)


def test_tables_are_complete() -> None:
    assert first_cells("setting") == list(Settings.model_fields)
    assert first_cells("reason") == [reason.name for reason in RejectionReason]
    assert first_cells("variant") == [variant.value for variant in Variant]


def rows(heading: str) -> list[list[str]]:
    """What stands in backticks in the first two columns of the table with this first heading."""
    (table,) = re.findall(rf"^\| {heading} \|.*\n\|.*\n((?:\|.*\n)+)", README, re.MULTILINE)
    return [re.findall(r"`([\w*]+)`", "|".join(row.split("|")[1:3])) for row in table.splitlines()]


def test_the_table_of_errors_has_exactly_the_reasons() -> None:
    """A class's own reason is its status's name, which stands in the table in any case."""
    sources = "".join(path.read_text() for path in SERVER.parent.rglob("*.py"))
    there = set(re.findall(r'(?:reason=|_Malformed\(".*", )"([A-Z_]+)"', sources))
    there |= {refusal.name for refusal in Refusal}
    assert {"QUEUE_FULL", "IMAGE_UNKNOWN_FORMAT", "TOKEN_EXPIRED", "STORE_FULL"} <= there
    told = {name for row in rows("status") for name in row}
    statuses = set(client_errors._BY_CODE)
    assert statuses <= told
    assert not {reason for reason in there if not any(fnmatch(reason, it) for it in told)}
    assert {it for it in told - statuses if not any(fnmatch(reason, it) for reason in there)} == {"RetryInfo"}


def test_the_metrics_exist() -> None:
    there = generate_latest(Metrics().registry).decode()
    named = {name for row in rows("metric") for name in row if "_" in name}
    assert "mapless_queue_cost_seconds" in named
    for name in named:
        assert re.search(rf"^# TYPE {name} ", there, re.MULTILINE), name


def commands(program: str) -> Iterator[list[str]]:
    """The arguments of every line of the README that runs a program."""
    text = README.replace("\\\n", " ")
    for line in re.findall(rf"^ {{4}}(?:\S+/|[A-Z_]+=\S+ )?{program} (.*)$", text, re.MULTILINE):
        yield shlex.split(re.sub(r"[>|].*", "", line))


def test_the_commands_of_the_client_are_understood() -> None:
    seen = list(commands("mapless"))
    assert len(seen) >= 7
    for arguments in seen:
        make_parser().parse_args(arguments)  # exits where it does not understand


def test_the_commands_of_the_server_are_understood() -> None:
    group = typer.main.get_command(app)
    seen = list(commands("mapless-server"))
    assert len(seen) >= 10
    for arguments in seen:
        command, rest = group, arguments
        context = typer.Context(command)
        while hasattr(command, "resolve_command"):
            _, command, rest = command.resolve_command(context, rest)
            context = typer.Context(command, parent=context)
        command.parse_args(context, rest)  # raises where it does not understand


def test_the_python_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """One after the other, with what the text around them takes as given."""
    first, *others = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    photo = encode(".jpg", textured(1600, 1067))
    for name in ("a", "b", "query", "photo", "left", "right"):
        (tmp_path / f"{name}.jpg").write_bytes(photo)
    monkeypatch.chdir(tmp_path)
    with serving(tmp_path / "data") as server:
        monkeypatch.setenv("MAPLESS_ADDRESS", server.address)
        known: dict[str, Any] = {
            "poses": {"a": pose(0.0).matrix(), "b": pose(1.0).matrix()},
            "xyz": pose(0.0).translation,
            "down_in_camera": np.array([0.0, 1.0, 0.0]),
            "rig_from_left": RigidTransform.identity(),
            "rig_from_right": pose(0.5),
            "tracked": pose(0.0),
            "walk": [("a.jpg", pose(0.0)), ("b.jpg", pose(1.0))],
        }
        exec(first.replace("localhost:50051", server.address), known)
        assert capsys.readouterr().out.startswith("[ 0.  2. -1.] 0.")
        with Client(server.address) as client:
            known["client"] = client
            client.create_scene("kitchen")
            for name, world_from_camera in known["poses"].items():
                pose_of = RigidTransform.from_matrix(world_from_camera)
                client.add_reference("kitchen", NewReference(name, photo, known["camera"], pose_of))
            client.update_scene("hall", down_in_world=(0, 0, -1))
            for program in others:
                exec(program.replace("localhost:50051", server.address), known)
                known["client"] = client
