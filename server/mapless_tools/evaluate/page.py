"""The report as one HTML file, and what its figures are of, for the terminal too."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from mapless_tools.charts import inline_svg
from mapless_tools.pages import render

from .averages import Group, groups_of
from .charts import ablation, along_sequence, cumulative, sparsity
from .figures import RULES
from .pictures import EPIPOLAR_PX, WorstQuery
from .suite import SceneWork, Suite
from .tables import tables_of, text_lines


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
    """The tables, and what the figures come from, for the terminal."""
    for group in groups_of(suite):
        for table in (table for table in tables_of(group) if not table.wide):
            print(f"\n{group.title}. {table.title}")
            print("\n".join((*text_lines(table), *table.notes)))
    print()
    for name, value in facts(suite).items():
        print(f"{name}: {value}")
    print("\n".join(problems(suite)))


def facts(suite: Suite) -> dict[str, str]:
    """What the figures come from and what was left out, name by name."""
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
    """What is missing or was decided for the reader, a sentence each."""
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
    """Each ground truth once, with its scenes, beside the one of the paper's figures."""
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
