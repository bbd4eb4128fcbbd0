"""Constants of the code name pages of evidence, and these name the constants, with the values that the code has."""

import ast
import importlib
import operator
import re
from collections.abc import Iterator
from datetime import date
from functools import cache
from pathlib import Path

import pytest

from mapless_server.networks.weights import WeightsMissing
from research.evidence.__main__ import DATA, KEYS, main, measurement_of
from research.evidence.page import PAGES, Measurement, Row, rewritten

CODE = PAGES.parents[1] / "server"
STATED = re.compile(r"^`([\w.]+):([\w.]+)` = `([^`]+)`$", re.MULTILINE)
NAMED = re.compile(r"Evidence: ([a-z][\w-]*(?:, [a-z][\w-]*)*)\.")
DIGEST = r"(?!0{8})[0-9a-f]{8}"
HAS_ROW = re.compile(r"^\|(?: ?-+ ?\|)+\n\|.*\d", re.MULTILINE)
INDEX = PAGES / "index.md"
EVIDENCE = sorted({*PAGES.glob("*.md")} - {INDEX})


@cache
def keys_of(module: Path) -> set[str]:
    """The keys that a module's docstrings name."""
    return {key for found in NAMED.findall(re.sub(r"\s+", " ", module.read_text())) for key in found.split(", ")}


def test_the_index_and_the_site_have_every_page() -> None:
    names = [path.name for path in EVIDENCE]
    assert sorted(re.findall(r"\]\(([\w-]+\.md)\) \|", INDEX.read_text())) == names
    site = (PAGES.parents[1] / "mkdocs.yml").read_text()
    assert sorted(re.findall(r": evidence/([\w-]+\.md)", site)) == names


def test_every_key_in_the_code_has_a_page() -> None:
    named = {key for path in (CODE / "mapless_server").rglob("*.py") for key in keys_of(path)}
    assert not named - {path.stem for path in EVIDENCE}


@pytest.mark.parametrize("path", EVIDENCE, ids=lambda it: it.stem)
def test_a_page_states_the_values_that_the_code_has(path: Path) -> None:
    text = path.read_text()
    stated = STATED.findall(text)
    assert text.splitlines()[2].startswith(f"`{stated[0][0]}:")
    for module, name, value in stated:
        found = importlib.import_module(module)
        assert found.__file__ is not None
        assert path.stem in keys_of(Path(found.__file__)), f"{module} does not name the page"
        assert repr(operator.attrgetter(name)(found)) == value
    parts = ("**Question.**", "**Data.**", "**Command.**", "**Decision.**")
    assert [text.count(it) for it in parts] == [1, 1, 1, 1]


def defaults_of(module: Path) -> set[str]:
    """The names in default values of a module's functions, which are read when it is imported."""
    found = [it for it in ast.walk(ast.parse(module.read_text())) if isinstance(it, ast.arguments)]
    values = [value for it in found for value in (*it.defaults, *it.kw_defaults) if value is not None]
    return {name.id for value in values for name in ast.walk(value) if isinstance(name, ast.Name)}


def test_a_program_that_changes_a_constant_changes_what_is_used() -> None:
    """A default value would keep the one in use while others are measured."""
    for path in EVIDENCE:
        for module, name, _ in STATED.findall(path.read_text()):
            file = importlib.import_module(module).__file__
            assert file is not None
            assert name not in defaults_of(Path(file)), f"{path.stem}: {name} is a default value in {module}"


def is_measured(key: str, text: str) -> bool:
    """Whether a page has its program's command, of a commit, and a row after it; else it names another one."""
    (command,) = re.findall(r"^\*\*Command\.\*\* (.*(?:\n.+)*)", text, re.MULTILINE)
    options = r"(?: DATA=\S+)?(?: ARGS='--sample \d+')?"
    if re.match(rf"`make evidence KEY={key}{options}`, \d{{4}}-\d\d-\d\d, {DIGEST}", command):
        assert HAS_ROW.search(text, text.index(command)), f"{key}: its table has no rows"
        return True
    assert re.match(rf"none: measured at {DIGEST}|`[^`]*python -m bench[\w.]* ", command), key
    return False


def test_every_page_is_measured_by_a_program_or_says_it_is_not() -> None:
    assert {path.stem for path in EVIDENCE if is_measured(path.stem, path.read_text())} == set(KEYS)
    assert all(measurement_of(key).rows for key in KEYS)


@pytest.mark.parametrize(("digest", "row"), [("0" * 8, "| 1 |\n"), ("be589da6", "")])
def test_a_page_without_a_commit_or_rows_is_not_measured(digest: str, row: str) -> None:
    text = f"**Command.** `make evidence KEY=k`, 2026-11-29, {{}}.\n\n| a |\n| --- |\n{row}\n**Decision.** 1.\n"
    assert is_measured("k", text.format("be589da6").replace("\n\n**", "\n| 2 |\n\n**"))
    with pytest.raises(AssertionError, match=r"^k"):
        is_measured("k", text.format(digest))


@cache
def constant(key: str) -> object:
    """The first constant of a page."""
    module, name, _ = STATED.findall((PAGES / f"{key}.md").read_text())[0]
    return operator.attrgetter(name)(importlib.import_module(module))


@pytest.mark.nightly(every_tenth=True)
@pytest.mark.timeout(900)
def test_a_key_measured_again_decides_for_the_value_in_use(request: pytest.FixtureRequest) -> None:
    """One of those that take at most a minute, by the day or by --tenth."""
    quick = [key for key in KEYS if measurement_of(key).decide is not None]
    tenth = request.config.getoption("--tenth")
    key = quick[(date.today().toordinal() if tenth is None else tenth) % len(quick)]
    measurement = measurement_of(key)
    if measurement.needs_scenes and next(DATA.glob("*/cameras.json"), None) is None:
        pytest.skip(f"needs real photographs, {DATA} is absent")
    assert measurement.decide is not None
    try:
        rows = list(measurement.rows(DATA))
    except WeightsMissing as error:
        pytest.skip(str(error))
    assert measurement.decide(rows) == constant(key), f"{key}: {rows}"


PAGE = """# k

`m:N` = `1`

**Question.** What?

**Command.** `old`,
of yesterday.

| a |
| --- |
| 1 |

**Decision.** 1.
"""


def test_a_page_keeps_its_text_and_gets_a_new_table() -> None:
    text = rewritten(PAGE, "k", [{"b": 2}, {"b": 3}])
    assert text.replace(re.findall(r"\*\*Command.*", text)[0], "") == PAGE.replace(
        "**Command.** `old`,\nof yesterday.", ""
    ).replace("| a |\n| --- |\n| 1 |", "| b |\n| --- |\n| 2 |\n| 3 |")
    assert rewritten(text, "k", [{"b": 2}, {"b": 3}]) == text
    with pytest.raises(ValueError, match="no line"):
        rewritten("# k", "k", [{"b": 2}])


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["no-such-key"], "invalid choice"),
        (["accusation-chance", "--nothing"], "unrecognized arguments"),
        (["same-place", "--sample", "0"], "must be at least 1, is 0"),
        (["same-place", "OTHER", "--sample", "1"], "none of the scenes"),
        (["accusation-chance", "EMPTY"], "has no scenes"),
        (["accusation-chance", "EMPTY/absent"], "has no scenes"),
        (["same-place", "OTHER"], "none of the scenes"),
        (["rungs", "OTHER"], "none of the scenes"),
        (["stationary-support", "OTHER"], "kitti-drive-a"),
    ],
)
def test_wrong_usage_ends_with_2_and_leaves_the_page(
    arguments: list[str],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "other/place/images").mkdir(parents=True)
    (tmp_path / "other/place/cameras.json").write_text('{"frames": [], "metric": true}')
    (tmp_path / "empty").mkdir()
    pages = tmp_path / "pages"
    pages.mkdir()
    for key in KEYS:
        (pages / f"{key}.md").write_text(PAGE)
    monkeypatch.setattr("research.evidence.__main__.PAGES", pages)
    folders = {"EMPTY": str(tmp_path / "empty"), "OTHER": str(tmp_path / "other")}
    given = [re.sub("EMPTY|OTHER", lambda it: folders[it.group()], it) for it in arguments]
    monkeypatch.setattr("sys.argv", ["evidence", *given])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    assert said in capsys.readouterr().err
    assert {it.read_text() for it in pages.iterdir()} == {PAGE}


@pytest.mark.parametrize("is_complete", [True, False])
def test_only_a_complete_table_is_written(
    is_complete: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / f"{KEYS[0]}.md"
    page.write_text(PAGE)

    def rows(folder: Path) -> Iterator[Row]:
        yield {"a": 41}
        assert page.read_text() == PAGE
        if not is_complete:
            raise ValueError("the disk is full")

    monkeypatch.setattr("research.evidence.__main__.PAGES", tmp_path)
    monkeypatch.setattr("research.evidence.__main__.measurement_of", lambda key: Measurement(rows, needs_scenes=False))
    monkeypatch.setattr("sys.argv", ["evidence", KEYS[0]])
    if is_complete:
        main()
        assert "| 41 |" in page.read_text()
    else:
        with pytest.raises(SystemExit):
            main()
        assert page.read_text() == PAGE
        assert "the disk is full" in capsys.readouterr().err
