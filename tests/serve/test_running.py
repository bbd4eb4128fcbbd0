"""The parts of a running server that settings switch."""

from pathlib import Path

import pytest
from support.servers import serving

from mapless_server.scenes.background import BackgroundMatching


def test_a_setting_switches_matching_in_the_background(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[bool] = []
    monkeypatch.setattr(BackgroundMatching, "start", lambda _, makes_pairs: started.append(makes_pairs))
    for is_on in (True, False):
        with serving(tmp_path, background_matching=is_on):
            pass
    assert started == [True, False]
