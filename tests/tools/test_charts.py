"""Charts: failures are seen, and colours fit any page."""

import math
from xml.etree import ElementTree

import numpy as np

from mapless_tools.charts import INK, figure_of, inline_svg, new_axes, plot, use_logarithms


def test_a_failure_is_a_cross_and_breaks_the_curve() -> None:
    axes = new_axes("a < b", "query", "translation error, cm")
    plot(axes, "best & all", range(5), [1.0, 2.0, math.inf, 1.0, 1.0])
    curve, crosses = axes.lines
    assert np.isnan(np.asarray(curve.get_ydata(), float)).tolist() == [False, False, True, False, False]
    assert (np.asarray(crosses.get_xdata()).tolist(), crosses.get_marker()) == ([2.0], "x")
    svg = ElementTree.fromstring(inline_svg(figure_of(axes)))
    assert {"a < b", "query", "translation error, cm", "best & all"} <= set(svg.itertext())


def test_a_chart_has_the_colour_of_the_page_around_it() -> None:
    svg = inline_svg(figure_of(new_axes("title", "x", "y")))
    assert INK not in svg
    assert "currentColor" in svg
    assert svg == inline_svg(figure_of(new_axes("title", "x", "y"))), "the same chart is the same text"


def test_logarithmic_scales_have_plain_numbers() -> None:
    axes = new_axes("title", "x", "y")
    use_logarithms(axes.yaxis)
    plot(axes, "curve", [0, 1], [0.03, 40.0])
    texts = set(ElementTree.fromstring(inline_svg(figure_of(axes))).itertext())
    assert {"0.1", "1", "10", "0.05", "0.5", "20"} <= texts
