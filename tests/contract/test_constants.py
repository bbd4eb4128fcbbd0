"""Tuned numbers of the method: few, and each says what it is for.

Counted are the names of module constants that have a number, defaults of options, and numbers inside functions. Not
counted inside functions: 0, 1, 2 and 0.5; numbers of coordinates and parameters (3 and 6, and all in subscripts and in
the shapes of arrays); changes of unit; and bounds of rounding errors, up to 1e-6.
"""

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

METHOD = Path(__file__).parents[2] / "server/mapless_server/method"
MOST = 396
"""Numbers: what needs one more removes another. The goal is 170."""
PLAIN = {0, 1, 2, 0.5}
COORDINATES = {3, 6}
"""Numbers of coordinates of a point, and of a pose."""
UNITS = {100, 1000, 60, 90, 180, 360, 255, 1024}
ROUNDING = 1e-6
SHAPES = {
    "zeros",
    "ones",
    "empty",
    "full",
    "eye",
    "reshape",
    "broadcast_to",
    "arange",
    "range",
    "identity",
    "triu_indices",
}
Function = ast.FunctionDef | ast.AsyncFunctionDef


class Number(NamedTuple):
    """A tuned number: its file and line, its name (that of the function for one inside it), and what it is for."""

    where: str
    name: str
    purpose: str


def numbers_in(node: ast.AST) -> list[ast.Constant]:
    return [it for it in ast.walk(node) if isinstance(it, ast.Constant) and type(it.value) in (int, float)]


def tuned_in(node: ast.AST) -> list[ast.Constant]:
    """Its numbers without those that count coordinates, parameters or dimensions."""
    sizes = {id(number) for it in ast.walk(node) for part in sizes_of(it) for number in numbers_in(part)}
    return [it for it in numbers_in(node) if id(it) not in sizes]


def docstring_after(body: list[ast.stmt], i: int) -> str:
    """That of the statement, or of the last one of those without an empty line between them."""
    while i + 1 < len(body) and assigned(body[i + 1]) and body[i + 1].lineno == (body[i].end_lineno or 0) + 1:
        i += 1
    following = body[i + 1] if i + 1 < len(body) else None
    found = following.value if isinstance(following, ast.Expr) else None
    return found.value if isinstance(found, ast.Constant) and isinstance(found.value, str) else ""


def assigned(statement: ast.stmt) -> tuple[list[str], ast.expr] | None:
    """The names that a statement assigns a value with a number to."""
    if not isinstance(statement, ast.Assign | ast.AnnAssign) or statement.value is None:
        return None
    target = statement.target if isinstance(statement, ast.AnnAssign) else statement.targets[0]
    names = [it.id for it in ast.walk(target) if isinstance(it, ast.Name)]
    return (names, statement.value) if tuned_in(statement.value) else None


def constants(tree: ast.Module, where: str) -> Iterator[Number]:
    for i, statement in enumerate(tree.body):
        if found := assigned(statement):
            names, value = found
            parts = value.elts if isinstance(value, ast.Tuple) else []
            numbers = [bool(numbers_in(it)) for it in parts] if len(parts) == len(names) else [True] * len(names)
            for name, has_number in zip(names, numbers, strict=True):
                if has_number:
                    yield Number(f"{where}:{statement.lineno}", name, docstring_after(tree.body, i))


def options(tree: ast.Module, where: str) -> Iterator[Number]:
    for owner in ast.walk(tree):
        if not isinstance(owner, ast.ClassDef) or not owner.name.endswith("Options"):
            continue
        text = ast.get_docstring(owner) or ""
        for i, statement in enumerate(owner.body):
            if found := assigned(statement):
                purpose = docstring_after(owner.body, i) or (text if f"{found[0][0]}" in text else "")
                yield Number(f"{where}:{statement.lineno}", f"{owner.name}.{found[0][0]}", purpose)


def literals(tree: ast.Module, where: str) -> Iterator[Number]:
    functions = [it for it in ast.walk(tree) if isinstance(it, Function)]
    inner = {id(it) for outer in functions for it in ast.walk(outer) if isinstance(it, Function) and it is not outer}
    for function in (it for it in functions if id(it) not in inner):
        for number in tuned_in(function):
            value = number.value
            assert isinstance(value, int | float)
            if value not in PLAIN | COORDINATES | UNITS and abs(value) > ROUNDING:
                yield Number(f"{where}:{number.lineno}", f"{function.name}: {value}", "")


def sizes_of(node: ast.AST) -> Iterator[ast.AST]:
    """Parts of an expression whose numbers count coordinates, parameters or dimensions."""
    if isinstance(node, ast.Subscript):
        yield node.slice
    elif isinstance(node, ast.Call):
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if name in SHAPES:
            yield from (*node.args, *node.keywords)
    elif isinstance(node, ast.Compare) and any(word in ast.dump(node) for word in ("'shape'", "'ndim'")):
        yield node


def counted(folder: Path = METHOD) -> list[Number]:
    found = list[Number]()
    for path in sorted(folder.rglob("*.py")):
        tree, where = ast.parse(path.read_text()), str(path.relative_to(folder))
        found += [*constants(tree, where), *options(tree, where), *literals(tree, where)]
    return found


def test_the_method_has_few_tuned_numbers() -> None:
    found = counted()
    assert len(found) <= MOST, f"{len(found)} numbers: {[(it.where, it.name) for it in found]}"


def test_constants_and_options_say_what_they_are_for() -> None:
    assert not [it for it in counted() if not it.purpose and ":" not in it.name]


def test_what_counts_as_a_tuned_number(tmp_path: Path) -> None:
    (tmp_path / "planted.py").write_text(
        "A, B = 3.0, x\n'''Two.'''\nC: int = 5\nD = name\n"
        "class Options:\n    '''Attributes: e: one.'''\n    e: float = 0.0\n    f: int = 4\n"
        "def g(a):\n    b = np.zeros((7, 7)) + a[6] * 180\n    return max(b, 1e-9) * 1.5 if a.shape[1] == 4 else 0.5\n"
    )
    found = [(it.name, bool(it.purpose)) for it in counted(tmp_path)]
    assert found == [("A", True), ("C", False), ("Options.e", True), ("Options.f", False), ("g: 1.5", False)]
