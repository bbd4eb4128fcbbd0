"""The report as one HTML file with charts; also the facts about its figures, for the terminal, too."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from mapless_tools.charts import figure_of, inline_svg, new_axes, plot, use_logarithms
from mapless_tools.output_files import render, text_table

from .benchmarks import DENSE
from .figures import RULES
from .metrics import QueryResult
from .pictures import EPIPOLAR_PX, WorstQuery
from .plan import Method, setting_name
from .suite import SceneWork, Suite
from .tables import Average, Group, groups_of, tables_of


def page(suite: Suite, worst: Sequence[WorstQuery]) -> str:
    """The report of a suite, with pictures of the worst queries."""
    groups = groups_of(suite)
    return render(
        "evaluation.html",
        title=f"Evaluation of mapless: {', '.join(group.title for group in groups)}",
        provenance=facts(suite),
        problems=problems(suite),
        groups=[_group(group, [it for it in worst if it.run.scene.place.layout == group.layout]) for group in groups],
        rules=RULES,
        epipolar_px=f"{EPIPOLAR_PX:g}",
    )


def _group(group: Group, worst: Sequence[WorstQuery]) -> dict[str, object]:
    return {
        "title": group.title,
        "tables": tables_of(group),
        "charts": map(inline_svg, (*sparsity(group), *cumulative(group), *ablation(group))),
        "sequences": [inline_svg(it) for scene in group.scenes for it in along_sequence(group, scene)],
        "worst": worst,
    }


def print_suite(suite: Suite) -> None:
    """Prints the tables, and the origin of the figures."""
    for group in groups_of(suite):
        for table in (table for table in tables_of(group) if not table.wide):
            print(f"\n{group.title}. {table.title}")
            lines = text_table([table.head, *(row.cells for row in table.rows)])
            print("\n".join((*lines, *table.notes)))
    print()
    for name, value in facts(suite).items():
        print(f"{name}: {value}")
    print("\n".join(problems(suite)))


def facts(suite: Suite) -> dict[str, str]:
    """The origin of the figures and what was left out, by name."""
    made, options = suite.provenance, suite.options
    choice = f"the pairs of {suite.pairs}" if suite.pairs is not None else options.choice
    return {
        "commit": f"{made.commit}, version {made.version}" if made.commit else f"version {made.version}",
        "weights": ", ".join(f"{name} sha256 {digest}" for name, digest in made.weights.items())
        or "none: no network is used",
        "settings": ", ".join(f"{name} {value}" for name, value in made.settings.items()),
        "method": f"variants {', '.join(options.variants)}; scale {', '.join(options.scales)}",
        "references of a query": f"K = {options.k}, chosen by: {choice}",
        "ground truth": "; ".join(_ground_truths(suite.scenes)),
        "subsampled": "; ".join(_subsampled(suite)) or "nothing: all references of the split, all queries",
        "machine": made.machine,
        "date": made.date,
    }


def problems(suite: Suite) -> list[str]:
    """Missing parts, and choices that were made, a sentence each."""
    lines = [f"{failure.scene} is not complete: {failure.message}" for failure in suite.failures]
    for scene in suite.scenes:
        refused = scene.dataset.refused
        if refused:
            lines.append(
                f"{scene.place.name}: {len(refused)} frames cannot be used, the first: {refused[0].frame}: "
                f"{refused[0].reason}"
            )
        lines += [f"{scene.place.name}: {note}" for note in scene.dataset.notes]
    return lines


def _ground_truths(scenes: Iterable[SceneWork]) -> list[str]:
    """Each ground truth once, with its scenes, compared with that of the paper's figures."""
    by_truth: dict[tuple[str, str], list[str]] = {}
    for scene in scenes:
        benchmark = scene.place.benchmark
        truth = scene.dataset.ground_truth or scene.dataset.source or "not named by its files"
        by_truth.setdefault((truth, benchmark.ground_truth if benchmark else ""), []).append(scene.place.name)
    return [
        f"{', '.join(names)}: {truth}" + (f" (the paper's figures: {papers})" if papers else "")
        for (truth, papers), names in by_truth.items()
    ]


def _subsampled(suite: Suite) -> list[str]:
    left_out = []
    if suite.options.stride > 1:
        left_out.append(f"dense: every {suite.options.stride}. training frame is a reference")
    for scene in suite.scenes:
        split = scene.splits[0]
        if len(split.queries) < split.test_count:
            left_out.append(f"{scene.place.name}: {len(split.queries)} of {split.test_count} queries, evenly spread")
    return left_out


RIVALS = ("ACE", "ACE + GS-CPR", "L3")
"""Methods in the paper's figure of sparsity."""
MAX_POINTS = 400
"""Most points of a curve along a sequence; beyond, each point is the worst of several queries."""


@dataclass(frozen=True)
class Measure:
    """An error that is shown in charts: of a query, and the mean over scenes of its median.

    Values smaller than `smallest` are drawn as this one, since no ground truth is so accurate. `paper_index` is the
    index of the value in the paper's medians.
    """

    name: str
    unit: str
    of_query: Callable[[QueryResult], float]
    of_average: Callable[[Average], float]
    smallest: float
    paper_index: int

    @property
    def label(self) -> str:
        """Label of an axis."""
        return f"{self.name}, {self.unit}"


MEASURES = (
    Measure(
        "translation error",
        "cm",
        lambda it: 100 * it.translation_error,
        lambda it: 100 * it.median_translation,
        0.01,
        0,
    ),
    Measure("rotation error", "°", lambda it: it.rotation_error_deg, lambda it: it.median_rotation_deg, 0.001, 1),
)


def cumulative(group: Group) -> list[Figure]:
    """For the densest and the sparsest setting: the share of all scenes' queries with at most an error."""
    figures = []
    for setting in dict.fromkeys((group.settings[0], group.settings[-1])):
        pools = {
            method.label: [it for scene in group.scenes for it in group.results(scene, setting, method)]
            for method in group.methods
        }
        for measure in MEASURES if any(pools.values()) else ():
            axes = new_axes(f"{setting_name(setting)}: queries within an error", measure.label, "queries, %")
            axes.set_ylim(0, 100)
            use_logarithms(axes.xaxis)
            for label, results in pools.items():
                errors = np.sort([max(measure.of_query(it), measure.smallest) for it in results])
                localized = errors[np.isfinite(errors)]
                axes.step(localized, 100 * np.arange(1, len(localized) + 1) / len(errors), where="post", label=label)
            figures.append(figure_of(axes))
    return figures


def sparsity(group: Group) -> list[Figure]:
    """Median error averaged over scenes against the number of references, with the paper's curves."""
    if len(group.settings) < 2:
        return []
    methods = {method.label: method for method in group.methods if method.scale == group.methods[0].scale}
    figures = []
    for measure in MEASURES:
        axes = _against_settings(group, measure, f"Sparsity: mean of the scenes' median {measure.name}", methods)
        for paper in group.benchmark.methods if group.benchmark else ():
            known = {i: paper.average[s] for i, s in enumerate(group.settings) if s in paper.average}
            if paper.name in RIVALS and known:
                medians = [math.inf if it is None else it[measure.paper_index] for it in known.values()]
                plot(axes, f"{paper.name} (paper)", list(known), medians, marker="o", dotted=True)
        figures.append(figure_of(axes))
    return figures


def ablation(group: Group) -> list[Figure]:
    """The same for the strategies of the scale."""
    last = group.methods[-1].variant
    methods = {method.scale: method for method in group.methods if method.variant == last}
    if len(group.settings) < 2 or len(methods) < 2:
        return []
    return [
        figure_of(_against_settings(group, measure, f"Scale, variant {last}: {measure.name}", methods))
        for measure in MEASURES
    ]


def along_sequence(group: Group, scene: str) -> list[Figure]:
    """Errors of the first method along the sequence of queries, for the densest and the sparsest setting."""
    method = group.methods[0]
    settings = dict.fromkeys((group.settings[0], group.settings[-1]))
    runs = {s: results for s in settings if (results := group.results(scene, s, method))}
    figures = []
    for measure in MEASURES if runs else ():
        stride = max(1, math.ceil(max(map(len, runs.values())) / MAX_POINTS))
        thinned = f"; the worst of each {stride}" if stride > 1 else ""
        x_label = f"query, in the order of the sequence{thinned}"
        axes = new_axes(f"{scene}, {method.label}", x_label, measure.label)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        use_logarithms(axes.yaxis)
        for setting, results in runs.items():
            errors = [max(measure.of_query(it), measure.smallest) for it in results]
            starts = range(0, len(errors), stride)
            plot(axes, setting_name(setting), starts, [max(errors[i : i + stride]) for i in starts])
        figures.append(figure_of(axes))
    return figures


def _against_settings(group: Group, measure: Measure, title: str, methods: dict[str, Method]) -> Axes:
    """Draws a curve for each method, by its label: the mean of the medians, over the settings."""
    axes = new_axes(title, "references of the scene", measure.label)
    use_logarithms(axes.yaxis)
    names = ["all" if setting == DENSE else str(setting) for setting in group.settings]
    axes.set_xticks(range(len(names)), names)
    for label, method in methods.items():
        averages = {i: group.average(setting, method) for i, setting in enumerate(group.settings)}
        known = {i: max(measure.of_average(it), measure.smallest) for i, it in averages.items() if it is not None}
        if known:
            plot(axes, label, list(known), list(known.values()), marker="o")
    return axes
