"""Progress without a terminal: a line when a step begins, and some more on its way."""

import pytest

from mapless_tools.progress import LINES, progress_bars


def test_lines_are_few_however_long_a_step_is(capsys: pytest.CaptureFixture[str]) -> None:
    with progress_bars() as progress:
        for done in range(1001):
            progress("storing", done, 1000)
        progress("checking", 0, 3)
    out, err = capsys.readouterr()
    lines = err.splitlines()
    assert out == ""
    assert lines[0] == "storing: 0 of 1000"
    assert lines[LINES] == "storing: 1000 of 1000"
    assert lines[LINES + 1 :] == ["checking: 0 of 3"]


def test_lines_say_how_much_is_done_a_second(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with progress_bars() as progress:
        monkeypatch.setattr("mapless_tools.progress.time.monotonic", lambda: 10.0)
        progress("storing", 0, 40)
        monkeypatch.setattr("mapless_tools.progress.time.monotonic", lambda: 14.0)
        progress("storing", 30, 40)
    assert capsys.readouterr().err.splitlines() == ["storing: 0 of 40", "storing: 30 of 40, 7.5 a second"]
