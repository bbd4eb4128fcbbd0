"""What the README says is so: its Python runs, and its tables are complete."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from images import encode, textured
from servers import pose, serving

from mapless_server.method.localize import Variant
from mapless_server.method.rejection import RejectionReason
from mapless_server.settings import Settings

README = (Path(__file__).parents[2] / "README.md").read_text()


def first_cells(heading: str) -> list[str]:
    """The names in the first column of the table with this first heading."""
    (table,) = re.findall(rf"^\| {heading} \|.*\n((?:\|.*\n)+)", README, re.MULTILINE)
    return re.findall(r"^\| `(\w+)`", table, re.MULTILINE)


def test_tables_are_complete() -> None:
    assert first_cells("setting") == list(Settings.model_fields)
    assert first_cells("reason") == [reason.name for reason in RejectionReason]
    assert first_cells("variant") == [variant.value for variant in Variant]


def test_the_python_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    (program,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    photo = encode(".jpg", textured(1600, 1067))
    for name in ("a", "b", "query"):
        (tmp_path / f"{name}.jpg").write_bytes(photo)
    monkeypatch.chdir(tmp_path)
    with serving(tmp_path / "data") as server:
        poses = {"a": pose(0.0).matrix(), "b": pose(1.0).matrix()}
        exec(program.replace("localhost:50051", server.address), {"poses": poses})
    assert capsys.readouterr().out.startswith("[ 0.  2. -1.] 0.2")
