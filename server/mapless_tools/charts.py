"""The common parts of all charts: axes without pyplot's global state, curves, and figures as SVG or files."""

import io
import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure

COLOURS = ("#2f7bd0", "#d2601f", "#239464", "#bd479c", "#97801c", "#8467d8", "#d24a52", "#748291")
"""Readable on white and on black. Neighbours differ in their dashes, too."""
DASHES = ("-", (0, (6, 2)), (0, (8, 2, 2, 2)), (0, (3, 1.5)))
INK = "#0c0b0d"
"""Colour of text and axes; `inline_svg` replaces it by the colour of the text around the chart."""
_STYLE: dict[Any, Any] = {
    "font.family": ["DejaVu Sans"],  # comes with matplotlib: no font is searched or fetched
    "font.size": 9,
    "svg.fonttype": "none",
    "svg.hashsalt": "mapless",  # the same chart is the same text
    **{f"{part}.color": INK for part in ("text", "xtick", "ytick")},
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.facecolor": "none",
}


def new_axes(title: str, x_label: str, y_label: str) -> Axes:
    """The axes of a new chart; `axes.figure` is the chart."""
    with rc_context(_STYLE):
        axes = Figure(figsize=(6.4, 4.2), layout="constrained").add_subplot()
    return prepared(axes, title, x_label, y_label)


def prepared(axes: Axes, title: str, x_label: str, y_label: str) -> Axes:
    """Prepares axes: titles, a grid, and curves that are distinguishable without colour, too."""
    with rc_context(_STYLE):
        axes.set_title(title, fontweight="bold", loc="left", fontsize=10, parse_math=False)  # a name may have a $
        axes.set_xlabel(x_label)
        axes.set_ylabel(y_label)
        axes.grid(alpha=0.25)
        axes.set_prop_cycle(color=COLOURS, linestyle=(*DASHES, *DASHES))
    return axes


def use_logarithms(*axes: Axis) -> None:
    """Makes scales logarithmic, with plain numbers at their ticks: 0.5, 20."""
    for axis in axes:
        set_scale = axis.axes.set_xscale if axis is axis.axes.xaxis else axis.axes.set_yscale
        set_scale("log")
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(partial(_minor_label, axis))


def _minor_label(axis: Axis, x: float, _: object) -> str:
    """Labels 2 and 5 in each decade; in less than a decade, all ticks."""
    low, high = axis.get_view_interval()
    return f"{x:g}" if high < 10 * low or f"{x:e}"[0] in "25" else ""


def plot(
    axes: Axes, label: str, x: Sequence[float], y: Sequence[float], marker: str = "", dotted: bool = False
) -> None:
    """Draws a curve; infinite values are failures, which interrupt it and are crosses at the upper edge."""
    at, values = np.asarray(x, float), np.asarray(y, float)
    failed = np.isinf(values)
    (line,) = axes.plot(at, np.where(failed, np.nan, values), label=label, marker=marker, markersize=4)
    if dotted:
        line.set(linestyle=":", linewidth=1.2)
    if failed.any():
        (crosses,) = axes.plot(at[failed], np.ones(int(failed.sum())), transform=axes.get_xaxis_transform())
        crosses.set(marker="x", linestyle="none", color=line.get_color(), clip_on=False)


def figure_of(axes: Axes) -> Figure:
    """The chart of finished axes, with a legend below them."""
    figure = axes.figure
    assert isinstance(figure, Figure)
    if axes.get_legend_handles_labels()[0]:
        with rc_context(_STYLE):
            figure.legend(loc="outside lower left", ncols=2, frameon=False, fontsize=8)
    return figure


def inline_svg(figure: Figure) -> str:
    """The chart as an element of an HTML page: text as text, readable on a light and on a dark page."""
    stream = io.StringIO()
    _save(figure, stream)
    svg = re.sub(r'<g id="[^"]*">', "<g>", stream.getvalue())  # no reference, and not unique in a page
    svg = svg[svg.index("<svg") :].replace(INK, "currentColor")
    return re.sub(r'(<svg [^>]*?)width="[^"]*" height="[^"]*"', r'\1class="chart" role="img"', svg, count=1)


def write_figure(figure: Figure, file: Path) -> None:
    """Writes a chart, on white, in the format that the file's suffix names: png or svg."""
    with file.open("wb") as stream:
        _save(figure, stream, facecolor="white", file_format=file.suffix[1:])


def _save(
    figure: Figure, stream: io.StringIO | io.BufferedWriter, facecolor: str = "none", file_format: str = "svg"
) -> None:
    no_metadata = dict.fromkeys(("Creator", "Date", "Format", "Type")) if file_format == "svg" else None
    with rc_context(_STYLE):
        figure.savefig(stream, format=file_format, facecolor=facecolor, metadata=no_metadata, dpi=120)
