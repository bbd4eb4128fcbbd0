"""The report as one HTML file that needs nothing else: tables, charts and pictures are in it, scripts are not."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

from . import svg
from .averages import Group, groups_of
from .charts import ablation, along_sequence, cumulative, sparsity
from .figures import RULES
from .pictures import EPIPOLAR_PX, WorstQuery
from .protocol import setting_name
from .suite import SceneWork, Suite
from .tables import Table, tables_of

_STYLE = (
    """
:root { color-scheme: light dark; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1340px; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.6rem; } h2 { margin-top: 3rem; border-bottom: 1px solid; } h3 { margin: 2rem 0 .3rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 13px; }
th, td { padding: .2rem .6rem; text-align: right; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
thead th { border-bottom: 2px solid; }
tr.ours td:first-child { font-weight: 600; }
td.text { text-align: left; white-space: normal; min-width: 20rem; }
tr.ours td { background: rgba(60, 130, 230, .12); }
tr.paper td { background: rgba(60, 130, 230, .05); }
.charts { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(460px, 100%), 1fr)); gap: 1.2rem; }
.note, figcaption { font-size: 13px; opacity: .8; }
.problem { border-left: 4px solid #c2410c; padding-left: .8rem; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .1rem 1rem; font-size: 14px; }
dt { opacity: .7; } dd { margin: 0; overflow-wrap: anywhere; }
figure { margin: 0; } figure img { max-width: 100%; border: 1px solid rgba(128, 128, 128, .4); }
"""
    + svg.STYLE
)


def page(suite: Suite, worst: Sequence[WorstQuery]) -> str:
    """The report.

    Args:
        suite: what was measured.
        worst: queries to show.
    """
    groups = groups_of(suite)
    titles = ", ".join(group.title for group in groups)
    return "\n".join(
        (
            "<!DOCTYPE html>",
            '<html lang="en"><head><meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>mapless: {escape(titles)}</title><style>{_STYLE}</style></head><body>",
            f"<h1>Evaluation of mapless: {escape(titles)}</h1>",
            *_provenance(suite),
            *_problems(suite),
            *(part for group in groups for part in _group(group, worst)),
            "<h2>How to read it</h2>",
            *(f'<p class="note">{escape(rule)}</p>' for rule in RULES),
            "</body></html>\n",
        )
    )


def told(suite: Suite) -> dict[str, str]:
    """What figures come from and what was left out, name by name."""
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


def _provenance(suite: Suite) -> list[str]:
    rows = (f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>" for name, value in told(suite).items())
    return ["<dl>", *rows, "</dl>"]


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


def _problems(suite: Suite) -> list[str]:
    return [f'<p class="problem">{escape(line)}</p>' for line in problems(suite)]


def _group(group: Group, worst: Sequence[WorstQuery]) -> list[str]:
    charts = [*sparsity(group), *cumulative(group), *ablation(group)]
    sequences = [chart for scene in group.scenes for chart in along_sequence(group, scene)]
    shown = [it for it in worst if it.run.scene.place.layout == group.layout]
    return [
        f"<h2>{escape(group.title)}</h2>",
        *(part for table in tables_of(group) for part in _table(table)),
        '<h3>Errors</h3><div class="charts">',
        *map(svg.draw, charts),
        '</div><h3>Errors along the sequences</h3><p class="note">A cross at the upper edge: not localized.</p>',
        '<div class="charts">',
        *map(svg.draw, sequences),
        "</div>",
        *_worst(shown),
    ]


def _table(table: Table) -> list[str]:
    head = "".join(f"<th>{escape(cell)}</th>" for cell in table.head)
    rows = (f'<tr class="{row.whose}">{"".join(map(_cell, row.cells))}</tr>' for row in table.rows)
    return [
        f'<h3>{escape(table.title)}</h3><div class="wide"><table><thead><tr>{head}</tr></thead><tbody>',
        *rows,
        "</tbody></table></div>",
        *(f'<p class="note">{escape(note)}</p>' for note in table.notes),
    ]


def _cell(text: str) -> str:
    return f'<td class="text">{escape(text)}</td>' if len(text) > 50 else f"<td>{escape(text)}</td>"


def _worst(shown: Sequence[WorstQuery]) -> list[str]:
    if not shown:
        return []
    note = (
        "Left the query, right the reference with the most inliers, or the first one where it was rejected. Lines are "
        f"matches of their features: green within {EPIPOLAR_PX:g} px of where the true poses put them, red elsewhere."
    )
    head = f'<h3>The worst queries</h3><p class="note">{escape(note)}</p><div class="charts">'
    return [head, *map(_figure, shown), "</div>"]


def _figure(it: WorstQuery) -> str:
    place = f"{it.run.scene.place.name}, {setting_name(it.run.split.setting)}, {it.run.method.label}"
    result = it.result
    if result.localized:
        outcome = (
            f"{100 * result.translation_error:.1f} cm, {result.rotation_error_deg:.2f}° off; "
            f"{result.inlier_count} inliers of {result.match_count} matches with all references"
        )
        if result.position_68 is not None:
            outcome += f"; claimed within {100 * result.position_68:.1f} cm (68 %)"
    else:
        outcome = f"not localized, {result.rejection}: {result.message}"
    beside = f"beside {it.reference}: {it.fitting} of {it.matches} matches fit the true poses" if it.reference else ""
    caption = ". ".join(filter(None, (f"{place}: {result.name}", outcome, beside)))
    return (
        f'<figure><img src="{it.data_uri}" alt="{escape(caption, quote=True)}" loading="lazy">'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )
