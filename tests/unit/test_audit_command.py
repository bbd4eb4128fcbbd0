"""What the audit command prints and writes, of findings that need no server."""

from __future__ import annotations

import json
from io import StringIO

from rich.console import Console

from mapless import ReferenceAudit
from mapless_server.audit.command import Examined, cells_of, summary_of, table_of, to_html, to_json, worst_first


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
]


def test_the_worst_comes_first() -> None:
    names = [a.name.rsplit("/", 1)[-1] for a in worst_first(FINDINGS)]
    assert names == ["swapped", "far", "near", "dark", "fine"]


def test_the_summary_counts_every_finding() -> None:
    expected = "5 references: 1 swapped image, 2 wrong pose, 1 unverifiable, 1 consistent"
    assert summary_of(Examined("hall", worst_first(FINDINGS), 5)) == expected
    assert summary_of(Examined("hall", total=0)) == "0 references: none"


def test_figures_that_are_not_known_are_dashes_not_zeros() -> None:
    assert cells_of(finding("dark", "UNVERIFIABLE", focal_ratio=0.0))[2:5] == ("-", "-", "-")


def test_the_given_focal_length_is_told_by_how_much_it_is_wrong() -> None:
    assert cells_of(finding("long", "WRONG_INTRINSICS", focal_ratio=1 / 1.05))[4] == "+5.0"


def test_the_table_has_a_row_for_each_reference() -> None:
    console = Console(width=200, record=True, file=StringIO())
    console.print(table_of(FINDINGS))
    text = console.export_text()
    assert all(a.message in text for a in FINDINGS)


def test_the_reports_hold_every_reference_and_names_cannot_break_the_page() -> None:
    content = json.loads(json.dumps(to_json(Examined("hall", FINDINGS, 5)), allow_nan=False))
    assert [r["verdict"] for r in content["references"]] == [a.verdict for a in FINDINGS]
    page = to_html(Examined("hall", FINDINGS, 5))
    assert page.count('<tr class="') == 5
    assert page.count('<tr class="alarm">') == 3
    assert "&lt;far&gt;" in page
    assert "<far>" not in page
