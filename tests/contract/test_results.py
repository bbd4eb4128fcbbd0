"""The page of results and the README show the committed figures, and new ones replace those of the same thing."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

from bench import results

SCENE: dict[str, Any] = {
    "scene": "hall",
    "metric": True,
    "split": "references_and_queries",
    "references": 5,
    "features": {"edgepoint2-l64": 3, "aliked-n16": 1},
    "queries": 4,
    "localized": 3,
    "wrong": 1,
    "median_translation_m": 0.0034567,
    "median_rotation_deg": 0.12345,
    "relative": {"median_translation_of_reference_distance": 0.001},
}


def test_the_pages_show_the_committed_figures() -> None:
    for page in results.PAGES:
        text = page.read_text(encoding="utf-8")
        assert results.current(text) == text, "run python -m bench.results"
        assert results.current(text.replace("0.19 cm", "0.18 cm")) == text
    shown = set(re.findall(r"<!-- results: (\w+) -->", "".join(page.read_text() for page in results.PAGES)))
    assert shown == set(results.TABLES)


@pytest.mark.parametrize("file", sorted(results.FIGURES.glob("*.json")), ids=lambda it: it.stem)
def test_figures_have_machine_commit_and_date(file: Path) -> None:
    content = json.loads(file.read_text(encoding="utf-8"))
    assert content["machine"]
    assert content["command"]
    for row in content["rows"]:
        assert re.fullmatch("[0-9a-f]{8}", row["commit"])
        assert re.fullmatch(r"2\d{3}-\d\d-\d\d", row["date"])


def test_new_figures_replace_those_of_the_same_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(results, "FIGURES", tmp_path)
    results.write(tmp_path / "accuracy.json", {"command": "`make bench`", "machine": "one", "rows": []})
    other = SCENE | {"metric": False, "split": "leave_one_out", "scene": "fox", "features": "sift-2048"}
    measured = {"quick": False, "scenes": [SCENE], "others": [other], "latency": None}
    for commit in ("00000000", "11111111"):
        rows = results.taken(measured, with_latency=False)["accuracy"]
        results.store("accuracy", [row | {"commit": commit, "date": "2026-11-29"} for row in rows])
    lines = results.table("accuracy").splitlines()
    assert lines[2] == "| hall | 5 |  | 0.35 cm / 0.123° (3 of 4, 1 wrong) | 11111111 |"
    assert lines[3] == "| fox | leave one out | 0.100 % / 0.123° (3 of 4, 1 wrong) |  | 11111111 |"
    assert lines[5] == "Measured by `make bench`; commits 11111111 (2026-11-29); one."


def test_quick_runs_are_not_taken() -> None:
    with pytest.raises(ValueError, match="complete run"):
        results.taken({"quick": True, "scenes": [SCENE], "others": [], "latency": None}, with_latency=False)
    with pytest.raises(ValueError, match="no file of bench"):
        results.taken([], with_latency=False)  # type: ignore[arg-type]


def test_rates_and_latencies_of_calls_are_taken() -> None:
    step = {
        "sent": 5,
        "goodput_per_s": 2.0,
        "refused_per_s": 1.0,
        "answers": {"p50_ms": 10.0, "p95_ms": 20.0, "p99_ms": 30.0},
        "refusals": {"max_ms": None},
        "fates": {"overdue": 1, "answered": 4},
    }
    pipeline = {"unloaded": step, "steps": [step | {"share_of_saturation": 1.5}]}
    alone, loaded = results.taken({"pipeline": pipeline}, with_latency=False)["load"]
    assert (alone["offered"], loaded["offered"], loaded["overdue"]) == ("one at a time", "150 % of saturation", 1)
    latency = {"first_pass_ms": [3.0, 1.0, 2.0], "warm_ms": [1.0], "cold_ms": [9.0], "memory_mib": {"peak_mib": 300.4}}
    measured = {"quick": False, "scenes": [SCENE], "others": [], "latency": latency}
    first, _, _, memory = results.taken(measured, with_latency=True)["latency"]
    assert (first["figure"], first["median"]) == ("`auto`, every photograph for the first time", 2)
    assert (memory["median"], memory["unit"]) == (300, "MiB")
