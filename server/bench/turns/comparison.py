"""Figures of two commits, their ratios with intervals, and the table."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapless.geometry import Array
from mapless_tools.output_files import markdown_table

TURNS = (0, 1, 1, 0)
RESAMPLES = 2000


@dataclass(frozen=True, eq=False)
class Figure:
    """A figure of both commits: values (N, 2), of N photographs or turns, before and after."""

    what: str
    unit: str
    values: Array


def figures_of_turns(what: Sequence[tuple[str, str]], found: Sequence[Sequence[Sequence[float]]]) -> list[Figure]:
    """Figures, by names and units, of values found[side][turn][figure]; turns of the same number are compared."""
    values = np.moveaxis(np.array(found, float), 0, 1)
    return [Figure(name, unit, values[:, :, number]) for number, (name, unit) in enumerate(what)]


def table(figures: Sequence[Figure]) -> list[str]:
    """A row for each figure, in Markdown: medians, and the ratio after / before."""
    rows = []
    for it in figures:
        before, after = np.median(it.values, axis=0)
        ratio, low, high = ratio_with_interval(it.values)
        name = f"{it.what}, {it.unit}" if it.unit else it.what
        rows.append((name, f"{before:.4g}", f"{after:.4g}", f"{ratio:.3f}", f"{low:.3f} to {high:.3f}"))
    return markdown_table(" | before | after | ratio | 95 %", rows)


def ratio_with_interval(values: Array) -> tuple[float, float, float]:
    """Geometric mean of after / before of values (N, 2), with its 95 % interval by bootstrap over the rows."""
    logs = np.log(values[:, 1] / values[:, 0])
    drawn = np.random.default_rng(0).integers(len(logs), size=(RESAMPLES, len(logs)))
    low, high = np.quantile(logs[drawn].mean(axis=1), [0.025, 0.975])
    return float(np.exp(logs.mean())), float(np.exp(low)), float(np.exp(high))
