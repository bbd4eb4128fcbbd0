"""The reference that is generated from the code is complete, and the site builds from it."""

import importlib
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from prometheus_client import generate_latest
from support.documents import ROOT

from mapless.errors import _BY_CODE
from mapless_server.observability.metrics import Metrics
from mapless_server.scheduling import Refusal
from mapless_server.settings import Settings

DOCS = ROOT / "docs"
PAGES = sorted(it for it in DOCS.rglob("*.md") if "<!-- generated:" in it.read_text())


@pytest.fixture(scope="module")
def generators() -> Iterator[Any]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(DOCS)
        yield importlib.import_module("reference").GENERATORS


def first_cells(table: str) -> list[str]:
    return re.findall(r"^\| `(\w+)`", table, re.MULTILINE)


def test_every_marker_has_a_generator_and_is_used_once(generators: Any) -> None:
    text = "".join(page.read_text() for page in DOCS.rglob("*.md"))
    assert sorted(re.findall(r"<!-- generated: (\S+) -->", text)) == sorted(generators)


@pytest.mark.parametrize("path", PAGES, ids=[it.name for it in PAGES])
def test_a_committed_page_is_as_the_code_is(generators: Any, path: Path) -> None:
    if "generated: client-commands" in path.read_text() and sys.version_info[:2] != (3, 11):
        pytest.skip("the text of help differs between versions of Python")
    text = path.read_text()
    assert importlib.import_module("reference").current(text) == text, "make reference"


def test_settings_are_complete_with_flag_and_variable(generators: Any) -> None:
    table = generators["settings"]()
    assert first_cells(table) == list(Settings.model_fields)
    for name in Settings.model_fields:
        assert f"`MAPLESS_{name.upper()}`" in table
        assert (f"`--{name.replace('_', '-')}`" in table) == (name != "database_url")


def test_errors_and_reasons_are_complete(generators: Any) -> None:
    assert first_cells(generators["errors"]()) == list(_BY_CODE)
    reasons = first_cells(generators["reasons"]())
    assert {"IMAGE_TRUNCATED", "STORE_FULL", "MALFORMED_ANSWER", *(refusal.name for refusal in Refusal)} <= {*reasons}
    assert len(reasons) == len({*reasons}) >= 30


def test_metrics_are_those_of_a_scrape(generators: Any) -> None:
    scraped = re.findall(r"^# TYPE (\w+) ", generate_latest(Metrics().registry).decode(), re.MULTILINE)
    assert sorted(first_cells(generators["metrics"]())) == sorted(scraped)


def test_commands_are_complete(generators: Any) -> None:
    shown = generators["server-commands"]() + generators["client-commands"]()
    for command in ("mapless-server serve", "mapless-server weights fetch", "mapless localize", "mapless scene update"):
        assert re.search(rf"^#+ `{command}`$", shown, re.MULTILINE)
    assert "--max-queued-s" in shown
    assert "--progressive" in shown


@pytest.mark.parametrize("stem", ["geometry", "localization_service", "reference_service"])
def test_the_interface_is_complete_with_its_comments(generators: Any, stem: str) -> None:
    page = generators[stem.replace("_", "-")]()
    proto = (ROOT / f"proto/mapless/v1/{stem}.proto").read_text()
    for name in re.findall(r"^(?:service|message|enum|  rpc) +(\w+)", proto, re.MULTILINE):
        assert re.search(rf"^#+ {name}$", page, re.MULTILINE), name
    fields = re.findall(r"^ +(?!//|rpc)(?:map<.*> |[\w.]+ )*(\w+) = \d+;", proto, re.MULTILINE)
    assert sorted(fields) == sorted(first_cells(page))
    words = set(re.findall(r"\w{8,}", "".join(re.findall(r"//(?! buf:).*", proto))))
    assert {word for word in words if word not in page} == set()


@pytest.mark.nightly  # CI runs "make docs", which is as strict
def test_the_site_builds_strictly(tmp_path: Path) -> None:
    pytest.importorskip("material", reason="mkdocs-material is not installed: make docs")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site")]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert built.returncode == 0, built.stderr
    assert "MAPLESS_MAX_QUEUED_S" in (tmp_path / "site/reference/settings/index.html").read_text()
    for page in (tmp_path / "site").rglob("index.html"):
        text = re.sub(r"<pre.*?</pre>", "", page.read_text(), flags=re.DOTALL)
        assert not re.search(r"^(- |\* |```|\| )", text, re.MULTILINE), f"{page}: Markdown that is not understood"
