"""The rooms of the server are a ladder: an import goes downward, and nowhere in a circle."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = {
    "mapless": "client",
    "mapless_server": "server",
    "mapless_tools": "server",
    "mapless_ray": "deploy/ray",
    "bench": "server",
    "research": "server",
}
LADDER = (
    "serve",
    "services",
    "rpc",
    "observability",
    "engine",
    "scenes",
    "store",
    "security",
    "method",
    "networks",
    "images",
    "kernels",
    "scheduling",
)
"""The rooms of mapless_server, the highest first; each may import those after it."""
LOOSE = ("__init__", "__main__", "bounds", "cache", "choices", "errors", "extras", "settings")
"""Modules of mapless_server outside its rooms, which import no room; but `__main__`, which starts the process."""


def modules_of(package: str) -> dict[str, Path]:
    """Every module of a package that people write, by its dotted name."""
    base = ROOT / SOURCES[package]
    paths = [path for path in (base / package).rglob("*.py") if "_pb2" not in path.name]
    return {".".join(path.relative_to(base).with_suffix("").parts).removesuffix(".__init__"): path for path in paths}


class Import(NamedTuple):
    """A statement that imports, and whether it is in a function, and for type checkers only."""

    node: ast.Import | ast.ImportFrom
    is_deferred: bool = False
    is_for_types: bool = False


@cache
def statements_of(path: Path) -> tuple[Import, ...]:
    """The imports of a module; without the rest of its tree, which is large."""
    return tuple(_statements(ast.parse(path.read_text())))


def _statements(node: ast.AST, is_deferred: bool = False, is_for_types: bool = False) -> Iterator[Import]:
    for part in ("body", "orelse", "finalbody", "handlers", "cases"):
        for child in getattr(node, part, ()):
            if isinstance(child, ast.Import | ast.ImportFrom):
                yield Import(child, is_deferred, is_for_types)
                continue
            is_function = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef)
            is_typing = isinstance(child, ast.If) and getattr(child.test, "id", "") == "TYPE_CHECKING"
            yield from _statements(child, is_deferred or is_function, is_for_types or is_typing)


def imports_of(
    module: str, path: Path, known: dict[str, Path], *, deferred: bool, typing: bool = True
) -> Iterator[str]:
    """The modules of `known` that a module imports; those in functions if `deferred`, for type checkers if `typing`."""
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    for node, is_deferred, is_for_types in statements_of(path):
        if (is_deferred and not deferred) or (is_for_types and not typing):
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in known)
        else:
            parts = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*parts, *([node.module] if node.module else [])])
            for alias in node.names:
                name = f"{base}.{alias.name}"
                if name in known or base in known:
                    yield name if name in known else base


@cache
def all_imports(*, deferred: bool) -> dict[str, set[str]]:
    """The imports of each module; a package's own modules count as imported by those that import the package."""
    known = {name: path for package in SOURCES for name, path in modules_of(package).items()}
    return {name: set(imports_of(name, path, known, deferred=deferred)) - {name} for name, path in known.items()}


def graph(*packages: str, deferred: bool) -> dict[str, set[str]]:
    """The imports among the modules of some packages."""
    found = all_imports(deferred=deferred)
    known = {name for name in found if name.partition(".")[0] in packages}
    return {name: found[name] & known for name in known}


def room_of(module: str) -> str:
    """`mapless_server.method.coarse.grids` is in the room `method`."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else "__init__"


def test_rooms_are_those_of_the_ladder() -> None:
    folder = ROOT / "server" / "mapless_server"
    assert {path.name for path in folder.iterdir() if (path / "__init__.py").exists()} == set(LADDER)
    assert {path.stem for path in folder.glob("*.py")} <= set(LOOSE)


def test_imports_between_rooms_go_downward() -> None:
    upward = [
        f"{module} imports {other}"
        for module, others in graph("mapless_server", deferred=True).items()
        for other in others
        if room_of(other) in LADDER
        and (
            room_of(module) in set(LOOSE) - {"__main__"}
            or (room_of(module) in LADDER and LADDER.index(room_of(module)) > LADDER.index(room_of(other)))
        )
    ]
    assert not upward


@pytest.mark.parametrize(
    ("below", "above"),
    [
        (("mapless", "mapless_server"), ("mapless_tools", "mapless_ray", "bench", "research")),
        (("mapless_tools", "mapless_ray"), ("bench", "research")),  # which are not installed
        (("bench",), ("research",)),
    ],
)
def test_what_is_below_imports_nothing_above(below: tuple[str, ...], above: tuple[str, ...]) -> None:
    upward = [
        f"{module} imports {other}"
        for module, others in graph(*below, *above, deferred=True).items()
        for other in others
        if module.partition(".")[0] in below and other.partition(".")[0] in above
    ]
    assert not upward


def test_no_module_is_in_a_circle_of_imports() -> None:
    TopologicalSorter(graph(*SOURCES, deferred=True)).prepare()


def test_no_room_inside_method_is_in_a_circle() -> None:
    """Nor the packages inside a room, taken as a whole."""
    parts: dict[str, set[str]] = {}
    for module, others in graph("mapless_server", deferred=False).items():
        if room_of(module) == "method":
            part = ".".join(module.split(".")[:3])
            parts.setdefault(part, set()).update(
                ".".join(other.split(".")[:3]) for other in others if room_of(other) == "method"
            )
    TopologicalSorter({part: others - {part, "mapless_server.method"} for part, others in parts.items()}).prepare()


def test_the_list_of_the_method_is_complete_and_in_order() -> None:
    """Order of a room's modules by its docstring; one on the same line may import the one before it."""
    known = modules_of("mapless_server")
    text = ast.get_docstring(ast.parse(known["mapless_server.method"].read_text())) or ""
    listed = [name for line in re.findall(r"^([a-z_, /]+?)  ", text, re.MULTILINE) for name in re.findall(r"\w+", line)]
    upward = []
    for module, others in graph("mapless_server", deferred=False).items():
        if module.startswith("mapless_server.method."):
            own = module.split(".")[2]
            parts = {other.split(".")[2] for other in others if other.startswith("mapless_server.method.")} - {own}
            upward += [f"{own} imports {part}" for part in parts if listed.index(part) > listed.index(own)]
    assert {module.split(".")[2] for module in known if module.startswith("mapless_server.method.")} == set(listed)
    assert upward == []


def packages_of(room: str) -> set[str]:
    """The imports of a room's modules from outside mapless: the first two parts of each name."""
    names: set[str] = set()
    for path in (ROOT / "server" / "mapless_server" / room).rglob("*.py"):
        for node, _, _ in statements_of(path):
            if isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
            elif node.module and not node.level:
                names.add(node.module)
    return {".".join(name.split(".")[:2]) for name in names}


@pytest.mark.parametrize("room", LADDER[LADDER.index("engine") :])
def test_rooms_below_rpc_know_neither_grpc_nor_messages(room: str) -> None:
    if room != "security":  # which reads the certificates of connections
        known = packages_of(room)
        assert not {name for name in known if name.split(".")[0] in ("grpc", "google", "grpc_status")}
        assert not known & {"mapless.v1", "mapless.wire"}


def test_the_queue_needs_nothing_but_the_standard_library() -> None:
    assert {name.split(".")[0] for name in packages_of("scheduling")} <= sys.stdlib_module_names | {"mapless_server"}


def test_services_load_little_of_what_computes() -> None:
    """All that loading the services loads: the most that their reader has to know."""
    known = {name: path for package in SOURCES for name, path in modules_of(package).items()}
    loaded, waiting = set[str](), [name for name in known if name.startswith("mapless_server.services")]
    while waiting:
        name = waiting.pop()
        if name not in loaded:
            loaded.add(name)
            waiting += imports_of(name, known[name], known, deferred=False, typing=False)
    server = [known[name] for name in loaded if name.startswith("mapless_server")]
    assert len(server) <= 112
    assert sum(len(path.read_text().splitlines()) for path in server) <= 18_800
