"""The scenes of the benchmark, the target on each and the accuracy that a map reaches, latency, and the report.

For people it is Markdown, for programs JSON, from which `bench.results` takes the tables of docs/results.md.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mapless import Client
from mapless_server import __version__
from mapless_server.settings import Settings
from mapless_tools.child import CONNECT, Memory, child_server
from mapless_tools.dataset import Dataset
from mapless_tools.evaluate.metrics import QueryResult, Summary, quantile, stage_share, summarize
from mapless_tools.evaluate.plan import EvaluationOptions
from mapless_tools.evaluate.report import (
    RULES,
    SCALE_FREE,
    format_length,
    format_rotation,
    format_share,
    format_stages,
    to_json,
)
from mapless_tools.evaluate.run import (
    SCENE,
    Evaluation,
    Plan,
    await_features,
    localize_queries,
    plan_for,
    store_references,
)
from mapless_tools.output_files import markdown_table
from mapless_tools.progress import Progress

REFERENCE_COUNT = 30


@dataclass(frozen=True)
class Latency:
    """The cost of calls on a filled store, and the memory after them.

    `cold_ms` are those of the first call of each of several fresh servers, with a different photograph each;
    `first_pass` those of every query for the first time on one server, without the cold one; `warm` the same again.
    """

    cold_ms: tuple[float, ...]
    first_pass: tuple[QueryResult, ...]
    warm: tuple[QueryResult, ...]
    memory: Memory | None


def measure_latency(
    dataset: Dataset, settings: Settings, query_count: int | None, cold_count: int, progress: Progress
) -> Latency:
    """Localizes on 30 stored references with K = 10, one call after the other; first calls on `cold_count` servers.

    The measured servers did not store the references themselves, so their memory does not include what storing needs.
    """
    options = EvaluationOptions(reference_count=REFERENCE_COUNT, query_count=query_count)
    plan = plan_for(dataset, options, settings, progress)
    with tempfile.TemporaryDirectory(prefix="mapless-bench-") as folder:
        data_dir = Path(folder)
        with child_server(data_dir) as server, Client(server.address, CONNECT) as client:
            store_references(client, SCENE, plan.references, progress)
            await_features(client, SCENE, progress)
        cold = [_first_call_ms(data_dir, plan, options, i + 1) for i in range(cold_count - 1)]
        with child_server(data_dir) as server, Client(server.address, CONNECT) as client:
            client.is_serving()
            first_pass = localize_queries(client, plan, options, progress)
            warm = localize_queries(client, plan, options, lambda *_: None)
            memory = server.memory()
    return Latency((*cold, first_pass[0].latency_ms), first_pass[1:], warm, memory)


def _first_call_ms(data_dir: Path, plan: Plan, options: EvaluationOptions, query: int) -> float:
    only = replace(plan, queries=(plan.queries[query % len(plan.queries)],))
    with child_server(data_dir) as server, Client(server.address, CONNECT) as client:
        client.is_serving()  # connects, which is no part of a call
        return localize_queries(client, only, options, lambda *_: None)[0].latency_ms


@dataclass(frozen=True)
class Figures:
    """Median errors, and the number of localized queries; None for all."""

    translation_cm: float
    rotation_deg: float
    localized: int | None = None


@dataclass(frozen=True)
class BenchScene:
    """A measurement with its target, and the accuracy of COLMAP 4.2 with a map built from all references beforehand.

    Without a number of references, each photograph is localized from all others.
    """

    folder: str
    references: int | None
    target: Figures
    with_map: Figures


KITCHEN = "7scenes-redkitchen-seq01-first600"
SCENES = (
    BenchScene("fountain-P11", None, Figures(0.24, 0.020), Figures(0.22, 0.011)),
    BenchScene("herz-jesus-P8", None, Figures(0.45, 0.020), Figures(0.50, 0.021)),
    BenchScene(KITCHEN, 30, Figures(0.19, 0.065), Figures(0.18, 0.073)),
    BenchScene(KITCHEN, 10, Figures(0.45, 0.13), Figures(0.43, 0.127)),
    BenchScene(KITCHEN, 5, Figures(1.0, 0.23, 39), Figures(0.87, 0.208, 37)),
    BenchScene("tum-fr3-office", None, Figures(0.50, 0.21), Figures(0.51, 0.235)),
    BenchScene("kitti-drive-a", None, Figures(1.15, 0.035), Figures(1.00, 0.035)),
)
OTHER_FOLDERS = ("fox-portrait", "reichstag-internet", "rendered-room")
"""Without a target: two have an arbitrary unit, one is rendered."""


def met(target: Figures, summary: Summary) -> bool:
    """Whether a scene meets its target."""
    wanted = summary.query_count if target.localized is None else target.localized
    return (
        100 * summary.median_translation <= target.translation_cm
        and summary.median_rotation_deg <= target.rotation_deg
        and summary.localized_count >= wanted
    )


@dataclass(frozen=True, eq=False)
class BenchResult:
    """All that was measured: scenes with a target and without, latency if its scene is there, and absent folders.

    A `quick` one leaves out queries, so that targets do not apply.
    """

    machine: str
    scenes: Sequence[tuple[BenchScene, Evaluation]]
    others: Sequence[Evaluation]
    latency: Latency | None
    absent: Sequence[str]
    quick: bool


def markdown(result: BenchResult) -> list[str]:
    """The lines of the report."""
    lines = [f"mapless {__version__}; {result.machine}.", ""]
    if result.quick:
        lines += ["**Quick run, few queries a scene: not comparable with the targets.**", ""]
    if result.absent:
        lines += [f"Not measured, their folders are absent: {', '.join(result.absent)}.", ""]
    head = "scene | references | localized | median | target | met | COLMAP 4.2, prebuilt map | p50 ms"
    rows = (_row(scene, summarize(evaluation.results), result.quick) for scene, evaluation in result.scenes)
    lines += [*markdown_table(head, rows), ""]
    if result.others:
        head = "scene | localized | median | of the references' radius | of the distance to the references"
        lines += [*markdown_table(head, map(_other_row, result.others)), ""]
    for evaluation in [*(e for _, e in result.scenes), *result.others]:
        rejections = summarize(evaluation.results).rejections
        if rejections:
            counts = ", ".join(f"{count} {reason}" for reason, count in rejections.items())
            chosen = evaluation.options.reference_count
            split = "leave one out" if chosen is None else f"{chosen} references"
            lines += [f"Rejected in {evaluation.dataset.name}, {split}: {counts}.", ""]
    if result.latency is not None:
        lines += _latency_lines(result.latency)
    scale_free = any(not evaluation.dataset.metric for evaluation in result.others)
    return [*lines, *(f"- {rule}" for rule in RULES), *([f"- {SCALE_FREE}"] if scale_free else [])]


def as_json(result: BenchResult) -> dict[str, Any]:
    """The same for programs, with every query."""
    return {
        "version": __version__,
        "machine": result.machine,
        "quick": result.quick,
        "absent": list(result.absent),
        "scenes": [
            {
                "target": vars(scene.target),
                "colmap_with_map": vars(scene.with_map),
                "target_met": None if result.quick else met(scene.target, summarize(evaluation.results)),
                **to_json(evaluation),
            }
            for scene, evaluation in result.scenes
        ],
        "others": [to_json(evaluation) for evaluation in result.others],
        "latency": None if result.latency is None else _latency_json(result.latency),
    }


def _row(scene: BenchScene, summary: Summary, quick: bool) -> list[str]:
    reached = "yes" if met(scene.target, summary) else "no"
    return [
        scene.folder,
        "leave one out" if scene.references is None else str(scene.references),
        f"{summary.localized_count} of {summary.query_count}",
        f"{format_length(summary.median_translation, True)} / {format_rotation(summary.median_rotation_deg)}",
        _figures(scene.target),
        "-" if quick else reached,
        _figures(scene.with_map),
        f"{summary.latency_p50_ms:.0f}",
    ]


def _other_row(evaluation: Evaluation) -> list[str]:
    summary = summarize(evaluation.results)
    return [
        evaluation.dataset.name,
        f"{summary.localized_count} of {summary.query_count}",
        f"{format_length(summary.median_translation, evaluation.dataset.metric)} / "
        f"{format_rotation(summary.median_rotation_deg)}",
        format_share(summary.median_translation / evaluation.trajectory_radius),
        format_share(summary.median_relative),
    ]


def _figures(figures: Figures) -> str:
    localized = "" if figures.localized is None else f", {figures.localized} of 40"
    return f"{figures.translation_cm:.2f} cm / {figures.rotation_deg:.3f}°{localized}"


def _latency_lines(latency: Latency) -> list[str]:
    first, warm, cold = _milliseconds(latency.first_pass), _milliseconds(latency.warm), latency.cold_ms
    rows = [
        ("every photograph for the first time", f"{quantile(first, 0.5):.0f}", f"{quantile(first, 0.95):.0f}"),
        ("the same again (warm)", f"{quantile(warm, 0.5):.0f}", f"{quantile(warm, 0.95):.0f}"),
        (f"first call of a fresh server (cold), median of {len(cold)}", f"{quantile(cold, 0.5):.0f}", ""),
    ]
    lines = [
        f"Localize on {KITCHEN}, {REFERENCE_COUNT} stored references, K = 10, one call at a time:",
        "",
        *markdown_table(" | p50 ms | p95 ms", rows),
        "",
        f"Time by stage, warm: {format_stages(stage_share(latency.warm))}.",
    ]
    if latency.memory is not None:
        lines.append(
            f"Memory of the server process: peak {latency.memory.peak_mib:.0f} MiB (VmHWM), "
            f"{latency.memory.resident_mib:.0f} MiB at the end."
        )
    return [*lines, ""]


def _latency_json(latency: Latency) -> dict[str, Any]:
    return {
        "scene": KITCHEN,
        "references": REFERENCE_COUNT,
        "k": 10,
        "cold_ms": list(latency.cold_ms),
        "first_pass_ms": _milliseconds(latency.first_pass),
        "warm_ms": _milliseconds(latency.warm),
        "warm_p50_ms": quantile(_milliseconds(latency.warm), 0.5),
        "warm_p95_ms": quantile(_milliseconds(latency.warm), 0.95),
        "stage_share": stage_share(latency.warm),
        "memory_mib": None if latency.memory is None else vars(latency.memory),
    }


def _milliseconds(results: Sequence[QueryResult]) -> list[float]:
    return [result.latency_ms for result in results]
