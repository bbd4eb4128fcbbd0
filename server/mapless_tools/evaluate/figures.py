"""The figures for programs: evaluation.json, evaluation.csv (a line for each run), queries.csv (one for each query)."""

import csv
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from mapless_tools.output_files import finite, whole_file, write_json

from .benchmarks import Benchmark
from .metrics import RECALL_BARS, summarize
from .plan import setting_name
from .rungs import RIGHT_DEG, RIGHT_M, rungs_of, wrong_count
from .suite import Run, Suite
from .tables import Group, groups_of

JSON_FILE, RUNS_FILE, QUERIES_FILE = "evaluation.json", "evaluation.csv", "queries.csv"
RULES = (
    f"A localized query is wrong that is off by more than {RIGHT_M:g} m or {RIGHT_DEG:g} degrees.",
    "Medians and recall are over all queries of a scene; one that was rejected counts as infinitely wrong.",
    "Averages are means of the scenes' medians; infinite (failed, null) if one of them is.",
    "Translation errors are distances of camera centres; rotation errors the angle between orientations.",
    "Times are of one Localize call as the client sees it, one after the other, retrieval included; the first call is "
    "not in p50 and p95.",
)


def write_figures(suite: Suite, folder: Path) -> None:
    """Writes the three files, each completely or not at all."""
    groups = groups_of(suite)
    with whole_file(folder / JSON_FILE) as partial:
        write_json(partial, as_json(suite, groups))
    _write_csv(folder / RUNS_FILE, [run_figures(run) for run in suite.runs])
    _write_csv(folder / QUERIES_FILE, [_query(run, i) for run in suite.runs for i in range(len(run.results))])


def as_json(suite: Suite, groups: Sequence[Group]) -> dict[str, Any]:
    """Everything except single queries, whose files are named; infinite values are null."""
    return {
        "provenance": asdict(suite.provenance),
        "options": asdict(suite.options) | {"pairs": None if suite.pairs is None else str(suite.pairs)},
        "scenes": [
            {
                "scene": scene.place.name,
                "layout": scene.place.layout,
                "ground_truth": scene.dataset.ground_truth,
                "source": scene.dataset.source,
                "frames_refused": {refusal.frame: refusal.reason for refusal in scene.dataset.refused},
                "notes": list(scene.dataset.notes),
            }
            for scene in suite.scenes
        ],
        "runs": [
            {
                **run_figures(run),
                "rungs": [asdict(it) for it in rungs_of(run.results, RIGHT_M)],
                "queries_file": f"{run.journal.path.parent.name}/{run.journal.path.name}",
            }
            for run in suite.runs
        ],
        "averages": [average for group in groups for average in _averages(group)],
        "paper": {group.layout: _paper(group.benchmark) for group in groups if group.benchmark},
        "failures": [asdict(failure) for failure in suite.failures],
        "rules": list(RULES),
    }


def run_figures(run: Run) -> dict[str, Any]:
    """One run's figures: the columns of evaluation.csv."""
    summary = summarize(run.results)
    return {
        "layout": run.scene.place.layout,
        "scene": run.scene.place.name,
        "setting": setting_name(run.split.setting),
        "variant": run.method.variant,
        "scale": run.method.scale,
        "ground_truth": run.scene.dataset.ground_truth,
        "references": len(run.split.references),
        "queries": summary.query_count,
        "queries_of_benchmark": run.split.test_count,
        "localized": summary.localized_count,
        "wrong": wrong_count(run.results, RIGHT_M),
        "median_translation_cm": finite(100 * summary.median_translation),
        "median_rotation_deg": finite(summary.median_rotation_deg),
        "p90_translation_cm": finite(100 * summary.p90_translation),
        **{f"recall_{name}": share for name, share in summary.recall.items()},
        "claimed_68_held": summary.claim_held,
        "claimed_95_held": summary.claim_95_held,
        "latency_p50_ms": summary.latency_p50_ms,
        "latency_p95_ms": summary.latency_p95_ms,
        "latency_first_ms": summary.latency_first_ms,
        "processor_ms": summary.processor_ms,
        "backend": run.results[0].backend,
        "features": " ".join(summary.features),
    }


def _averages(group: Group) -> Iterable[dict[str, Any]]:
    for setting in group.settings:
        for method in group.methods:
            average = group.average(setting, method)
            if average is not None:
                yield {
                    "layout": group.layout,
                    "setting": setting_name(setting),
                    **asdict(method),
                    "scenes": list(average.scenes),
                    "all_of_the_papers_scenes": average.complete if group.benchmark else None,
                    "median_translation_cm": finite(100 * average.median_translation),
                    "median_rotation_deg": finite(average.median_rotation_deg),
                    **{f"recall_{name}": average.recall[name] for name in RECALL_BARS},
                    "localized": average.localized_count,
                    "queries": average.query_count,
                }


def _paper(tables: Benchmark) -> dict[str, Any]:
    return {
        "tables": [tables.dense_table, tables.sparse_table],
        "unit": "cm, degrees",
        "methods": [
            {
                "name": method.name,
                "kind": method.kind,
                "scenes": dict(method.scenes),
                "average": {setting_name(setting): median for setting, median in method.average.items()},
                "recall_percent": dict(method.recall_percent),
            }
            for method in tables.methods
        ],
    }


def _query(run: Run, index: int) -> dict[str, Any]:
    result = run.results[index]
    pose, claimed = result.pose or (None,) * 7, result.accuracy
    return {
        "scene": run.scene.place.name,
        "setting": setting_name(run.split.setting),
        **asdict(run.method),
        "query": result.name,
        "translation_cm": finite(100 * result.translation_error),
        "rotation_deg": finite(result.rotation_error_deg),
        "claimed_68_cm": 100 * claimed.position_68_m if claimed else None,
        "claimed_95_cm": 100 * claimed.position_95_m if claimed else None,
        "claimed_68_deg": claimed.rotation_68_deg if claimed else None,
        "claimed_95_deg": claimed.rotation_95_deg if claimed else None,
        "trust": result.trust,
        "inliers": result.inlier_count,
        "matches": result.match_count,
        "rejection": result.rejection,
        "latency_ms": round(result.latency_ms, 1),
        "processor_ms": round(result.processor_ms, 1),
        **dict(zip(("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"), pose, strict=True)),
        "references": " ".join(result.references),
    }


def _write_csv(file: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    with whole_file(file) as partial, partial.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]) if rows else ["scene"])
        writer.writeheader()
        writer.writerows(rows)
