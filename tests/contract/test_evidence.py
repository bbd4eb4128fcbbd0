"""Pages of evidence name constants, `module:NAME` = `value`, with the values that the code has."""

import importlib
import re
from pathlib import Path

import pytest

from research.evidence.page import PAGES

STATED = re.compile(r"`([\w.]+):([\w.]+)` = `([^`]+)`")


INDEX = PAGES / "index.md"
EVIDENCE = sorted({*PAGES.glob("*.md")} - {INDEX})


def test_the_index_and_the_site_have_every_page() -> None:
    names = [path.name for path in EVIDENCE]
    assert sorted(re.findall(r"\]\(([\w-]+\.md)\) \|", INDEX.read_text())) == names
    site = (PAGES.parents[1] / "mkdocs.yml").read_text()
    assert sorted(re.findall(r": evidence/([\w-]+\.md)", site)) == names


@pytest.mark.parametrize("path", EVIDENCE, ids=lambda it: it.stem)
def test_a_page_states_the_values_that_the_code_has(path: Path) -> None:
    text = path.read_text()
    stated = STATED.findall(text)
    assert stated
    for module, name, value in stated:
        found = importlib.import_module(module)
        for part in name.split("."):
            found = getattr(found, part)
        assert repr(found) == value
    assert "**Question.**" in text
    assert "**Data.**" in text
