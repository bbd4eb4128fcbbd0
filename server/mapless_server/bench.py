"""`mapless-server bench`: accuracy on the real scenes against targets and against a map, and what a call costs."""

from __future__ import annotations

import platform
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mapless import Client

from . import __version__
from .child import Memory, child_server
from .dataset import Dataset, read_folder
from .evaluation.command import progress_bars, terminable, usage_errors, write_json
from .evaluation.metrics import QueryResult, Summary, quantile, stage_share, summarize
from .evaluation.plan import EvaluationOptions, Plan, Progress, UsageError
from .evaluation.report import RULES, SCALE_FREE, format_length, format_rotation, format_share, to_json
from .evaluation.run import CONNECT, Evaluation, evaluate, localize_queries, plan_for, upload
from .settings import Settings, available_cores, load_settings

OUTPUT = Path("bench-output/bench.json")


@dataclass(frozen=True)
class Figures:
    """Median errors and how many queries were localized; None for all."""

    translation_cm: float
    rotation_deg: float
    localized: int | None = None


@dataclass(frozen=True)
class BenchScene:
    """A measurement: what is aimed at, and what COLMAP 4.2 reaches with a map built of all references beforehand.

    Attributes:
        references: how many; None leaves one out.
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

QUICK_QUERIES = 6


@dataclass(frozen=True)
class Latency:
    """What calls cost, milliseconds.

    Attributes:
        cold_ms: the first call of each of several fresh servers on a filled store.
        first_pass: calls of one server that meets every query for the first time, the cold one left out.
        warm: the same calls again.
        memory: of that server after them; None where the system does not tell.
    """

    cold_ms: tuple[float, ...]
    first_pass: tuple[QueryResult, ...]
    warm: tuple[QueryResult, ...]
    memory: Memory | None


def bench(data: Path, quick: bool) -> None:
    """Measures all scenes in a folder, prints Markdown and writes `OUTPUT`. Absent scenes are named and passed over.

    Raises:
        UsageError: none of the scenes is there, one is damaged, or a setting is wrong.
        ServerFailed: the server did not start.
        MaplessError: a call failed.
    """
    with usage_errors():
        settings = load_settings({}).settings
    folders = [*dict.fromkeys(scene.folder for scene in SCENES), *OTHER_FOLDERS]
    absent = [folder for folder in folders if not (data / folder / "cameras.json").is_file()]
    if len(absent) == len(folders):
        raise UsageError(f"{data} holds none of the scenes: {', '.join(folders)}")
    query_count = QUICK_QUERIES if quick else None
    OUTPUT.parent.mkdir(exist_ok=True)

    def measure(folder: str, references: int | None) -> Evaluation:
        with usage_errors():
            dataset = read_folder(data / folder)
        options = EvaluationOptions(reference_count=references, query_count=query_count)
        return evaluate(dataset, options, settings, _labelled(progress, dataset, references))

    with terminable(), progress_bars() as progress:
        scenes = [(s, measure(s.folder, s.references)) for s in SCENES if s.folder not in absent]
        others = [measure(folder, None) for folder in OTHER_FOLDERS if folder not in absent]
        latency = None
        if KITCHEN not in absent:
            latency = measure_latency(read_folder(data / KITCHEN), settings, quick, progress)
    machine = f"{cpu_model()}, {available_cores()} cores"
    print("\n".join(markdown(machine, scenes, others, latency, absent, quick)))
    write_json(OUTPUT, as_json(machine, scenes, others, latency, absent, quick))


def measure_latency(dataset: Dataset, settings: Settings, quick: bool, progress: Progress) -> Latency:
    """Localize on 30 stored references, K = 10, one call after the other.

    The servers that are measured did not store the references: what storing needs is not in their memory.
    """
    options = EvaluationOptions(reference_count=30, query_count=QUICK_QUERIES if quick else None)
    labelled = _labelled(progress, dataset, None, "latency")
    plan = plan_for(dataset, options, settings, labelled)
    with tempfile.TemporaryDirectory(prefix="mapless-bench-") as folder:
        data_dir = Path(folder)
        with child_server(data_dir) as server, Client(server.address, CONNECT) as client:
            upload(client, plan, labelled)
        cold = [_first_call_ms(data_dir, plan, options, i) for i in range(1 if quick else 5)]
        with child_server(data_dir) as server, Client(server.address, CONNECT) as client:
            client.is_serving()
            first_pass = localize_queries(client, plan, options, _labelled(progress, dataset, None, "first pass"))
            warm = localize_queries(client, plan, options, _labelled(progress, dataset, None, "warm"))
            memory = server.memory()
    return Latency((*cold, first_pass[0].latency_ms), first_pass[1:], warm, memory)


def _first_call_ms(data_dir: Path, plan: Plan, options: EvaluationOptions, query: int) -> float:
    only = replace(plan, queries=(plan.queries[query % len(plan.queries)],))
    with child_server(data_dir) as server, Client(server.address, CONNECT) as client:
        client.is_serving()  # connects, which is no part of a call
        return localize_queries(client, only, options, lambda *_: None)[0].latency_ms


def cpu_model() -> str:
    """The processor's name, as far as the system tells it."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def met(target: Figures, summary: Summary) -> bool:
    """Whether a scene reaches its target."""
    wanted = summary.query_count if target.localized is None else target.localized
    return (
        100 * summary.median_translation <= target.translation_cm
        and summary.median_rotation_deg <= target.rotation_deg
        and summary.localized_count >= wanted
    )


def markdown(
    machine: str,
    scenes: Sequence[tuple[BenchScene, Evaluation]],
    others: Sequence[Evaluation],
    latency: Latency | None,
    absent: Sequence[str],
    quick: bool,
) -> list[str]:
    """The lines of the report."""
    lines = [f"mapless {__version__}; {machine}.", ""]
    if quick:
        lines += [f"**Quick run: at most {QUICK_QUERIES} queries a scene. Not comparable with the targets.**", ""]
    lines += [f"Not measured, the folder is absent: {folder}." for folder in absent] + [""] * bool(absent)
    lines += [
        "| scene | references | localized | median | target | met | COLMAP 4.2, prebuilt map | p50 ms |",
        "|---|---|---|---|---|---|---|---|",
    ]
    lines += [*(_row(scene, summarize(evaluation.results)) for scene, evaluation in scenes), ""]
    if others:
        lines += [
            "| scene | localized | median | of the references' radius | of the distance to the references |",
            "|---|---|---|---|---|",
            *map(_other_row, others),
            "",
        ]
    if latency is not None:
        lines += _latency_lines(latency)
    return [*lines, *RULES, *([SCALE_FREE] if any(not e.dataset.metric for e in others) else [])]


def as_json(
    machine: str,
    scenes: Sequence[tuple[BenchScene, Evaluation]],
    others: Sequence[Evaluation],
    latency: Latency | None,
    absent: Sequence[str],
    quick: bool,
) -> dict[str, Any]:
    """The same for programs, with every query."""
    return {
        "version": __version__,
        "machine": machine,
        "quick": quick,
        "absent": list(absent),
        "scenes": [
            {
                "target": vars(scene.target),
                "colmap_with_map": vars(scene.with_map),
                "target_met": met(scene.target, summarize(evaluation.results)),
                **to_json(evaluation),
            }
            for scene, evaluation in scenes
        ],
        "others": [to_json(evaluation) for evaluation in others],
        "latency": None if latency is None else _latency_json(latency),
    }


def _row(scene: BenchScene, summary: Summary) -> str:
    cells = [
        scene.folder,
        "leave one out" if scene.references is None else str(scene.references),
        f"{summary.localized_count} of {summary.query_count}",
        f"{format_length(summary.median_translation, True)} / {format_rotation(summary.median_rotation_deg)}",
        _figures(scene.target),
        "yes" if met(scene.target, summary) else "no",
        _figures(scene.with_map),
        f"{summary.latency_p50_ms:.0f}",
    ]
    return f"| {' | '.join(cells)} |"


def _other_row(evaluation: Evaluation) -> str:
    summary = summarize(evaluation.results)
    cells = [
        evaluation.dataset.name,
        f"{summary.localized_count} of {summary.query_count}",
        f"{format_length(summary.median_translation, evaluation.dataset.metric)} / "
        f"{format_rotation(summary.median_rotation_deg)}",
        format_share(summary.median_translation / evaluation.trajectory_radius),
        format_share(summary.median_relative),
    ]
    return f"| {' | '.join(cells)} |"


def _figures(figures: Figures) -> str:
    localized = "" if figures.localized is None else f", {figures.localized} of 40"
    return f"{figures.translation_cm:.2f} cm / {figures.rotation_deg:.3f}°{localized}"


def _latency_lines(latency: Latency) -> list[str]:
    first, warm, cold = _milliseconds(latency.first_pass), _milliseconds(latency.warm), latency.cold_ms
    lines = [
        f"Localize on {KITCHEN}, 30 stored references, K = 10, one call at a time:",
        "",
        "| | p50 ms | p95 ms |",
        "|---|---|---|",
        f"| every photograph for the first time | {quantile(first, 0.5):.0f} | {quantile(first, 0.95):.0f} |",
        f"| the same again (warm) | {quantile(warm, 0.5):.0f} | {quantile(warm, 0.95):.0f} |",
        f"| first call of a fresh server (cold), median of {len(cold)} | {quantile(cold, 0.5):.0f} | |",
        "",
        "Time by stage, warm: "
        + ", ".join(f"{stage} {100 * share:.0f} %" for stage, share in stage_share(latency.warm).items())
        + ".",
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
        "references": 30,
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


def _labelled(
    progress: Progress, dataset: Dataset, references: int | None, label: str = ""
) -> Callable[[str, int, int], None]:
    """The same progress, each step under its scene's name."""
    name = " ".join(filter(None, (dataset.name, str(references or ""), label)))
    return lambda step, done, total: progress(f"{name}: {step}", done, total)
