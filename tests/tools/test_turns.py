"""Two servers by turns: what is reported of their times."""

import numpy as np
import pytest
import typer

from mapless_tools.bench.turns import Measured, main, ratio_with_interval, report


def test_a_planted_ratio_lies_in_its_interval() -> None:
    random = np.random.default_rng(1)
    before = random.uniform(0.1, 0.3, 40)
    ratio, low, high = ratio_with_interval(np.stack([before, 0.8 * before * random.normal(1, 0.05, 40)], axis=1))
    assert low < 0.8 < high
    assert low < ratio < high
    assert high - low < 0.05


def test_a_rejected_photograph_counts_for_the_time_alone() -> None:
    times = np.array([[0.2, 0.2], [0.1, 0.1]])
    lines = report([Measured(times, times, 1e-9), Measured(times, times, None)], ("a", "b"))
    assert "| processor time | 200.0 | 100.0 | 0.500 | 0.500 to 0.500 |" in lines
    assert lines[-1] == "Localized by both: 1, at most 1e-09 (unit of the scene) apart."


def test_without_a_commit_nothing_is_measured(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(typer.Exit):
        main("")
    assert "BEFORE=commit" in capsys.readouterr().err
