"""The report of an evaluation for people (tables) and for programs (JSON)."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from rich.console import Console
from rich.table import Table

from mapless_server import __version__
from mapless_server.scenes.retrieval.ranking import APART_M, NEARBY_WEIGHT
from mapless_tools.output_files import finite

from .metrics import QueryResult, Summary, summarize
from .run import Evaluation
from .rungs import RIGHT_DEG, RIGHT_M, RIGHT_SHARE, Rung, largest_error, rungs_of, wrong_count

CHOICE_RULES = {
    False: f"References of a query: those with the most feature matches; within {APART_M:g} m of one chosen "
    f"before, matches count {NEARBY_WEIGHT:g}. Its true pose is not looked at.",
    True: "References of a query: those that the server chooses. Radii are those without the scene's calibration.",
}
"""How references are chosen, by whether a stored scene was measured."""
RULES = (
    "Medians, p90 and recall are over all queries; one that was rejected counts as infinitely wrong.",
    "Latency: time of one Localize call as the client sees it, one after the other, on this machine; choosing the "
    "references is not in it, nor is the first call in p50 and p95.",
    f"A localized query is wrong that is off by more than {RIGHT_M:g} m or {RIGHT_DEG:g} degrees; where the unit is "
    f"arbitrary, by more than {100 * RIGHT_SHARE:g} % of the radius of the references' trajectory, or as many degrees.",
)
SCALE_FREE = (
    "Where a folder's unit of length is arbitrary, errors are in it, and the method's own thresholds, in metres, "
    "do not mean what they say: compare the relative errors only."
)


def to_json(evaluation: Evaluation) -> dict[str, Any]:
    """Everything as JSON values; infinite and unknown ones are null."""
    dataset, options = evaluation.dataset, evaluation.options
    summary = summarize(evaluation.results)
    metric = dataset.metric
    return {
        "scene": dataset.name,
        "metric": metric,
        "ground_truth": dataset.source,
        "stored_scene": evaluation.scene_id or None,
        "split": _split(evaluation),
        "references": evaluation.reference_count,
        "k": options.k,
        "variant": options.variant,
        "scale": options.scale_strategy,
        "backend": evaluation.results[0].backend,
        "features": next(iter(summary.features)) if len(summary.features) == 1 else dict(summary.features),
        "version": __version__,
        "queries": summary.query_count,
        "localized": summary.localized_count,
        "wrong": wrong_count(evaluation.results, _largest_error(evaluation)),
        "median_translation_m": finite(summary.median_translation) if metric else None,
        "median_rotation_deg": finite(summary.median_rotation_deg),
        "p90_translation_m": finite(summary.p90_translation) if metric else None,
        "recall": dict(summary.recall) if metric else dict.fromkeys(summary.recall),
        "relative": _relative(evaluation, summary),
        "claimed_68_held": summary.claim_held,
        "claimed_95_held": summary.claim_95_held,
        "latency_ms": {"p50": summary.latency_p50_ms, "p95": summary.latency_p95_ms, "first": summary.latency_first_ms},
        "processor_ms": {
            "mean": summary.processor_ms,
            "localized": summary.processor_localized_ms,
            "rejected": summary.processor_rejected_ms,
        },
        "stage_share": dict(summary.stage_share),
        "rejections": dict(summary.rejections),
        "rungs": [asdict(it) for it in rungs_of(evaluation.results, _largest_error(evaluation))],
        "rules": list(_rules(evaluation)),
        "per_query": [_query(result, metric) for result in evaluation.results],
    }


def print_report(evaluation: Evaluation, console: Console) -> None:
    """Prints the table, what was rejected, and the rules of the figures."""
    dataset, options = evaluation.dataset, evaluation.options
    summary = summarize(evaluation.results)
    split = "leave one out" if _split(evaluation) == "leave_one_out" else f"{evaluation.reference_count} references"
    if evaluation.scene_id:
        split = f"scene {evaluation.scene_id}, {split}"
    table = Table("", "", title=f"{dataset.name}: {split}, K = {options.k}", show_header=False, title_justify="left")
    for name, value in {
        "localized": f"{summary.localized_count} of {summary.query_count}, "
        f"{wrong_count(evaluation.results, _largest_error(evaluation))} of them wrong",
        **_accuracy_rows(evaluation, summary),
        "latency": f"p50 {summary.latency_p50_ms:.0f} ms, p95 {summary.latency_p95_ms:.0f} ms, "
        f"first call {summary.latency_first_ms:.0f} ms",
        "processor time": _processor_time(summary),
        "time by stage": format_stages(summary.stage_share),
        "rejected": ", ".join(f"{count} {reason}" for reason, count in summary.rejections.items()) or "none",
        "method": f"{options.variant}, scale {options.scale_strategy}; {evaluation.results[0].backend}, "
        f"{_format_features(summary.features)}; mapless {__version__}",
        "ground truth": dataset.source or "not named",
    }.items():
        table.add_row(name, value)
    console.print(table, highlight=False, markup=False)
    rungs = rungs_of(evaluation.results, _largest_error(evaluation))
    if rungs:
        console.print(_rungs_table(rungs), highlight=False, markup=False)
    for rejected in (r for r in evaluation.results if not r.localized):
        console.print(f"  {rejected.name}: {rejected.rejection}: {rejected.message}", highlight=False, markup=False)
    for rule in _rules(evaluation):
        console.print(rule, highlight=False, markup=False)


RUNG_HEAD = ("attempt", "tried", "answered", "rescued", "wrong", "processor s")
RUNG_NOTES = (
    "Tried: photographs on which the attempt was made; answered: whose answer came from it; of these rescued: those "
    "localized right although no pose was accepted before; wrong: photographs that are localized wrongly since this "
    "attempt, the answer before which was right, or none.",
)


def rung_cells(rung: Rung) -> tuple[str, ...]:
    """A line of the table of attempts."""
    return rung.rung, *map(str, (rung.tried, rung.answered, rung.rescued, rung.wrong)), f"{rung.processor_s:.1f}"


def _rungs_table(rungs: Sequence[Rung]) -> Table:
    table = Table(*RUNG_HEAD, title="Attempts", caption=" ".join(RUNG_NOTES), title_justify="left")
    for rung in rungs:
        table.add_row(*rung_cells(rung))
    return table


def _split(evaluation: Evaluation) -> str:
    if evaluation.scene_id:
        return "stored_scene"
    return "leave_one_out" if evaluation.options.reference_count is None else "references_and_queries"


def _rules(evaluation: Evaluation) -> tuple[str, ...]:
    first, *others = RULES
    scale_free = () if evaluation.dataset.metric else (SCALE_FREE,)
    return first, CHOICE_RULES[bool(evaluation.scene_id)], *others, *scale_free


def _largest_error(evaluation: Evaluation) -> float:
    return largest_error(evaluation.dataset.metric, evaluation.trajectory_radius)


def format_length(value: float, metric: bool) -> str:
    """A length in centimetres, or in the folder's own unit."""
    if math.isinf(value):
        return "infinite"
    return f"{100 * value:.2f} cm" if metric else f"{value:.4g} units"


def format_rotation(degrees: float) -> str:
    """An angle in degrees, with three decimals."""
    return "infinite" if math.isinf(degrees) else f"{degrees:.3f}°"


def format_share(share: float) -> str:
    """A share in per cent, with three decimals."""
    return "infinite" if math.isinf(share) else f"{100 * share:.3f} %"


def format_stages(shares: Mapping[str, float]) -> str:
    """Shares of the time, per cent; the stages of each stronger tier, "aliked-2048-1024px/coarse", are summed."""
    sums: dict[str, float] = {}
    for stage, share in shares.items():
        features, slash, _ = stage.partition("/")
        name = features.split("-")[0] if slash else stage
        sums[name] = sums.get(name, 0.0) + share
    return ", ".join(f"{name} {100 * share:.0f} %" for name, share in sums.items())


def _format_features(counts: Mapping[str, int]) -> str:
    if len(counts) == 1:
        return next(iter(counts))
    return ", ".join(f"{name} {count}" for name, count in counts.items())


def _processor_time(summary: Summary) -> str:
    text = f"{summary.processor_ms:.0f} ms a query, in the mean"
    if summary.processor_localized_ms is not None and summary.processor_rejected_ms is not None:
        text += f"; localized {summary.processor_localized_ms:.0f} ms, rejected {summary.processor_rejected_ms:.0f} ms"
    return text


def _accuracy_rows(evaluation: Evaluation, summary: Summary) -> dict[str, str]:
    metric = evaluation.dataset.metric
    of_radius = summary.median_translation / evaluation.trajectory_radius if evaluation.trajectory_radius else math.inf
    rows = {
        "median translation": format_length(summary.median_translation, metric),
        "median rotation": format_rotation(summary.median_rotation_deg),
        "p90 translation": format_length(summary.p90_translation, metric),
        "median relative translation": f"{format_share(of_radius)} of the references' radius, "
        f"{format_share(summary.median_relative)} of the distance to them",
    }
    if metric:
        rows["recall"] = ", ".join(
            f"{name.replace('_', ' ')} {100 * share:.0f} %" for name, share in summary.recall.items()
        )
    if summary.claim_held is not None and summary.claim_95_held is not None:
        shares = f"{100 * summary.claim_held:.0f} and {100 * summary.claim_95_held:.0f} %"
        rows["claimed 68 and 95 % radii held"] = f"{shares} of localized queries"
    return rows


def _relative(evaluation: Evaluation, summary: Summary) -> dict[str, Any]:
    """Lengths that do not depend on the unit, and those in the folder's unit if it is not the metre."""
    radius = evaluation.trajectory_radius
    relative: dict[str, Any] = {
        "median_translation_of_reference_radius": finite(summary.median_translation / radius) if radius else None,
        "p90_translation_of_reference_radius": finite(summary.p90_translation / radius) if radius else None,
        "median_translation_of_reference_distance": finite(summary.median_relative),
    }
    if not evaluation.dataset.metric:
        relative["median_translation_units"] = finite(summary.median_translation)
        relative["p90_translation_units"] = finite(summary.p90_translation)
    return relative


def _query(result: QueryResult, metric: bool) -> dict[str, Any]:
    unit, claimed = "m" if metric else "units", result.accuracy
    return {
        "name": result.name,
        "localized": result.localized,
        f"translation_{unit}": finite(result.translation_error),
        "rotation_deg": finite(result.rotation_error_deg),
        f"claimed_68_{unit}": claimed.position_68_m if claimed else None,
        f"claimed_95_{unit}": claimed.position_95_m if claimed else None,
        "claimed_68_deg": claimed.rotation_68_deg if claimed else None,
        "claimed_95_deg": claimed.rotation_95_deg if claimed else None,
        "calibration": claimed.calibration if claimed else None,
        "trust": result.trust,
        "intrinsics_checks": [asdict(check) for check in result.intrinsics_checks],
        f"reference_distance_{unit}": result.reference_distance,
        "inliers": result.inlier_count,
        "matches": result.match_count,
        "rejection": None if result.localized else {"reason": result.rejection, "message": result.message},
        "features": result.features,
        "latency_ms": result.latency_ms,
        "processor_ms": result.processor_ms,
        "stage_ms": dict(result.stage_ms),
        "attempts": [asdict(attempt) for attempt in result.attempts],
        "earlier": [asdict(answer) for answer in result.earlier],
        "references": list(result.references),
    }
