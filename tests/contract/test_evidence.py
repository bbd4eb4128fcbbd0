"""Each page of evidence names a constant and its value in the code, and a program measures it again."""

import importlib
import re
from pathlib import Path

import pytest

from research.evidence.page import PAGES


@pytest.mark.parametrize("path", sorted(PAGES.glob("*.md")), ids=lambda it: it.stem)
def test_a_page_states_the_value_that_the_code_has(path: Path) -> None:
    text = path.read_text()
    stated = re.search(r"^`([\w.]+):([\w.]+)` = `(.+)`$", text, re.MULTILINE)
    assert stated is not None
    found = importlib.import_module(stated[1])
    for part in stated[2].split("."):
        found = getattr(found, part)
    assert repr(found) == stated[3]
    for part in ("Question", "Data", "Command", "Decision"):
        assert f"**{part}.**" in text
