"""Output and files of the audit command, for findings that need no server."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime, timezone
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

from mapless import DataLoss, ReferenceAudit, RigidTransform, Scene, Unavailable
from mapless_tools.cli.app import app
from mapless_tools.cli.audit import Examined, cells_of, summary_of, table_of, to_html, to_json, worst_first


def finding(name: str, verdict: str, offset_m: float = 0.0, focal_ratio: float = 1.0) -> ReferenceAudit:
    return ReferenceAudit(
        f"scenes/hall/references/{name}", verdict, f"<{name}>", 8, 200, 150, 0.7, offset_m, 0.25, focal_ratio, ""
    )


FINDINGS = [
    finding("fine", "CONSISTENT"),
    finding("near", "WRONG_POSE", 0.05),
    finding("dark", "UNVERIFIABLE", focal_ratio=0.0),
    finding("far", "WRONG_POSE", 0.5),
    finding("swapped", "SWAPPED_IMAGE"),
    finding("either", "DOUBTFUL_DEPTH"),
]


def test_the_worst_comes_first() -> None:
    names = [a.name.rsplit("/", 1)[-1] for a in worst_first(FINDINGS)]
    assert names == ["swapped", "far", "near", "either", "dark", "fine"]


def test_the_summary_counts_every_finding() -> None:
    expected = "6 references: 1 swapped image, 2 wrong pose, 1 doubtful depth, 1 unverifiable, 1 consistent"
    assert summary_of(Examined("hall", worst_first(FINDINGS), 6)) == expected
    assert summary_of(Examined("hall", total=0)) == "0 references: none"


@pytest.mark.parametrize(
    ("failure", "code", "why"),
    [
        (Unavailable("UNAVAILABLE", "the server is gone"), 1, "gone"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (SystemExit(143), 143, "terminated"),
    ],
    ids=["error", "ctrl-c", "sigterm"],
)
def test_findings_before_the_interruption_are_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failure: BaseException, code: int, why: str
) -> None:
    asked: list[float | None] = []

    class Ending:
        def get_scene(self, scene: str) -> Any:
            return Scene(scene, 7, 40, datetime.now(timezone.utc), down_in_world=(0.0, -1.0, 0.0))

        def list_references(self, scene: str, *, page_size: int) -> Iterator[Any]:
            upright = RigidTransform(np.eye(3), np.zeros(3))
            yield from [SimpleNamespace(world_from_camera=upright)] * 3
            raise DataLoss("DATA_LOSS", "the fourth is damaged")

        def audit_scene(self, scene: str, *, page_size: int, timeout_s: float | None) -> Iterator[ReferenceAudit]:
            asked.append(timeout_s)
            yield from FINDINGS
            raise failure

    @contextmanager
    def connected(*_: Any) -> Iterator[Ending]:
        yield Ending()

    monkeypatch.setattr("mapless_tools.connection.connected", connected)
    report, html = tmp_path / "report.json", tmp_path / "report.html"
    arguments = ["audit", "hall", "--address", "127.0.0.1:1", "--report", str(report), "--html", str(html)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == code
    content = json.loads(report.read_text())
    assert [r["verdict"] for r in content["references"]] == [a.verdict for a in worst_first(FINDINGS)]
    assert why in content["stopped"]
    assert "180 degrees off the down of 3 reference cameras" in content["warnings"][0]
    assert content["warnings"][0] in html.read_text()
    assert f"stopped after {len(FINDINGS)} of 40 references" in result.output.replace("\n", "")
    assert "stopped after" in html.read_text()
    assert asked == [35.0]


def test_figures_that_are_not_known_are_dashes_not_zeros() -> None:
    assert cells_of(finding("dark", "UNVERIFIABLE", focal_ratio=0.0))[2:5] == ("-", "-", "-")
    assert cells_of(replace(finding("away", "WRONG_POSE"), reprojection_error_px=0.0))[6] == "-"


def test_a_wrong_focal_length_is_printed_with_its_factor() -> None:
    assert cells_of(finding("long", "WRONG_INTRINSICS", focal_ratio=1 / 1.05))[4] == "+5.0"


def test_reports_hold_every_reference_and_escape_names() -> None:
    content = json.loads(json.dumps(to_json(Examined("hall", FINDINGS, 6)), allow_nan=False))
    assert [r["verdict"] for r in content["references"]] == [a.verdict for a in FINDINGS]
    page = to_html(Examined("hall", FINDINGS, 6))
    assert page.count('<tr class="') == 6
    assert page.count('<tr class="alarm">') == 3
    assert "&lt;far&gt;" in page
    assert "<far>" not in page
    console = Console(width=80, record=True, file=StringIO())  # as wide as a terminal
    console.print(table_of(FINDINGS))
    text = console.export_text()
    assert all(a.name.rpartition("/")[2] in text for a in FINDINGS)
