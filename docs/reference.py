"""The parts of the reference that come from the code: settings, errors, metrics, commands and the interface.

Each generator returns Markdown. A page has it between `<!-- generated: NAME -->` and `<!-- end -->`; `make reference`
writes it there again, and a test compares.
"""

import ast
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import typer.cli
from google.protobuf import descriptor_pb2

from mapless import errors as client_errors
from mapless.cli.arguments import make_parser
from mapless.cli.parsing import all_parsers
from mapless_server import errors, settings
from mapless_server.method.ladder import RUNGS
from mapless_server.observability.metrics import Metrics
from mapless_server.scheduling import Refusal
from mapless_tools.cli.app import app

ROOT = Path(__file__).resolve().parents[1]
_DESCRIPTORS: Any = descriptor_pb2  # which is not annotated


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Makes a Markdown table."""
    head = list(head)
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def first_paragraph(documented: Any) -> str:
    """The first paragraph of a docstring, on one line."""
    return " ".join((documented.__doc__ or "").strip().split("\n\n")[0].split())


def ladder_table() -> str:
    """The rungs of the ladder in order."""
    head = ["rung", "changes", "tried on", "needs", "computes again"]
    doubts = {it.name: ", ".join(str(doubt.name) for doubt in it.doubts) for it in RUNGS}
    return table(head, [[it.name, it.changes, doubts[it.name], it.needs, it.cost] for it in RUNGS])


# Settings


def settings_table() -> str:
    """Every setting with its flag, environment variable, type, default, bounds and meaning."""
    commands: Any = typer.main.get_command(app)
    flags = {parameter.name: parameter.opts[0] for parameter in commands.commands["serve"].params}
    rows = []
    for name, field in settings.Settings.model_fields.items():
        flag = f"`{flags[name]}`" if name in flags else "no flag"
        rows.append(
            [
                f"`{name}`",
                f"{flag}<br>`{settings.PREFIX}{name.upper()}`",
                f"`{default}`" if (default := settings.default_text(name)) else "",
                settings.bounds_text(name),
                str(field.description),
            ]
        )
    return table(["setting", "flag, variable", "default", "bounds", "meaning"], rows)


# Errors


def errors_table() -> str:
    """Every status that a call can fail with: when, and the exception of the Python client."""
    by_code = {kind.code: kind for kind in errors.RequestError.__subclasses__()}
    rows = []
    for code, client in client_errors._BY_CODE.items():
        when = first_paragraph(by_code.get(code, client))
        rows.append([f"`{code}`", f"`mapless.errors.{client.__name__}`", when])
    return table(["status", "Python client", "when"], rows)


def reasons_table() -> str:
    """Lists every reason that the sources give to an error, with its messages."""
    found: dict[str, dict[str, None]] = {refusal.name: {} for refusal in Refusal}
    for folder in ("server", "client/mapless"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            for reason, message in _reasons(ast.parse(path.read_text())):
                found.setdefault(reason, {})
                if message:
                    found[reason][message] = None
    rows = [[f"`{reason}`", "<br>".join(messages)] for reason, messages in sorted(found.items())]
    return table(["reason", "message"], rows)


def _reasons(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Reasons and messages of the calls that make an error: `reason=` or, in the decoder, the argument IMAGE_...

    A message may be the variable of this name, which was given its text before.
    """
    texts = [
        it
        for it in ast.walk(tree)
        if isinstance(it, ast.Assign) and isinstance(it.targets[0], ast.Name) and it.targets[0].id == "message"
    ]
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        named = [keyword.value for keyword in node.keywords if keyword.arg == "reason"]
        for value in (*named, *node.args):
            for reason in _strings(value):
                if re.fullmatch(r"[A-Z]+(_[A-Z]+)*" if value in named else r"IMAGE(_[A-Z]+)+", reason):
                    given = [_text_before(it, texts) for it in node.args]
                    yield reason, next((it for it in map(_message, given) if it), "")


def _text_before(value: ast.expr, texts: Sequence[ast.Assign]) -> ast.expr:
    """What the variable `message` was given last before a place of the source; any other expression as it is."""
    if not (isinstance(value, ast.Name) and value.id == "message"):
        return value
    before = [it for it in texts if it.lineno < value.lineno]
    return max(before, key=lambda it: it.lineno).value if before else value


def _strings(value: ast.expr) -> list[str]:
    return [it.value for it in ast.walk(value) if isinstance(it, ast.Constant) and isinstance(it.value, str)]


def _message(value: ast.expr) -> str:
    """The text of a message, with its values as "..."; empty for a name, or if a variable holds the message."""
    if isinstance(value, ast.JoinedStr):
        parts = [str(part.value) if isinstance(part, ast.Constant) else "..." for part in value.values]
        return "".join(parts).replace("<", "&lt;")
    text = value.value if isinstance(value, ast.Constant) else None
    return text if isinstance(text, str) and not text.isupper() else ""


# Metrics


def metrics_table() -> str:
    """Every metric of the server by its name in a scrape."""
    registry = Metrics().registry
    labels = {
        name: list(getattr(collector, "_labelnames", ()))
        for collector, names in registry._collector_to_names.items()
        for name in names
    }
    rows = []
    for metric in registry.collect():
        name = f"{metric.name}_total" if metric.type == "counter" else metric.name
        of = labels.get(metric.name) or list(getattr(metric, "_labelnames", ()))  # of those without samples
        of = of or sorted({label for it in metric.samples for label in it.labels} - {"le"})
        rows.append([f"`{name}`", metric.type, " ".join(f"`{label}`" for label in of), metric.documentation])
    return table(["metric", "type", "labels", "what it measures"], rows)


# Commands


def server_commands() -> str:
    """`mapless-server` and its commands, as Typer documents them."""
    command = typer.main.get_command(app)
    context = typer.Context(command, info_name="mapless-server")
    text = typer.cli.get_docs_for_click(obj=command, ctx=context, name="mapless-server", indent=1)
    return re.sub(r"^#(#*) `", r"##\1 `", text, flags=re.MULTILINE)


def client_commands() -> str:
    """`mapless` and its commands: the help of each."""
    os.environ["COLUMNS"] = "100"  # argparse wraps by it
    return "\n\n".join(
        f"### `{parser.prog}`\n\n```text\n{parser.format_help().rstrip()}\n```" for parser in all_parsers(make_parser())
    )


# The interface

_LABELS = {3: "repeated "}
_TYPES = {1: "double", 2: "float", 3: "int64", 4: "uint64", 5: "int32", 8: "bool", 9: "string", 12: "bytes"}
_MESSAGE, _ENUM = 11, 14


@cache
def _descriptors() -> dict[str, Any]:
    """The files of proto/ with their comments, as buf compiles them."""
    with tempfile.TemporaryDirectory() as folder:
        image = Path(folder) / "image.binpb"
        buf = Path(sys.executable).parent / "buf"
        subprocess.run([buf, "build", "-o", image], cwd=ROOT, check=True)
        found = _DESCRIPTORS.FileDescriptorSet.FromString(image.read_bytes())
    return {Path(file.name).stem: file for file in found.file if file.package == "mapless.v1"}


@cache
def _pages() -> dict[str, str]:
    """The page that documents a message or enum, by its full name."""
    return {
        f".mapless.v1.{it.name}": f"{stem.replace('_', '-')}.md"
        for stem, file in _descriptors().items()
        for it in (*file.message_type, *file.enum_type)
    }


def interface(stem: str) -> str:
    """The services, messages and enums of one file of the interface, with their comments."""
    file = _descriptors()[stem]
    comments = {tuple(it.path): it for it in file.source_code_info.location}
    page = f"{stem.replace('_', '-')}.md"

    def comment(*path: int) -> str:
        located = comments.get(path)
        text = located.leading_comments if located else ""
        return re.sub(r"^ *buf:lint:.*\n?", "", text, flags=re.MULTILINE)

    def block(*path: int) -> str:
        lines = comment(*path).splitlines()
        return "\n".join(line.removeprefix(" ") for line in lines).strip()

    def cell(*path: int) -> str:
        return " ".join(comment(*path).split())

    def apart(*path: int) -> list[str]:
        """Comments before an element that belong to no element: those of the file, or of several elements."""
        located = comments.get(path)
        texts = located.leading_detached_comments if located else ()
        return ["\n".join(line.removeprefix(" ") for line in text.splitlines()) for text in texts]

    parts = []
    for number, service in enumerate(file.service):
        parts += apart(6, number)
        parts.append(f"## {service.name}\n\n{block(6, number)}")
        for position, method in enumerate(service.method):
            streams = "stream " if method.server_streaming else ""
            asked, answered = _link(method.input_type, page), _link(method.output_type, page)
            parts.append(f"### {method.name}\n\n{asked} → {streams}{answered}\n\n{block(6, number, 2, position)}")
    if file.service:
        parts.append("## Messages")
    for number, message in enumerate(file.message_type):
        fields = [
            [f"`{field.name}`", str(field.number), _type(message, field, page), cell(4, number, 2, position)]
            for position, field in enumerate(message.field)
        ]
        body = table(["field", "number", "type", "meaning"], fields) if fields else ""
        parts += apart(4, number)
        parts.append(f"### {message.name}\n\n{block(4, number)}\n\n{body}")
    for number, enum in enumerate(file.enum_type):
        values = [
            [f"`{value.name}`", str(value.number), cell(5, number, 2, position)]
            for position, value in enumerate(enum.value)
        ]
        parts += apart(5, number)
        parts.append(f"### {enum.name}\n\n{block(5, number)}\n\n{table(['value', 'number', 'meaning'], values)}")
    return "\n\n".join(part.strip() for part in parts)


def _type(message: Any, field: Any, page: str) -> str:
    entry = next((it for it in message.nested_type if it.options.map_entry and field.type_name.endswith(it.name)), None)
    if entry is not None:
        key, value = (_type(entry, it, page) for it in entry.field)
        return f"map of {key} to {value}"
    name = _link(field.type_name, page) if field.type in (_MESSAGE, _ENUM) else _TYPES[field.type]
    if field.proto3_optional:
        return f"optional {name}"
    oneof = f", one of `{message.oneof_decl[field.oneof_index].name}`" if field.HasField("oneof_index") else ""
    return f"{_LABELS.get(field.label, '')}{name}{oneof}"


def _link(name: str, page: str) -> str:
    """A link to where a message is documented."""
    there, short = _pages().get(name), name.rpartition(".")[2]
    if there is None:
        return f"`{name.removeprefix('.')}`"
    return f"[{short}]({'' if there == page else there}#{short.lower()})"


GENERATORS: dict[str, Callable[[], str]] = {
    "settings": settings_table,
    "ladder": ladder_table,
    "errors": errors_table,
    "reasons": reasons_table,
    "metrics": metrics_table,
    "server-commands": server_commands,
    "client-commands": client_commands,
    "geometry": partial(interface, "geometry"),
    "localization-service": partial(interface, "localization_service"),
    "reference-service": partial(interface, "reference_service"),
}

_GENERATED = re.compile(r"^(<!-- generated: (\S+) -->\n).*?^(<!-- end -->)$", re.MULTILINE | re.DOTALL)


def current(page: str) -> str:
    """A page's text with its generated parts made again."""
    return _GENERATED.sub(lambda found: f"{found[1]}\n{GENERATORS[found[2]]()}\n\n{found[3]}", page)


def main() -> None:
    """Writes the generated parts of all pages again."""
    for path in sorted((ROOT / "docs").rglob("*.md")):
        text = path.read_text(encoding="utf-8")
        if (again := current(text)) != text:
            path.write_text(again, encoding="utf-8")
            print(path.relative_to(ROOT))


if __name__ == "__main__":
    main()
