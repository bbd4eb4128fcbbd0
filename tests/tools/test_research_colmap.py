"""COLMAP beside mapless: on the rendered room, whose poses are exact, and the table of both."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

from mapless_tools.ingest.formats.cameras import read_folder

pytest.importorskip("pycolmap")

from research.colmap import Case, SceneDatabase, measure, table

ROOM = Path(__file__).parents[2] / "server/mapless_tools/demo/room"


@pytest.mark.nightly
def test_colmap_places_a_rendered_photograph(tmp_path: Path) -> None:
    room = read_folder(ROOM)
    few = replace(room, frames=room.frames[5:9])
    content = measure(few, Case(ROOM.name, None), SceneDatabase(ROOM, tmp_path))
    assert content["localized"] == content["queries"] == 4
    assert content["median_translation_m"] < 0.003
    assert content["median_rotation_deg"] < 0.03


def result(**errors_m: float) -> str:
    """A result file of these queries, lost where infinite."""
    queries = [
        {"name": name, "localized": math.isfinite(it), "translation_m": it, "rotation_deg": 0.1}
        | {"reference_distance_m": 1.0}
        for name, it in errors_m.items()
    ]
    return json.dumps(
        {"metric": True, "queries": len(queries), "median_translation_m": None, "median_rotation_deg": 0.1}
        | {"latency_ms": {"p50": 200.0}, "per_query": queries}
    )


def test_the_table_counts_lost_and_wrong(tmp_path: Path) -> None:
    case = Case("room", 5)
    (tmp_path / "mapless").mkdir()
    (tmp_path / case.file_name).write_text(result(a=0.01, b=math.inf, c=0.3))
    (tmp_path / "mapless" / case.file_name).write_text(result(a=0.01, b=0.02, c=0.03))
    *_, row = table([case], tmp_path, tmp_path / "mapless")
    assert row == "| room | 5 | 3 | 2 | 1 | infinite / 0.100° | 0.20 | 3 | 0 | infinite / 0.100° | 0.20 |"
