"""What the report draws: cumulative errors, errors against sparsity, the ablation, errors along a sequence."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from .averages import Average, Group
from .metrics import QueryResult, Summary
from .paper import DENSE
from .protocol import Method, setting_name
from .svg import Axis, Chart, Curve, log_range

SMALLEST_CM, SMALLEST_DEG = 0.01, 0.001
"""Errors below are not told apart: no ground truth is that good."""
RIVALS = ("ACE", "ACE + GS-CPR", "L3")
"""Of the paper's figure of sparsity."""
MAX_POINTS = 400
"""Of a curve along a sequence; beyond, each point is the worst of several queries."""

Pick = Callable[[Summary | Average], float]
_MEASURES: tuple[tuple[str, Callable[[QueryResult], float], float], ...] = (
    ("translation error, cm", lambda result: 100 * result.translation_error, SMALLEST_CM),
    ("rotation error, °", lambda result: result.rotation_error_deg, SMALLEST_DEG),
)


def cumulative(group: Group) -> list[Chart]:
    """For the densest and the sparsest setting: the share of all scenes' queries with at most an error."""
    charts = []
    for setting in dict.fromkeys((group.settings[0], group.settings[-1])):
        pools = {method: _pooled(group, setting, method) for method in group.methods}
        for label, error, smallest in _MEASURES:
            values = [error(result) for results in pools.values() for result in results]
            if values:
                low, high = log_range(values, smallest)
                curves = tuple(
                    Curve(method.label, _shares([error(r) for r in results], low, high))
                    for method, results in pools.items()
                    if results
                )
                title = f"{setting_name(setting)}: queries within an error"
                charts.append(Chart(title, Axis(label, low, high, True), Axis("queries, %", 0, 100), curves))
    return charts


def sparsity(group: Group) -> list[Chart]:
    """Median error averaged over scenes against the number of references, with the paper's curves."""
    if len(group.settings) < 2:
        return []
    methods = [method for method in group.methods if method.scale == group.methods[0].scale]
    charts = []
    for part, (label, _, smallest) in enumerate(_MEASURES):
        curves = _by_setting(group, methods, part, lambda method: method.label)
        for paper in group.benchmark.paper.methods if group.benchmark else ():
            if paper.name in RIVALS:
                medians = [(i, paper.average.get(s, (math.nan, math.nan))) for i, s in enumerate(group.settings)]
                points = [(float(i), math.inf if m is None else float(m[part])) for i, m in medians]
                known = tuple((x, y) for x, y in points if not math.isnan(y))
                curves.append(Curve(f"{paper.name} (paper)", known, from_paper=True, marked=True))
        charts.append(
            _against_settings(
                group, f"Sparsity: mean of the scenes' median {label.split(',')[0]}", label, curves, smallest
            )
        )
    return charts


def ablation(group: Group) -> list[Chart]:
    """The same for the strategies of the scale."""
    last = group.methods[-1].variant
    methods = [method for method in group.methods if method.variant == last]
    if len(group.settings) < 2 or len(methods) < 2:
        return []
    charts = []
    for part, (label, _, smallest) in enumerate(_MEASURES):
        curves = _by_setting(group, methods, part, lambda method: method.scale)
        charts.append(
            _against_settings(group, f"Scale, variant {last}: {label.split(',')[0]}", label, curves, smallest)
        )
    return charts


def along_sequence(group: Group, scene: str) -> list[Chart]:
    """Errors of the first method, query after query, for the densest and the sparsest setting."""
    method = group.methods[0]
    settings = dict.fromkeys((group.settings[0], group.settings[-1]))
    runs = {setting: group.runs.get((scene, setting, method)) for setting in settings}
    charts = []
    for label, error, smallest in _MEASURES:
        errors = {setting: [error(r) for r in run.results] for setting, run in runs.items() if run is not None}
        if errors:
            low, high = log_range([value for values in errors.values() for value in values], smallest)
            curves = tuple(Curve(setting_name(setting), _worst(values)) for setting, values in errors.items())
            longest = max(map(len, errors.values()))
            x = Axis("query, in the order of the sequence" + _binned(longest), 0, max(longest - 1, 1))
            charts.append(Chart(f"{scene}, {method.label}", x, Axis(label, low, high, True), curves))
    return charts


def _pooled(group: Group, setting: int, method: Method) -> list[QueryResult]:
    keys = [(scene, setting, method) for scene in group.scenes]
    return [result for key in keys if key in group.runs for result in group.runs[key].results]


def _shares(errors: Sequence[float], low: float, high: float, steps: int = 120) -> tuple[tuple[float, float], ...]:
    """Per cent of the errors at or below each of some values; what is infinite never counts."""
    levels = [low * (high / low) ** (i / steps) for i in range(steps + 1)]
    return tuple((level, 100 * sum(error <= level for error in errors) / len(errors)) for level in levels)


def _by_setting(group: Group, methods: Sequence[Method], part: int, name: Callable[[Method], str]) -> list[Curve]:
    curves = []
    for method in methods:
        averages = [(float(i), group.average(setting, method)) for i, setting in enumerate(group.settings)]
        points = tuple(
            (x, 100 * it.median_translation_m if part == 0 else it.median_rotation_deg) for x, it in averages if it
        )
        if points:
            curves.append(Curve(name(method), points, marked=True))
    return curves


def _against_settings(group: Group, title: str, label: str, curves: Sequence[Curve], smallest: float) -> Chart:
    low, high = log_range([y for curve in curves for _, y in curve.points], smallest)
    names = tuple("all" if setting == DENSE else str(setting) for setting in group.settings)
    x = Axis("references of the scene", -0.3, len(names) - 0.7, names=names)
    return Chart(title, x, Axis(label, low, high, True), tuple(curves))


def _stride(count: int) -> int:
    return max(1, math.ceil(count / MAX_POINTS))


def _binned(count: int) -> str:
    return "" if _stride(count) == 1 else f"; the worst of each {_stride(count)}"


def _worst(values: Sequence[float]) -> tuple[tuple[float, float], ...]:
    stride = _stride(len(values))
    return tuple((float(i), max(values[i : i + stride])) for i in range(0, len(values), stride))
