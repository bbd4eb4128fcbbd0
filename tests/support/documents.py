"""The pages of the documentation, and the code blocks in them."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = (
    *(ROOT / name for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md")),
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted((ROOT / "deploy").rglob("*.md")),
    ROOT / "client/unity/README.md",
    ROOT / "server/research/README.md",
)
_FENCE = re.compile(r"^( *)```(\w*)[^\n]*\n(.*?)^\1```$", re.MULTILINE | re.DOTALL)


def written(page: Path) -> str:
    """A page's text without the parts that are generated from the code."""
    return re.sub(r"^<!-- generated: .*?^<!-- end -->$", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)


def blocks(page: Path, language: str) -> list[str]:
    """The fenced blocks of a page in one language."""
    return [
        re.sub(f"^{indent}", "", text, flags=re.MULTILINE)
        for indent, of, text in _FENCE.findall(page.read_text())
        if of == language
    ]


def shell(page: Path) -> str:
    """All that a page shows for a shell, fenced or indented; a line that goes on in the next is one."""
    indented = re.findall(r"^ {4}(.*)$", _FENCE.sub("", page.read_text()), re.MULTILINE)
    return "\n".join([*blocks(page, "sh"), *indented]).replace("\\\n", " ")


def commands(program: str, before: str = "") -> Iterator[tuple[Path, list[str]]]:
    """The arguments of every line that runs a program, perhaps after variables, or after another program."""
    for page in PAGES:
        for line in re.findall(rf"^(?:{before})?(?:[A-Z_]+=\S+ )*(?:\S+/)?{program} (.*)$", shell(page), re.MULTILINE):
            for part in line.split(" && "):
                words = shlex.split(re.sub(r"[>|].*", "", part).removeprefix(f"{program} "), comments=True)
                yield page, [re.sub(r"^\[(\w+)\]$", r"\1", word) for word in words]


def prose(page: Path) -> str:
    """A page without its blocks of code."""
    return _FENCE.sub("", page.read_text())


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings."""
    headings = re.findall(r"^#+ (.*)$", prose(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading).strip().lower().replace(" ", "-") for heading in headings}
