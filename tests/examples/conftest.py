"""Makes the examples importable by name."""

from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "client" / "examples"


@pytest.fixture(autouse=True)
def examples(monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.syspath_prepend(str(EXAMPLES))
    return EXAMPLES
